"""Values, gradients and Hessians of the interpolants of order 2 and 3; see stencil_kernels."""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.volume.sampling.sample_kernels import has_voxels, kernels_of
from geokit.volume.sampling.stencil_kernels import stencil_gradient, stencil_hessian, stencil_value, weights

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


@wp.func
def smooth_value(volume: wp.uint64, u: wp.vec3d, basis: Any, background: Any):
    """The interpolant at index coordinates."""
    if not has_voxels(u):
        return background
    base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
    f = u - base
    zero = type(background)(wp.float64(0.0))
    return stencil_value(volume, base, basis, weights(basis, f[0]), weights(basis, f[1]), weights(basis, f[2]), zero)


@wp.func
def smooth_gradient(volume: wp.uint64, u: wp.vec3d, basis: Any, zero: Any):
    """Derivatives of the interpolant along each index axis."""
    if not has_voxels(u):
        return zero, zero, zero
    base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
    f = u - base
    return stencil_gradient(volume, base, basis, weights(basis, f[0]), weights(basis, f[1]), weights(basis, f[2]), zero)


def smooth_kernels_of(basis: Any, name: str) -> tuple[Any, Any, Any]:
    """Three kernels of an interpolant: values, gradients, and gradients with Hessians of scalar grids.

    Args:
        basis: Quadratic or Cubic.
        name: Warp module of the kernels. Each interpolant has its own, so that an unused one is not compiled.
    """
    module = wp.get_module(name)
    wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False}, module=module)

    @wp.func
    def value(volume: wp.uint64, u: wp.vec3d, background: Any):
        return smooth_value(volume, u, basis(), background)

    @wp.func
    def differences(volume: wp.uint64, u: wp.vec3d, zero: Any):
        a, b, c = smooth_gradient(volume, u, basis(), zero)
        return a, b, c

    @wp.kernel(module=module)
    def hessian_kernel(
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
        gradient = wp.vec3d()
        second = wp.mat33d()
        if has_voxels(u):
            base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
            f = u - base
            gradient, second = stencil_hessian(
                volume, base, basis(), weights(basis(), f[0]), weights(basis(), f[1]), weights(basis(), f[2])
            )
        out_gradient[i] = wp.transpose(to_index) * gradient
        world = wp.transpose(to_index) * second * to_index
        # Averaging with the transpose removes the asymmetry that rounding leaves.
        out_hessian[i] = (world + wp.transpose(world)) * wp.float64(0.5)

    return *kernels_of(value, differences, module), hessian_kernel
