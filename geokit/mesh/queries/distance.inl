// The nearest pair of triangles of two surfaces, and the points of theirs that are nearest to each other.
//
// Triangles that do not meet are nearest at a vertex of one and a point of the other, or inside an edge of each.
#include "core/atomic.inl"
#include "core/simd.inl"
#include "mesh/bvh/bvh2.inl"
#include "mesh/triangle/closest.inl"
#include "mesh/triangle/pair.inl"

static constexpr auto vertex_gap = [](const point& p, const point* u, point& y) {
    const point ab = u[1] - u[0], ac = u[2] - u[0];
    double v, w;
    const double squared = closest_on_triangle(p - u[0], ab, ac, v, w);
    y = u[0] + v * ab + w * ac;
    return squared;
};
// The segments p + s d and q + r e. Their inner minimum from cross products: of nearly parallel segments the first
// solution has few correct digits, and its correction gives the rest. Ends are vertices, and those are tested anyway.
static constexpr auto edge_gap = [](const point& p, const point& d, const point& q, const point& e, double& s,
                                    double& r) {
    auto share = [](double part, double whole) { return part <= 0.0 ? 0.0 : part >= whole ? 1.0 : part / whole; };
    const point n = wp::cross(d, e);
    const double nn = wp::dot(n, n);
    if (!(nn > 0.0)) return (double)INFINITY;
    const point apart = p - q;
    s = r = 0.0;
    for (int k = 0; k < 2; ++k) {
        const point rest = apart + s * d - r * e;
        s -= wp::dot(wp::cross(rest, e), n) / nn;
        r -= wp::dot(wp::cross(rest, d), n) / nn;
    }
    s = s > 0.0 ? wp::min(s, 1.0) : 0.0;
    r = share(wp::dot(apart + s * d, e), wp::dot(e, e));
    s = share(wp::dot(r * e - apart, d), wp::dot(d, d));
    const point rest = apart + s * d - r * e;
    return wp::dot(rest, rest);
};
static constexpr auto feature_gap = [](const point* t, const point* u, point& x, point& y) OUT_OF_LINE {
    double least = INFINITY;
    for (int side = 0; side < 2; ++side)
        for (int k = 0; k < 3; ++k) {
            const point p = side ? u[k] : t[k];
            point q;
            const double squared = vertex_gap(p, side ? t : u, q);
            if (squared >= least) continue;
            least = squared;
            x = side ? q : p;
            y = side ? p : q;
        }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const point d = t[(i + 1) % 3] - t[i], e = u[(j + 1) % 3] - u[j];
            double s, r;
            const double squared = edge_gap(t[i], d, u[j], e, s, r);
            if (squared >= least) continue;
            least = squared;
            x = t[i] + s * d;
            y = u[j] + r * e;
        }
    return least;
};
// Calls on_point(point, squared) where the plane of a triangle cuts an edge of the other one, with how far from the
// triangle that is.
static constexpr auto visit_through = [](const point* t, const point* u, auto&& on_point) {
    for (int side = 0; side < 2; ++side) {
        const point *one = side ? u : t, *other = side ? t : u;
        const point n = wp::cross(other[1] - other[0], other[2] - other[0]);
        for (int k = 0; k < 3; ++k) {
            const point p = one[k], q = one[(k + 1) % 3];
            const double from = wp::dot(n, p - other[0]), to = wp::dot(n, q - other[0]);
            if (!(from * to < 0.0)) continue;
            const point through = p + (from / (from - to)) * (q - p);
            point found;
            on_point(through, vertex_gap(through, other, found));
        }
    }
};
// The squared distance of two triangles, arrays of three points; sets x on t and y on u. 0 and a common point, to
// rounding, where they meet, which is decided exactly.
static constexpr auto triangle_gap = [](const point* t, const point* u, point& x, point& y) OUT_OF_LINE {
    const bool meet = boxes_meet(t, u, 0.0) && triangles_meet(t, u);
    double least = feature_gap(t, u, x, y);
    // Rounding may make 0 of a gap: triangles that do not meet are apart.
    if (!meet) return wp::max(least, 1e-300);
    // Where an edge goes through the other triangle, no vertex and no other edge need be near.
    visit_through(t, u, [&](const point& through, double squared) {
        if (squared >= least) return;
        least = squared;
        x = through;
    });
    y = x;
    return 0.0;
};

// Calls take(slot, other, t, u) with pairs of one item (a leaf of eight slots on a CPU, one slot on CUDA) and a whole
// tree, and with their corners in units: all that are as near as `best`, a squared distance in units, which take may
// lower. The tree is pruned in float64 by the distance of its boxes from those of the item.
static constexpr auto visit_nearer = [](int item, const SurfaceTree& surface, const wp::mat33d& linear,
                                        const point& shift, const SurfaceTree& tree,
                                        const wp::array_t<float>& slot_boxes, double unit, double& best, auto&& take) {
    const wp::array_t<int>& slot_triangle = surface.slot_triangle;
    double reach = 0.0, far = 0.0;
#if defined(__CUDA_ARCH__)
    const int width = 1;
#else
    const int width = 8;
#endif
    point moved[width][3];
    // Boxes in the tree's local frame.
    double lows[width][3], highs[width][3], low[3], high[3];
    for (int k = 0; k < 3; ++k) {
        low[k] = INFINITY;
        high[k] = -INFINITY;
    }
    for (int lane = 0; lane < width; ++lane) {
        const int slot = width * item + lane;
        point* const p = moved[lane];
        for (int k = 0; k < 3; ++k) p[k] = wp::mul(linear, surface.corners.data[3 * slot + k]) + shift;
        for (int k = 0; k < 3; ++k) {
            lows[lane][k] = INFINITY;
            highs[lane][k] = -INFINITY;
            if (slot_triangle.data[slot] < 0) continue;
            lows[lane][k] = (wp::min(wp::min(p[0][k], p[1][k]), p[2][k]) - tree.origin[k]) / tree.scale;
            highs[lane][k] = (wp::max(wp::max(p[0][k], p[1][k]), p[2][k]) - tree.origin[k]) / tree.scale;
            low[k] = wp::min(low[k], lows[lane][k]);
            high[k] = wp::max(high[k], highs[lane][k]);
            far = wp::max(far, wp::max(wp::abs(lows[lane][k]), wp::abs(highs[lane][k])));
        }
    }
    // Farther boxes hold no pair as near as the best one, whatever the rounding.
    auto update_reach = [&]() {
        const double local = sqrt(best) / unit / tree.scale * (1.0 + 1e-12) + (BOX_PADDING + 1e-14 * far);
        reach = local * local;
    };
    // Whether a slab between the triangles is wider than the best distance: across the line of their centers, or across
    // that from the center of one to the nearest point of the other.
    auto surely_farther = [&](const point* t, const point* u) {
        point a[3], b[3], nearest;
        double size = 0.0;
        for (int k = 0; k < 3; ++k) {
            a[k] = t[k] - t[0];
            b[k] = u[k] - t[0];
            size = wp::max(size, wp::max(largest(a[k]), largest(b[k])));
        }
        auto beyond = [&](const point& axis) {
            double above = -INFINITY, below = INFINITY;
            for (int k = 0; k < 3; ++k) {
                above = wp::max(above, wp::dot(axis, a[k]));
                below = wp::min(below, wp::dot(axis, b[k]));
            }
            const double gap = below - above - 1e-14 * largest(axis) * size;
            return gap > 0.0 && gap * gap > best * wp::dot(axis, axis) * (1.0 + 1e-12);
        };
        const point one = (a[0] + a[1] + a[2]) / 3.0, other = (b[0] + b[1] + b[2]) / 3.0;
        if (beyond(other - one)) return true;
        vertex_gap(one, b, nearest);
        if (beyond(nearest - one)) return true;
        vertex_gap(other, a, nearest);
        return beyond(other - nearest);
    };
    auto evaluate = [&](int slot, int other) {
        if (slot_triangle.data[slot] < 0 || tree.slot_triangle.data[other] < 0) return;
        point t[3], u[3];
        for (int k = 0; k < 3; ++k) {
            t[k] = moved[slot - width * item][k] * unit;
            u[k] = tree.corners.data[3 * other + k] * unit;
        }
        if (surely_farther(t, u)) return;
        const double before = best;
        take(slot, other, t, u);
        if (best != before) update_reach();
    };
    update_reach();
#if defined(__CUDA_ARCH__)
    auto gap_of = [&](double lx, double ly, double lz, double ux, double uy, double uz) {
        const double x = wp::max(wp::max(lx - high[0], low[0] - ux), 0.0),
                     y = wp::max(wp::max(ly - high[1], low[1] - uy), 0.0),
                     z = wp::max(wp::max(lz - high[2], low[2] - uz), 0.0);
        return x * x + y * y + z * z;
    };
    int stack[64], depth = 0, node = tree.children.data[0];
    double entry[64];
    while (true) {
        if (node >= 0) {
            const Node n = load_node(tree.boxes.data, node);
            const double dl = gap_of(n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ),
                         dr = gap_of(n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ);
            const bool left_first = dl <= dr;
            if ((left_first ? dr : dl) <= reach) {
                stack[depth] = left_first ? n.right : n.left;
                entry[depth++] = left_first ? dr : dl;
            }
            node = left_first ? n.left : n.right;
            if ((left_first ? dl : dr) <= reach) continue;
        } else {
            for (int other = first_slot(node); other < end_slot(node); ++other) {
                double lower[3], upper[3];
                const point* p = tree.corners.data + 3 * other;
                for (int k = 0; k < 3; ++k) {
                    lower[k] = (wp::min(wp::min(p[0][k], p[1][k]), p[2][k]) - tree.origin[k]) / tree.scale;
                    upper[k] = (wp::max(wp::max(p[0][k], p[1][k]), p[2][k]) - tree.origin[k]) / tree.scale;
                }
                if (gap_of(lower[0], lower[1], lower[2], upper[0], upper[1], upper[2]) <= reach) evaluate(item, other);
            }
        }
        do --depth;
        while (depth >= 0 && entry[depth] > reach);
        if (depth < 0) break;
        node = stack[depth];
    }
#else
    // Squared distance of eight boxes, given as six rows, from one.
    auto gap_of = [&](const float* rows, const double* lower, const double* upper) {
        const d8 zero = 0.0;
        d8 sum = 0.0;
        for (int k = 0; k < 3; ++k) {
            const d8 from = __builtin_convertvector(*(const v8*)(rows + 8 * k), d8),
                     to = __builtin_convertvector(*(const v8*)(rows + 24 + 8 * k), d8);
            const d8 gap = __builtin_elementwise_max(__builtin_elementwise_max(from - upper[k], lower[k] - to), zero);
            sum += gap * gap;
        }
        return sum;
    };
    // As surely_farther, by the line of centers, for a triangle and the eight of a block, whose corners are given axis by
    // axis: a bit for each.
    auto all_farther = [&](const point* t, const d8(*u)[3]) {
        d8 axis[3], above, below, size = 0.0, length = 0.0;
        for (int k = 0; k < 3; ++k) {
            axis[k] = u[0][k] + u[1][k] + u[2][k] - (t[0][k] + t[1][k] + t[2][k]);
            length += axis[k] * axis[k];
        }
        for (int corner = 0; corner < 3; ++corner) {
            d8 a = 0.0, b = 0.0;
            for (int k = 0; k < 3; ++k) {
                const double to = t[corner][k] - t[0][k];
                const d8 from = u[corner][k] - t[0][k];
                a += axis[k] * to;
                b += axis[k] * from;
                size = __builtin_elementwise_max(size, __builtin_elementwise_abs(from) + wp::abs(to));
            }
            above = corner ? __builtin_elementwise_max(above, a) : a;
            below = corner ? __builtin_elementwise_min(below, b) : b;
        }
        // No component of the axis is longer than the axis.
        const d8 gap = below - above - 1e-14 * __builtin_elementwise_sqrt(length) * size;
        return mask_of((gap > 0.0) & (gap * gap > best * (1.0 + 1e-12) * length));
    };
    int stack[STACK], height = 1;
    double entry[STACK];
    stack[0] = 0;
    entry[0] = 0.0;
    while (height > 0) {
        --height;
        if (entry[height] > reach) continue;
        const int node = stack[height];
        if (node < 0) {
            const int first = 8 * (-1 - node);
            d8 u[3][3];
            for (int j = 0; j < 8; ++j)
                for (int k = 0; k < 9; ++k)
                    u[k / 3][k % 3][j] = tree.corners.data[3 * (first + j) + k / 3][k % 3] * unit;
            for (int lane = 0; lane < 8; ++lane) {
                if (slot_triangle.data[8 * item + lane] < 0) continue;
                const d8 gap = gap_of(slot_boxes.data + 6 * first, lows[lane], highs[lane]);
                unsigned mask = mask_of(gap <= reach);
                if (!mask) continue;
                const point t[3] = {moved[lane][0] * unit, moved[lane][1] * unit, moved[lane][2] * unit};
                for (mask &= ~all_farther(t, u); mask; mask &= mask - 1) {
                    const int j = __builtin_ctz(mask);
                    if (gap[j] <= reach) evaluate(8 * item + lane, first + j);
                }
            }
            continue;
        }
        const float* rows = tree.boxes.data + 48 * node;
        const d8 gap = gap_of(rows, low, high);
        const int base = height;
        for (unsigned mask = mask_of(gap <= reach); mask; mask &= mask - 1) {
            const int j = __builtin_ctz(mask);
            if (rows[j] > rows[24 + j]) continue;  // no child
            const double d = gap[j];
            int at = height++;
            for (; at > base && entry[at - 1] < d; --at) {
                entry[at] = entry[at - 1];
                stack[at] = stack[at - 1];
            }
            entry[at] = d;
            stack[at] = tree.children.data[8 * node + j];
        }
    }
#endif
};

// The nearest pair of one item. Pairs as near as the limit count, and ties go to the lowest triangle of the surface, then
// of the tree: which pair wins in the end depends neither on the order of items nor on how soon the limit falls. Writes
// the squared distance (in units, inf without a pair) and both slots (-1), and returns the lower one of that distance and
// the limit.
static constexpr auto nearest_pair = [](int item, const SurfaceTree& surface, const wp::mat33d& linear,
                                        const point& shift, const SurfaceTree& tree,
                                        const wp::array_t<float>& slot_boxes, double unit, double limit, int out_row,
                                        wp::array_t<double>& out_squared, wp::array_t<int>& out_slots) -> double {
    double best = limit;
    int winner = -1, winner_other = -1;
    visit_nearer(item, surface, linear, shift, tree, slot_boxes, unit, best,
                 [&](int slot, int other, const point* t, const point* u) {
                     point x, y;
                     const double squared = triangle_gap(t, u, x, y);
                     if (!(squared <= best)) return;
                     if (squared == best && winner >= 0) {
                         const int triangle = surface.slot_triangle.data[slot],
                                   first = surface.slot_triangle.data[winner];
                         const int another = tree.slot_triangle.data[other];
                         if (triangle > first || (triangle == first && another > tree.slot_triangle.data[winner_other]))
                             return;
                     }
                     winner = slot;
                     winner_other = other;
                     best = squared;
                 });
    out_squared.data[out_row] = winner < 0 ? (double)INFINITY : best;
    out_slots.data[2 * out_row] = winner;
    out_slots.data[2 * out_row + 1] = winner_other;
    return best;
};

// Area of the part of t from which u is within a margin straight along the normal of t: u clipped by the sides of t and
// by two planes along it, as seen from there. 0 of triangles without area.
static constexpr auto area_within = [](const point* t, const point* u, double margin) OUT_OF_LINE {
    const point n = wp::normalize(wp::cross(t[1] - t[0], t[2] - t[0]));
    point now[8], next[8];
    int count = 3;
    for (int k = 0; k < 3; ++k) now[k] = u[k] - t[0];
    for (int plane = 0; plane < 5; ++plane) {
        const bool is_side = plane < 3;
        const point inward = is_side ? wp::cross(n, t[(plane + 1) % 3] - t[plane]) : plane == 3 ? n : -n;
        const double least = is_side ? wp::dot(inward, t[plane] - t[0]) : -margin;
        int kept = 0;
        for (int k = 0; k < count; ++k) {
            const point p = now[k], q = now[(k + 1) % count];
            const double from = wp::dot(inward, p) - least, to = wp::dot(inward, q) - least;
            if (from >= 0.0) next[kept++] = p;
            if ((from >= 0.0) != (to >= 0.0) && kept < 8) next[kept++] = p + (from / (from - to)) * (q - p);
        }
        count = kept;
        for (int k = 0; k < count; ++k) now[k] = next[k];
    }
    double twice = 0.0;
    for (int k = 2; k < count; ++k) twice += wp::dot(n, wp::cross(now[k - 1] - now[0], now[k] - now[0]));
    return wp::abs(twice) / 2.0;
};

// Counts the pairs of an item in a pose, and writes those that there is room for, in any order: the pose and both
// triangles; and a row of their distance, the area on the first one, and the nearest points [world].
static constexpr auto list_within =
    [](int row, int items, const SurfaceTree& surface, const wp::array_t<wp::mat33d>& linear,
       const wp::array_t<wp::vec3d>& shift, const SurfaceTree& tree, const wp::array_t<float>& slot_boxes,
       const wp::array_t<double>& unit, double margin, wp::array_t<wp::int64>& out_count, wp::array_t<int>& out_pairs,
       wp::array_t<double>& out_rows) {
        const int pose = row / items;
        const double scale = unit.data[pose], within = margin * scale;
        double limit = within * within;
        auto take = [&](int slot, int other, const point* t, const point* u) {
            // Without a margin their distance says nothing more.
            if (limit == 0.0 && !(boxes_meet(t, u, 0.0) && triangles_meet(t, u))) return;
            point x, y, sum;
            const double squared = triangle_gap(t, u, x, y);
            if (!(squared <= limit)) return;
            const wp::int64 at = add_to(out_count, 0, (wp::int64)1);
            if (8 * at >= out_rows.shape[0]) return;
            // Of triangles that cross, the middle of what they share: it moves on as they do.
            double count = 0.0;
            auto add_point = [&](const point& through, double off) {
                if (off > CONTACT_ERROR * CONTACT_ERROR) return;
                sum += through;
                ++count;
            };
            if (squared == 0.0) visit_through(t, u, add_point);
            if (count > 0.0) x = y = sum / count;
            int* const pair = out_pairs.data + 3 * at;
            pair[0] = pose;
            pair[1] = surface.slot_triangle.data[slot];
            pair[2] = tree.slot_triangle.data[other];
            double* const out = out_rows.data + 8 * at;
            out[0] = sqrt(squared) / scale;
            out[1] = area_within(t, u, within + CONTACT_ERROR) / scale / scale;
            for (int k = 0; k < 3; ++k) {
                out[2 + k] = x[k] / scale;
                out[5 + k] = y[k] / scale;
            }
        };
        visit_nearer(row % items, surface, linear.data[pose], shift.data[pose], tree, slot_boxes, scale, limit, take);
    };

// Writes the nearest points of the pair of slots of a pose [world], one of each surface.
static constexpr auto points_of_pair = [](int pose, const SurfaceTree& surface, const wp::array_t<wp::mat33d>& linear,
                                          const wp::array_t<wp::vec3d>& shift, const SurfaceTree& tree,
                                          const wp::array_t<double>& unit, const wp::array_t<int>& slots,
                                          wp::array_t<wp::vec3d>& out_points) {
    const double scale = unit.data[pose];
    point t[3], u[3], x, y;
    for (int k = 0; k < 3; ++k) {
        const point& corner = surface.corners.data[3 * slots.data[2 * pose] + k];
        t[k] = (wp::mul(linear.data[pose], corner) + shift.data[pose]) * scale;
        u[k] = tree.corners.data[3 * slots.data[2 * pose + 1] + k] * scale;
    }
    triangle_gap(t, u, x, y);
    out_points.data[2 * pose] = x / scale;
    out_points.data[2 * pose + 1] = y / scale;
};
