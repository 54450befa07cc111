"""The trilinear interpolant of float grids together with its gradient, through the leaf table.

The eight voxels of a cell are most of what a sample reads, so the gradient beside it costs little. Sums are those of
trilinear_table_kernels: each half of the answer has the bits that it has alone.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.core.gradients.sums_kernels import overloads
from geokit.volume.sampling.leaf_table_kernels import LeafTable
from geokit.volume.sampling.sample_kernels import linear_differences, linear_value, world_gradient

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


@cpp.func_native("volume/sampling/trilinear.inl")
def value_and_slopes(table: LeafTable, u: wp.vec3d, to_index: wp.mat33d) -> wp.vec4d:
    """The value at index coordinates, then the gradient; NaN where the table does not answer."""
    ...


@wp.kernel
def sample_slopes_at_once_kernel(
    first: int,
    volume: wp.uint64,
    table: LeafTable,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.float64,
    out_value: wp.array(dtype=Any),
    out_slopes: wp.array(dtype=Any),
    out_nonfinite: wp.array(dtype=int),
):
    i = first + wp.tid()
    point = wp.vec3d(points[i])
    u = to_index * (point - origin)
    found = value_and_slopes(table, u, to_index)
    value = found[0]
    slope = wp.vec3d(found[1], found[2], found[3])
    # Through the tree: also where a voxel is not finite, of which the answers there are the same.
    if wp.isnan(value) or wp.isnan(slope[0]):
        if not wp.isfinite(point):
            out_nonfinite[0] = 1
        value = linear_value(volume, u, background)
        a, b, c = linear_differences(volume, u, wp.float64(0.0))
        slope = world_gradient(a, b, c, to_index)
    out_value[i] = out_value.dtype(value)
    out_slopes[i] = out_slopes.dtype(slope)


# By the type of the points' coordinates.
AT_ONCE = overloads(sample_slopes_at_once_kernel, ("points", "out_slopes"), ("out_value",))
