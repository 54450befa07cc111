// Moves the vertices of surface nets to the intersection of tangent planes: see dual_contouring_kernels.
#include "volume/isosurface/surface_nets_cases.inl"

// Moves the vertices of a plane's cells to the intersection of the tangent planes at the crossings of their edges.
static constexpr auto sharpen_plane = [](const Cells& cells, const Nets& nets, int plane, const wp::array_t<int>& leaf,
                                         const wp::array_t<double>& tile, const auto& linear, const auto& offset,
                                         wp::array_t<wp::vec3d>& vertex) {
    const int block = cells.crossed.data[plane >> 3], x = plane & 7;
    const u64* record = nets.records.data + (long long)RECORD * plane;
    if (!record[0]) return;
    const wp::vec3i& first = cells.origin.data[block];
    // Reads a voxel of this block or of those around it, relative to the isovalue.
    const float* near[27];
    for (int n = 0; n < 27; ++n) {
        const int at = leaf.data[27ll * (plane >> 3) + n];
        near[n] = at < 0 ? (const float*)0 : (const float*)(cells.values + cells.stride * (u64)at);
    }
    auto value = [&](int i, int j, int k) -> double {
        const int n = 9 * (i >> 3) + 3 * (j >> 3) + (k >> 3) + 13;
        if (!near[n]) return tile.data[27ll * (plane >> 3) + n];
        return (double)near[n][64 * (i & 7) + 8 * (j & 7) + (k & 7)] - cells.isovalue;
    };
    auto size = [](double v) { return v < 0.0 ? -v : v; };
    // The derivative at the middle of five values, to second order, from the side on which they are straighter.
    auto slope = [&](double a, double b, double c, double d, double e) {
        const double lower = c - 2.0 * b + a, upper = e - 2.0 * d + c;
        return size(lower) < size(upper) ? c - b + 0.5 * lower : d - c - 0.5 * upper;
    };
    u64 c[8];
    cell_corners(cells, block, x, inside_plane, c);
    wp::vec3d* out = vertex.data + nets.base.data[plane];
    for (u64 rest = record[0]; rest; rest &= rest - 1) {
        const int bit = (int)first_bit(rest), y = bit >> 3, z = bit & 7;
        const int code = case_of(c, bit);
        const unsigned word = word_of(nets.table, nets.flips, code, plane, bit);
        double f[8], g[8][3];
        bool known[8] = {};
        for (int n = 0; n < 8; ++n) f[n] = value(x + (n >> 2), y + (n >> 1 & 1), z + (n & 1));
        auto find_slopes = [&](int n) {
            if (known[n]) return;
            known[n] = true;
            const int i = x + (n >> 2), j = y + (n >> 1 & 1), k = z + (n & 1);
            g[n][0] = slope(value(i - 2, j, k), value(i - 1, j, k), f[n], value(i + 1, j, k), value(i + 2, j, k));
            g[n][1] = slope(value(i, j - 2, k), value(i, j - 1, k), f[n], value(i, j + 1, k), value(i, j + 2, k));
            g[n][2] = slope(value(i, j, k - 2), value(i, j, k - 1), f[n], value(i, j, k + 1), value(i, j, k + 2));
        };
        for (int loop = 0; loop < loop_count(word); ++loop, ++out) {
            double point[12][3], normal[12][3], mean[3] = {}, middle[3] = {}, steepest = 0.0;
            int count = 0;
            for (int edge = 0; edge < 12; ++edge) {
                const int axis = edge >> 2, step = 4 >> axis;
                const int n = (edge >> 1 & 1) * (axis == 0 ? 2 : 4) + (edge & 1) * (axis == 2 ? 2 : 1), m = n + step;
                if (!((code >> n ^ code >> m) & 1) || (int)(word >> 2 * edge & 3u) != loop) continue;
                find_slopes(n);
                find_slopes(m);
                // Crossings of the edge with the planes of both ends, from the lower end on.
                const double s = g[n][axis], r = g[m][axis];
                const double t = -f[n] / s, u = 1.0 - f[m] / r;
                const bool has_t = t >= 0.0 && t <= 1.0, has_u = u >= 0.0 && u <= 1.0;
                // The maximum of two planes is a convex edge of the body: the surface is where the body is first left.
                const bool is_convex = f[m] - f[n] - s + f[n] - f[m] + r > 0.0;
                const bool from_below = (code >> n & 1) != 0;
                bool lower = has_t && (!has_u || (is_convex == from_below ? t <= u : t >= u));
                double place = lower ? t : u;
                if (!has_t && !has_u) {
                    // Neither crossing fits: the one of surface nets, with the plane of the nearer end.
                    place = f[n] / (f[n] - f[m]);
                    lower = place < 0.5;
                }
                place = place > 0.0 ? (place < 1.0 ? place : 1.0) : 0.0;
                const double* slopes = lower ? g[n] : g[m];
                double length = 0.0;
                for (int k = 0; k < 3; ++k) length += slopes[k] * slopes[k];
                length = wp::sqrt(length);
                const bool has_slope = length > NO_SLOPE * (size(f[n]) + size(f[m])) && length < 1.0e300;
                if (has_slope) steepest = wp::max(steepest, length);
                for (int k = 0; k < 3; ++k) {
                    point[count][k] = k == axis ? place : (double)(n >> (2 - k) & 1);
                    normal[count][k] = has_slope ? slopes[k] / length : 0.0;
                    mean[k] += point[count][k];
                }
                ++count;
            }
            double matrix[3][3] = {}, right[3] = {}, turn[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
            for (int k = 0; k < 3; ++k) mean[k] /= count;
            for (int e = 0; e < count; ++e) {
                double height = 0.0;
                for (int k = 0; k < 3; ++k) height += normal[e][k] * (point[e][k] - mean[k]);
                for (int k = 0; k < 3; ++k) {
                    middle[k] += normal[e][k];
                    right[k] += height * normal[e][k];
                    for (int l = 0; l < 3; ++l) matrix[k][l] += normal[e][k] * normal[e][l];
                }
            }
            double place[3] = {mean[0], mean[1], mean[2]}, share = 0.0;
            for (int k = 0; k < 3; ++k) share += middle[k] * middle[k] / count;
            if (matrix[0][0] + matrix[1][1] + matrix[2][2] - share < FLAT * share) {
                // Normals are so similar that only one direction can be solved for: that of their sum, after one step
                // of the power method.
                double ray[3], stretch = 0.0, along = 0.0;
                for (int k = 0; k < 3; ++k) {
                    ray[k] = matrix[k][0] * middle[0] + matrix[k][1] * middle[1] + matrix[k][2] * middle[2];
                    along += ray[k] * right[k];
                }
                for (int k = 0; k < 3; ++k) {
                    stretch += ray[k] * (matrix[k][0] * ray[0] + matrix[k][1] * ray[1] + matrix[k][2] * ray[2]);
                }
                for (int k = 0; k < 3; ++k) place[k] += ray[k] * along / stretch;
            } else {
                for (int sweep = 0; sweep < SWEEPS; ++sweep) {
                    for (int p = 0; p < 2; ++p)
                        for (int q = p + 1; q < 3; ++q) {
                            if (matrix[p][q] == 0.0) continue;
                            const double theta = 0.5 * (matrix[q][q] - matrix[p][p]) / matrix[p][q];
                            const double sign = theta < 0.0 ? -1.0 : 1.0;
                            const double tangent = sign / (size(theta) + wp::sqrt(theta * theta + 1.0));
                            const double cosine = 1.0 / wp::sqrt(tangent * tangent + 1.0), sine = tangent * cosine;
                            for (int k = 0; k < 3; ++k) {
                                const double v = matrix[k][p], w = matrix[k][q];
                                matrix[k][p] = cosine * v - sine * w;
                                matrix[k][q] = sine * v + cosine * w;
                            }
                            for (int k = 0; k < 3; ++k) {
                                const double v = matrix[p][k], w = matrix[q][k];
                                matrix[p][k] = cosine * v - sine * w;
                                matrix[q][k] = sine * v + cosine * w;
                            }
                            for (int k = 0; k < 3; ++k) {
                                const double v = turn[k][p], w = turn[k][q];
                                turn[k][p] = cosine * v - sine * w;
                                turn[k][q] = sine * v + cosine * w;
                            }
                        }
                }
                const double top = wp::max(matrix[0][0], wp::max(matrix[1][1], matrix[2][2]));
                for (int e = 0; e < 3; ++e) {
                    if (!(matrix[e][e] > FLAT * top)) continue;
                    double along = 0.0;
                    for (int k = 0; k < 3; ++k) along += turn[k][e] * right[k];
                    for (int k = 0; k < 3; ++k) place[k] += turn[k][e] * along / matrix[e][e];
                }
            }
            // If the planes meet outside the cell, the nearest place in the cell may be worse than the start.
            double moved = 0.0, unmoved = 0.0;
            for (int k = 0; k < 3; ++k) place[k] = place[k] > 0.0 ? (place[k] < 1.0 ? place[k] : 1.0) : 0.0;
            for (int e = 0; e < count; ++e) {
                double high = 0.0, low = 0.0;
                for (int k = 0; k < 3; ++k) {
                    high += normal[e][k] * (place[k] - point[e][k]);
                    low += normal[e][k] * (mean[k] - point[e][k]);
                }
                moved += high * high;
                unmoved += low * low;
            }
            double there = 0.0;
            for (int n = 0; n < 8; ++n) {
                double weight = f[n];
                for (int k = 0; k < 3; ++k) weight *= n >> (2 - k) & 1 ? place[k] : 1.0 - place[k];
                there += weight;
            }
            const bool is_far = size(there) > FAR * steepest;
            const int at[3] = {first[0] + x, first[1] + y, first[2] + z};
            double index[3];
            for (int k = 0; k < 3; ++k) {
                if (is_far || unmoved < moved) place[k] = mean[k];
                // A margin at the cell's border keeps vertices of other cells and of other sheets apart. The
                // comparisons turn NaN into a number.
                const double least = END * (1 + loop), low = place[k] > least ? place[k] : least;
                index[k] = (double)at[k] + (low < 1.0 - least ? low : 1.0 - least);
            }
            for (int row = 0; row < 3; ++row) {
                (*out)[row] = linear.data[row][0] * index[0] + linear.data[row][1] * index[1]
                              + linear.data[row][2] * index[2] + offset[row];
            }
        }
    }
};
static constexpr auto sharpen_planes = [](int item, int span, const Cells& cells, const Nets& nets,
                                          const wp::array_t<int>& leaf, const wp::array_t<double>& tile,
                                          const wp::mat33d& linear, const wp::vec3d& offset,
                                          wp::array_t<wp::vec3d>& vertex) {
    for (int plane = span * item; plane < span * (item + 1); ++plane)
        sharpen_plane(cells, nets, plane, leaf, tile, linear, offset, vertex);
};
