"""Values and gradients of a volume, one by one, for the user's own kernels: :mod:`geokit.kernels`."""

# mypy: ignore-errors
import warp as wp

from geokit.volume.sampling.leaf_table_kernels import LeafTable
from geokit.volume.sampling.trilinear_table_kernels import interpolate_by_tree, interpolate_single

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class SparseVolume:
    """A grid of numbers in kernels, by :meth:`geokit.volume.SparseVolume.on_kernel`; its fields may change."""

    grid: wp.uint64
    table: LeafTable
    # Index coordinates are to_index * (point - origin).
    origin: wp.vec3d
    to_index: wp.mat33d
    background: wp.float64


@wp.func
def sample(volume: SparseVolume, point: wp.vec3d) -> wp.float64:
    """The trilinear interpolant at a point: the answer of :func:`geokit.volume.sample` of order 1.

    A point that is not finite has the background. On a ``wp.Tape`` it has slopes by the point.

    Args:
        volume: ``volume.on_kernel(device)``.
        point: The point [world].
    """
    u = volume.to_index * (point - volume.origin)
    found = interpolate_single(volume.table, u, volume.to_index, volume.background)
    if wp.isnan(found):
        found = interpolate_by_tree(volume.grid, u, volume.to_index, volume.background)
    return found


@wp.func
def gradient(volume: SparseVolume, point: wp.vec3d) -> wp.vec3d:
    """The gradient of :func:`sample` [value / world]: the answer of :func:`geokit.volume.gradient` of order 1.

    On a ``wp.Tape`` it counts as a constant.

    Args:
        volume: ``volume.on_kernel(device)``.
        point: The point [world].
    """
    u = volume.to_index * (point - volume.origin)
    found = interpolate_single(volume.table, u, volume.to_index, wp.vec3d())
    if wp.isnan(found[0]):
        found = interpolate_by_tree(volume.grid, u, volume.to_index, wp.vec3d())
    return found


@wp.func_grad(sample)
def adj_sample(volume: SparseVolume, point: wp.vec3d, adj_ret: wp.float64):
    wp.adjoint[point] += adj_ret * gradient(volume, point)


@wp.func_grad(gradient)
def adj_gradient(volume: SparseVolume, point: wp.vec3d, adj_ret: wp.vec3d):
    pass
