// The vertices and quads of a plane of 64 cells: see surface_nets_kernels.
#include "volume/isosurface/surface_nets_cases.inl"

constexpr float least_place = (float)END, most_place = 1.f - least_place;
static constexpr auto clamped = [](float t) -> float {
    // The comparisons turn NaN into a number.
    const float end = t > least_place ? t : least_place;
    return end < most_place ? end : most_place;
};
static constexpr auto to_world = [](const auto& linear, const auto& offset, const int* at, const float* local,
                                    wp::vec3d& out) {
    double index[3];
    for (int k = 0; k < 3; ++k) index[k] = (double)at[k] + (double)local[k];
    for (int row = 0; row < 3; ++row) {
        out[row] = linear.data[row][0] * index[0] + linear.data[row][1] * index[1] + linear.data[row][2] * index[2]
                   + offset[row];
    }
};
// Places the vertices of a cell whose corners have the values f relative to the isovalue. `sums` is a word of
// sum_table: sums of the crossed edges' constant coordinates x, y, z and their number, four bits each, then the edges.
static constexpr auto place = [](const auto& linear, const auto& offset, unsigned word, unsigned sums, const float* f,
                                 const int* at, wp::vec3d* out) {
    #ifndef __CUDA_ARCH__
    if (loop_count(word) == 1) {
        const v8 all = *(const v8*)f;
        const v16 low = __builtin_shufflevector(all, all, 0, 1, 2, 3, 0, 1, 4, 5, 0, 2, 4, 6, 0, 0, 0, 0);
        const v16 high = __builtin_shufflevector(all, all, 4, 5, 6, 7, 2, 3, 6, 7, 1, 3, 5, 7, 0, 0, 0, 0);
        const i16 lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
        const v16 t = low / (low - high);
        const v16 least = least_place, most = most_place, none = 0.f;
        const v16 end = t > least ? t : least;
        const v16 inner = end < most ? end : most;
        const v16 one = ((i16)(int)(sums >> 16) >> lane & 1) != 0 ? inner : none;
        const v16 two = one + __builtin_shufflevector(one, one, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
        const float number = (float)(sums >> 12 & 15u);
        const float local[3] = {((float)(sums & 15u) + (two[0] + two[2])) / number,
                                ((float)(sums >> 4 & 15u) + (two[4] + two[6])) / number,
                                ((float)(sums >> 8 & 15u) + (two[8] + two[10])) / number};
        to_world(linear, offset, at, local, out[0]);
        return;
    }
    #endif
    for (int loop = 0; loop < loop_count(word); ++loop) {
        int whole[3] = {}, number = 0;
        float part[3];
        for (int axis = 0; axis < 3; ++axis) {
            float one[4];
            for (int side = 0; side < 4; ++side) {
                const int edge = 4 * axis + side;
                const int n = (side >> 1) * (axis == 0 ? 2 : 4) + (side & 1) * (axis == 2 ? 2 : 1);
                const bool is_in = (sums >> 16 >> edge & 1u) && (int)(word >> 2 * edge & 3u) == loop;
                one[side] = is_in ? clamped(f[n] / (f[n] - f[n + (4 >> axis)])) : 0.f;
                number += is_in;
                for (int k = 0; k < 3; ++k) whole[k] += is_in ? n >> (2 - k) & 1 : 0;
            }
            part[axis] = (one[0] + one[1]) + (one[2] + one[3]);
        }
        float local[3];
        for (int k = 0; k < 3; ++k) local[k] = ((float)whole[k] + part[k]) / (float)number;
        to_world(linear, offset, at, local, out[loop]);
    }
};

// Places the vertices of a plane's cells. Returns a bit mask of those left because a corner lies in a tile.
static constexpr auto place_vertices = [](const Cells& cells, const Nets& nets, int plane, const wp::mat33d& linear,
                                          const wp::vec3d& offset, wp::array_t<wp::vec3d>& vertex) -> u64 {
    const int block = cells.crossed.data[plane >> 3], x = plane & 7;
    const u64* record = nets.records.data + (long long)RECORD * plane;
    if (!record[0]) return 0ull;
    const int* refs = cells.refs.data + 8ll * block;
    const wp::vec3i& first = cells.origin.data[block];
    u64 c[8], left = 0;
    cell_corners(cells, block, x, inside_plane, c);
    // The leaf of each of the eight blocks, if it exists.
    const float* leaf[8];
    for (int d = 0; d < 8; ++d) {
        const bool is_leaf = refs[d] >= 0 && refs[d] < cells.leaf_count;
        leaf[d] = is_leaf ? (const float*)(cells.values + cells.stride * (u64)refs[d]) : (const float*)0;
    }
    wp::vec3d* out = vertex.data + nets.base.data[plane];
    for (u64 rest = record[0]; rest; rest &= rest - 1) {
        const int bit = (int)first_bit(rest), y = bit >> 3, z = bit & 7;
        const int code = case_of(c, bit);
        const unsigned word = word_of(nets.table, nets.flips, code, plane, bit);
        alignas(32) float f[8];
        bool known = true;
        if (x < 7 && y < 7 && z < 7 && leaf[0]) {
            const float* v = leaf[0] + 64 * x + bit;
            #pragma unroll
            for (int n = 0; n < 8; ++n) {
                f[n] = (float)((double)v[64 * (n >> 2) + 8 * (n >> 1 & 1) + (n & 1)] - cells.isovalue);
            }
        } else {
            for (int n = 0; n < 8; ++n) {
                const int i = x + (n >> 2), j = y + (n >> 1 & 1), k = z + (n & 1);
                const float* v = leaf[4 * (i >> 3) + 2 * (j >> 3) + (k >> 3)];
                known = known && v;
                f[n] = v ? (float)((double)v[64 * (i & 7) + 8 * (j & 7) + (k & 7)] - cells.isovalue) : 0.f;
            }
        }
        const int at[3] = {first[0] + x, first[1] + y, first[2] + z};
        if (known) place(linear, offset, word, nets.sums.data[code], f, at, out);
        else left |= 1ull << bit;
        out += loop_count(word);
    }
    return left;
};

// Places the vertices of one cell from the values at its corners, relative to the isovalue.
static constexpr auto place_vertex = [](const Cells& cells, const Nets& nets, int plane, int bit, const auto& value,
                                        const wp::mat33d& linear, const wp::vec3d& offset,
                                        wp::array_t<wp::vec3d>& vertex) {
    const int block = cells.crossed.data[plane >> 3];
    const wp::vec3i& first = cells.origin.data[block];
    u64 c[8];
    cell_corners(cells, block, plane & 7, inside_plane, c);
    const int code = case_of(c, bit);
    float f[8];
    for (int n = 0; n < 8; ++n) f[n] = (float)value[n];
    const u64* record = nets.records.data + (long long)RECORD * plane;
    const u64 below = (1ull << bit) - 1;
    long long start = nets.base.data[plane];
    for (int n = 0; n < RECORD; ++n) start += count_bits(record[n] & below);
    const int at[3] = {first[0] + (plane & 7), first[1] + (bit >> 3), first[2] + (bit & 7)};
    place(linear, offset, word_of(nets.table, nets.flips, code, plane, bit), nets.sums.data[code], f, at,
          vertex.data + start);
};

// Places two triangles for each crossed edge that a plane's cells own; quads are split along the shorter diagonal.
static constexpr auto place_quads = [](const Cells& cells, const Nets& nets, int plane,
                                       const wp::array_t<int>& first_quad, int turned,
                                       const wp::array_t<wp::vec3d>& vertex, wp::array_t<int>& faces) {
    const int block = cells.crossed.data[plane >> 3], x = plane & 7;
    if (!nets.records.data[(long long)RECORD * plane]) return;
    const int* refs = cells.refs.data + 8ll * block;
    u64 c[8], a[8];
    cell_corners(cells, block, x, inside_plane, c);
    cell_corners(cells, block, x, active_plane, a);
    // Planes x and x + 1 of this block and of those above it: index 4 for x + 1, 2 and 1 for the next block along y
    // and z.
    const u64* record_of[8];
    int plane_of[8];
    for (int n = 0; n < 8; ++n) {
        const int i = x + (n >> 2), other = refs[4 * (i >> 3) + (n & 3)];
        const int slot = other < 0 ? -1 : cells.slot.data[other];
        plane_of[n] = 8 * slot + (i & 7);
        record_of[n] = nets.records.data + (long long)RECORD * (slot < 0 ? 0 : plane_of[n]);
    }
    // The vertex of the sheet that crosses an edge of the cell (x + di, j, k), counted from this block; up to 8.
    auto vertex_at = [&](int di, int j, int k, int edge) -> int {
        const int n = 4 * di + 2 * (j >> 3) + (k >> 3), p = plane_of[n], bit = (j & 7) << 3 | (k & 7);
        const u64* record = record_of[n];
        const u64 below = (1ull << bit) - 1;
        int number = nets.base.data[p] + (int)count_bits(record[0] & below);
        if (record[1]) {
            for (int m = 1; m < RECORD; ++m) number += (int)count_bits(record[m] & below);
            if (record[1] >> bit & 1) {
                u64 d[8];
                cell_corners(cells, cells.crossed.data[p >> 3], p & 7, inside_plane, d);
                number += (int)(word_of(nets.table, nets.flips, case_of(d, bit), p, bit) >> 2 * edge & 3u);
            }
        }
        return number;
    };
    int* out = faces.data + 6ll * first_quad.data[plane];
    auto distance = [&](int p, int q) {
        const wp::vec3d e = vertex.data[p] - vertex.data[q];
        return e[0] * e[0] + e[1] * e[1] + e[2] * e[2];
    };
    const u64 crossed[3] = {(c[3] ^ c[7]) & (a[3] | a[7]), (c[5] ^ c[7]) & (a[5] | a[7]),
                            (c[6] ^ c[7]) & (a[6] | a[7])};
    for (u64 rest = crossed[0] | crossed[1] | crossed[2]; rest; rest &= rest - 1) {
        const int bit = (int)first_bit(rest), y = bit >> 3, z = bit & 7;
        for (int axis = 0; axis < 3; ++axis) {
            if (!(crossed[axis] >> bit & 1)) continue;
            // Corners run counter-clockwise about the axis, seen from its upper end.
            int q[4];
            q[0] = vertex_at(0, y, z, 3 + 4 * axis);
            if (axis == 0) {
                q[1] = vertex_at(0, y + 1, z, 1);
                q[2] = vertex_at(0, y + 1, z + 1, 0);
                q[3] = vertex_at(0, y, z + 1, 2);
            } else if (axis == 1) {
                q[1] = vertex_at(0, y, z + 1, 6);
                q[2] = vertex_at(1, y, z + 1, 4);
                q[3] = vertex_at(1, y, z, 5);
            } else {
                q[1] = vertex_at(1, y, z, 9);
                q[2] = vertex_at(1, y + 1, z, 8);
                q[3] = vertex_at(0, y + 1, z, 10);
            }
            const bool is_outward = (c[7 - (4 >> axis)] >> bit & 1) != 0;
            if (is_outward == (turned != 0)) {
                const int swap = q[1];
                q[1] = q[3];
                q[3] = swap;
            }
            // Ties keep the first diagonal.
            const bool is_first = distance(q[0], q[2]) <= distance(q[1], q[3]);
            out[0] = q[0];
            out[1] = q[1];
            out[2] = is_first ? q[2] : q[3];
            out[3] = is_first ? q[0] : q[1];
            out[4] = q[2];
            out[5] = q[3];
            out += 6;
        }
    }
};
static constexpr auto place_all_quads = [](int item, int span, const Cells& cells, const Nets& nets,
                                           const wp::array_t<int>& first_quad, int turned,
                                           const wp::array_t<wp::vec3d>& vertex, wp::array_t<int>& faces) {
    for (int plane = span * item; plane < span * (item + 1); ++plane)
        place_quads(cells, nets, plane, first_quad, turned, vertex, faces);
};
