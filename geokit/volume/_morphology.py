"""Offsets of level sets and the morphology that they make up; morphology of the active voxels of other grids."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.core.user_arrays import require_finite_scalar
from geokit.errors import InputError
from geokit.volume._model import SparseVolume
from geokit.volume.level_set.active_morphology import MOST_VOXELS, changed_topology
from geokit.volume.level_set.operands import half_width_of, require_level_set, with_band
from geokit.volume.level_set.redistance import redistance
from geokit.volume.tree.leaves import require_volume

__all__ = ["closing", "dilate", "erode", "offset", "opening", "renormalize"]

# Farthest offset [voxels]: the band has to reach as far while it is computed, and memory goes with it.
FARTHEST_OFFSET = 256.0
NARROWEST_BAND = 1.0


def renormalize(volume: SparseVolume, *, half_width: float | None = None, device: Any = None) -> SparseVolume:
    """The same surface with signed distances around it: the slope is 1 again.

    For level sets whose values are no longer distances, such as sums, products, advected or blended fields. Corners of
    the cells that the surface crosses are divided by the field's slope there, so that the surface stays; every other
    voxel gets its distance from the piece of surface that the nearest of those stands for. The surface moves at most
    0.005 voxel where the slope changes by less than 4 % a voxel along it, and not at all where it is 1 already.
    Distances are right to 0.005 voxel around surfaces whose radius of curvature is at least 10 voxels and whose slope
    is even, to 0.1 where it changes by 4 % a voxel; next to sharp edges they are up to 0.3 voxel off. Results are the
    same on every device. Held by tests/volume/level_set/test_morphology.py.

    Slopes up to half_width / 1.75 keep their surface; steeper fields are cut off, and it is no longer known. Held by
    tests/accuracy/stability/test_envelopes.py.

    Args:
        volume: Level set.
        half_width: Width of the new band on each side [voxels], at least 1; that of the old one where None.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Level set of the same type (float where that is quantised).
    Raises:
        InputError: No level set, voxels that are no cubes, or a half width below 1 or beyond 256.
        UnsupportedGridError: Values that are not real numbers.
        DeviceMemoryError: The band needs more memory than there is.
    Source:
        Closest features as in Danielsson, "Euclidean distance mapping" (1980). Differs: features are pieces of the
        surface with a direction and a curvature instead of points.
    """
    voxel_size = require_level_set(volume, "volume")
    width = half_width_of(volume, voxel_size) if half_width is None else _checked_half_width(half_width)
    return redistance(volume, voxel_size, width, device=device)


def offset(volume: SparseVolume, distance: float, *, device: Any = None) -> SparseVolume:
    """The surface at a signed distance from a level set's own: outside for positive, inside for negative ones.

    Exact to 0.05 voxel where the radius of curvature is at least 8 voxels before and after: the surface is the level
    set's own isosurface, and only beyond its band that of distances computed from it. All distances are then made new
    from the new surface. A body that is thinner than twice the distance disappears. Held by
    tests/volume/level_set/test_morphology.py and tests/accuracy/stability/test_envelopes.py.

    Args:
        volume: Level set.
        distance: How far the surface moves [world], at most 256 voxels.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Level set of the same type, with a band of the same width.
    Raises:
        InputError: No level set, voxels that are no cubes, or a distance that is not finite or too far.
        UnsupportedGridError: Values that are not real numbers.
    """
    voxel_size = require_level_set(volume, "volume")
    distance = require_finite_scalar(distance, "distance")
    return _offset(volume, voxel_size, _checked_voxels(distance, voxel_size), device)


def dilate(
    volume: SparseVolume,
    distance: float | None = None,
    *,
    voxels: int | None = None,
    neighbors: str = "faces",
    device: Any = None,
) -> SparseVolume:
    """What a level set holds inside, or what is active in another grid, grown.

    A level set grows by a distance, as by :func:`offset` outwards. Of other grids, fog for one, every voxel next to an
    active one becomes active, ``voxels`` times; it keeps the value that the tree has there, that of an inactive voxel,
    a tile or the background, also in a bool grid: what is turned on is the state, as with OpenVDB's
    dilateActiveValues. Of a mask the state is the value. Active tiles become voxels (:func:`prune` makes tiles of
    them). Held by tests/volume/level_set/test_morphology.py, tests/volume/level_set/test_active_morphology.py and
    tests/volume/level_set/test_active_morphology_types.py.

    Args:
        volume: Level set with ``distance``; a grid of any type that holds values with ``voxels``.
        distance: Of a level set's surface [world], not negative.
        voxels: Steps, at most 1024; not for level sets.
        neighbors: Of a voxel in a step: those across its "faces" (6), also "edges" (18), or also "vertices" (26).
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Grid of the same type, class and background (float where that is quantised).
    Raises:
        InputError: Not exactly one of distance and voxels, a negative one, or one that the grid does not take;
            otherwise as of :func:`offset`.
        UnsupportedGridError: A grid of indices or points; with ``distance`` one whose values are not real.
        DeviceMemoryError: The result needs more memory than there is.
    """
    return _changed(volume, distance, voxels, neighbors, (1,), device)


def erode(
    volume: SparseVolume,
    distance: float | None = None,
    *,
    voxels: int | None = None,
    neighbors: str = "faces",
    device: Any = None,
) -> SparseVolume:
    """What a level set holds inside, or what is active in another grid, shrunk.

    A level set shrinks by a distance, as by :func:`offset` inwards, and has no surface where nothing is left. Of other
    grids every active voxel next to an inactive one becomes inactive background, ``voxels`` times; inactive voxels
    keep their values. Held by tests/volume/level_set/test_morphology.py,
    tests/volume/level_set/test_active_morphology.py and tests/volume/level_set/test_active_morphology_types.py.

    Args:
        volume: Level set with ``distance``; a grid of any type that holds values with ``voxels``.
        distance: Of a level set's surface [world], not negative.
        voxels: Steps, at most 1024; not for level sets.
        neighbors: Of a voxel in a step: those across its "faces" (6), also "edges" (18), or also "vertices" (26).
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Grid of the same type, class and background (float where that is quantised).
    Raises:
        InputError: Not exactly one of distance and voxels, a negative one, or one that the grid does not take;
            otherwise as of :func:`offset`.
        UnsupportedGridError: A grid of indices or points; with ``distance`` one whose values are not real.
        DeviceMemoryError: The result needs more memory than there is.
    """
    return _changed(volume, distance, voxels, neighbors, (-1,), device)


def opening(
    volume: SparseVolume,
    distance: float | None = None,
    *,
    voxels: int | None = None,
    neighbors: str = "faces",
    device: Any = None,
) -> SparseVolume:
    """Eroded, then dilated: thin parts go.

    Of a level set parts thinner than twice the distance, and outer edges are rounded. Of other grids active parts in
    which the neighbourhood of ``voxels`` steps does not fit; what stays active keeps its values.
    Held by tests/volume/level_set/test_morphology.py, tests/volume/level_set/test_active_morphology.py and
    tests/volume/level_set/test_active_morphology_types.py.

    Args:
        volume: Level set with ``distance``; a grid of any type that holds values with ``voxels``.
        distance: Radius of the ball that has to fit inside [world], not negative.
        voxels: Steps, at most 1024; not for level sets.
        neighbors: Of a voxel in a step: those across its "faces" (6), also "edges" (18), or also "vertices" (26).
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Grid of the same type, class and background (float where that is quantised).
    Raises:
        InputError: Not exactly one of distance and voxels, a negative one, or one that the grid does not take;
            otherwise as of :func:`offset`.
        UnsupportedGridError: A grid of indices or points; with ``distance`` one whose values are not real.
        DeviceMemoryError: The result needs more memory than there is.
    """
    return _changed(volume, distance, voxels, neighbors, (-1, 1), device)


def closing(
    volume: SparseVolume,
    distance: float | None = None,
    *,
    voxels: int | None = None,
    neighbors: str = "faces",
    device: Any = None,
) -> SparseVolume:
    """Dilated, then eroded: gaps close.

    Of a level set gaps and holes narrower than twice the distance, and inner edges are rounded. Of other grids gaps
    between active voxels in which the neighbourhood of ``voxels`` steps does not fit; what becomes active keeps the
    value that it had, and so does what stays as it was. Held by tests/volume/level_set/test_morphology.py,
    tests/volume/level_set/test_active_morphology.py and tests/volume/level_set/test_active_morphology_types.py.

    Args:
        volume: Level set with ``distance``; a grid of any type that holds values with ``voxels``.
        distance: Radius of the ball that has to fit outside [world], not negative.
        voxels: Steps, at most 1024; not for level sets.
        neighbors: Of a voxel in a step: those across its "faces" (6), also "edges" (18), or also "vertices" (26).
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Grid of the same type, class and background (float where that is quantised).
    Raises:
        InputError: Not exactly one of distance and voxels, a negative one, or one that the grid does not take;
            otherwise as of :func:`offset`.
        UnsupportedGridError: A grid of indices or points; with ``distance`` one whose values are not real.
        DeviceMemoryError: The result needs more memory than there is.
    """
    return _changed(volume, distance, voxels, neighbors, (1, -1), device)


def _changed(
    volume: SparseVolume, distance: Any, voxels: Any, neighbors: str, steps: tuple[int, ...], device: Any
) -> SparseVolume:
    if (distance is None) == (voxels is None):
        raise InputError("distance, voxels: give one of the two: a distance for level sets, voxels for other grids")
    if distance is not None:
        voxel_size = require_level_set(volume, "volume")
        radius = _checked_radius(distance, voxel_size)
        for step in steps:
            volume = _offset(volume, voxel_size, step * radius, device)
        return volume
    require_volume(volume, "volume")
    if volume.info.grid_class == "level set":
        raise InputError(
            f"voxels: grid {volume.info.name!r} is a level set, whose surface moves by a distance; give distance="
        )
    if isinstance(voxels, bool) or not isinstance(voxels, (int, np.integer)) or not 0 <= voxels <= MOST_VOXELS:
        raise InputError(f"voxels: {voxels!r} is not a whole number from 0 to {MOST_VOXELS}")
    return changed_topology(volume, tuple(step * int(voxels) for step in steps), neighbors, device)


def _offset(volume: SparseVolume, voxel_size: float, voxels: float, device: Any) -> SparseVolume:
    half_width = half_width_of(volume, voxel_size)
    # The cells that the new surface crosses must be inside the band, corners and all.
    needed = abs(voxels) + 2.0
    wide = with_band(volume, voxel_size, needed, device=device) if needed > half_width else volume
    return redistance(wide, voxel_size, half_width, isovalue=voxels, device=device)


def _checked_half_width(half_width: Any) -> float:
    width = require_finite_scalar(half_width, "half_width")
    if not NARROWEST_BAND <= width <= FARTHEST_OFFSET:
        raise InputError(
            f"half_width: {width} voxels; a band needs at least {NARROWEST_BAND:g} and at most {FARTHEST_OFFSET:g}"
        )
    return width


def _checked_voxels(distance: float, voxel_size: float) -> float:
    voxels = distance / voxel_size
    if abs(voxels) > FARTHEST_OFFSET:
        raise InputError(
            f"distance: {distance:g} is {abs(voxels):.3g} voxels, more than {FARTHEST_OFFSET:g}; resample the volume "
            f"at a voxel_size of {abs(distance) / FARTHEST_OFFSET:.2g} or more"
        )
    return voxels


def _checked_radius(distance: Any, voxel_size: float) -> float:
    radius = require_finite_scalar(distance, "distance")
    if radius < 0.0:
        raise InputError(f"distance: {radius} is negative; give how far the surface moves, and choose the operation")
    return _checked_voxels(radius, voxel_size)
