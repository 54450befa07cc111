"""The trilinear interpolant of float grids, and its gradient, through the leaf table.

On a CPU a thread handles 64 queries at a time. Their positions are computed by vector arithmetic, and the voxels of all
of them are prefetched before the first is read. Two thirds of all cells lie in one leaf and most others in two; the
leaves of a cell's first and last voxel tell which. So two look-ups are enough, without a branch. The remaining
twentieth looks up all eight voxels.

All sums are those of sample_kernels, in the same order, so answers agree to the last bit.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.sampling.leaf_table_kernels import LeafTable
from geokit.volume.sampling.sample_kernels import linear_differences, linear_value, world_gradient

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Queries of a thread on a CPU: one for each bit of the mask of queries that the table does not answer.
GROUP = wp.constant(64)


# Points and answers: values and gradients, of each precision.
ANSWERS = ((wp.vec3d, wp.float64), (wp.vec3f, wp.float32), (wp.vec3d, wp.vec3d), (wp.vec3f, wp.vec3f))

for _point, _answer in ANSWERS:

    @cpp.func_native("volume/sampling/trilinear_cpu.inl")
    def interpolate_group(table: LeafTable, points: wp.array(dtype=_point), out: wp.array(dtype=_answer)) -> wp.uint64:
        """Answers the points ``start`` to ``stop``, 64 at most; returns a bit mask of those that are left."""
        ...


# Overloads: values or gradients, by the type of the last argument.
@cpp.func_native("volume/sampling/trilinear.inl", function="table_value")
def interpolate_single(table: LeafTable, u: wp.vec3d, to_index: wp.mat33d, background: wp.float64) -> wp.float64:
    """The answer at index coordinates; NaN where the table does not answer."""
    ...


@cpp.func_native("volume/sampling/trilinear.inl", function="table_slopes")
def interpolate_single(  # noqa: F811
    table: LeafTable, u: wp.vec3d, to_index: wp.mat33d, background: wp.vec3d
) -> wp.vec3d: ...


@wp.func
def interpolate_by_tree(volume: wp.uint64, u: wp.vec3d, to_index: wp.mat33d, background: wp.float64):
    return linear_value(volume, u, background)


@wp.func
def interpolate_by_tree(volume: wp.uint64, u: wp.vec3d, to_index: wp.mat33d, background: wp.vec3d):  # noqa: F811
    a, b, c = linear_differences(volume, u, wp.float64(0.0))
    return world_gradient(a, b, c, to_index)


# An item is a group of queries on a CPU, a single query on CUDA. Queries that the table does not answer go through the
# tree. Non-finite points are among them and set out_nonfinite to 1. ``background`` is the grid's background for values,
# and a zero vector for gradients.
@wp.kernel
def interpolate_cpu_kernel(
    first: int,
    volume: wp.uint64,
    table: LeafTable,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: Any,
    out: wp.array(dtype=Any),
    out_nonfinite: wp.array(dtype=int),
):
    start = (first + wp.tid()) * GROUP
    stop = wp.min(start + GROUP, points.shape[0])
    left = interpolate_group(table, start, stop, points, origin, to_index, out)
    if left != wp.uint64(0):
        for q in range(start, stop):
            if (left >> wp.uint64(q - start)) & wp.uint64(1) == wp.uint64(1):
                point = wp.vec3d(points[q])
                if not wp.isfinite(point):
                    out_nonfinite[0] = 1
                u = to_index * (point - origin)
                out[q] = out.dtype(interpolate_by_tree(volume, u, to_index, background))


@wp.kernel
def interpolate_cuda_kernel(
    first: int,
    volume: wp.uint64,
    table: LeafTable,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: Any,
    out: wp.array(dtype=Any),
    out_nonfinite: wp.array(dtype=int),
):
    i = first + wp.tid()
    point = wp.vec3d(points[i])
    u = to_index * (point - origin)
    found = interpolate_single(table, u, to_index, background)
    if wp.isnan(found):
        if not wp.isfinite(point):
            out_nonfinite[0] = 1
        found = interpolate_by_tree(volume, u, to_index, background)
    out[i] = out.dtype(found)


def overloads(kernel: Any, background: Any, single: Any, double: Any) -> dict[bool, Any]:
    """Overloads of a kernel, keyed by whether points and answers are float32."""
    return {
        is_single: wp.overload(
            kernel, {"points": wp.array(dtype=rows), "background": background, "out": wp.array(dtype=answers)}
        )
        for is_single, rows, answers in ((True, wp.vec3f, single), (False, wp.vec3d, double))
    }


SAMPLE_CPU = overloads(interpolate_cpu_kernel, wp.float64, wp.float32, wp.float64)
SAMPLE_CUDA = overloads(interpolate_cuda_kernel, wp.float64, wp.float32, wp.float64)
GRADIENT_CPU = overloads(interpolate_cpu_kernel, wp.vec3d, wp.vec3f, wp.vec3d)
GRADIENT_CUDA = overloads(interpolate_cuda_kernel, wp.vec3d, wp.vec3f, wp.vec3d)
