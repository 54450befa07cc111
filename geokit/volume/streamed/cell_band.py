"""The narrow band of one cell, or the smaller cells into which it has to be split.

A cell is a task of its own: what it needs is its file and :class:`CellBands`, which can be pickled.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.errors import DeviceMemoryError
from geokit.formats.blocks.records import BYTES_AT_A_TIME
from geokit.formats.blocks.workers import Done
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.surface import BYTES_PER_FACE, Surface
from geokit.volume.band.band import BandShape, build_band, make_band
from geokit.volume.band.tiles import Lattice, near_tiles
from geokit.volume.nanovdb.nodes import grid_nodes
from geokit.volume.streamed.cells import LEAF_SPAN, LOWER_SPAN, Cell, CellLattice, smaller, split
from geokit.volume.streamed.windings import AT_A_TIME, ColumnWindings
from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.grid_head import GridHead

# Memory for each triangle of a cell, with its tree and winding numbers, and for each leaf, until it is on disk.
BYTES_PER_TRIANGLE, BYTES_PER_LEAF = BYTES_PER_FACE + 300, 10000
# Voxels along an edge of the largest cell that is made at once.
LARGEST_SPAN = 1024


@dataclass(frozen=True)
class CellBands:
    """What is the same for all cells of a band.

    Attributes:
        lattice: The voxels.
        shape: Widths and offset of the band; its method is "none", or "parity" for signs by exact winding numbers.
        head: Headers of the grid.
        memory: Bytes that a cell may take.
        device: Name of the device to compute on.
        turn: -1 if the mesh is inside out, else 1.
        near: Voxels nearer to the surface than this [world] are on it, and so outside.
    """

    lattice: CellLattice
    shape: BandShape
    head: GridHead
    memory: int
    device: str
    turn: int
    near: float

    @property
    def signed(self) -> bool:
        """Whether empty regions inside take the inner background."""
        return self.shape.method != "none" or self.shape.offset > 0.0

    def winding(self, number: int) -> int | None:
        """The winding number, where anybody needs it."""
        return None if self.shape.method == "none" else number

    def make(self, cell: Cell, folder: Path) -> Done:
        """Make the band of a cell, or split it; its own file stays.

        What is found is its grid, if it has a leaf. The number is that of voxels with a negative winding number, of all
        that were looked at.

        Args:
            cell: Of whole lower nodes, or a part of one.
            folder: Where files of smaller cells are made.
        Raises:
            DeviceMemoryError: A cell of a single leaf needs more memory than may be taken.
        """
        memory = max(self.memory - BYTES_AT_A_TIME, BYTES_AT_A_TIME)
        need = cell.file.count * BYTES_PER_TRIANGLE + self._leaves(cell) * BYTES_PER_LEAF
        smallest = cell.span == LEAF_SPAN
        if smallest or (need <= memory and cell.span <= LARGEST_SPAN):
            if smallest and cell.file.count * BYTES_PER_TRIANGLE > memory:
                raise DeviceMemoryError(
                    f"memory_limit: {cell.file.count} triangles lie near the 8^3 voxels from {cell.origin.tolist()} "
                    "on; give more memory or smaller voxels",
                    need=cell.file.count * BYTES_PER_TRIANGLE + BYTES_AT_A_TIME,
                )
            try:
                return self._band(cell, memory)
            except DeviceMemoryError:
                if smallest:
                    raise
        span = smaller(cell.span)
        # A folder for each attempt: that of a worker which was given up may still be running.
        place = Path(tempfile.mkdtemp(dir=folder))
        counts = (cell.span // span,) * 3
        winding = self.winding(cell.winding)
        blocks = cell.file.parts(AT_A_TIME)
        cells = split(blocks, cell.file.dtype.base, cell.origin, span, counts, self.lattice, winding, place)
        if span >= LOWER_SPAN:
            return Done(None, cells)
        # Only whole lower nodes are parts of the grid; what is smaller is joined.
        return self._joined(cells, folder)

    def _leaves(self, cell: Cell) -> float:
        """Leaves of the band of a cell, about."""
        width = 2.0 * self.lattice.reach / self.lattice.voxel_size
        return float(min((cell.span // LEAF_SPAN) ** 3, cell.area / 64.0 * (1.5 + width / 8.0)))

    def _band(self, cell: Cell, memory: int) -> Done:
        lattice, corners = self.lattice, cell.file.read()
        windings = None
        if self.shape.method != "none":
            places = lattice.coordinates(cell.origin - 1, 1, (cell.span + 1,) * 3)
            windings = ColumnWindings(corners, places, cell.winding)
        mesh = TriangleMesh(
            corners.reshape(-1, 3).astype(np.float64), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
        )
        del corners
        device = launcher.resolve_device(self.device)
        surface = _CellSurface(mesh, device, lattice, cell.origin - 1, windings, self.turn, self.near)
        within = _LatticeOfCell(surface, cell, lattice, self.shape.hollow, memory)
        tiles = None if within.is_empty else near_tiles(within)
        if tiles is None or len(tiles.keys) == 0:
            return Done(None)
        band = make_band(within, self.shape, tiles=tiles)
        if len(band.leaves.keys) == 0:
            return Done(None, number=surface.against)
        built = build_band(band, self.head)
        return Done(built.buffer.numpy() if built.host is None else built.host, number=surface.against)

    def _joined(self, cells: list[Cell], folder: Path) -> Done:
        """One grid of the leaves of several cells, which are made one after the other."""
        grids, against = [], 0
        for cell in cells:
            made = self.make(cell, folder)
            os.unlink(cell.file.path)
            against += made.number
            if made.found is not None:
                grids.append(made.found)
        if not grids:
            return Done(None, number=against)
        leaves = [grid_nodes(grid, self.head.layout).leaf for grid in grids]
        origins, values, masks = (
            np.concatenate([getattr(leaf, name) for leaf in leaves]) for name in ("origins", "values", "value_mask")
        )
        return Done(build_leaves(self.head, origins, values, masks, signed=self.signed), number=against)


class _CellSurface(Surface):
    """The triangles near a cell. They are part of a closed mesh, whose winding numbers tell inside from outside."""

    def __init__(
        self,
        mesh: TriangleMesh,
        device: "wp.Device",
        lattice: CellLattice,
        first: NDArray[np.int64],
        windings: ColumnWindings | None,
        turn: int,
        near: float,
    ) -> None:
        super().__init__(mesh, device=device)
        self._lattice, self._first, self._windings = lattice, first, windings
        self._turn, self._near, self.against = turn, near, 0

    @property
    def is_closed(self) -> bool:
        return True

    def contains(self, points: Any, **_: Any) -> Any:
        """Whether voxels, given by their positions, lie inside; those on the surface are outside."""
        assert self._windings is not None
        lattice = self._lattice
        where = points.numpy()
        voxels = np.rint((where - lattice.translation) / lattice.voxel_size).astype(np.int64)
        numbers = self._turn * self._windings.at(voxels - self._first)
        self.against += int(np.count_nonzero(numbers < 0))
        inside = np.flatnonzero(numbers > 0)
        if len(inside):
            near = self.closest_point(where[inside], max_distance=self._near).distance
            numbers[inside[near <= self._near]] = 0
        return wp.array(numbers > 0, dtype=wp.bool, device=self._device)


class _LatticeOfCell(Lattice):
    """The lattice of the whole band, of which only a cell's tiles are looked at."""

    def __init__(self, surface: Surface, cell: Cell, lattice: CellLattice, hollow: float, memory: int) -> None:
        super().__init__(surface, lattice.voxel_size, lattice.reach, hollow, translation=lattice.translation)
        self._low, self._high = cell.origin // LEAF_SPAN, (cell.origin + cell.span) // LEAF_SPAN - 1
        # Of the memory, some is taken by the triangles, and some by leaves after the band.
        self.free = min(self.free, memory / 2.0)

    def box(self, voxel_size: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        low, high = super().box(voxel_size)
        return np.maximum(low, self._low), np.minimum(high, self._high)

    @property
    def is_empty(self) -> bool:
        """Whether no tile of the cell is within reach."""
        low, high = self.box(self.voxel_size)
        return bool((low > high).any())

    def area(self) -> float:
        """Nothing: most triangles may lie outside of the cell, so that their area tells little."""
        return 0.0
