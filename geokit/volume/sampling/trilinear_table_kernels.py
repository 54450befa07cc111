"""The trilinear interpolant of float grids, and its gradient, through a table of the leaves.

On a CPU a thread works on 64 queries side by side: their positions are vector arithmetic, and the voxels of all are on
their way from memory before the first is needed. A cell lies in one leaf (two thirds of all) or in two (most others):
its first and its last voxel say which. So two look-ups do, without a branch: where a cell crosses one border, the step
along that axis is the jump from one leaf into the other. What is left, a twentieth, looks up all eight voxels.

All sums are those of sample_kernels, in the same order: answers are equal to the last bit.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.sampling.leaf_table_kernels import LeafTable
from geokit.volume.sampling.sample_kernels import linear_differences, linear_value, world_derivative
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
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

_SET_UP = "const float* const voxels = (const float*)table.grid;" + tree_of("table") + box_of("table") + MATRIX


def _group(rows, total, keep, store):
    """C++ for up to 64 queries from ``start`` on; returns which of them have to be asked of the tree."""
    return f"""
#if !defined(__CUDA_ARCH__)
{_SET_UP}
{group_positions(rows)}
{group_steps("voxels")}
{group_cells("voxels", "")}
{group_sums(rows, total, keep, store)}
#else
    return 0ull;
#endif
"""


_VALUES = "r[G]", VALUE_SUM + "\nr[q] = value;", "results[start + q] = r[q];"
_GRADIENTS = (
    "r0[G], r1[G], r2[G]",
    GRADIENT_SUM + "\nr0[q] = g0; r1[q] = g1; r2[q] = g2;",
    "auto* const g = results + 3ll * (start + q); g[0] = r0[q]; g[1] = r1[q]; g[2] = r2[q];",
)


# One overload for points, and answers, of each precision.
@wp.func_native(_group("double", *_VALUES))
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


@wp.func_native(_group("float", *_VALUES))
def sample_group(  # noqa: F811
    table: LeafTable,
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3f),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.float32),
) -> wp.uint64: ...


@wp.func_native(_group("double", *_GRADIENTS))
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


@wp.func_native(_group("float", *_GRADIENTS))
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
    const int a = (int)i1, b = (int)j1, c = (int)k1;
    const double x = u0 - i0, y = u1 - j0, z = u2 - k0;
    {ENTRY_OF}
    const int e000 = entry_of(a, b, c);
    {SINGLE_CELL}
    {sums}
"""


@wp.func_native((_single(VALUE_SUM) + "return value;").replace("NONE", "return (double)NAN;"))
def sample_single(
    table: LeafTable, u0: wp.float64, u1: wp.float64, u2: wp.float64, origin: wp.vec3d, to_index: wp.mat33d
) -> wp.float64:
    """The value at index coordinates; NaN where the table does not answer."""
    ...


@wp.func_native(
    (_single(GRADIENT_SUM) + "return wp::vec_t<3, double>(g0, g1, g2);").replace(
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


SAMPLE_GROUPS = overloads(sample_groups_kernel, "out_value", wp.float32, wp.float64)
SAMPLE_SINGLES = overloads(sample_singles_kernel, "out_value", wp.float32, wp.float64)
GRADIENT_GROUPS = overloads(gradient_groups_kernel, "out_gradient", wp.vec3f, wp.vec3d)
GRADIENT_SINGLES = overloads(gradient_singles_kernel, "out_gradient", wp.vec3f, wp.vec3d)
