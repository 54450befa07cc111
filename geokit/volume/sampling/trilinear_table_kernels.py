"""The trilinear interpolant of float grids, and its gradient, through a table of the leaves.

On a CPU a thread works on 64 queries side by side: their positions are vector arithmetic, and the voxels of all are
prefetched before the first is needed. A cell lies in one leaf (two thirds of all) or in two (most others): its first
and its last voxel say which. So two look-ups are enough, without a branch. The remaining twentieth looks up all eight
voxels.

All sums are those of sample_kernels, in the same order: answers are equal to the last bit.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.cpp import cpp
from geokit.volume.sampling.leaf_table_kernels import LeafTable
from geokit.volume.sampling.sample_kernels import linear_differences, linear_value, world_derivative

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Queries of a thread on a CPU: as many bits as the mask of those that the table does not answer.
GROUP = wp.constant(64)


def _cells(gradient: int, real: str | None = None) -> str:
    defines = {"FIRST_TABLE": "table", "GRADIENT": str(gradient)}
    if real is not None:
        defines["REAL"] = real
    return cpp("volume/sampling/trilinear_cells.inl", defines=defines)


# One overload for values and for gradients, and for points and answers of each precision.
@wp.func_native(_cells(0, "double"))
def interpolate_group(
    table: LeafTable,
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.float64),
) -> wp.uint64:
    """Answers at the points ``start`` to ``stop``, 64 at most; a bit for each that the table does not answer."""
    ...


@wp.func_native(_cells(0, "float"))
def interpolate_group(  # noqa: F811
    table: LeafTable,
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3f),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.float32),
) -> wp.uint64: ...


@wp.func_native(_cells(1, "double"))
def interpolate_group(  # noqa: F811
    table: LeafTable,
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.vec3d),
) -> wp.uint64: ...


@wp.func_native(_cells(1, "float"))
def interpolate_group(  # noqa: F811
    table: LeafTable,
    start: int,
    stop: int,
    points: wp.array(dtype=wp.vec3f),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out: wp.array(dtype=wp.vec3f),
) -> wp.uint64: ...


# One overload for values and for gradients, chosen by the type of the last argument.
@wp.func_native(_cells(0))
def interpolate_single(table: LeafTable, u: wp.vec3d, to_index: wp.mat33d, background: wp.float64) -> wp.float64:
    """The answer at index coordinates; NaN where the table does not answer."""
    ...


@wp.func_native(_cells(1))
def interpolate_single(  # noqa: F811
    table: LeafTable, u: wp.vec3d, to_index: wp.mat33d, background: wp.vec3d
) -> wp.vec3d: ...


@wp.func
def interpolate_by_tree(volume: wp.uint64, u: wp.vec3d, to_index: wp.mat33d, background: wp.float64):
    return linear_value(volume, u, background)


@wp.func
def interpolate_by_tree(volume: wp.uint64, u: wp.vec3d, to_index: wp.mat33d, background: wp.vec3d):  # noqa: F811
    a, b, c = linear_differences(volume, u, wp.float64(0.0))
    return wp.vec3d(
        world_derivative(a, b, c, to_index, 0),
        world_derivative(a, b, c, to_index, 1),
        world_derivative(a, b, c, to_index, 2),
    )


@wp.func
def is_unanswered(value: wp.float64) -> bool:
    return wp.isnan(value)


@wp.func
def is_unanswered(slope: wp.vec3d) -> bool:  # noqa: F811
    return wp.isnan(slope[0])


# Kernels. On a CPU an item is a group of queries, on CUDA a query. Queries that the table does not answer go through
# the tree; points that are not finite are among them, and make out_bad 1. ``background`` is the grid's, for values, and
# a zero vector for gradients.
@wp.kernel
def interpolate_groups_kernel(
    first: int,
    volume: wp.uint64,
    table: LeafTable,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: Any,
    out: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    start = (first + wp.tid()) * GROUP
    stop = wp.min(start + GROUP, points.shape[0])
    left = interpolate_group(table, start, stop, points, origin, to_index, out)
    if left != wp.uint64(0):
        for q in range(start, stop):
            if (left >> wp.uint64(q - start)) & wp.uint64(1) == wp.uint64(1):
                point = wp.vec3d(points[q])
                if not wp.isfinite(point):
                    out_bad[0] = 1
                u = to_index * (point - origin)
                out[q] = out.dtype(interpolate_by_tree(volume, u, to_index, background))


@wp.kernel
def interpolate_singles_kernel(
    first: int,
    volume: wp.uint64,
    table: LeafTable,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: Any,
    out: wp.array(dtype=Any),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    point = wp.vec3d(points[i])
    u = to_index * (point - origin)
    found = interpolate_single(table, u, to_index, background)
    if is_unanswered(found):
        if not wp.isfinite(point):
            out_bad[0] = 1
        found = interpolate_by_tree(volume, u, to_index, background)
    out[i] = out.dtype(found)


def overloads(kernel: Any, background: Any, single: Any, double: Any) -> dict[bool, Any]:
    """A kernel by whether points and answers are float32."""
    return {
        is_single: wp.overload(
            kernel, {"points": wp.array(dtype=rows), "background": background, "out": wp.array(dtype=answers)}
        )
        for is_single, rows, answers in ((True, wp.vec3f, single), (False, wp.vec3d, double))
    }


SAMPLE_GROUPS = overloads(interpolate_groups_kernel, wp.float64, wp.float32, wp.float64)
SAMPLE_SINGLES = overloads(interpolate_singles_kernel, wp.float64, wp.float32, wp.float64)
GRADIENT_GROUPS = overloads(interpolate_groups_kernel, wp.vec3d, wp.vec3f, wp.vec3d)
GRADIENT_SINGLES = overloads(interpolate_singles_kernel, wp.vec3d, wp.vec3f, wp.vec3d)
