"""The interpolant of an adaptive field, and its gradient: of each point in the finest cell that answers for it.

A point's cell of level 0 is found as in any grid. As long as the cell's bit says that the next level answers, the half
of the cell that the point lies in is the next cell; its fraction is doubled, which rounds nothing. Sums are those of
_linear_kernels, in the same order: a field of one level gives what a volume gives, and a CPU what a GPU gives.

On a CPU a thread works on 64 queries side by side, as there; those whose cell of level 0 is handed on go down one by
one before the voxels of all are asked for.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume._leaf_table_kernels import LeafTable
from geokit.volume._linear_kernels import _AT, _ENTRY, _GRADIENT_SUM, _VALUE_SUM, GROUP, _placed

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# C++ that goes down from the cell (i, j, k) of level 0, and the fraction (x, y, z) in it, to the cell that answers:
# its level, its place (a, b, c) in the box of the level's table, and the entry e000 of its first voxel.
_DESCENT = f"""
    int level = 0, e000, a, b, c;
    for (;;) {{
        const auto& table = levels.data[level];
        const int* const top = table.top.data;
        const int* const slots = table.slots.data;
        const int size_y = table.size[1], size_z = table.size[2];
        a = i - table.lower[0]; b = j - table.lower[1]; c = k - table.lower[2];
        {_placed(_ENTRY, "a", "b", "c")}
        e000 = entry;
        if (entry < 0 || level + 1 == levels.shape[0]) break;
        const unsigned bits = finer.data[first_word.data[level] + 16ll * ((entry - first_entry.data[level]) / 67)
            + ((a & 7) << 1 | (b & 7) >> 2)];
        if (!((bits >> ((b & 3) << 3 | (c & 7))) & 1u)) break;
        const int p = x >= 0.5, q = y >= 0.5, r = z >= 0.5;
        const auto& moved = shift.data[level];
        i = 2 * i + moved[0] + p; j = 2 * j + moved[1] + q; k = 2 * k + moved[2] + r;
        x = 2.0 * x - p; y = 2.0 * y - q; z = 2.0 * z - r;
        ++level;
    }}
    const auto& table = levels.data[level];
    const int* const top = table.top.data;
    const int* const slots = table.slots.data;
    const int size_y = table.size[1], size_z = table.size[2];
    const auto entry_of = [&](int f, int g, int h) {{
        {_placed(_ENTRY, "f", "g", "h")}
        return entry;
    }};
"""
_COARSEST = """
    const auto& coarsest = levels.data[0];
    const int lower_x = coarsest.lower[0], lower_y = coarsest.lower[1], lower_z = coarsest.lower[2];
    const int coarse_y = coarsest.size[1], coarse_z = coarsest.size[2];
    const int last_x = coarsest.size[0] * 128 - 2, last_y = coarse_y * 128 - 2, last_z = coarse_z * 128 - 2;
    const double m00 = to_index.data[0][0], m01 = to_index.data[0][1], m02 = to_index.data[0][2];
    const double m10 = to_index.data[1][0], m11 = to_index.data[1][1], m12 = to_index.data[1][2];
    const double m20 = to_index.data[2][0], m21 = to_index.data[2][1], m22 = to_index.data[2][2];
"""


def _group(rows, total, stores):
    """C++ for up to 64 queries from ``start`` on; returns which of them lie beyond the box of level 0."""
    return f"""
#if !defined(__CUDA_ARCH__)
{_COARSEST}
    constexpr int G = 64;
    const int* const coarse_top = coarsest.top.data;
    const int* const coarse_slots = coarsest.slots.data;
    const unsigned* const words = finer.data + first_word.data[0];
    const int coarse_first = first_entry.data[0];
    const bool alone = levels.shape[0] == 1;
    const double origin_x = origin[0], origin_y = origin[1], origin_z = origin[2];
    const {rows}* const rows = (const {rows}*)points.data;
    const int count = stop - start < G ? stop - start : G;
    double u[G], v[G], w[G];
    for (int q = 0; q < G; ++q) {{
        const {rows}* const p = rows + 3ll * (start + (q < count ? q : 0));
        u[q] = (double)p[0]; v[q] = (double)p[1]; w[q] = (double)p[2];
    }}
    int at_x[G], at_y[G], at_z[G], outside[G], level_of[G];
    for (int q = 0; q < G; ++q) {{
        const double x = u[q] - origin_x, y = v[q] - origin_y, z = w[q] - origin_z;
        const double a = m00 * x + m01 * y + m02 * z, b = m10 * x + m11 * y + m12 * z, c = m20 * x + m21 * y + m22 * z;
        const double i0 = __builtin_floor(a), j0 = __builtin_floor(b), k0 = __builtin_floor(c);
        u[q] = a - i0; v[q] = b - j0; w[q] = c - k0;
        const double i1 = i0 - lower_x, j1 = j0 - lower_y, k1 = k0 - lower_z;
        // False for NaN as well.
        const bool inside = (i1 >= 0.0) & (i1 <= last_x) & (j1 >= 0.0) & (j1 <= last_y) & (k1 >= 0.0) & (k1 <= last_z);
        outside[q] = !inside;
        at_x[q] = inside ? (int)i1 : 0; at_y[q] = inside ? (int)j1 : 0; at_z[q] = inside ? (int)k1 : 0;
        level_of[q] = 0;
    }}
    int first_top[G], first_slot[G], last_top[G], last_slot[G], word[G], bit[G];
    for (int q = 0; q < G; ++q) {{
        const int x = at_x[q], y = at_y[q], z = at_z[q], x1 = x + 1, y1 = y + 1, z1 = z + 1;
        first_top[q] = ((x >> 7) * coarse_y + (y >> 7)) * coarse_z + (z >> 7);
        first_slot[q] = ((x >> 3) & 15) << 8 | ((y >> 3) & 15) << 4 | ((z >> 3) & 15);
        last_top[q] = ((x1 >> 7) * coarse_y + (y1 >> 7)) * coarse_z + (z1 >> 7);
        last_slot[q] = ((x1 >> 3) & 15) << 8 | ((y1 >> 3) & 15) << 4 | ((z1 >> 3) & 15);
        word[q] = (x & 7) << 1 | (y & 7) >> 2;
        bit[q] = (y & 3) << 3 | (z & 7);
    }}
    int first[G], last[G];
    const float* voxels[G];
    for (int q = 0; q < G; ++q) {{
        const int a = coarse_top[first_top[q]], b = coarse_top[last_top[q]];
        first[q] = a < 0 ? a : coarse_slots[a + first_slot[q]];
        last[q] = b < 0 ? b : coarse_slots[b + last_slot[q]];
        voxels[q] = (const float*)coarsest.grid;
    }}
    unsigned long long handed_on = 0;
    for (int q = 0; q < G; ++q) {{
        const bool leaf = (first[q] >= 0) & !alone;
        const unsigned some = words[leaf ? 16ll * ((first[q] - coarse_first) / 67) + word[q] : 0];
        handed_on |= (unsigned long long)(leaf & ((some >> bit[q]) & 1u)) << q;
    }}
    for (; handed_on; handed_on &= handed_on - 1) {{
        const int n = __builtin_ctzll(handed_on);
        int i = at_x[n] + lower_x, j = at_y[n] + lower_y, k = at_z[n] + lower_z;
        double x = u[n], y = v[n], z = w[n];
        {_DESCENT}
        at_x[n] = a; at_y[n] = b; at_z[n] = c;
        u[n] = x; v[n] = y; w[n] = z;
        first[n] = e000; last[n] = entry_of(a + 1, b + 1, c + 1);
        voxels[n] = (const float*)table.grid;
        level_of[n] = level;
    }}
    long long at[G], step_x[G], step_y[G], step_z[G];
    int apart[G];
    for (int q = 0; q < G; ++q) {{
        const int x = at_x[q] & 7, y = at_y[q] & 7, z = at_z[q] & 7;
        const int borders = (x == 7) + (y == 7) + (z == 7);
        const long long leaf = (long long)first[q] * 8, jump = (long long)last[q] * 8 - leaf;
        const bool tile = first[q] < 0;
        apart[q] = (borders > 1) | ((borders == 1) & (tile | (last[q] < 0)));
        at[q] = tile ? (long long)~first[q] : leaf + 24 + (x << 6 | y << 3 | z);
        step_x[q] = tile ? 0 : x == 7 ? jump - 448 : 64;
        step_y[q] = tile ? 0 : y == 7 ? jump - 56 : 8;
        step_z[q] = tile ? 0 : z == 7 ? jump - 7 : 1;
    }}
    for (int q = 0; q < G; ++q) {{
        const float* const n = voxels[q] + at[q];
        const float* const far = apart[q] ? n : n + step_x[q];
        const long long up = apart[q] ? 0 : step_y[q];
        __builtin_prefetch(n);
        __builtin_prefetch(n + up);
        __builtin_prefetch(far);
        __builtin_prefetch(far + up);
    }}
    float cell[8][G];
    unsigned long long left = 0;
    for (int q = 0; q < G; ++q) {{
        left |= (unsigned long long)(outside[q] != 0) << q;
        if (!apart[q]) {{
            const float* c = voxels[q] + at[q];
            const long long y = step_y[q], z = step_z[q];
            cell[0][q] = c[0]; cell[1][q] = c[z]; cell[2][q] = c[y]; cell[3][q] = c[y + z];
            c += step_x[q];
            cell[4][q] = c[0]; cell[5][q] = c[z]; cell[6][q] = c[y]; cell[7][q] = c[y + z];
        }} else {{
            const auto& table = levels.data[level_of[q]];
            const int* const top = table.top.data;
            const int* const slots = table.slots.data;
            const int size_y = table.size[1], size_z = table.size[2];
            for (int n = 0; n < 8; ++n) {{
                const int x = at_x[q] + (n >> 2), y = at_y[q] + ((n >> 1) & 1), z = at_z[q] + (n & 1);
                {_placed(_ENTRY + _AT, "x", "y", "z")}
                cell[n][q] = voxels[q][at];
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
    # A level's voxels are smaller by a power of two, and its slopes by as much steeper in the units of level 0.
    _GRADIENT_SUM + "\nconst double s = (double)(1ll << level_of[q]); r0[q] = s * g0; r1[q] = s * g1; r2[q] = s * g2;",
    "auto* const g = results + 3ll * (start + q); g[0] = r0[q]; g[1] = r1[q]; g[2] = r2[q];",
)


# One overload for points, and answers, of each precision.
@wp.func_native(_group("double", "r[G]", _VALUE_STORES))
def adaptive_group(
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.float64),
) -> wp.uint64:
    """Values at the points ``start`` to ``stop``, 64 at most; a bit for each that lies beyond the box of level 0."""
    ...


@wp.func_native(_group("float", "r[G]", _VALUE_STORES))
def adaptive_group(  # noqa: F811
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3f),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.float32),
) -> wp.uint64: ...


@wp.func_native(_group("double", "r0[G], r1[G], r2[G]", _GRADIENT_STORES))
def adaptive_gradient_group(
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.vec3d),
) -> wp.uint64:
    """As adaptive_group, world gradients."""
    ...


@wp.func_native(_group("float", "r0[G], r1[G], r2[G]", _GRADIENT_STORES))
def adaptive_gradient_group(  # noqa: F811
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3f),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.vec3f),
) -> wp.uint64: ...


def _single(sums):
    """C++ for one query at index coordinates (u0, u1, u2) of level 0; NONE beyond the box of its table."""
    return f"""
{_COARSEST}
    const double i0 = floor(u0), j0 = floor(u1), k0 = floor(u2);
    const double i1 = i0 - lower_x, j1 = j0 - lower_y, k1 = k0 - lower_z;
    if (!(i1 >= 0.0 && i1 <= last_x && j1 >= 0.0 && j1 <= last_y && k1 >= 0.0 && k1 <= last_z)) NONE
    int i = (int)i0, j = (int)j0, k = (int)k0;
    double x = u0 - i0, y = u1 - j0, z = u2 - k0;
    {_DESCENT}
    const float* const voxels = (const float*)table.grid;
    double c0, c1, c2, c3, c4, c5, c6, c7;
    if (e000 >= 0 && table.pairs.data) {{
        struct alignas(8) Pair {{ float low, high; }};
        const Pair* const p = (const Pair*)table.pairs.data
            + ((long long)((e000 - table.first_leaf) / 67) * 648 + (((a & 7) * 8 + (b & 7)) * 9 + (c & 7)));
        const Pair near_0 = p[0], near_1 = p[1], far_0 = p[72], far_1 = p[73];
        c0 = (double)near_0.low; c1 = (double)near_1.low; c2 = (double)near_0.high; c3 = (double)near_1.high;
        c4 = (double)far_0.low; c5 = (double)far_1.low; c6 = (double)far_0.high; c7 = (double)far_1.high;
    }} else {{
        // Of the leaves around a cell only those are looked up that it reaches into.
        const bool next_x = (a & 7) == 7, next_y = (b & 7) == 7, next_z = (c & 7) == 7;
        const int e001 = next_z ? entry_of(a, b, c + 1) : e000;
        const int e010 = next_y ? entry_of(a, b + 1, c) : e000;
        const int e100 = next_x ? entry_of(a + 1, b, c) : e000;
        const int e011 = !next_y ? e001 : next_z ? entry_of(a, b + 1, c + 1) : e010;
        const int e101 = !next_x ? e001 : next_z ? entry_of(a + 1, b, c + 1) : e100;
        const int e110 = !next_x ? e010 : next_y ? entry_of(a + 1, b + 1, c) : e100;
        const int e111 = !next_x ? e011 : !next_y ? e101 : next_z ? entry_of(a + 1, b + 1, c + 1) : e110;
        const auto voxel = [&](int entry, int n) {{
            return (double)voxels[entry < 0 ? (long long)~entry : (long long)entry * 8 + 24 + n];
        }};
        const int x0 = (a & 7) << 6, x1 = ((a + 1) & 7) << 6;
        const int y0 = (b & 7) << 3, y1 = ((b + 1) & 7) << 3;
        const int z0 = c & 7, z1 = (c + 1) & 7;
        c0 = voxel(e000, x0 | y0 | z0); c1 = voxel(e001, x0 | y0 | z1);
        c2 = voxel(e010, x0 | y1 | z0); c3 = voxel(e011, x0 | y1 | z1);
        c4 = voxel(e100, x1 | y0 | z0); c5 = voxel(e101, x1 | y0 | z1);
        c6 = voxel(e110, x1 | y1 | z0); c7 = voxel(e111, x1 | y1 | z1);
    }}
    {sums}
"""


@wp.func_native((_single(_VALUE_SUM) + "return value;").replace("NONE", "return (double)NAN;"))
def adaptive_single(
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    u0: wp.float64,
    u1: wp.float64,
    u2: wp.float64,
    to_index: wp.mat33d,
) -> wp.float64:
    """The value at index coordinates of level 0; NaN beyond the box of its table."""
    ...


@wp.func_native(
    (
        _single(_GRADIENT_SUM)
        + "const double s = (double)(1ll << level); return wp::vec_t<3, double>(s * g0, s * g1, s * g2);"
    ).replace("NONE", "return wp::vec_t<3, double>((double)NAN);")
)
def adaptive_gradient_single(
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    u0: wp.float64,
    u1: wp.float64,
    u2: wp.float64,
    to_index: wp.mat33d,
) -> wp.vec3d:
    """The world gradient at index coordinates of level 0; NaN beyond the box of its table."""
    ...


# Kernels. On a CPU an item is a group of queries, on CUDA a query. What lies beyond the box of level 0 is background;
# points that are not finite are among it, and make out_bad 1.
@wp.kernel
def sample_adaptive_groups_kernel(
    first: int,
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    outside: wp.float64,
    out_value: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    start = (first + wp.tid()) * GROUP
    stop = wp.min(start + GROUP, points.shape[0])
    left = adaptive_group(
        levels, finer, first_word, first_entry, shift, start, stop, points, origin, to_index, out_value
    )
    if left != wp.uint64(0):
        for q in range(start, stop):
            if (left >> wp.uint64(q - start)) & wp.uint64(1) == wp.uint64(1):
                if not wp.isfinite(wp.vec3d(points[q])):
                    out_bad[0] = 1
                out_value[q] = out_value.dtype(outside)


@wp.kernel
def sample_adaptive_singles_kernel(
    first: int,
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    outside: wp.float64,
    out_value: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    point = wp.vec3d(points[i])
    u = to_index * (point - origin)
    found = adaptive_single(levels, finer, first_word, first_entry, shift, u[0], u[1], u[2], to_index)
    if wp.isnan(found):
        if not wp.isfinite(point):
            out_bad[0] = 1
        found = outside
    out_value[i] = out_value.dtype(found)


@wp.kernel
def gradient_adaptive_groups_kernel(
    first: int,
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    outside: wp.vec3d,
    out_gradient: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    start = (first + wp.tid()) * GROUP
    stop = wp.min(start + GROUP, points.shape[0])
    left = adaptive_gradient_group(
        levels, finer, first_word, first_entry, shift, start, stop, points, origin, to_index, out_gradient
    )
    if left != wp.uint64(0):
        for q in range(start, stop):
            if (left >> wp.uint64(q - start)) & wp.uint64(1) == wp.uint64(1):
                if not wp.isfinite(wp.vec3d(points[q])):
                    out_bad[0] = 1
                out_gradient[q] = out_gradient.dtype(outside)


@wp.kernel
def gradient_adaptive_singles_kernel(
    first: int,
    levels: wp.array(dtype=LeafTable),
    finer: wp.array(dtype=wp.uint32),
    first_word: wp.array(dtype=wp.int64),
    first_entry: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3i),
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    outside: wp.vec3d,
    out_gradient: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    point = wp.vec3d(points[i])
    u = to_index * (point - origin)
    found = adaptive_gradient_single(levels, finer, first_word, first_entry, shift, u[0], u[1], u[2], to_index)
    if wp.isnan(found):
        if not wp.isfinite(point):
            out_bad[0] = 1
        found = outside
    out_gradient[i] = out_gradient.dtype(found)


def _overloads(kernel, out, single, double):
    """By whether points and answers are float32."""
    return {
        is_single: wp.overload(kernel, {"points": wp.array(dtype=rows), out: wp.array(dtype=answers)})
        for is_single, rows, answers in ((True, wp.vec3f, single), (False, wp.vec3d, double))
    }


SAMPLE_GROUPS = _overloads(sample_adaptive_groups_kernel, "out_value", wp.float32, wp.float64)
SAMPLE_SINGLES = _overloads(sample_adaptive_singles_kernel, "out_value", wp.float32, wp.float64)
GRADIENT_GROUPS = _overloads(gradient_adaptive_groups_kernel, "out_gradient", wp.vec3f, wp.vec3d)
GRADIENT_SINGLES = _overloads(gradient_adaptive_singles_kernel, "out_gradient", wp.vec3f, wp.vec3d)
