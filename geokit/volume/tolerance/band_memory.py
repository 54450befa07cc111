"""Predicts the bytes of a narrow band by counting its nodes, of fine bands at a coarser voxel size."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.volume.band.sign_change_tiles import with_sign_changes
from geokit.volume.band.tiles import TILE_VOXELS, WORKING_BYTES, Lattice, near_tiles
from geokit.volume.nanovdb.header import HEAD_SIZE
from geokit.volume.nanovdb.layout import LAYOUTS, LEAF_VOXELS, QUANTIZED_HEADER

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

# Most tiles that are counted. Above this the count is extrapolated with the square of the resolution.
MOST_COUNTED = 60_000
# Voxels along the mesh's longest side where the tiles in its holes are counted; their number grows with the square.
COUNTED_VOXELS = 200.0
# Edges of a lower and of an upper node, in tiles.
LOWER_TILES, UPPER_TILES = 16, 512


@dataclass(frozen=True)
class BandCounts:
    """Predicted numbers of a band's nodes."""

    leaves: float
    lowers: float
    uppers: float

    def bytes_of(self, codec: str, bits: float = 0.0) -> float:
        """Bytes of the grid in a codec; ``bits`` is the mean per voxel for "fpn", whose leaves differ."""
        layout = LAYOUTS[codec]
        leaf = QUANTIZED_HEADER + bits * LEAF_VOXELS / 8.0 if codec == "fpn" else layout.leaf_size
        head = HEAD_SIZE + layout.root_size + self.uppers * layout.root_tile_size
        return head + self.leaves * leaf + self.lowers * layout.lower_size + self.uppers * layout.upper_size

    @property
    def working_bytes(self) -> float:
        """Bytes needed while the band is built as floats."""
        return self.bytes_of("float") + self.leaves * WORKING_BYTES


@dataclass
class BandMemory:
    """Counts the nodes of bands around one surface.

    Attributes:
        surface: Surface of the bands.
        offset: Distance [world] of the field's surface from the mesh.
        method: Sign method, or "none" for unsigned distances.
    """

    surface: Surface
    offset: float
    method: str = "none"
    _known: dict[tuple[float, float, float | None], int] = field(default_factory=dict)

    def counts(self, voxel_size: float, width: float) -> BandCounts:
        """Nodes of a band that extends ``width`` [world] to either side of the field's surface."""
        # A surface crosses about one and a half tiles per area of a tile's face.
        expected = 1.5 * self._area / (TILE_VOXELS * voxel_size) ** 2
        coarser = max(1.0, expected / MOST_COUNTED) ** 0.5
        leaves = self._counted(voxel_size * coarser, width * coarser) * coarser * coarser
        leaves += self._sign_change_area / (TILE_VOXELS * voxel_size) ** 2
        # A node is counted as a tile of larger voxels.
        tile = TILE_VOXELS * voxel_size
        lowers = min(self._counted(voxel_size * LOWER_TILES, width, tile), leaves)
        uppers = min(self._counted(voxel_size * UPPER_TILES, width, tile), lowers)
        return BandCounts(leaves, lowers, uppers)

    def _counted(self, voxel_size: float, width: float, tile: float | None = None) -> float:
        key = (voxel_size, width, tile)
        if key not in self._known:
            lattice = lattice_within(self.surface, voxel_size, width, self.offset, tile=tile)
            self._known[key] = max(1, len(near_tiles(lattice).keys))
        return float(self._known[key])

    @cached_property
    def _sign_change_area(self) -> float:
        """Area [world^2] of the tiles' faces, as many as there are tiles in the holes of an open mesh."""
        if self.method == "none" or self.surface.is_closed:
            return 0.0
        size = 2.0 * float(self.surface.scale) / COUNTED_VOXELS
        lattice = lattice_within(self.surface, size, size, self.offset)
        near = near_tiles(lattice)
        more = len(with_sign_changes(lattice, near, self.method).keys) - len(near.keys)
        return more * (TILE_VOXELS * size) ** 2

    @cached_property
    def _area(self) -> float:
        scale = float(self.surface.scale)
        return Lattice(self.surface, scale, 0.0).area() * scale * scale


def lattice_within(
    surface: Surface, voxel_size: float, width: float, offset: float, *, tile: float | None = None
) -> Lattice:
    """Lattice of a band that extends ``width`` [world] to either side, placed so that it needs the fewest nodes.

    Index 0 is where the band begins, so that no node reaches below it. It lies on a multiple of ``tile`` [world]; None
    for the voxels' own tiles.
    """
    reach = width + offset
    start = band_start(surface, reach, tile or TILE_VOXELS * voxel_size)
    return Lattice(surface, voxel_size, reach, max(0.0, offset - width), translation=start)


def band_start(surface: Surface, reach: float, tile: float) -> NDArray[np.float64]:
    """The last multiples of ``tile`` [world] below all of a band."""
    return np.asarray(np.floor((surface.bounds[0] - reach) / tile) * tile)
