"""Values and gradients of staggered vector grids: each component of a voxel lies on one of the voxel's faces.

Component c of voxel ijk is the field's at ``ijk - e_c / 2``, the centre of the face towards smaller indices: it is
sampled half a voxel further along axis c than the point is.

Source:
    OpenVDB (Museth 2013), StaggeredPointSampler, StaggeredBoxSampler and StaggeredQuadraticSampler.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.sampling.cubic_kernels import cubic_slopes, cubic_value
from geokit.volume.sampling.quadratic_kernels import quadratic_slopes, quadratic_value
from geokit.volume.sampling.sample_kernels import central_differences, linear_differences, linear_value, nearest_value

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def at_face(u: wp.vec3d, axis: int) -> wp.vec3d:
    """Where a component is found at index coordinates ``u``, if it were stored at voxel centres."""
    moved = u
    moved[axis] = u[axis] + wp.float64(0.5)
    return moved


@wp.kernel
def sample_staggered_nearest_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.vec3d,
    out_value: wp.array(dtype=wp.vec3d),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    value = wp.vec3d()
    for axis in range(3):
        at = nearest_value(volume, at_face(u, axis), background)
        value[axis] = at[axis]
    out_value[i] = value


@wp.kernel
def sample_staggered_linear_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.vec3d,
    out_value: wp.array(dtype=wp.vec3d),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    value = wp.vec3d()
    for axis in range(3):
        at = linear_value(volume, at_face(u, axis), background)
        value[axis] = at[axis]
    out_value[i] = value


@wp.kernel
def sample_staggered_quadratic_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.vec3d,
    out_value: wp.array(dtype=wp.vec3d),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    value = wp.vec3d()
    for axis in range(3):
        at = quadratic_value(volume, at_face(u, axis), background)
        value[axis] = at[axis]
    out_value[i] = value


@wp.kernel
def sample_staggered_cubic_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.vec3d,
    out_value: wp.array(dtype=wp.vec3d),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    value = wp.vec3d()
    for axis in range(3):
        at = cubic_value(volume, at_face(u, axis), background)
        value[axis] = at[axis]
    out_value[i] = value


@wp.kernel
def gradient_staggered_nearest_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    zero: wp.vec3d,
    out_jacobian: wp.array3d(dtype=wp.float64),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    for axis in range(3):
        a, b, c = central_differences(volume, at_face(u, axis), zero)
        slope = wp.transpose(to_index) * wp.vec3d(a[axis], b[axis], c[axis])
        for world in range(3):
            out_jacobian[i, axis, world] = slope[world]


@wp.kernel
def gradient_staggered_linear_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    zero: wp.vec3d,
    out_jacobian: wp.array3d(dtype=wp.float64),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    for axis in range(3):
        a, b, c = linear_differences(volume, at_face(u, axis), zero)
        slope = wp.transpose(to_index) * wp.vec3d(a[axis], b[axis], c[axis])
        for world in range(3):
            out_jacobian[i, axis, world] = slope[world]


@wp.kernel
def gradient_staggered_quadratic_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    zero: wp.vec3d,
    out_jacobian: wp.array3d(dtype=wp.float64),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    for axis in range(3):
        a, b, c = quadratic_slopes(volume, at_face(u, axis), zero)
        slope = wp.transpose(to_index) * wp.vec3d(a[axis], b[axis], c[axis])
        for world in range(3):
            out_jacobian[i, axis, world] = slope[world]


@wp.kernel
def gradient_staggered_cubic_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    zero: wp.vec3d,
    out_jacobian: wp.array3d(dtype=wp.float64),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    for axis in range(3):
        a, b, c = cubic_slopes(volume, at_face(u, axis), zero)
        slope = wp.transpose(to_index) * wp.vec3d(a[axis], b[axis], c[axis])
        for world in range(3):
            out_jacobian[i, axis, world] = slope[world]


# By order of the interpolant.
SAMPLE_STAGGERED = (
    sample_staggered_nearest_kernel,
    sample_staggered_linear_kernel,
    sample_staggered_quadratic_kernel,
    sample_staggered_cubic_kernel,
)
GRADIENT_STAGGERED = (
    gradient_staggered_nearest_kernel,
    gradient_staggered_linear_kernel,
    gradient_staggered_quadratic_kernel,
    gradient_staggered_cubic_kernel,
)
