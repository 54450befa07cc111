"""Values, gradients and Hessians of the tricubic interpolant: Catmull-Rom splines along each index axis."""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.sampling.sample_kernels import has_voxels, store_column, world_derivative
from geokit.volume.sampling.stencil_kernels import stencil_bends, stencil_slopes, stencil_value

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

CUBIC_VOXELS = wp.constant(4)


@wp.func
def cubic_weights(t: wp.float64) -> wp.mat44d:
    """Weights of the voxels at -1, 0, 1 and 2 for a point at t in [0, 1], and their first two derivatives."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    three = wp.float64(3.0)
    four = wp.float64(4.0)
    five = wp.float64(5.0)
    nine = wp.float64(9.0)
    half = wp.float64(0.5)
    none = wp.float64(0.0)
    return wp.mat44d(
        half * t * ((two - t) * t - one),
        half * (t * t * (three * t - five) + two),
        half * t * ((four - three * t) * t + one),
        half * t * t * (t - one),
        half * ((four - three * t) * t - one),
        half * t * (nine * t - wp.float64(10.0)),
        half * ((wp.float64(8.0) - nine * t) * t + one),
        half * t * (three * t - two),
        two - three * t,
        nine * t - five,
        four - nine * t,
        three * t - one,
        none, none, none, none,
    )  # fmt: skip


@wp.func
def cubic_value(volume: wp.uint64, u: wp.vec3d, background: Any):
    """The tricubic interpolant at index coordinates."""
    if not has_voxels(u):
        return background
    base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
    f = u - base
    zero = type(background)(wp.float64(0.0))
    return stencil_value(
        volume, base, CUBIC_VOXELS, cubic_weights(f[0]), cubic_weights(f[1]), cubic_weights(f[2]), zero
    )


@wp.func
def cubic_slopes(volume: wp.uint64, u: wp.vec3d, zero: Any):
    """Derivatives of the tricubic interpolant along each index axis."""
    if not has_voxels(u):
        return zero, zero, zero
    base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
    f = u - base
    return stencil_slopes(
        volume, base, CUBIC_VOXELS, cubic_weights(f[0]), cubic_weights(f[1]), cubic_weights(f[2]), zero
    )


@wp.kernel
def sample_cubic_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: Any,
    out_value: wp.array(dtype=Any),
):
    i = first + wp.tid()
    out_value[i] = cubic_value(volume, to_index * (points[i] - origin), background)


@wp.kernel
def gradient_cubic_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    zero: Any,
    out_jacobian: wp.array3d(dtype=wp.float64),
):
    i = first + wp.tid()
    a, b, c = cubic_slopes(volume, to_index * (points[i] - origin), zero)
    for axis in range(3):
        store_column(out_jacobian, i, axis, world_derivative(a, b, c, to_index, axis))


@wp.kernel
def hessian_cubic_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out_gradient: wp.array(dtype=wp.vec3d),
    out_hessian: wp.array(dtype=wp.mat33d),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    slope = wp.vec3d()
    second = wp.mat33d()
    if has_voxels(u):
        base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
        f = u - base
        slope, second = stencil_bends(
            volume, base, CUBIC_VOXELS, cubic_weights(f[0]), cubic_weights(f[1]), cubic_weights(f[2])
        )
    out_gradient[i] = wp.transpose(to_index) * slope
    world = wp.transpose(to_index) * second * to_index
    # Rounding must not make it unsymmetric.
    out_hessian[i] = (world + wp.transpose(world)) * wp.float64(0.5)


# By the number of a value's components.
SAMPLE_CUBIC = {
    1: wp.overload(sample_cubic_kernel, {"background": wp.float64, "out_value": wp.array(dtype=wp.float64)}),
    3: wp.overload(sample_cubic_kernel, {"background": wp.vec3d, "out_value": wp.array(dtype=wp.vec3d)}),
    4: wp.overload(sample_cubic_kernel, {"background": wp.vec4d, "out_value": wp.array(dtype=wp.vec4d)}),
}
GRADIENT_CUBIC = {
    1: wp.overload(gradient_cubic_kernel, {"zero": wp.float64}),
    3: wp.overload(gradient_cubic_kernel, {"zero": wp.vec3d}),
    4: wp.overload(gradient_cubic_kernel, {"zero": wp.vec4d}),
}
