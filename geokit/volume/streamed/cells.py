"""Cells: cubes of voxels with the triangles near them, in files, split until one fits into memory."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.blocks.records import Buckets, RecordFile
from geokit.volume.streamed.windings import Coordinates, CornerWindings, extent, in_parts

# Voxels along an edge of a lower node and of a leaf: a grid's parts are whole lower nodes.
LOWER_SPAN, LEAF_SPAN = 128, 8
# A cell is split into this many along each axis.
PARTS = 4
# Voxels by which triangles may lie beyond the reach of a cell: half the diagonal of a leaf is 2.6 voxels longer than
# half its edge, and the first point of the lattice of winding numbers is one voxel outside.
HALO = 3.0


@dataclass(frozen=True)
class CellLattice:
    """The voxels of the whole band.

    Attributes:
        voxel_size: Edge length [world].
        translation: Position of index 0 [world], (3,).
        reach: Distance [world] of the band's farthest voxels from the surface.
    """

    voxel_size: float
    translation: NDArray[np.float64]
    reach: float

    def coordinates(self, low: NDArray[np.int64], step: int, counts: tuple[int, int, int]) -> Coordinates:
        """Positions of lattice points along each axis, from voxel ``low`` on, ``step`` voxels apart."""
        x, y, z = (
            (first + step * np.arange(count)).astype(np.float64) * self.voxel_size + move
            for first, count, move in zip(low.tolist(), counts, self.translation.tolist(), strict=True)
        )
        return x, y, z


@dataclass(frozen=True)
class Cell:
    """A cube of voxels.

    Attributes:
        origin: Its first voxel, multiples of ``span``, (3,).
        span: Voxels along an edge, a power of two.
        file: The triangles that reach it, (3, 3) each.
        area: Area of them [squares of a voxel], of each no more than the cell can hold.
        winding: Winding number at the voxel diagonally before the first one.
    """

    origin: NDArray[np.int64]
    span: int
    file: RecordFile
    area: float
    winding: int


def smaller(span: int) -> int:
    """Voxels along an edge of the cells into which one of this many is split."""
    return max(span // PARTS, LOWER_SPAN if span > LOWER_SPAN else LEAF_SPAN)


def split(
    blocks: Iterable[NDArray[Any]],
    dtype: np.dtype[Any],
    origin: NDArray[np.int64],
    span: int,
    counts: tuple[int, int, int],
    lattice: CellLattice,
    winding: int | None,
    folder: Path,
) -> list[Cell]:
    """Sort triangles into cells, each into all cells that it reaches; cells without triangles are left out.

    Args:
        blocks: The triangles (N, 3, 3), some at a time.
        dtype: Type of the numbers in the files.
        origin: First voxel of the first cell, (3,).
        span: Voxels along an edge of a cell.
        counts: Number of cells along each axis.
        lattice: The voxels.
        winding: Winding number diagonally before the first cell; None where nobody needs it.
        folder: Where the files are made.
    """
    size = lattice.voxel_size
    windings = CornerWindings(lattice.coordinates(origin - 1, span, counts), 0 if winding is None else winding)
    areas = np.zeros(math.prod(counts))
    # A plane through a cube meets it in at most 1.3 squares of its edge, and the halo adds some.
    largest = 2.0 * (span + 2.0 * (lattice.reach / size + HALO)) ** 2
    stem = "-".join(map(str, [span, *origin.tolist()]))
    buckets = Buckets(folder / stem, np.dtype((dtype, (3, 3))), len(areas))
    for block in blocks:
        corners = block.astype(np.float64)
        if winding is not None:
            windings.add(corners)
        local = (corners - lattice.translation) / size - origin
        edges = local[:, 1:] - local[:, :1]
        area = np.minimum(0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1), largest)
        row, cell = _reached(local, span, counts, lattice.reach / size + HALO)
        for at, some in buckets.add(block, cell, row):
            areas[at] += area[some].sum()
    numbers = windings.numbers().reshape(-1)
    return [
        Cell(origin + span * np.array(np.unravel_index(at, counts)), span, file, float(areas[at]), int(numbers[at]))
        for at, file in buckets.files()
    ]


def _reached(
    local: NDArray[np.float64], span: int, counts: tuple[int, int, int], margin: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a triangle and a cell that it reaches, from corners (N, 3, 3) in voxels from the first cell."""
    low, high = extent(local)
    low, high = np.floor((low - margin) / span), np.floor((high + margin) / span)
    last = np.array(counts) - 1
    low, high = np.clip(low, 0, last + 1).astype(np.int64), np.clip(high, -1, last).astype(np.int64)
    number = np.maximum(high - low + 1, 0)
    pairs = number[:, 0] * number[:, 1] * number[:, 2]
    row = np.repeat(np.arange(len(local)), pairs)
    within = np.arange(len(row)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    place = np.empty((len(row), 3), np.int64)
    for axis in (2, 1, 0):
        place[:, axis] = low[row, axis] + within % number[row, axis]
        within = within // number[row, axis]
    kept = np.ones(len(row), bool)
    for some in in_parts(np.flatnonzero(pairs[row] > 1)):
        kept[some] = _meets(local[row[some]] - span * (place[some, None] + 0.5), 0.5 * span + margin)
    return row[kept], np.ravel_multi_index(tuple(place[kept].T), counts)


def _meets(corners: NDArray[np.float64], half: float) -> NDArray[np.bool_]:
    """Whether triangles (N, 3, 3) may meet a cube around the origin: no plane of a face or edge lies between.

    Source:
        Akenine-Möller, "Fast 3D Triangle-Box Overlap Testing" (2001).
    """
    edges = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(edges[:, 0], edges[:, 1])
    # Rounding must not separate what touches.
    half *= 1.0 + 1e-9
    meets = np.abs(np.einsum("ij,ij->i", normal, corners[:, 0])) <= half * np.abs(normal).sum(axis=1) * (1.0 + 1e-9)
    for edge in range(3):
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            across = np.stack([-edges[:, edge, v], edges[:, edge, u]], axis=1)
            along = np.einsum("ij,ikj->ik", across, corners[:, :, (u, v)])
            reach = half * np.abs(across).sum(axis=1) * (1.0 + 1e-9)
            low, high = extent(along)
            meets &= (low <= reach) & (high >= -reach)
    return np.asarray(meets)
