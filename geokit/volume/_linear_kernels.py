"""The trilinear interpolant of float grids, and its gradient, through a table of the leaves.

On a CPU a thread works on 64 queries side by side: their positions are vector arithmetic, and the voxels of all are on
their way from memory before the first is needed. A cell lies in one leaf (two thirds of all) or in two (most others):
its first and its last voxel say which. So two look-ups do, without a branch: where a cell crosses one border, the step
along that axis is the jump from one leaf into the other. What is left, a twentieth, looks up all eight voxels.

All sums are those of _sample_kernels, in the same order: answers are equal to the last bit.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume._leaf_table_kernels import LeafTable
from geokit.volume._sample_kernels import linear_differences, linear_value, world_derivative

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Queries of a thread on a CPU: as many bits as the mask of those that the table does not answer.
GROUP = wp.constant(64)

# C++ that finds the voxel (X, Y, Z) of the box: its ENTRY from the table, and AT, its place as a number of floats.
_ENTRY = """
    const int START = top[((X >> 7) * size_y + (Y >> 7)) * size_z + (Z >> 7)];
    const int ENTRY = START < 0 ? START
        : slots[START + (((X >> 3) & 15) << 8 | ((Y >> 3) & 15) << 4 | ((Z >> 3) & 15))];
"""
_AT = """
    const long long AT = ENTRY < 0 ? (long long)~ENTRY
        : (long long)ENTRY * 8 + 24 + ((X & 7) << 6 | (Y & 7) << 3 | (Z & 7));
"""


def _placed(text, x, y, z):
    for name, value in {"START": "start", "ENTRY": "entry", "AT": "at", "X": x, "Y": y, "Z": z}.items():
        text = text.replace(name, value)
    return text


_VALUE_SUM = """
    const double low_low = c0 + (c1 - c0) * z, low_high = c2 + (c3 - c2) * z;
    const double high_low = c4 + (c5 - c4) * z, high_high = c6 + (c7 - c6) * z;
    const double low = low_low + (low_high - low_low) * y, high = high_low + (high_high - high_low) * y;
    const double value = low + (high - low) * x;
"""
# Differences before averages, as in linear_differences.
_GRADIENT_SUM = """
    const double i_low = (c4 - c0) + ((c5 - c1) - (c4 - c0)) * z, i_high = (c6 - c2) + ((c7 - c3) - (c6 - c2)) * z;
    const double j_low = (c2 - c0) + ((c3 - c1) - (c2 - c0)) * z, j_high = (c6 - c4) + ((c7 - c5) - (c6 - c4)) * z;
    const double k_low = (c1 - c0) + ((c3 - c2) - (c1 - c0)) * y, k_high = (c5 - c4) + ((c7 - c6) - (c5 - c4)) * y;
    const double di = i_low + (i_high - i_low) * y;
    const double dj = j_low + (j_high - j_low) * x;
    const double dk = k_low + (k_high - k_low) * x;
    const double g0 = di * m00 + dj * m10 + dk * m20;
    const double g1 = di * m01 + dj * m11 + dk * m21;
    const double g2 = di * m02 + dj * m12 + dk * m22;
"""

_SET_UP = """
    const float* const voxels = (const float*)table.grid;
    const int* const top = table.top.data;
    const int* const slots = table.slots.data;
    const int size_y = table.size[1], size_z = table.size[2];
    const int lower_x = table.lower[0], lower_y = table.lower[1], lower_z = table.lower[2];
    const double m00 = to_index.data[0][0], m01 = to_index.data[0][1], m02 = to_index.data[0][2];
    const double m10 = to_index.data[1][0], m11 = to_index.data[1][1], m12 = to_index.data[1][2];
    const double m20 = to_index.data[2][0], m21 = to_index.data[2][1], m22 = to_index.data[2][2];
    const double origin_x = origin[0], origin_y = origin[1], origin_z = origin[2];
    const int last_x = table.size[0] * 128 - 2, last_y = size_y * 128 - 2, last_z = size_z * 128 - 2;
"""


def _group(rows, total, stores):
    """C++ for up to 64 queries from ``start`` on; returns which of them have to be asked of the tree."""
    return f"""
#if !defined(__CUDA_ARCH__)
{_SET_UP}
    constexpr int G = 64;
    const {rows}* const rows = (const {rows}*)points.data;
    const int count = stop - start < G ? stop - start : G;
    double u[G], v[G], w[G];
    for (int q = 0; q < G; ++q) {{
        const {rows}* const p = rows + 3ll * (start + (q < count ? q : 0));
        u[q] = (double)p[0]; v[q] = (double)p[1]; w[q] = (double)p[2];
    }}
    int i[G], j[G], k[G], outside[G];
    for (int q = 0; q < G; ++q) {{
        const double x = u[q] - origin_x, y = v[q] - origin_y, z = w[q] - origin_z;
        const double a = m00 * x + m01 * y + m02 * z, b = m10 * x + m11 * y + m12 * z, c = m20 * x + m21 * y + m22 * z;
        const double i0 = __builtin_floor(a), j0 = __builtin_floor(b), k0 = __builtin_floor(c);
        u[q] = a - i0; v[q] = b - j0; w[q] = c - k0;
        const double i1 = i0 - lower_x, j1 = j0 - lower_y, k1 = k0 - lower_z;
        // False for NaN as well.
        const bool inside = (i1 >= 0.0) & (i1 <= last_x) & (j1 >= 0.0) & (j1 <= last_y) & (k1 >= 0.0) & (k1 <= last_z);
        outside[q] = !inside;
        i[q] = inside ? (int)i1 : 0; j[q] = inside ? (int)j1 : 0; k[q] = inside ? (int)k1 : 0;
    }}
    int first_top[G], first_slot[G], last_top[G], last_slot[G], borders[G];
    for (int q = 0; q < G; ++q) {{
        const int x = i[q], y = j[q], z = k[q], x1 = x + 1, y1 = y + 1, z1 = z + 1;
        first_top[q] = ((x >> 7) * size_y + (y >> 7)) * size_z + (z >> 7);
        first_slot[q] = ((x >> 3) & 15) << 8 | ((y >> 3) & 15) << 4 | ((z >> 3) & 15);
        last_top[q] = ((x1 >> 7) * size_y + (y1 >> 7)) * size_z + (z1 >> 7);
        last_slot[q] = ((x1 >> 3) & 15) << 8 | ((y1 >> 3) & 15) << 4 | ((z1 >> 3) & 15);
        borders[q] = (x1 & 7 ? 0 : 1) + (y1 & 7 ? 0 : 1) + (z1 & 7 ? 0 : 1);
    }}
    int first[G], last[G];
    for (int q = 0; q < G; ++q) {{
        const int a = top[first_top[q]], b = top[last_top[q]];
        first[q] = a < 0 ? a : slots[a + first_slot[q]];
        last[q] = b < 0 ? b : slots[b + last_slot[q]];
    }}
    long long at[G], step_x[G], step_y[G], step_z[G];
    int apart[G];
    for (int q = 0; q < G; ++q) {{
        const int x = i[q] & 7, y = j[q] & 7, z = k[q] & 7;
        const long long leaf = (long long)first[q] * 8, jump = (long long)last[q] * 8 - leaf;
        const bool tile = first[q] < 0;
        apart[q] = (borders[q] > 1) | ((borders[q] == 1) & (tile | (last[q] < 0)));
        at[q] = tile ? (long long)~first[q] : leaf + 24 + (x << 6 | y << 3 | z);
        step_x[q] = tile ? 0 : x == 7 ? jump - 448 : 64;
        step_y[q] = tile ? 0 : y == 7 ? jump - 56 : 8;
        step_z[q] = tile ? 0 : z == 7 ? jump - 7 : 1;
    }}
    unsigned long long left = 0;
    for (int q = 0; q < G; ++q) {{
        left |= (unsigned long long)(outside[q] != 0) << q;
        const long long n = at[q];
        const long long far = apart[q] ? n : n + step_x[q], up = apart[q] ? 0 : step_y[q];
        __builtin_prefetch(voxels + n);
        __builtin_prefetch(voxels + n + up);
        __builtin_prefetch(voxels + far);
        __builtin_prefetch(voxels + far + up);
    }}
    float cell[8][G];
    for (int q = 0; q < G; ++q) {{
        if (!apart[q]) {{
            const float* c = voxels + at[q];
            const long long y = step_y[q], z = step_z[q];
            cell[0][q] = c[0]; cell[1][q] = c[z]; cell[2][q] = c[y]; cell[3][q] = c[y + z];
            c += step_x[q];
            cell[4][q] = c[0]; cell[5][q] = c[z]; cell[6][q] = c[y]; cell[7][q] = c[y + z];
        }} else {{
            for (int n = 0; n < 8; ++n) {{
                const int x = i[q] + (n >> 2), y = j[q] + ((n >> 1) & 1), z = k[q] + (n & 1);
                {_placed(_ENTRY + _AT, "x", "y", "z")}
                cell[n][q] = voxels[at];
            }}
        }}
    }}
    double {total};
    for (int q = 0; q < G; ++q) {{
        const double x = u[q], y = v[q], z = w[q];
        const double c0 = cell[0][q], c1 = cell[1][q], c2 = cell[2][q], c3 = cell[3][q];
        const double c4 = cell[4][q], c5 = cell[5][q], c6 = cell[6][q], c7 = cell[7][q];
        {stores[0]}
    }}
    {rows}* const results = ({rows}*)out.data;
    for (int q = 0; q < count; ++q) {{
        {stores[1]}
    }}
    return count == G ? left : left & ((1ull << count) - 1ull);
#else
    return 0ull;
#endif
"""


_VALUE_STORES = (_VALUE_SUM + "\nr[q] = value;", "results[start + q] = r[q];")
_GRADIENT_STORES = (
    _GRADIENT_SUM + "\nr0[q] = g0; r1[q] = g1; r2[q] = g2;",
    "auto* const g = results + 3ll * (start + q); g[0] = r0[q]; g[1] = r1[q]; g[2] = r2[q];",
)


# One overload for points, and answers, of each precision.
@wp.func_native(_group("double", "r[G]", _VALUE_STORES))
def sample_group(
    table: LeafTable,
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.float64),
) -> wp.uint64:
    """Values at the points ``start`` to ``stop``, 64 at most; a bit for each that the table does not answer."""
    ...


@wp.func_native(_group("float", "r[G]", _VALUE_STORES))
def sample_group(  # noqa: F811
    table: LeafTable,
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3f),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.float32),
) -> wp.uint64: ...


@wp.func_native(_group("double", "r0[G], r1[G], r2[G]", _GRADIENT_STORES))
def gradient_group(
    table: LeafTable,
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.vec3d),
) -> wp.uint64:
    """As sample_group, world gradients."""
    ...


@wp.func_native(_group("float", "r0[G], r1[G], r2[G]", _GRADIENT_STORES))
def gradient_group(  # noqa: F811
    table: LeafTable,
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3f),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.vec3f),
) -> wp.uint64: ...


def _single(sums):
    """C++ for one query at index coordinates (u0, u1, u2); NaN where the tree has to be asked."""
    return f"""
{_SET_UP}
    const double i0 = floor(u0), j0 = floor(u1), k0 = floor(u2);
    const double i1 = i0 - lower_x, j1 = j0 - lower_y, k1 = k0 - lower_z;
    if (!(i1 >= 0.0 && i1 <= last_x && j1 >= 0.0 && j1 <= last_y && k1 >= 0.0 && k1 <= last_z)) NONE
    const int i = (int)i1, j = (int)j1, k = (int)k1;
    const double x = u0 - i0, y = u1 - j0, z = u2 - k0;
    const auto entry_of = [&](int a, int b, int c) {{
        {_placed(_ENTRY, "a", "b", "c")}
        return entry;
    }};
    const int e000 = entry_of(i, j, k);
    double c0, c1, c2, c3, c4, c5, c6, c7;
    if (e000 >= 0 && table.pairs.data) {{
        struct alignas(8) Pair {{ float low, high; }};
        const Pair* const p = (const Pair*)table.pairs.data
            + ((long long)((e000 - table.first_leaf) / 67) * 648 + (((i & 7) * 8 + (j & 7)) * 9 + (k & 7)));
        const Pair near_0 = p[0], near_1 = p[1], far_0 = p[72], far_1 = p[73];
        c0 = (double)near_0.low; c1 = (double)near_1.low; c2 = (double)near_0.high; c3 = (double)near_1.high;
        c4 = (double)far_0.low; c5 = (double)far_1.low; c6 = (double)far_0.high; c7 = (double)far_1.high;
    }} else {{
        // Of the leaves around a cell only those are looked up that it reaches into.
        const bool next_x = (i & 7) == 7, next_y = (j & 7) == 7, next_z = (k & 7) == 7;
        const int e001 = next_z ? entry_of(i, j, k + 1) : e000;
        const int e010 = next_y ? entry_of(i, j + 1, k) : e000;
        const int e100 = next_x ? entry_of(i + 1, j, k) : e000;
        const int e011 = !next_y ? e001 : next_z ? entry_of(i, j + 1, k + 1) : e010;
        const int e101 = !next_x ? e001 : next_z ? entry_of(i + 1, j, k + 1) : e100;
        const int e110 = !next_x ? e010 : next_y ? entry_of(i + 1, j + 1, k) : e100;
        const int e111 = !next_x ? e011 : !next_y ? e101 : next_z ? entry_of(i + 1, j + 1, k + 1) : e110;
        const auto voxel = [&](int entry, int n) {{
            return (double)voxels[entry < 0 ? (long long)~entry : (long long)entry * 8 + 24 + n];
        }};
        const int x0 = (i & 7) << 6, x1 = ((i + 1) & 7) << 6;
        const int y0 = (j & 7) << 3, y1 = ((j + 1) & 7) << 3;
        const int z0 = k & 7, z1 = (k + 1) & 7;
        c0 = voxel(e000, x0 | y0 | z0); c1 = voxel(e001, x0 | y0 | z1);
        c2 = voxel(e010, x0 | y1 | z0); c3 = voxel(e011, x0 | y1 | z1);
        c4 = voxel(e100, x1 | y0 | z0); c5 = voxel(e101, x1 | y0 | z1);
        c6 = voxel(e110, x1 | y1 | z0); c7 = voxel(e111, x1 | y1 | z1);
    }}
    {sums}
"""


@wp.func_native((_single(_VALUE_SUM) + "return value;").replace("NONE", "return (double)NAN;"))
def sample_single(
    table: LeafTable, u0: wp.float64, u1: wp.float64, u2: wp.float64, origin: wp.vec3d, to_index: wp.mat33d
) -> wp.float64:
    """The value at index coordinates; NaN where the table does not answer."""
    ...


@wp.func_native(
    (_single(_GRADIENT_SUM) + "return wp::vec_t<3, double>(g0, g1, g2);").replace(
        "NONE", "return wp::vec_t<3, double>((double)NAN);"
    )
)
def gradient_single(
    table: LeafTable, u0: wp.float64, u1: wp.float64, u2: wp.float64, origin: wp.vec3d, to_index: wp.mat33d
) -> wp.vec3d:
    """The world gradient at index coordinates; NaN where the table does not answer."""
    ...


@wp.func
def tree_gradient(volume: wp.uint64, u: wp.vec3d, to_index: wp.mat33d) -> wp.vec3d:
    a, b, c = linear_differences(volume, u, wp.float64(0.0))
    return wp.vec3d(
        world_derivative(a, b, c, to_index, 0),
        world_derivative(a, b, c, to_index, 1),
        world_derivative(a, b, c, to_index, 2),
    )


# Kernels. On a CPU an item is a group of queries, on CUDA a query. What the table does not answer goes through the
# tree; points that are not finite are among it, and make out_bad 1.
@wp.kernel
def sample_groups_kernel(
    first: int,
    volume: wp.uint64,
    table: LeafTable,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.float64,
    out_value: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    start = (first + wp.tid()) * GROUP
    stop = wp.min(start + GROUP, points.shape[0])
    left = sample_group(table, start, stop, points, origin, to_index, out_value)
    if left != wp.uint64(0):
        for q in range(start, stop):
            if (left >> wp.uint64(q - start)) & wp.uint64(1) == wp.uint64(1):
                point = wp.vec3d(points[q])
                if not wp.isfinite(point):
                    out_bad[0] = 1
                u = to_index * (point - origin)
                out_value[q] = out_value.dtype(linear_value(volume, u, background))


@wp.kernel
def gradient_groups_kernel(
    first: int,
    volume: wp.uint64,
    table: LeafTable,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.float64,
    out_gradient: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    start = (first + wp.tid()) * GROUP
    stop = wp.min(start + GROUP, points.shape[0])
    left = gradient_group(table, start, stop, points, origin, to_index, out_gradient)
    if left != wp.uint64(0):
        for q in range(start, stop):
            if (left >> wp.uint64(q - start)) & wp.uint64(1) == wp.uint64(1):
                point = wp.vec3d(points[q])
                if not wp.isfinite(point):
                    out_bad[0] = 1
                u = to_index * (point - origin)
                out_gradient[q] = out_gradient.dtype(tree_gradient(volume, u, to_index))


@wp.kernel
def sample_singles_kernel(
    first: int,
    volume: wp.uint64,
    table: LeafTable,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.float64,
    out_value: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    point = wp.vec3d(points[i])
    u = to_index * (point - origin)
    value = sample_single(table, u[0], u[1], u[2], origin, to_index)
    if wp.isnan(value):
        if not wp.isfinite(point):
            out_bad[0] = 1
        value = linear_value(volume, u, background)
    out_value[i] = out_value.dtype(value)


@wp.kernel
def gradient_singles_kernel(
    first: int,
    volume: wp.uint64,
    table: LeafTable,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.float64,
    out_gradient: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    point = wp.vec3d(points[i])
    u = to_index * (point - origin)
    g = gradient_single(table, u[0], u[1], u[2], origin, to_index)
    if wp.isnan(g[0]):
        if not wp.isfinite(point):
            out_bad[0] = 1
        g = tree_gradient(volume, u, to_index)
    out_gradient[i] = out_gradient.dtype(g)


def _overloads(kernel, out, single, double):
    """By whether points and answers are float32."""
    return {
        is_single: wp.overload(kernel, {"points": wp.array(dtype=rows), out: wp.array(dtype=answers)})
        for is_single, rows, answers in ((True, wp.vec3f, single), (False, wp.vec3d, double))
    }


SAMPLE_GROUPS = _overloads(sample_groups_kernel, "out_value", wp.float32, wp.float64)
SAMPLE_SINGLES = _overloads(sample_singles_kernel, "out_value", wp.float32, wp.float64)
GRADIENT_GROUPS = _overloads(gradient_groups_kernel, "out_gradient", wp.vec3f, wp.vec3d)
GRADIENT_SINGLES = _overloads(gradient_singles_kernel, "out_gradient", wp.vec3f, wp.vec3d)
