"""Marching cubes: a vertex on each crossed edge of the grid, and the triangles of each cell's case between them.

An item is ``span`` planes of 64 cells of the blocks that the surface crosses: on a GPU one, on a CPU, where an item has
its price, a block of eight. A cell owns the edges that start at its lowest
corner: all vertices of its triangles belong to cells of its own block or above. Edges without an active voxel at either
end have no vertex, and what would have used it is left out.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.isosurface.cells_kernels import PLANES, Cells, value_at

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Words of a plane's record: crossed edges along x, y and z.
RECORD = wp.constant(3)
# Crossings keep this far away from the ends of their edge [voxels]: a voxel that has the isovalue itself would give
# vertices at one place, and triangles without area. Well below what a float32 voxel resolves, and still distinct in
# float64 at index 2^30.
END = 1.0e-6
TRIANGLES_SHIFT = wp.constant(16)
HAS_DEAD = wp.constant(1 << 30)
COUNT_MASK = wp.constant(0xFFF)

# Names that the text expects: cells, plane.
_PLANE = f"""
    {PLANES}
    const int block = cells.crossed.data[plane >> 3], x = plane & 7;
    const int* refs = cells.refs.data + 8ll * block;
    u64 c[8], a[8];
    corners(refs, x, inside_plane, c);
    corners(refs, x + 1, inside_plane, c + 4);
    corners(refs, x, active_plane, a);
    corners(refs, x + 1, active_plane, a + 4);
    u64 any = 0, all = ~0ull, dead = 0;
    for (int n = 0; n < 8; ++n) {{ any |= c[n]; all &= c[n]; }}
    for (int step = 4; step; step >>= 1)
        for (int n = 0; n < 8; ++n) if (!(n & step)) dead |= (c[n] ^ c[n + step]) & ~(a[n] | a[n + step]);
    // Whether an edge of the cell at `bit` has an active end.
    auto is_live = [&](int edge, int bit) -> bool {{
        const int axis = edge >> 2, high = axis == 0 ? 2 : 4, low = axis == 2 ? 2 : 1;
        const int n = (edge >> 1 & 1) * high + (edge & 1) * low;
        return ((a[n] | a[n + (4 >> axis)]) >> bit & 1) != 0;
    }};
    auto is_whole = [&](int edges, int bit) -> bool {{
        return !(dead >> bit & 1)
            || (is_live(edges & 15, bit) && is_live(edges >> 4 & 15, bit) && is_live(edges >> 8, bit));
    }};
"""

_COUNT_SNIPPET = f"""
    {_PLANE}
    u64* record = records.data + 3ll * plane;
    int vertices = 0, triangles = 0;
    for (int axis = 0; axis < 3; ++axis) {{
        const int n = 4 >> axis;
        record[axis] = (c[0] ^ c[n]) & (a[0] | a[n]);
        vertices += (int)count_bits(record[axis]);
    }}
    for (u64 rest = any & ~all; rest; rest &= rest - 1) {{
        const int bit = (int)first_bit(rest), code = case_of(c, bit);
        if (dead >> bit & 1) {{
            for (int t = start.data[code]; t < start.data[code + 1]; ++t) triangles += is_whole(edges.data[t], bit);
        }} else {{
            triangles += start.data[code + 1] - start.data[code];
        }}
    }}
    return vertices | triangles << 16 | (dead ? 1 << 30 : 0);
"""

# Names that the text expects: cells, plane, linear, offset.
_POINT = f"""
    // The crossing of the edge along an axis from a cell's lowest corner, whose ends have the values f and g.
    auto point_on = [&](const wp::vec_t<3, int>& first, int x, int bit, int axis, float f, float g) {{
        const float t = f / (f - g);
        // Written so that NaN gives a number too.
        const float end = t > {END}f ? t : {END}f, inner = end < 1.f - {END}f ? end : 1.f - {END}f;
        double index[3] = {{ (double)(first[0] + x), (double)(first[1] + (bit >> 3)), (double)(first[2] + (bit & 7)) }};
        index[axis] += (double)inner;
        wp::vec_t<3, double> point;
        for (int row = 0; row < 3; ++row) {{
            point[row] = linear.data[row][0] * index[0] + linear.data[row][1] * index[1]
                + linear.data[row][2] * index[2] + offset[row];
        }}
        return point;
    }};
"""

_VERTICES_SNIPPET = f"""
    {PLANES}
    {_POINT}
    const int block = cells.crossed.data[plane >> 3], x = plane & 7;
    const u64* record = records.data + 3ll * plane;
    const wp::vec_t<3, int>& first = cells.origin.data[block];
    // The leaf of the block, and those beyond its upper faces along x, y and z, where there are such.
    const float* leaf[4];
    for (int d = 0; d < 4; ++d) {{
        const int ref = cells.refs.data[8ll * block + (d ? 4 >> (d - 1) : 0)];
        const bool is_leaf = ref >= 0 && ref < cells.leaf_count;
        leaf[d] = is_leaf ? (const float*)(cells.values + cells.stride * (u64)ref) : (const float*)0;
    }}
    wp::vec_t<3, double>* out = vertex.data + base.data[plane];
    bool is_complete = true;
    for (int axis = 0; axis < 3; ++axis) {{
        for (u64 rest = record[axis]; rest; rest &= rest - 1, ++out) {{
            const int bit = (int)first_bit(rest), n = 64 * x + bit, step = 64 >> 3 * axis;
            const int along = axis == 0 ? x : axis == 1 ? bit >> 3 : bit & 7;
            const float* end = along < 7 ? leaf[0] : leaf[axis + 1];
            if (!leaf[0] || !end) {{ is_complete = false; continue; }}
            const float f = (float)((double)leaf[0][n] - cells.isovalue);
            const float g = (float)((double)end[along < 7 ? n + step : n - 7 * step] - cells.isovalue);
            *out = point_on(first, x, bit, axis, f, g);
        }}
    }}
    return is_complete;
"""

_VERTEX_SNIPPET = f"""
    {PLANES}
    {_POINT}
    const u64* record = records.data + 3ll * plane;
    long long at = base.data[plane] + count_bits(record[axis] & ((1ull << bit) - 1));
    for (int before = 0; before < axis; ++before) at += count_bits(record[before]);
    const wp::vec_t<3, int>& first = cells.origin.data[cells.crossed.data[plane >> 3]];
    vertex.data[at] = point_on(first, plane & 7, bit, axis, (float)low, (float)high);
"""

_TRIANGLES_SNIPPET = f"""
    {_PLANE}
    // Planes x and x + 1 of this block and of those beside and above it: 4 for x + 1, 2 and 1 for the block's y and z.
    const u64* record_of[8];
    int base_of[8];
    for (int n = 0; n < 8; ++n) {{
        const int i = x + (n >> 2), other = refs[4 * (i >> 3) + (n & 3)];
        const int slot = other < 0 ? -1 : cells.slot.data[other], p = slot < 0 ? 0 : 8 * slot + (i & 7);
        record_of[n] = records.data + 3ll * p;
        base_of[n] = base.data[p];
    }}
    auto vertex_on = [&](int bit, int edge) -> int {{
        const int axis = edge >> 2, one = edge >> 1 & 1, two = edge & 1;
        const int di = axis == 0 ? 0 : one, j = (bit >> 3) + (axis == 0 ? one : axis == 1 ? 0 : two);
        const int k = (bit & 7) + (axis == 2 ? 0 : two), n = 4 * di + 2 * (j >> 3) + (k >> 3);
        const u64* record = record_of[n];
        const u64 below = (1ull << ((j & 7) << 3 | (k & 7))) - 1;
        int number = base_of[n] + (int)count_bits(record[axis] & below);
        if (axis > 0) number += (int)count_bits(record[0]);
        if (axis > 1) number += (int)count_bits(record[1]);
        return number;
    }};
    int* out = faces.data + 3ll * first_triangle.data[plane];
    for (u64 rest = any & ~all; rest; rest &= rest - 1) {{
        const int bit = (int)first_bit(rest), code = case_of(c, bit);
        for (int t = start.data[code]; t < start.data[code + 1]; ++t) {{
            const int three = edges.data[t];
            if (!is_whole(three, bit)) continue;
            out[0] = vertex_on(bit, three & 15);
            out[turned ? 2 : 1] = vertex_on(bit, three >> 4 & 15);
            out[turned ? 1 : 2] = vertex_on(bit, three >> 8);
            out += 3;
        }}
    }}
"""


@wp.func_native(_COUNT_SNIPPET)
def count_plane(
    cells: Cells,
    start: wp.array(dtype=int),
    edges: wp.array(dtype=int),
    plane: int,
    records: wp.array(dtype=wp.uint64),
) -> int:
    """Vertices, triangles and a flag of a plane; writes which of its edges are crossed."""
    ...


@wp.func_native(_VERTICES_SNIPPET)
def place_vertices(
    cells: Cells,
    plane: int,
    records: wp.array(dtype=wp.uint64),
    base: wp.array(dtype=int),
    linear: wp.mat33d,
    offset: wp.vec3d,
    vertex: wp.array(dtype=wp.vec3d),
) -> bool:
    """The vertices of a plane's edges; False where some are left because an end lies in a tile."""
    ...


@wp.func_native(_VERTEX_SNIPPET)
def place_vertex(
    cells: Cells,
    plane: int,
    bit: int,
    axis: int,
    low: wp.float64,
    high: wp.float64,
    records: wp.array(dtype=wp.uint64),
    base: wp.array(dtype=int),
    linear: wp.mat33d,
    offset: wp.vec3d,
    vertex: wp.array(dtype=wp.vec3d),
):
    """The vertex of one edge whose ends' values are given, relative to the isovalue."""
    ...


@wp.func_native(_TRIANGLES_SNIPPET)
def place_triangles(
    cells: Cells,
    start: wp.array(dtype=int),
    edges: wp.array(dtype=int),
    plane: int,
    records: wp.array(dtype=wp.uint64),
    base: wp.array(dtype=int),
    first_triangle: wp.array(dtype=int),
    turned: int,
    faces: wp.array(dtype=int),
):
    """The triangles of a plane's cells."""
    ...


@wp.kernel
def count_kernel(
    first: int,
    span: int,
    cells: Cells,
    start: wp.array(dtype=int),
    edges: wp.array(dtype=int),
    records: wp.array(dtype=wp.uint64),
    out_vertices: wp.array(dtype=int),
    out_triangles: wp.array(dtype=int),
    out_flag: wp.array(dtype=int),
):
    for plane in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        found = count_plane(cells, start, edges, plane, records)
        out_vertices[plane] = found & COUNT_MASK
        out_triangles[plane] = (found >> TRIANGLES_SHIFT) & COUNT_MASK
        # Whoever writes here writes the same.
        if (found & HAS_DEAD) != 0:
            out_flag[0] = 1


@wp.kernel
def vertices_kernel(
    first: int,
    span: int,
    cells: Cells,
    records: wp.array(dtype=wp.uint64),
    base: wp.array(dtype=int),
    isovalue: wp.float64,
    linear: wp.mat33d,
    offset: wp.vec3d,
    out_vertex: wp.array(dtype=wp.vec3d),
):
    for plane in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        if not place_vertices(cells, plane, records, base, linear, offset, out_vertex):
            volume = cells.volume
            block = cells.crossed[plane / 8]
            corner = cells.origin[block]
            for axis in range(3):
                word = records[RECORD * plane + axis]
                for bit in range(64):
                    if (word >> wp.uint64(bit)) & wp.uint64(1) != wp.uint64(0):
                        i = corner[0] + plane % 8
                        j = corner[1] + bit / 8
                        k = corner[2] + bit % 8
                        low = value_at(volume, i, j, k) - isovalue
                        high = value_at(volume, i + int(axis == 0), j + int(axis == 1), k + int(axis == 2)) - isovalue
                        place_vertex(cells, plane, bit, axis, low, high, records, base, linear, offset, out_vertex)


@wp.kernel
def triangles_kernel(
    first: int,
    span: int,
    cells: Cells,
    start: wp.array(dtype=int),
    edges: wp.array(dtype=int),
    records: wp.array(dtype=wp.uint64),
    base: wp.array(dtype=int),
    first_triangle: wp.array(dtype=int),
    turned: int,
    out_faces: wp.array(dtype=int),
):
    for plane in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        place_triangles(cells, start, edges, plane, records, base, first_triangle, turned, out_faces)
