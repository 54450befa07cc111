"""Distance fields of meshes within a tolerance: turns arguments into a search, and its result into a volume."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.blocks.chunked_queries import Progress
from geokit.core.interop import user_arrays
from geokit.core.interop.types import MeshLike
from geokit.core.require import require_choice, require_count
from geokit.errors import InputError
from geokit.volume.band.band import BandShape, build_band, make_band
from geokit.volume.band.fields import (
    band_metadata,
    grid_head,
    half_widths,
    in_float32,
    resolve_surface,
    volume_from_built,
)
from geokit.volume.band.tiles import Lattice
from geokit.volume.nanovdb.provenance import provenance, with_more
from geokit.volume.tolerance.band_memory import BandMemory, lattice_within
from geokit.volume.tolerance.checked_fields import made_within
from geokit.volume.tolerance.search import CODECS, ORDERS, Search, Setting, options_of
from geokit.volume.tolerance.zone import Zone, checked_within, require_extent
from geokit.volume.tree.leaf_codecs import LeafReader

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface
    from geokit.volume.model.sparse_volume import SparseVolume

# Voxels along the longest side of the band whose leaf ranges are measured: it has a few hundred to a thousand leaves.
RANGED_VOXELS = 100.0
# Least tolerance as a share of the field's size: a few roundings of its coordinates.
LEAST_SHARE = 1e-15


def tolerance_search(
    mesh: MeshLike | Surface,
    tolerance: float,
    *,
    within: float | None,
    order: int | None,
    half_width: Any = None,
    sign: str,
    thickness: float | None = None,
    interior: str = "remove",
    codec: str | None,
    device: Any,
) -> Search:
    """The search for the setting that keeps a tolerance; see :func:`from_mesh` for the arguments.

    Raises:
        InputError: As :func:`from_mesh`.
    """
    from geokit.mesh._sample_surface import sample_surface
    from geokit.volume.retyped.quantize import CODECS as ALL_CODECS

    tolerance = user_arrays.require_finite_scalar(tolerance, "tolerance", low=0.0)
    if order is not None:
        order = require_count(order, "order", min(ORDERS), max(ORDERS))
    if codec is not None:
        require_choice(codec, "codec", ALL_CODECS)
    if isinstance(half_width, (tuple, list)):
        raise InputError("half_width: a pair of widths has no meaning with tolerance; give one, or none")
    if half_width is not None:
        half_width = half_widths(half_width)[0]
    surface, method, offset = resolve_surface(mesh, sign, thickness, interior, device, tolerance)
    within = checked_within(within, tolerance, jumps=method != "none" and not surface.is_closed)

    def truth(points: NDArray[np.float64]) -> NDArray[np.float64]:
        if method == "none":
            return np.asarray(surface.closest_point(points).distance) - offset
        return np.asarray(surface.signed_distance(points, sign=method).distance)

    def seeds(count: int, seed: int) -> NDArray[np.float64]:
        return sample_surface(surface.mesh, count, seed=seed).points

    def onto(points: NDArray[np.float64]) -> NDArray[np.float64]:
        foot = np.asarray(surface.closest_point(points).points)
        away = points - foot
        length = np.linalg.norm(away, axis=1, keepdims=True)
        # Where there is no direction the point stays on the mesh, which is not in the zone of a shell.
        return foot + away * (offset / np.where(length > 0.0, length, np.inf))

    zone = Zone(truth, seeds, onto, surface.bounds, within, offset)
    require_extent(zone.longest)
    if tolerance < LEAST_SHARE * zone.longest:
        raise InputError(
            f"tolerance: {tolerance:g} is out of reach for a field of {zone.longest:.3g} across, whose coordinates are "
            f"float64; use {LEAST_SHARE * zone.longest:.2g} or more"
        )
    options = options_of(ORDERS if order is None else (order,), CODECS if codec is None else (codec,))
    most_bytes = Lattice(surface, zone.longest, 0.0).free

    def leaf_ranges(width: float) -> NDArray[np.float64]:
        # Leaf ranges are similar at every voxel size, so those of one coarse band serve all sizes.
        size = zone.longest / RANGED_VOXELS
        reach = in_float32(width * size)
        lattice = lattice_within(surface, size, reach, offset)
        shape = BandShape(reach, reach, offset, method)
        grid = volume_from_built(build_band(make_band(lattice, shape), grid_head(shape, lattice, "")), {})
        reader = LeafReader(grid.nanovdb)
        values = reader.values(0, reader.count)
        return np.asarray((values.max(axis=1) - values.min(axis=1)) / (2.0 * reach), np.float64)

    memory = BandMemory(surface, offset, method)
    return Search(zone, memory, tolerance, options, most_bytes, leaf_ranges, half_width, sign, method)


def make_setting(search: Search, setting: Setting, name: str | None = None) -> SparseVolume:
    """Build the field of a setting."""
    from geokit.volume.retyped.quantize import quantize

    surface, size = search.memory.surface, setting.voxel_size
    width = in_float32(setting.half_width * size)
    shape = BandShape(width, width, search.zone.offset, search.sign_method)
    lattice = lattice_within(surface, size, width, search.zone.offset)
    band = make_band(lattice, shape)
    head = grid_head(shape, lattice, surface.mesh.name if name is None else name)
    # No warning about thin parts: no voxel may lie inside them, but the interpolant may still keep the tolerance.
    volume = volume_from_built(build_band(band, head), band_metadata(band, search.sign, say_lost=False))
    if setting.option.codec == "float":
        return volume
    share = setting.option.share
    return quantize(volume, setting.option.codec, tolerance=share * search.tolerance if share else None)


def within_tolerance(
    mesh: MeshLike | Surface,
    tolerance: float,
    options: dict[str, Any],
    sign: str,
    method: str,
    name: str | None,
    progress: Progress | None = None,
) -> SparseVolume:
    if method != "geokit":
        raise InputError("method: only 'geokit' makes fields with a tolerance; the others are off by what they are")
    search = tolerance_search(mesh, tolerance, sign=sign, **options)
    search.progress = progress
    setting, volume, achieved = made_within(search, lambda s: make_setting(search, s, name))
    assert volume is not None
    assert achieved is not None
    found = provenance(
        tolerance=search.tolerance,
        achieved_error=achieved.largest,
        achieved_error_999=achieved.p999,
        checked_within=search.zone.within,
        order=setting.option.order,
    )
    if progress:
        progress(100, 100)
    return with_more(volume, found)
