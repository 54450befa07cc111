"""Second derivatives of a volume, and curvatures of its level sets."""

from __future__ import annotations

from typing import Any, NamedTuple

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.blocks.several_devices import LEAST_ON_GPUS
from geokit.core.interop.types import Array, Devices, Rows
from geokit.core.interop.user_arrays import Batch, read_vectors
from geokit.core.query.ask import query
from geokit.errors import UnsupportedGridError
from geokit.volume.at_points.sample import is_scalar, require_order, view_as
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.sampling.space import query_inputs, require_space
from geokit.volume.tree.leaves import require_volume


class Curvatures(NamedTuple):
    """Curvatures of level sets.

    Attributes:
        mean: Half the sum of the principal curvatures [1 / world], shape (N,).
        gaussian: Product of the principal curvatures [1 / world^2], shape (N,).
        principal: The larger and the smaller principal curvature [1 / world], shape (N, 2).
    """

    mean: Array
    gaussian: Array
    principal: Array


@query("points", is_replayed=True, least_rows=LEAST_ON_GPUS, row_bytes=96)
def hessian(
    volume: SparseVolume, points: Rows, *, order: int = 3, space: str = "world", device: Devices = None
) -> Array:
    """Hessian (matrix of second derivatives) of a volume at each point.

    The result is exact for the interpolant of :func:`geokit.volume.sample`, in float64. The second derivatives of both
    interpolants are of first order: on a smooth field the error shrinks with the voxel size, is at most about the third
    derivative times the voxel size, and jumps between cells. Second derivatives of a quadratic field are exact.

    Args:
        volume: A scalar grid.
        points: Query points [world], shape (N, 3).
        order: 2 (triquadratic) or 3 (tricubic).
        space: Space of ``points`` and of the derivatives: "world", or "index", where voxel centers lie at whole
            numbers.
        device: Where to compute; None for the first GPU, else the CPU. Several devices share 65,536 rows or more, of
            arrays on a GPU 2 million.

    Returns:
        Symmetric matrices [value / world^2] in the container of ``points``, shape (N, 3, 3), float64 (float32 where the
        points are).

    Raises:
        InputError: points is not (N, 3) or not finite, or the order or space is unknown.
        UnsupportedGridError: The grid is not scalar.

    Example:
        >>> from geokit.volume import load
        >>> hessian(load("data/samples/torus.vdb"), [[1.0, 0.0, 0.0]]).shape
        (1, 3, 3)
    """
    batch, _, second = _derivatives(volume, points, order, space, device)
    return batch.to_caller(view_as(second, wp.float64, (len(batch), 3, 3)))


@query("points", is_replayed=True, least_rows=LEAST_ON_GPUS, row_bytes=128)
def curvature(volume: SparseVolume, points: Rows, *, order: int = 3, device: Devices = None) -> Curvatures:
    """Curvatures of the level set through each point.

    They are computed from the gradient and the Hessian of the interpolant, so the field need not be a distance. The
    curvature is positive where the level set bends away from larger values: a sphere whose distance field is positive
    outside has mean curvature 1 / r. Where the gradient is 0 there is no level set, and all results are NaN.

    The error is of first order in the voxel size h. On spheres of radius r and tori of tube radius r, with r from 5 to
    40 voxels, the mean curvature is off by 0.3 h / r of 1 / r rms and by 1.2 h / r at most, the Gaussian curvature by
    0.6 h / r of 1 / r^2 rms, with either order (second derivatives jump between cells by the third derivative times the
    distance from the cell's middle). In a narrow band of half width 3 this holds at the surface; up to one voxel from
    it the error is 1.6 times as large; farther out the background takes part.

    Args:
        volume: A scalar grid, such as a level set.
        points: Query points [world], shape (N, 3).
        order: 2 (triquadratic) or 3 (tricubic).
        device: Where to compute; None for the first GPU, else the CPU. Several devices share 65,536 rows or more, of
            arrays on a GPU 2 million.

    Returns:
        Curvatures with mean (N,) [1 / world], gaussian (N,) [1 / world^2] and principal (N, 2) [1 / world], in the
        container of ``points``, float64 (float32 where the points are).

    Raises:
        InputError: points is not (N, 3) or not finite, or the order is not supported.
        UnsupportedGridError: The grid is not scalar.

    Source:
        Goldman, Curvature formulas for implicit curves and surfaces (2005). Differs: all curvatures come from the shape
            operator in the tangent plane, so that the principal ones do not suffer from cancellation.

    Example:
        >>> from geokit.volume import load
        >>> torus = load("data/samples/torus.vdb")
        >>> curvature(torus, [[1.0, 0.0, 0.0]]).principal.shape
        (1, 2)
    """
    from geokit.volume.sampling.curvature_kernels import curvature_kernel

    batch, slope, second = _derivatives(volume, points, order, "world", device)
    count = len(batch)
    mean = wp.empty(count, dtype=wp.float64, device=slope.device)
    gaussian = wp.empty(count, dtype=wp.float64, device=slope.device)
    principal = wp.empty((count, 2), dtype=wp.float64, device=slope.device)
    launcher.launch(curvature_kernel, count, [slope, second], [mean, gaussian, principal], slope.device)
    return Curvatures(batch.to_caller(mean), batch.to_caller(gaussian), batch.to_caller(principal))


def _derivatives(
    volume: SparseVolume, points: Rows, order: int, space: str, device: Any
) -> tuple[Batch, "wp.array", "wp.array"]:
    """The rows of the points, with the gradient (vec3d) and the Hessian (mat33d) at each, in the given space."""
    from geokit.volume.sampling.kernel_table import query_kernel

    require_volume(volume, "volume")
    order = require_order(order, lowest=2)
    require_space(space)
    if not is_scalar(volume):
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} has no Hessian here; use a scalar grid"
        )
    target = launcher.resolve_device(device)
    batch = read_vectors(points, "points", target, single=True)
    slope = wp.empty(len(batch), dtype=wp.vec3d, device=target)
    second = wp.empty(len(batch), dtype=wp.mat33d, device=target)
    kernel, _ = query_kernel("hessian", order, 1, False)
    inputs = query_inputs(volume, batch.array, space)
    launcher.launch(kernel, len(batch), inputs, [slope, second], target)
    return batch, slope, second
