"""Offsets of level sets, and the morphology that they make up."""

from __future__ import annotations

from typing import Any

from geokit._arrays import require_finite_scalar
from geokit.errors import InputError
from geokit.volume._level_set import half_width_of, redistanced, require_level_set, with_band
from geokit.volume.model import SparseVolume

__all__ = ["closing", "dilate", "erode", "offset", "opening", "renormalize"]

# Farthest offset [voxels]: the band has to reach as far while it is computed, and memory goes with it.
FARTHEST_OFFSET = 256.0
NARROWEST_BAND = 1.0


def renormalize(volume: SparseVolume, *, half_width: float | None = None) -> SparseVolume:
    """The same surface with signed distances around it: the slope is 1 again.

    For level sets whose values are no longer distances, such as sums, products, advected or blended fields. Corners of
    the cells that the surface crosses are divided by the field's slope there, so that the surface stays; all others
    get distances from those. The surface moves at most 0.005 voxel where the slope changes by less than 4 % a voxel
    along it, and not at all where it is 1 already. Distances are right to 0.02 voxel around surfaces whose radius of
    curvature is at least 10 voxels and whose slope is even, to 0.1 where it changes by 4 % a voxel; next to sharp edges
    they are up to half a voxel off.
    Held by tests/unit/test_operations_morphology.py.

    Args:
        volume: Level set.
        half_width: Width of the new band on each side [voxels], at least 1; that of the old one where None.
    Returns:
        Level set of the same type (float where that is quantised).
    Raises:
        InputError: No level set, voxels that are no cubes, or a half width below 1 or beyond 256.
        UnsupportedGridError: Values that are not real numbers.
        MissingDependencyError: geokit was built without OpenVDB.
    Source:
        Jiang and Peng, "Weighted ENO schemes for Hamilton-Jacobi equations" (2000). Differs: voxels next to the surface
        are scaled by the slope and held.
    """
    voxel_size = require_level_set(volume, "volume")
    width = half_width_of(volume, voxel_size) if half_width is None else _checked_half_width(half_width)
    return redistanced(volume, voxel_size, width)


def offset(volume: SparseVolume, distance: float) -> SparseVolume:
    """The surface at a signed distance from a level set's own: outside for positive, inside for negative ones.

    Exact to 0.05 voxel where the radius of curvature is at least 10 voxels: the surface is the level set's own
    isosurface, and only beyond its band that of distances computed from it. All distances are then made new from
    the new surface. A body that is thinner than twice the distance disappears. Held by
    tests/unit/test_operations_morphology.py.

    Args:
        volume: Level set.
        distance: How far the surface moves [world], at most 256 voxels.
    Returns:
        Level set of the same type, with a band of the same width.
    Raises:
        InputError: No level set, voxels that are no cubes, or a distance that is not finite or too far.
        UnsupportedGridError: Values that are not real numbers.
        MissingDependencyError: geokit was built without OpenVDB.
    """
    voxel_size = require_level_set(volume, "volume")
    distance = require_finite_scalar(distance, "distance")
    return _offset(volume, voxel_size, _checked_voxels(distance, voxel_size))


def dilate(volume: SparseVolume, distance: float) -> SparseVolume:
    """The level set grown by a distance: :func:`offset` outwards.

    Args:
        volume: Level set.
        distance: [world], not negative.
    Returns:
        Level set.
    Raises:
        InputError: As of :func:`offset`, or a negative distance.
        UnsupportedGridError: Values that are not real numbers.
        MissingDependencyError: geokit was built without OpenVDB.
    """
    voxel_size = require_level_set(volume, "volume")
    return _offset(volume, voxel_size, _checked_radius(distance, voxel_size))


def erode(volume: SparseVolume, distance: float) -> SparseVolume:
    """The level set shrunk by a distance: :func:`offset` inwards.

    Args:
        volume: Level set.
        distance: [world], not negative.
    Returns:
        Level set; without a surface where nothing is left.
    Raises:
        InputError: As of :func:`offset`, or a negative distance.
        UnsupportedGridError: Values that are not real numbers.
        MissingDependencyError: geokit was built without OpenVDB.
    """
    voxel_size = require_level_set(volume, "volume")
    return _offset(volume, voxel_size, -_checked_radius(distance, voxel_size))


def opening(volume: SparseVolume, distance: float) -> SparseVolume:
    """Eroded, then dilated: parts thinner than twice the distance go, outer edges are rounded.

    Args:
        volume: Level set.
        distance: Radius of the ball that has to fit inside [world], not negative.
    Returns:
        Level set.
    Raises:
        InputError: As of :func:`offset`, or a negative distance.
        UnsupportedGridError: Values that are not real numbers.
        MissingDependencyError: geokit was built without OpenVDB.
    """
    voxel_size = require_level_set(volume, "volume")
    radius = _checked_radius(distance, voxel_size)
    return _offset(_offset(volume, voxel_size, -radius), voxel_size, radius)


def closing(volume: SparseVolume, distance: float) -> SparseVolume:
    """Dilated, then eroded: gaps and holes narrower than twice the distance close, inner edges are rounded.

    Args:
        volume: Level set.
        distance: Radius of the ball that has to fit outside [world], not negative.
    Returns:
        Level set.
    Raises:
        InputError: As of :func:`offset`, or a negative distance.
        UnsupportedGridError: Values that are not real numbers.
        MissingDependencyError: geokit was built without OpenVDB.
    """
    voxel_size = require_level_set(volume, "volume")
    radius = _checked_radius(distance, voxel_size)
    return _offset(_offset(volume, voxel_size, radius), voxel_size, -radius)


def _offset(volume: SparseVolume, voxel_size: float, voxels: float) -> SparseVolume:
    half_width = half_width_of(volume, voxel_size)
    # The cells that the new surface crosses must be inside the band, corners and all.
    needed = abs(voxels) + 2.0
    wide = with_band(volume, voxel_size, needed) if needed > half_width else volume
    return redistanced(wide, voxel_size, half_width, isovalue=voxels)


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
