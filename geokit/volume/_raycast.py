"""Intersection of rays with an isosurface of a sparse volume."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.blocks.several_devices import LEAST_ON_GPUS
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Array, Devices, Rows
from geokit.core.memory.pinned import host_flags
from geokit.core.query.ask import query
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.rays.crossing_blocks import crossing_blocks
from geokit.volume.rays.ray_field import ray_field
from geokit.volume.tree.leaves import require_volume

# Fewest packets of rays that are worth a thread of their own.
GRAIN = 32


class VolumeHits(NamedTuple):
    """Result of :func:`raycast`. A miss has t inf and NaN elsewhere.

    Attributes:
        t: Where the rays hit, in units of their directions, shape (N,).
        points: Where they hit [world], shape (N, 3).
        normals: Unit normals there [world], shape (N, 3).
    """

    t: Array
    points: Array
    normals: Array


@query(
    "origins",
    "directions",
    gradient=".sampling.gradients:RAYCAST",
    is_replayed=True,
    least_rows=LEAST_ON_GPUS,
    row_bytes=80,
)
def raycast(
    volume: SparseVolume,
    origins: Rows,
    directions: Rows,
    *,
    isovalue: float = 0.0,
    t_min: float = 0.0,
    max_distance: float = math.inf,
    transform: ArrayLike | None = None,
    device: Devices = None,
) -> VolumeHits:
    """First point on each ray where the volume's value equals the isovalue, from either side.

    The value is the trilinear interpolant, that of ``sample`` at order 1: inactive voxels and tiles count with their
    values, and beyond the stored voxels lies the background. A ray that starts at the isovalue, or in a region of that
    constant value, hits at ``t_min``. A ray that touches the isovalue without crossing it hits if the touch is exact.

    No crossing is stepped over. In each cell of eight voxels the interpolant is a cubic along the ray. The cubic is
    divided where its derivative vanishes, and a piece whose ends lie on both sides of the isovalue is bracketed to the
    last bits. All arithmetic is float64. t is off by a few times 2^-53 of the largest coordinate involved, plus the
    shift of the crossing that as many roundings of the voxels cause. Where a ray misses or touches within those
    roundings, either may be reported.

    No slope makes rays miss. The surface found is the field's own where its slope is at most half_width / 1.75
    (distance fields: a half width of 1.75). Steeper fields are cut off by the band, and the surface is up to half a
    voxel off. Rays that would be less than 0.375 voxel^2 over the radius of curvature below the surface may pass.

    Args:
        volume: A grid of one component, of any type, with any transform.
        origins: Start points of the rays [world], shape (N, 3).
        directions: Directions of the rays, of any length, shape (N, 3), or one of shape (3,) for all.
        isovalue: The value to find.
        t_min: Crossings nearer than this are ignored, in units of the direction.
        max_distance: Length of the rays [world]; farther crossings are misses.
        transform: A rigid map or mirror for column vectors, (4, 4), or (B, 4, 4) for answers (B, N, ...): where it
            is. All is in world coordinates; moving rounds by 1e-15 of the size. None leaves the volume in place.
        device: Where to compute; None for the first GPU, else the CPU. Several devices share 65,536 rows or more, of
            arrays on a GPU 2 million.
    Returns:
        VolumeHits in the container of ``origins``: t (N,) in units of the direction, points (N, 3), and normals (N, 3):
            unit gradients of the interpolant, towards larger values, in the cell of the hit; zero where the interpolant
            is constant. A miss has t inf and NaN elsewhere.
    Raises:
        InputError: An array is not (N, 3) or not finite, their lengths differ, a direction is zero, the isovalue is not
            finite, t_min is negative or not finite, max_distance is negative or not a number, or the transform is not
            rigid (to 1e-6) or is given beside tensors with gradients.
        UnsupportedGridError: The grid has several components, or stores indices or points.
    Source:
        Marmitt et al., "Fast and Accurate Ray-Voxel Intersection Techniques for Iso-Surface Ray Tracing" (VMV 2004),
            for the cubic and its division; Museth, "Hierarchical Digital Differential Analyzer" (SIGGRAPH Talks 2014),
            for the traversal. Differs: float64, cells that span leaves, and the side of the isovalue is carried from
            cell to cell.
    Example:
        >>> from geokit.volume import load
        >>> hits = raycast(load("data/samples/torus.vdb"), [[3.0, 0.0, 0.0]], [[-1.0, 0.0, 0.0]], device="cpu")
        >>> hits.normals.shape
        (1, 3)
    """
    from geokit.volume.rays.raycast_kernels import RAYCAST, SHORTEST_DIRECTION

    level = user_arrays.require_finite_scalar(isovalue, "isovalue")
    start, reach = user_arrays.ray_limits(t_min, max_distance)
    target = launcher.resolve_device(device)
    rays, heading = user_arrays.read_rows([origins, directions], ["origins", "directions"], target, defer=True)
    field = ray_field(require_volume(volume, "volume"), target)
    found = VolumeHits(
        t=user_arrays.empty(len(rays), wp.float64, rays.rows),
        points=user_arrays.empty(len(rays), wp.vec3d, rays.rows),
        normals=user_arrays.empty(len(rays), wp.vec3d, rays.rows),
    )
    bad = host_flags(1, target)
    single = volume.info.grid_type == "float"
    levels = [wp.float32(near) for near in _neighbors(level)] if single else [wp.float64(level), wp.float64(level)]
    blocks = crossing_blocks(volume, levels, len(rays), target)
    if blocks:
        field.reach, field.numbers, field.first_block, field.block_count, field.blocks = blocks
    inputs = [rays.rows, heading.rows, field, start, reach, wp.float64(level), *levels]
    if blocks and target.is_cpu:
        from geokit.volume.rays.raycast_cpu_kernels import PACKET, RAYCAST_PACKETS

        items = -(-len(rays) // PACKET)
        launcher.launch(RAYCAST_PACKETS[single], items, inputs, [*found, bad], target, grain=GRAIN)
    else:
        launcher.launch(RAYCAST[single], len(rays), inputs, [*found, bad], target)
    user_arrays.refuse_rays(bad, rays, heading, float(SHORTEST_DIRECTION))
    return VolumeHits(*(rays.to_caller(array) for array in found))


def _neighbors(level: float) -> tuple[float, float]:
    """The largest float32 not above ``level``, and the smallest not below it.

    Voxels are compared with these in their own type.
    """
    with np.errstate(over="ignore"):
        near = np.float32(level)
    # NumPy would round a Python float to float32 before the comparison.
    below = near if float(near) <= level else np.nextafter(near, np.float32(-np.inf))
    above = near if float(near) >= level else np.nextafter(near, np.float32(np.inf))
    return float(below), float(above)
