"""The interpolant of an adaptive field, and its gradient: of each point in the finest cell that answers for it.

A point's cell of level 0 is found as in any grid. As long as the cell's bit says that the next level answers, the half
of the cell that the point lies in is the next cell; its fraction is doubled, which rounds nothing. Sums are those of
trilinear_table_kernels, in the same order: a field of one level gives what a volume gives, and a CPU what a GPU gives.

On a CPU a thread works on 64 queries side by side, as there; those whose cell of level 0 is handed on go down one by
one before the voxels of all are asked for.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.sampling.leaf_table_kernels import LeafTable
from geokit.volume.sampling.trilinear_cell_kernels import (
    ENTRY_OF,
    GRADIENT_SUM,
    GROUP,
    MATRIX,
    SINGLE_CELL,
    VALUE_SUM,
    box_of,
    group_cells,
    group_positions,
    group_steps,
    group_sums,
    overloads,
    tree_of,
    voxel_entry,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# C++ that goes down from the cell (i, j, k) of level 0, and the fraction (x, y, z) in it, to the cell that answers:
# its level, its place (a, b, c) in the box of the level's table, and the entry e000 of its first voxel.
_DESCENT = f"""
    int level = 0, e000, a, b, c;
    for (;;) {{
        const auto& table = levels.data[level];
        {tree_of("table")}
        a = i - table.lower[0]; b = j - table.lower[1]; c = k - table.lower[2];
        {voxel_entry("a", "b", "c")}
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
    {tree_of("table")}
    {ENTRY_OF}
"""
_COARSEST = "const auto& coarsest = levels.data[0];" + box_of("coarsest") + MATRIX


def _group(rows, total, keep, store):
    """C++ for up to 64 queries from ``start`` on; returns which of them lie beyond the box of level 0."""
    return f"""
#if !defined(__CUDA_ARCH__)
{_COARSEST}
{tree_of("coarsest")}
{group_positions(rows)}
    const unsigned* const words = finer.data + first_word.data[0];
    const int coarse_first = first_entry.data[0];
    const bool alone = levels.shape[0] == 1;
    int level_of[G];
    const float* voxels[G];
    unsigned long long handed_on = 0;
    for (int q = 0; q < G; ++q) {{
        level_of[q] = 0;
        voxels[q] = (const float*)coarsest.grid;
        const bool leaf = (first[q] >= 0) & !alone;
        const int y = at_y[q], word = (at_x[q] & 7) << 1 | (y & 7) >> 2, bit = (y & 3) << 3 | (at_z[q] & 7);
        const unsigned some = words[leaf ? 16ll * ((first[q] - coarse_first) / 67) + word : 0];
        handed_on |= (unsigned long long)(leaf & ((some >> bit) & 1u)) << q;
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
{group_steps("voxels[q]")}
{group_cells("voxels[q]", "const auto& table = levels.data[level_of[q]];" + tree_of("table"))}
{group_sums(rows, total, keep, store)}
#else
    return 0ull;
#endif
"""


_VALUES = "r[G]", VALUE_SUM + "\nr[q] = value;", "results[start + q] = r[q];"
_GRADIENTS = (
    "r0[G], r1[G], r2[G]",
    # A level's voxels are smaller by a power of two, and its slopes by as much steeper in the units of level 0.
    GRADIENT_SUM + "\nconst double s = (double)(1ll << level_of[q]); r0[q] = s * g0; r1[q] = s * g1; r2[q] = s * g2;",
    "auto* const g = results + 3ll * (start + q); g[0] = r0[q]; g[1] = r1[q]; g[2] = r2[q];",
)


# One overload for points, and answers, of each precision.
@wp.func_native(_group("double", *_VALUES))
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


@wp.func_native(_group("float", *_VALUES))
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


@wp.func_native(_group("double", *_GRADIENTS))
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


@wp.func_native(_group("float", *_GRADIENTS))
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
    {SINGLE_CELL}
    {sums}
"""


@wp.func_native((_single(VALUE_SUM) + "return value;").replace("NONE", "return (double)NAN;"))
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
        _single(GRADIENT_SUM)
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


SAMPLE_GROUPS = overloads(sample_adaptive_groups_kernel, "out_value", wp.float32, wp.float64)
SAMPLE_SINGLES = overloads(sample_adaptive_singles_kernel, "out_value", wp.float32, wp.float64)
GRADIENT_GROUPS = overloads(gradient_adaptive_groups_kernel, "out_gradient", wp.vec3f, wp.vec3d)
GRADIENT_SINGLES = overloads(gradient_adaptive_singles_kernel, "out_gradient", wp.vec3f, wp.vec3d)
