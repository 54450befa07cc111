"""Values, gradients and Hessians of the triquadratic interpolant: parabolas through three voxels along each axis."""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.sampling.sample_kernels import has_voxels, store_column, world_derivative
from geokit.volume.sampling.stencil_kernels import stencil_bends, stencil_slopes, stencil_value

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

QUADRATIC_VOXELS = wp.constant(3)


@wp.func
def quadratic_weights(t: wp.float64) -> wp.mat44d:
    """Weights of the voxels at -1, 0 and 1 for a point at t in [0, 1), and their first two derivatives."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    half = wp.float64(0.5)
    none = wp.float64(0.0)
    return wp.mat44d(
        half * t * (t - one), one - t * t, half * t * (t + one), none,
        t - half, -two * t, t + half, none,
        one, -two, one, none,
        none, none, none, none,
    )  # fmt: skip


@wp.func
def quadratic_value(volume: wp.uint64, u: wp.vec3d, background: Any):
    """The triquadratic interpolant at index coordinates."""
    if not has_voxels(u):
        return background
    base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
    f = u - base
    zero = type(background)(wp.float64(0.0))
    return stencil_value(
        volume, base, QUADRATIC_VOXELS, quadratic_weights(f[0]), quadratic_weights(f[1]), quadratic_weights(f[2]), zero
    )


@wp.func
def quadratic_slopes(volume: wp.uint64, u: wp.vec3d, zero: Any):
    """Derivatives of the triquadratic interpolant along each index axis."""
    if not has_voxels(u):
        return zero, zero, zero
    base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
    f = u - base
    return stencil_slopes(
        volume, base, QUADRATIC_VOXELS, quadratic_weights(f[0]), quadratic_weights(f[1]), quadratic_weights(f[2]), zero
    )


@wp.kernel
def sample_quadratic_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: Any,
    out_value: wp.array(dtype=Any),
):
    i = first + wp.tid()
    out_value[i] = quadratic_value(volume, to_index * (points[i] - origin), background)


@wp.kernel
def gradient_quadratic_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    zero: Any,
    out_jacobian: wp.array3d(dtype=wp.float64),
):
    i = first + wp.tid()
    a, b, c = quadratic_slopes(volume, to_index * (points[i] - origin), zero)
    for axis in range(3):
        store_column(out_jacobian, i, axis, world_derivative(a, b, c, to_index, axis))


@wp.kernel
def hessian_quadratic_kernel(
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
            volume, base, QUADRATIC_VOXELS, quadratic_weights(f[0]), quadratic_weights(f[1]), quadratic_weights(f[2])
        )
    out_gradient[i] = wp.transpose(to_index) * slope
    world = wp.transpose(to_index) * second * to_index
    # Rounding must not make it unsymmetric.
    out_hessian[i] = (world + wp.transpose(world)) * wp.float64(0.5)


# By the number of a value's components.
SAMPLE_QUADRATIC = {
    1: wp.overload(sample_quadratic_kernel, {"background": wp.float64, "out_value": wp.array(dtype=wp.float64)}),
    3: wp.overload(sample_quadratic_kernel, {"background": wp.vec3d, "out_value": wp.array(dtype=wp.vec3d)}),
    4: wp.overload(sample_quadratic_kernel, {"background": wp.vec4d, "out_value": wp.array(dtype=wp.vec4d)}),
}
GRADIENT_QUADRATIC = {
    1: wp.overload(gradient_quadratic_kernel, {"zero": wp.float64}),
    3: wp.overload(gradient_quadratic_kernel, {"zero": wp.vec3d}),
    4: wp.overload(gradient_quadratic_kernel, {"zero": wp.vec4d}),
}
