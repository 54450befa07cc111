"""Bands of two widths: how far a level set's distances reach outside and inside, and bands cut to such widths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.nanovdb.nodes import bits_of, grid_nodes
from geokit.volume.nanovdb.types import QUANTIZED
from geokit.volume.tree.grid_head import result_head, volume_from_buffer
from geokit.volume.tree.leaves import build_real_grid, dequantized
from geokit.volume.tree.typed_tree import RowTable, tree_of

# Bands whose widths differ by less count as equal: a background is a float32 product of voxel size and half width.
BAND_TOLERANCE = 1e-5
# Active values of a band exceed its background by no more: files in half precision round values by 2^-11 of them.
ROUNDING = 1e-3
# No band is narrower: a cell that the surface crosses has a corner within this distance on each side.
NARROWEST = 1.0 - BAND_TOLERANCE
# A background beyond this many voxels is some large number, and no width.
WIDEST = 1 << 16
LEAVES_AT_A_TIME = 1024


class BandWidths(NamedTuple):
    """How far a band reaches from the surface [voxels].

    Attributes:
        outside: To the background.
        inside: To the value of inactive voxels inside, the negative of it.
    """

    outside: float
    inside: float

    @property
    def widest(self) -> float:
        """The wider of both."""
        return max(self)

    @property
    def narrowest(self) -> float:
        """The narrower of both: no value within it is cut off."""
        return min(self)

    @property
    def are_equal(self) -> bool:
        """Whether the band reaches equally far on both sides."""
        return bool(np.isclose(self.outside, self.inside, rtol=BAND_TOLERANCE, atol=0.0))


def widths_of(volume: SparseVolume, voxel_size: float) -> BandWidths:
    """Widths of a level set's band.

    The width inside is that of the value which inactive voxels inside have in common. A body that is active throughout
    has none: all that it holds is kept. Fields that say neither, because these values differ or active ones exceed
    them, or because the background is no width, count as bands of one width, that of the background. So do fields that
    are active beyond the background, as those whose distances nobody has cut off.
    """
    found: BandWidths = volume._cache.find("widths of the band", lambda: _found_widths(volume, voxel_size))
    return found


def with_widths(volume: SparseVolume, voxel_size: float, widths: BandWidths) -> SparseVolume:
    """The level set, whose band has one width, cut to two: what lies beyond becomes inactive."""
    if widths.are_equal:
        return volume
    source = dequantized(volume)
    tree = tree_of(source)
    layout = tree.layout
    kind = layout.background
    outer, inner = (kind.type(width * voxel_size) for width in widths)
    values, active = tree.values.copy(), bits_of(tree.masks)
    is_inside = values < 0
    # Where a side is as wide as it was, inactive voxels have its value already.
    active &= (values < outer) & (values > -inner)
    values[~active & ~is_inside] = outer
    values[~active & is_inside] = -inner
    kept = _needed(tree.origins, active, is_inside)
    masks = np.packbits(active[kept], axis=1, bitorder="little")
    head = replace(
        result_head(source, layout, outer, "level set", source.info.transform), inside=np.array(-inner, kind.base)
    )
    return volume_from_buffer(build_real_grid(head, tree.origins[kept], masks, values[kept]), source)


def _found_widths(volume: SparseVolume, voxel_size: float) -> BandWidths:
    background = float(volume.info.background)
    outside = _in_voxels(background, voxel_size)
    one = BandWidths(outside, outside)
    if not outside <= WIDEST:
        return one
    check_volume(volume)
    highest = background * (1.0 + ROUNDING)
    inner, deepest = None, 0.0
    for values, active in _values(volume):
        inside = values < 0
        known = -values[inside & ~active].astype(np.float64)
        if len(known):
            # Most bands end here, with the first leaves that were read.
            inner = float(known[0]) if inner is None else inner
            if _same(inner, background):
                return one
            if not _same(known, inner).all():
                return one
        if (active & (values > highest)).any():
            return one
        deepest = max(deepest, -float(values.min(initial=0, where=inside & active)))
    if not np.isfinite(deepest):
        return one
    if inner is None:
        return BandWidths(outside, max(outside, deepest / voxel_size))
    if not NARROWEST <= inner / voxel_size < np.inf or deepest > inner * (1.0 + BAND_TOLERANCE):
        return one
    return BandWidths(outside, _in_voxels(inner, voxel_size))


def _same(values: Any, width: float) -> Any:
    return np.isclose(values, width, rtol=BAND_TOLERANCE, atol=0.0)


def _in_voxels(width: float, voxel_size: float) -> float:
    voxels = width / voxel_size
    nearest = round(voxels) if np.isfinite(voxels) else 0
    return float(nearest) if abs(voxels - nearest) < BAND_TOLERANCE * voxels else voxels


def _values(volume: SparseVolume) -> Iterator[tuple[NDArray[Any], NDArray[np.bool_]]]:
    """Values in parts, each with which of them are active: of tiles, then of leaves."""
    is_quantized = volume.info.grid_type in QUANTIZED
    grid = grid_nodes(volume.nanovdb)
    for level in (grid.lower, grid.upper):
        for _, part in level.parts():
            is_tile = ~bits_of(np.ascontiguousarray(part.child_mask))
            yield np.asarray(part.values)[is_tile], bits_of(np.ascontiguousarray(part.value_mask))[is_tile]
    table = grid.table[grid.table["child"] == 0]
    yield table["value"], table["state"] != 0
    if is_quantized:
        source = dequantized(volume)
        grid = grid_nodes(source.nanovdb, LAYOUTS[source.info.grid_type])
    for _, part in grid.leaf.parts(LEAVES_AT_A_TIME):
        yield np.asarray(part.values), bits_of(np.ascontiguousarray(part.value_mask))


def _needed(origins: NDArray[np.int32], active: NDArray[np.bool_], is_inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Leaves that hold an active voxel, or show where the sign changes without one, as in holes of open meshes."""
    needed = np.asarray(active.any(axis=1) | (is_inside.any(axis=1) & ~is_inside.all(axis=1)))
    cells, table = is_inside.reshape(-1, 8, 8, 8), RowTable(origins)
    for axis in range(3):
        step = np.zeros(3, np.int32)
        step[axis] = 8
        beyond = table.find(origins + step)
        row = np.flatnonzero(beyond >= 0)
        differs = np.take(cells[row], 7, axis + 1) != np.take(cells[beyond[row]], 0, axis + 1)
        row = row[differs.any(axis=(1, 2))]
        needed[row] = needed[beyond[row]] = True
    return needed
