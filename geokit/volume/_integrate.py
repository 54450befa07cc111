"""Transmittance of a fog volume along rays, and its emission."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.blocks.several_devices import LEAST_ON_GPUS
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Array, Devices, Rows
from geokit.core.memory.pinned import host_flags
from geokit.core.query.ask import query
from geokit.core.require import require_one_world
from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.rays.ray_field import ray_field
from geokit.volume.tree.leaves import require_volume


class Transmittance(NamedTuple):
    """Result of :func:`integrate`.

    Attributes:
        transmittance: Share of the light that passes along each ray, from 0 to 1, shape (N,).
        emission: What each ray collects, shape (N,).
    """

    transmittance: Array
    emission: Array


@query(
    "origins",
    "directions",
    gradient=".rays.gradients:INTEGRATE",
    holders=("emission",),
    least_rows=LEAST_ON_GPUS,
    row_bytes=24,
)
def integrate(
    volume: SparseVolume,
    origins: Rows,
    directions: Rows,
    *,
    extinction: float = 1.0,
    emission: SparseVolume | None = None,
    t_min: float = 0.0,
    max_distance: float = math.inf,
    device: Devices = None,
) -> Transmittance:
    """Transmittance of a fog volume along each ray, and the emission that reaches the ray's start.

    The optical depth is ``extinction`` times the integral of the density over the ray's length in world units. The
    transmittance is ``exp(-depth)``; the emission is the integral of the emission grid's values, each times the
    transmittance up to it. The density is the trilinear interpolant, that of ``sample`` at order 1. Its integral is
    exact in each cell of eight voxels and in each tile: there are no steps, so nothing is missed between them. The
    depth is off by some tens of roundings of 2^-53. The emission, from a quadrature with six Gauss points in each cell
    and for each half unit of depth, is off by less than 1e-9 of itself.

    The borders of a fog are known to half a voxel each: transmittances are right to exp(1 / mean free path in voxels) -
    1, which is 7 % at 16.

    Both carry gradients with respect to the rays and to the active values of both grids (:func:`with_values`); see
    docs/gradients.md.

    Args:
        volume: Density, a grid of one component with a background of 0. Negative values amplify.
        origins: Start points of the rays [world], shape (N, 3).
        directions: Directions of the rays, of any length, shape (N, 3), or one of shape (3,) for all.
        extinction: Optical depth of a density of 1 [1 / world].
        emission: Emitted light [1 / world], a grid with the transform of ``volume`` and a background of 0; None for no
            emission.
        t_min: Start of the integral, in units of the direction.
        max_distance: Length of the rays [world].
        device: Where to compute; None for the first GPU, else the CPU. Several devices share 65,536 rows or more, of
            arrays on a GPU 2 million.
    Returns:
        Transmittance in the container of ``origins``: transmittance (N,) and emission (N,).
    Raises:
        InputError: An array is not (N, 3) or not finite, their lengths differ, a direction is zero, the extinction or
            t_min is negative or not finite, max_distance is negative or not a number, a background is not 0, or the
            transforms, or units or up axes that are known, differ.
        UnsupportedGridError: A grid has several components, or stores indices or points.
    Example:
        >>> from geokit.volume import load
        >>> smoke = load("data/samples/smoke.vdb", grid="density")
        >>> integrate(smoke, [[0.0, 0.0, 9.0]], [[0.0, 0.0, -1.0]], extinction=20.0, device="cpu").transmittance.shape
        (1,)
    """
    from geokit.volume.rays.raycast_kernels import SHORTEST_DIRECTION

    factor = wp.float64(user_arrays.require_finite_scalar(extinction, "extinction", low=user_arrays.FROM_ZERO))
    start, reach = user_arrays.ray_limits(t_min, max_distance)
    target = launcher.resolve_device(device)
    rays, heading = user_arrays.read_rows([origins, directions], ["origins", "directions"], target, defer=True)
    require_volume(volume, "volume")
    if emission is not None:
        require_volume(emission, "emission")
        require_one_world(volume=volume.info, emission=emission.info)
    field = _field(volume, emission, target)
    found = Transmittance(
        transmittance=user_arrays.empty(len(rays), wp.float64, rays.rows),
        emission=user_arrays.empty(len(rays), wp.float64, rays.rows),
    )
    bad = host_flags(1, target)
    kernel, more = _kernel(volume, emission, target)
    inputs = [rays.rows, heading.rows, field, *more, start, reach, factor]
    launcher.launch(kernel, len(rays), inputs, [*found, bad], target)
    user_arrays.refuse_rays(bad, rays, heading, float(SHORTEST_DIRECTION))
    return Transmittance(*(rays.to_caller(array) for array in found))


def _kernel(volume: SparseVolume, emission: SparseVolume | None, device: "wp.Device") -> tuple[Any, list[Any]]:
    """The kernel, and its inputs after the field."""
    from geokit.volume.rays import integrate_kernels as kernels

    if emission is not None:
        return kernels.emission_kernel, [wp.uint64(emission.id(device))]
    family = wp.float32 if volume.info.grid_type == "float" else wp.float64
    return kernels.DEPTH[family], [family(0.0)]


def _field(volume: SparseVolume, emission: SparseVolume | None, device: "wp.Device") -> Any:
    """Both grids as the kernels see them: boxes and numbers cover the two together."""
    grids = [volume] if emission is None else [volume, emission]
    for name, grid in zip(("volume", "emission"), grids, strict=False):
        if isinstance(grid.info.background, (int, float)) and grid.info.background != 0:
            raise InputError(
                f"{name}: the background of grid {grid.info.name!r} is {grid.info.background}, which rays never leave; "
                "give a fog volume, whose background is 0"
            )
    if emission is not None and not np.array_equal(volume.info.transform, emission.info.transform):
        raise InputError("emission: its transform is not that of volume; resample it to the same voxels")
    return ray_field(volume, device, *grids[1:])
