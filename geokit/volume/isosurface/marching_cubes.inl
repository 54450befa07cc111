// Marching cubes of a plane of 64 cells: see marching_cubes_kernels.
#include "volume/isosurface/blocks.inl"

// For each corner of the cells of a plane which are inside (c) and which are active (a); which cells have any corner
// inside, and which have all.
static constexpr auto read_cubes = [](const auto& cells, int plane, u64* c, u64* a, u64& any, u64& all) {
    cell_corners(cells, cells.crossed.data[plane >> 3], plane & 7, inside_plane, c);
    cell_corners(cells, cells.crossed.data[plane >> 3], plane & 7, active_plane, a);
    any = 0;
    all = ~0ull;
    for (int n = 0; n < 8; ++n) {
        any |= c[n];
        all &= c[n];
    }
};

// Whether an edge of the cell at `bit` has an active end.
static constexpr auto is_live = [](const u64* a, int edge, int bit) -> bool {
    const int axis = edge >> 2, high = axis == 0 ? 2 : 4, low = axis == 2 ? 2 : 1;
    const int n = (edge >> 1 & 1) * high + (edge & 1) * low;
    return ((a[n] | a[n + (4 >> axis)]) >> bit & 1) != 0;
};
// Whether all three edges of a triangle have an active end.
static constexpr auto is_whole = [](const u64* a, u64 dead, int edges, int bit) -> bool {
    return !(dead >> bit & 1)
           || (is_live(a, edges & 15, bit) && is_live(a, edges >> 4 & 15, bit) && is_live(a, edges >> 8, bit));
};

constexpr float least_place = (float)END, most_place = 1.f - least_place;
// The crossing of the edge along an axis from a cell's lowest corner, whose ends have the values f and g.
static constexpr auto point_on = [](const auto& linear, const auto& offset, const wp::vec3i& first, int x, int bit,
                                    int axis, float f, float g) {
    const float t = f / (f - g);
    // The comparisons turn NaN into a number.
    const float end = t > least_place ? t : least_place, inner = end < most_place ? end : most_place;
    double index[3] = {(double)(first[0] + x), (double)(first[1] + (bit >> 3)), (double)(first[2] + (bit & 7))};
    index[axis] += (double)inner;
    wp::vec3d point;
    for (int row = 0; row < 3; ++row) {
        point[row] = linear.data[row][0] * index[0] + linear.data[row][1] * index[1] + linear.data[row][2] * index[2]
                     + offset[row];
    }
    return point;
};

// Counts the vertices and triangles of a plane, and writes bit masks of its crossed edges; the flag says that some edges
// are dead. All threads that write it write the same value.
static constexpr auto count_plane = [](const Cells& cells, const wp::array_t<int>& start, const wp::array_t<int>& edges,
                                       int plane, wp::array_t<uint64_t>& records, wp::array_t<int>& out_vertices,
                                       wp::array_t<int>& out_triangles, wp::array_t<int>& out_flag) {
    u64 c[8], a[8], any, all;
    read_cubes(cells, plane, c, a, any, all);
    const u64 dead = dead_edges(c, a);
    u64* record = records.data + 3ll * plane;
    int vertices = 0, triangles = 0;
    for (int axis = 0; axis < 3; ++axis) {
        const int n = 4 >> axis;
        record[axis] = (c[0] ^ c[n]) & (a[0] | a[n]);
        vertices += (int)count_bits(record[axis]);
    }
    for (u64 rest = any & ~all; rest; rest &= rest - 1) {
        const int bit = (int)first_bit(rest), code = case_of(c, bit);
        if (dead >> bit & 1) {
            for (int t = start.data[code]; t < start.data[code + 1]; ++t)
                triangles += is_whole(a, dead, edges.data[t], bit);
        } else {
            triangles += start.data[code + 1] - start.data[code];
        }
    }
    out_vertices.data[plane] = vertices;
    out_triangles.data[plane] = triangles;
    if (dead) out_flag.data[0] = 1;
};
static constexpr auto count_planes = [](int item, int span, const Cells& cells, const wp::array_t<int>& start,
                                        const wp::array_t<int>& edges, wp::array_t<uint64_t>& records,
                                        wp::array_t<int>& out_vertices, wp::array_t<int>& out_triangles,
                                        wp::array_t<int>& out_flag) {
    for (int plane = span * item; plane < span * (item + 1); ++plane)
        count_plane(cells, start, edges, plane, records, out_vertices, out_triangles, out_flag);
};

// Places the vertices of a plane's edges. Returns false if some are left because an end lies in a tile.
static constexpr auto place_vertices = [](const Cells& cells, int plane, const wp::array_t<uint64_t>& records,
                                          const wp::array_t<int>& base, const wp::mat33d& linear,
                                          const wp::vec3d& offset, wp::array_t<wp::vec3d>& vertex) -> bool {
    const int block = cells.crossed.data[plane >> 3], x = plane & 7;
    const u64* record = records.data + 3ll * plane;
    const wp::vec3i& first = cells.origin.data[block];
    // The leaf of the block, and the leaves beyond its upper faces along x, y and z, if they exist.
    const float* leaf[4];
    for (int d = 0; d < 4; ++d) {
        const int ref = cells.refs.data[8ll * block + (d ? 4 >> (d - 1) : 0)];
        const bool is_leaf = ref >= 0 && ref < cells.leaf_count;
        leaf[d] = is_leaf ? (const float*)(cells.values + cells.stride * (u64)ref) : (const float*)0;
    }
    wp::vec3d* out = vertex.data + base.data[plane];
    bool is_complete = true;
    for (int axis = 0; axis < 3; ++axis) {
        for (u64 rest = record[axis]; rest; rest &= rest - 1, ++out) {
            const int bit = (int)first_bit(rest), n = 64 * x + bit, step = 64 >> 3 * axis;
            const int along = axis == 0 ? x : axis == 1 ? bit >> 3 : bit & 7;
            const float* end = along < 7 ? leaf[0] : leaf[axis + 1];
            if (!leaf[0] || !end) {
                is_complete = false;
                continue;
            }
            const float f = (float)((double)leaf[0][n] - cells.isovalue);
            const float g = (float)((double)end[along < 7 ? n + step : n - 7 * step] - cells.isovalue);
            *out = point_on(linear, offset, first, x, bit, axis, f, g);
        }
    }
    return is_complete;
};

// Places the vertex of one edge from the values at its ends, relative to the isovalue.
static constexpr auto place_vertex = [](const Cells& cells, int plane, int bit, int axis, double low, double high,
                                        const wp::array_t<uint64_t>& records, const wp::array_t<int>& base,
                                        const wp::mat33d& linear, const wp::vec3d& offset,
                                        wp::array_t<wp::vec3d>& vertex) {
    const u64* record = records.data + 3ll * plane;
    long long at = base.data[plane] + count_bits(record[axis] & ((1ull << bit) - 1));
    for (int before = 0; before < axis; ++before) at += count_bits(record[before]);
    const wp::vec3i& first = cells.origin.data[cells.crossed.data[plane >> 3]];
    vertex.data[at] = point_on(linear, offset, first, plane & 7, bit, axis, (float)low, (float)high);
};

// Places the triangles of a plane's cells.
static constexpr auto place_triangles =
    [](const Cells& cells, const wp::array_t<int>& start, const wp::array_t<int>& edges, int plane,
       const wp::array_t<uint64_t>& records, const wp::array_t<int>& base, const wp::array_t<int>& first_triangle,
       int turned, wp::array_t<int>& faces) {
        const int x = plane & 7;
        const int* refs = cells.refs.data + 8ll * cells.crossed.data[plane >> 3];
        u64 c[8], a[8], any, all;
        read_cubes(cells, plane, c, a, any, all);
        const u64 dead = dead_edges(c, a);
        // Planes x and x + 1 of this block and of those above it: index 4 for x + 1, 2 and 1 for the next block along y
        // and z.
        const u64* record_of[8];
        int base_of[8];
        for (int n = 0; n < 8; ++n) {
            const int i = x + (n >> 2), other = refs[4 * (i >> 3) + (n & 3)];
            const int slot = other < 0 ? -1 : cells.slot.data[other], p = slot < 0 ? 0 : 8 * slot + (i & 7);
            record_of[n] = records.data + 3ll * p;
            base_of[n] = base.data[p];
        }
        auto vertex_on = [&](int bit, int edge) -> int {
            const int axis = edge >> 2, one = edge >> 1 & 1, two = edge & 1;
            const int di = axis == 0 ? 0 : one, j = (bit >> 3) + (axis == 0 ? one : axis == 1 ? 0 : two);
            const int k = (bit & 7) + (axis == 2 ? 0 : two), n = 4 * di + 2 * (j >> 3) + (k >> 3);
            const u64* record = record_of[n];
            const u64 below = (1ull << ((j & 7) << 3 | (k & 7))) - 1;
            int number = base_of[n] + (int)count_bits(record[axis] & below);
            if (axis > 0) number += (int)count_bits(record[0]);
            if (axis > 1) number += (int)count_bits(record[1]);
            return number;
        };
        int* out = faces.data + 3ll * first_triangle.data[plane];
        for (u64 rest = any & ~all; rest; rest &= rest - 1) {
            const int bit = (int)first_bit(rest), code = case_of(c, bit);
            for (int t = start.data[code]; t < start.data[code + 1]; ++t) {
                const int three = edges.data[t];
                if (!is_whole(a, dead, three, bit)) continue;
                out[0] = vertex_on(bit, three & 15);
                out[turned ? 2 : 1] = vertex_on(bit, three >> 4 & 15);
                out[turned ? 1 : 2] = vertex_on(bit, three >> 8);
                out += 3;
            }
        }
    };
static constexpr auto place_all_triangles = [](int item, int span, const Cells& cells, const wp::array_t<int>& start,
                                               const wp::array_t<int>& edges, const wp::array_t<uint64_t>& records,
                                               const wp::array_t<int>& base, const wp::array_t<int>& first_triangle,
                                               int turned, wp::array_t<int>& faces) {
    for (int plane = span * item; plane < span * (item + 1); ++plane)
        place_triangles(cells, start, edges, plane, records, base, first_triangle, turned, faces);
};
