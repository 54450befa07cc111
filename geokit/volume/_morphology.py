"""Offsets and morphology of level sets, and morphology of the active voxels of other grids."""

from __future__ import annotations

from typing import Any

from geokit._warn import warn
from geokit.core.interop.types import Device
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_choice, require_count
from geokit.errors import InputError
from geokit.volume.band.fields import half_widths
from geokit.volume.level_set.active_morphology import MOST_VOXELS, NEIGHBORS, changed_topology
from geokit.volume.level_set.band_widths import BandWidths, widths_of, with_widths
from geokit.volume.level_set.operands import require_level_set, with_band
from geokit.volume.level_set.redistance import redistance
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.leaves import require_volume

__all__ = ["closing", "dilate", "erode", "offset", "opening", "renormalize"]

# Largest offset [voxels]: the band must reach that far during the computation, and memory grows with it.
FARTHEST_OFFSET = 256.0
# Voxels by which a band reaches beyond the new surface, outwards and inwards.
MARGIN, INWARD_MARGIN = 2.0, 3.0
# Least part [voxels] of an offset outwards that is made within the band before the band is extended for the rest.
LEAST_STEP = 0.5


@needs(lambda volume, *_, **__: 32500 * leaf_count(volume))
def renormalize(
    volume: SparseVolume, *, half_width: float | tuple[float, float] | None = None, device: Device = None
) -> SparseVolume:
    """Recompute signed distances around the same surface, so that the slope is 1 again.

    Use it for level sets whose values are no longer distances, such as sums, products, advected or blended fields. The
    corners of cells that the surface crosses are divided by the field's slope there, which keeps the surface in place.
    Every other voxel gets its distance from the piece of surface that the nearest of those corners represents. The
    surface moves at most 0.005 voxel where the slope changes by less than 4 % a voxel along it, and not at all where
    the slope is already 1. Distances are right to 0.005 voxel around surfaces whose radius of curvature is at least 10
    voxels and whose slope is even, and to 0.1 where it changes by 4 % a voxel; next to sharp edges they are up to 0.3
    voxel off. Results are the same on every device.

    Fields with slopes up to half_width / 1.75 keep their surface. Steeper fields are cut off by the band, and their
    surface is no longer known.

    Args:
        volume: Level set.
        half_width: Width of the new band on each side [voxels], at least 1, or a pair of widths, outside and inside;
            None for those of the old one.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Level set of the same type (float if that is quantized).
    Raises:
        InputError: volume is not a level set, its voxels are not cubes, or the half width is below 1 or above 256.
        UnsupportedGridError: Values are not real numbers.
        DeviceMemoryError: The band does not fit into memory.
    Source:
        Closest features as in Danielsson, "Euclidean distance mapping" (1980). Differs: features are pieces of the
            surface with a direction and a curvature instead of points.
    """
    voxel_size = require_level_set(volume, "volume")
    widths = widths_of(volume, voxel_size) if half_width is None else _checked_half_widths(half_width)
    return with_widths(redistance(volume, voxel_size, widths.widest, device=device), voxel_size, widths)


@needs(lambda volume, *_, **__: 48500 * leaf_count(volume))
def offset(volume: SparseVolume, distance: float, *, device: Device = None) -> SparseVolume:
    """Move the surface of a level set by a signed distance: outwards if positive, inwards if negative.

    The new surface is exact to 0.05 voxel where the radius of curvature is at least 8 voxels before and after. So are
    the distances around it, but for up to 0.2 % of the voxels around bodies that are no balls: 0.15 voxel there. The
    surface is an isosurface of the level set itself; only beyond its band is it one of distances computed from it. All
    distances are then recomputed from the new surface. A body thinner than twice the distance disappears.

    Sharp edges stay sharp: convex ones inwards, concave ones outwards. Distances beyond them are those from the edge:
    right to 0.3 voxel next to edges and corners of boxes, cylinders and plates, 0.4 next to tips and acute rims and
    where less than a voxel is left, and 0.7 at the ends of concave edges and outwards beyond the band, in bands of up
    to 5 voxels. In polyhedra of many short or blunt edges up to 0.1 % of the voxels are farther off, by up to the width
    of the band. This needs a level set that holds distances.
    Outwards, the other edges become round. Distances next to them are right to 0.3 voxel, but for up to 0.1 % of the
    voxels at edges in odd directions: 0.6 voxel off where the band of the level set covers the offset and two voxels
    more, and else by up to the width of the band.

    Args:
        volume: Level set.
        distance: Distance by which the surface moves [world], at most 256 voxels.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Level set of the same type, with a band of the same widths.
    Raises:
        InputError: volume is not a level set, its voxels are not cubes, or the distance is not finite or too large.
        UnsupportedGridError: Values are not real numbers.

    Source:
        Ju et al., Dual Contouring of Hermite Data (2002) for the mesh that keeps edges; Hildreth, "A quadratic
            programming procedure" (1957) for the distance from the body behind tangent planes.
    """
    voxel_size = require_level_set(volume, "volume")
    distance = require_finite_scalar(distance, "distance")
    return _offset(volume, voxel_size, [_checked_voxels(distance, voxel_size)], device)


def _bytes(for_each_leaf: int) -> Any:
    def estimate(volume: SparseVolume, distance: Any = None, *, voxels: Any = None, **_: Any) -> float:
        return leaf_count(volume) * (for_each_leaf if voxels is None else 5000)

    return estimate


@needs(_bytes(48500))
def dilate(
    volume: SparseVolume,
    distance: float | None = None,
    *,
    voxels: int | None = None,
    neighbors: str = "faces",
    device: Device = None,
) -> SparseVolume:
    """Dilation: grow the inside of a level set by a distance, or the active region of another grid by voxels.

    A level set grows by ``distance``, with the errors of :func:`offset` outwards. In other grids, such as fog, every
    voxel next to an active one becomes active, ``voxels`` times. It keeps its value in the tree, which is that of an
    inactive voxel, a tile or the background, in bool grids too: the state is turned on, not the value, as with
    OpenVDB's dilateActiveValues. In a mask the state is the value. Active tiles become voxels (:func:`prune` makes
    tiles of them).

    Args:
        volume: Level set with ``distance``; a grid of any type that holds values with ``voxels``.
        distance: Distance by which a level set's surface moves [world], not negative.
        voxels: Number of steps, at most 1024; not for level sets.
        neighbors: Neighbors of a voxel in a step: across its "faces" (6), also "edges" (18), or also "vertices" (26).
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Grid of the same type, class and background (float if that is quantized).
    Raises:
        InputError: Not exactly one of distance and voxels is given, or it is negative or does not apply to the grid;
            otherwise as for :func:`offset`.
        UnsupportedGridError: A grid of indices or points; with ``distance``, a grid whose values are not real numbers.
        DeviceMemoryError: The result does not fit into memory.
    """
    return _changed(volume, distance, voxels, neighbors, (1,), device)


@needs(_bytes(48500))
def erode(
    volume: SparseVolume,
    distance: float | None = None,
    *,
    voxels: int | None = None,
    neighbors: str = "faces",
    device: Device = None,
) -> SparseVolume:
    """Erosion: shrink the inside of a level set by a distance, or the active region of another grid by voxels.

    A level set shrinks by ``distance``, as with :func:`offset` inwards, and has no surface if nothing is left.
    Distances are right to 0.3 voxel next to sharp edges, with the exceptions that :func:`offset` names. In other
    grids every active voxel next to an inactive one becomes inactive background, ``voxels`` times; inactive voxels keep
    their values.

    Args:
        volume: Level set with ``distance``; a grid of any type that holds values with ``voxels``.
        distance: Distance by which a level set's surface moves [world], not negative.
        voxels: Number of steps, at most 1024; not for level sets.
        neighbors: Neighbors of a voxel in a step: across its "faces" (6), also "edges" (18), or also "vertices" (26).
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Grid of the same type, class and background (float if that is quantized).
    Raises:
        InputError, UnsupportedGridError, DeviceMemoryError: As for :func:`dilate`.
    """
    return _changed(volume, distance, voxels, neighbors, (-1,), device)


@needs(_bytes(49000))
def opening(
    volume: SparseVolume,
    distance: float | None = None,
    *,
    voxels: int | None = None,
    neighbors: str = "faces",
    device: Device = None,
) -> SparseVolume:
    """Opening: erosion followed by dilation. Removes parts thinner than twice the distance.

    In a level set, outer edges are rounded too. Distances are right to 0.5 voxel there (0.3 for most bodies),
    to 1.0 where the erosion leaves less than a voxel, with the exception of polyhedra that :func:`offset` names. Other
    grids lose active parts in which the neighborhood of ``voxels`` steps does not fit; voxels that stay active keep
    their values.

    Args:
        volume: Level set with ``distance``; a grid of any type that holds values with ``voxels``.
        distance: Radius of the ball that must fit inside a level set [world], not negative.
        voxels: Number of steps, at most 1024; not for level sets.
        neighbors: Neighbors of a voxel in a step: across its "faces" (6), also "edges" (18), or also "vertices" (26).
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Grid of the same type, class and background (float if that is quantized).
    Raises:
        InputError, UnsupportedGridError, DeviceMemoryError: As for :func:`dilate`.
    """
    return _changed(volume, distance, voxels, neighbors, (-1, 1), device)


@needs(_bytes(52000))
def closing(
    volume: SparseVolume,
    distance: float | None = None,
    *,
    voxels: int | None = None,
    neighbors: str = "faces",
    device: Device = None,
) -> SparseVolume:
    """Closing: dilation followed by erosion. Fills gaps and holes narrower than twice the distance.

    In a level set, inner edges are rounded too. Distances around boxes are right to 0.7 voxel, but for single voxels.
    Next to other sharp edges, concave or not, up to 0.3 % of the voxels have the errors of :func:`offset` beyond the
    band: up to its width. Other grids have gaps between active voxels filled in which the neighborhood of ``voxels``
    steps does not fit. Voxels that become active keep their previous values, and so do all others.

    Args:
        volume: Level set with ``distance``; a grid of any type that holds values with ``voxels``.
        distance: Radius of the ball that must fit outside a level set [world], not negative.
        voxels: Number of steps, at most 1024; not for level sets.
        neighbors: Neighbors of a voxel in a step: across its "faces" (6), also "edges" (18), or also "vertices" (26).
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Grid of the same type, class and background (float if that is quantized).
    Raises:
        InputError, UnsupportedGridError, DeviceMemoryError: As for :func:`dilate`.
    """
    return _changed(volume, distance, voxels, neighbors, (1, -1), device)


def _changed(
    volume: SparseVolume, distance: Any, voxels: Any, neighbors: str, steps: tuple[int, ...], device: Any
) -> SparseVolume:
    require_choice(neighbors, "neighbors", NEIGHBORS)
    if (distance is None) == (voxels is None):
        raise InputError("distance, voxels: give one of the two: a distance for level sets, voxels for other grids")
    if distance is not None:
        voxel_size = require_level_set(volume, "volume")
        radius = _checked_radius(distance, voxel_size)
        return _offset(volume, voxel_size, [step * radius for step in steps], device)
    require_volume(volume, "volume")
    if volume.info.grid_class == "level set":
        raise InputError(
            f"voxels: grid {volume.info.name!r} is a level set, whose surface moves by a distance; give distance="
        )
    voxels = require_count(voxels, "voxels", 0, MOST_VOXELS)
    return changed_topology(volume, tuple(step * voxels for step in steps), neighbors, device)


def _offset(volume: SparseVolume, voxel_size: float, steps: list[float], device: Any) -> SparseVolume:
    """The level set after offsets [voxels], one after the other; a UserWarning says where nothing is left."""
    given = volume.info
    widths = widths_of(volume, voxel_size)
    half_width = widths.widest
    for step, following in zip(steps, [*steps[1:], 0.0], strict=True):
        # Sharp edges are rounded by a step within the band: one that is extended from round edges is off less often.
        first = widths_of(volume, voxel_size).narrowest - MARGIN
        if LEAST_STEP <= first < step:
            volume = redistance(volume, voxel_size, half_width, isovalue=first, device=device)
            step -= first
        # The band must contain every cell that the new surface crosses, with all its corners; inwards, with all
        # voxels that tell directions there.
        needed = max(half_width, abs(step) + (INWARD_MARGIN if step < 0.0 else MARGIN))
        wide = (
            with_band(volume, voxel_size, needed, device=device)
            if needed > widths_of(volume, voxel_size).narrowest
            else volume
        )
        width = max(half_width, following + INWARD_MARGIN) if step < 0.0 < following else half_width
        volume = redistance(wide, voxel_size, width, isovalue=step, device=device)
    if given.active_voxel_count and not volume.info.active_voxel_count:
        inwards = -min(steps) * voxel_size
        warn(f"volume: nothing of grid {given.name!r} is left: it has no place {inwards:g} deep")
    return with_widths(volume, voxel_size, widths)


def _checked_half_widths(half_width: Any) -> BandWidths:
    widths = BandWidths(*half_widths(half_width))
    if widths.widest > FARTHEST_OFFSET:
        raise InputError(f"half_width: {widths.widest} voxels; a band has at most {FARTHEST_OFFSET:g}")
    return widths


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
