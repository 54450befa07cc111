"""Values and gradients of staggered vector grids, whose components lie on the faces of voxels.

Component c of voxel ijk is the field's value at ``ijk - e_c / 2``, the center of the face towards smaller indices. So
component c is sampled half a voxel beyond the point along axis c.

Source:
    OpenVDB (Museth 2013), StaggeredPointSampler, StaggeredBoxSampler and StaggeredQuadraticSampler.
"""

# mypy: ignore-errors
import warp as wp

from geokit.volume.sampling.sample_kernels import central_differences, linear_differences, linear_value, nearest_value
from geokit.volume.sampling.smooth_kernels import smooth_gradient, smooth_value
from geokit.volume.sampling.stencil_kernels import Cubic, Quadratic

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


@wp.func
def at_face(u: wp.vec3d, axis: int) -> wp.vec3d:
    """Index coordinates at which a component is sampled as if it lay at voxel centers."""
    moved = u
    moved[axis] = u[axis] + wp.float64(0.5)
    return moved


@wp.func
def value_of_order(volume: wp.uint64, u: wp.vec3d, order: int, background: wp.vec3d) -> wp.vec3d:
    if order == 0:
        return nearest_value(volume, u, background)
    if order == 1:
        return linear_value(volume, u, background)
    if order == 2:
        return smooth_value(volume, u, Quadratic(), background)
    return smooth_value(volume, u, Cubic(), background)


@wp.func
def gradient_of_order(volume: wp.uint64, u: wp.vec3d, order: int, zero: wp.vec3d):
    if order == 0:
        a, b, c = central_differences(volume, u, zero)
        return a, b, c
    if order == 1:
        a, b, c = linear_differences(volume, u, zero)
        return a, b, c
    if order == 2:
        a, b, c = smooth_gradient(volume, u, Quadratic(), zero)
        return a, b, c
    a, b, c = smooth_gradient(volume, u, Cubic(), zero)
    return a, b, c


@wp.kernel
def sample_staggered_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.vec3d,
    order: int,
    out_value: wp.array(dtype=wp.vec3d),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    value = wp.vec3d()
    for axis in range(3):
        at = value_of_order(volume, at_face(u, axis), order, background)
        value[axis] = at[axis]
    out_value[i] = value


@wp.kernel
def gradient_staggered_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    zero: wp.vec3d,
    order: int,
    out_jacobian: wp.array3d(dtype=wp.float64),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    for axis in range(3):
        a, b, c = gradient_of_order(volume, at_face(u, axis), order, zero)
        slope = wp.transpose(to_index) * wp.vec3d(a[axis], b[axis], c[axis])
        for world in range(3):
            out_jacobian[i, axis, world] = slope[world]
