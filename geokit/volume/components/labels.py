"""Labels of connected components: voxels of leaves and whole tiles that touch at their faces.

The cost grows with the cells, not with the components: a tile is one cell, however many voxels it covers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory import available_memory
from geokit.core.scan import prefix_sum
from geokit.errors import DeviceMemoryError
from geokit.volume.nanovdb.nodes import bits_of, slot_of, slot_places
from geokit.volume.tree.typed_tree import RowTable, TypedTree

# Voxels along an edge of a cell: a voxel, and the tiles of lower nodes, upper nodes and the root.
CELL_SPANS = (1, 8, 128, 4096)
# Cells are numbered by int32.
MOST_ROWS = (1 << 31) // 512 - 1
# Bytes of a row: links, their copy on the host, sizes, masks, origin and neighbors.
BYTES_PER_ROW = 512 * (2 * 4 + 2) + 256
# Fewest rows per thread.
GRAIN = 16
# Step to the row behind each face: low and high x, y, z.
STEPS = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])


@dataclass(frozen=True)
class Rows:
    """Rows of 8^3 cells of one size.

    Attributes:
        span: Voxels along an edge of a cell.
        origins: First voxel of each row, (R, 3) int32, each once.
        words: Bit masks of the set cells, (R, 8) uint64.
        leaves: Leaf of the tree that each row is, (R,) int64; empty for tiles.
    """

    span: int
    origins: NDArray[np.int32]
    words: NDArray[np.uint64]
    leaves: NDArray[np.int64]


@dataclass(frozen=True)
class Labels:
    """Labels of the set cells of some rows.

    Attributes:
        rows: The rows, by size of their cells, smallest first.
        cells: Label of each cell from 1 on, 0 for cells that are not set, one (R, 512) int32 array per ``rows``.
        firsts: Bit masks of cells, at least one of each component in each row that it has cells in; as ``Rows.words``.
        voxel_counts: Voxels of each component, (C,) int64, descending; of equal ones the one whose first cell comes
            first in the rows.
    """

    rows: tuple[Rows, ...]
    cells: tuple[NDArray[np.int32], ...]
    firsts: tuple[NDArray[np.uint64], ...]
    voxel_counts: NDArray[np.int64]

    def pieces(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Component, from 0 on, and row of ``rows[0]`` of each component's share of a row, in this order."""
        row, cell = np.nonzero(bits_of(self.firsts[0].view(np.uint8)))
        both = np.unique(self.cells[0][row, cell].astype(np.int64) - 1 << 32 | row)
        return both >> 32, both & 0xFFFFFFFF

    def tiles(self, number: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """First voxel (T, 3) and label (T,) of each set cell of ``rows[number]``."""
        rows, cells = self.rows[number], self.cells[number]
        row, cell = np.nonzero(cells)
        steps = rows.span * slot_places(cell, 8)
        return rows.origins[row] + steps, cells[row, cell]


def active_rows(tree: TypedTree) -> tuple[Rows, ...]:
    """The active voxels and tiles of a tree."""
    states = (tree.lower.active, tree.upper.active, tree.root.active)
    return (_rows_of_leaves(tree.origins, tree.masks), *_rows_of_tiles(tree, states))


def inside_rows(tree: TypedTree) -> tuple[Rows, ...]:
    """The voxels and tiles of a level set that have negative values."""
    inside = np.packbits(tree.values < 0.0, axis=1, bitorder="little")
    states = (tree.lower.values < 0.0, tree.upper.values < 0.0, tree.root.values < 0.0)
    return (_rows_of_leaves(tree.origins, inside), *_rows_of_tiles(tree, states))


def _rows_of_leaves(origins: NDArray[np.int32], masks: NDArray[np.uint8]) -> Rows:
    """Rows of those leaves (L, 3) whose masks (L, 64) have a set voxel."""
    words = np.ascontiguousarray(masks).view(np.uint64)
    some = np.flatnonzero(words.any(axis=1))
    return Rows(1, origins[some], words[some], some)


def _rows_of_tiles(tree: TypedTree, states: tuple[NDArray[np.bool_], ...]) -> list[Rows]:
    found = []
    for nodes, state, span, width in zip(
        (tree.lower, tree.upper, tree.root), states, CELL_SPANS[1:], (16, 32, 1), strict=True
    ):
        origins = nodes.origins[state] if span == CELL_SPANS[3] else nodes.corners(state, width, span)
        if not len(origins):
            continue
        own, row = np.unique(origins & ~np.int32(8 * span - 1), axis=0, return_inverse=True)
        bits = np.zeros((len(own), 512), np.bool_)
        bits[row.reshape(-1), slot_of(origins, 8, span)] = True
        words = np.packbits(bits, axis=1, bitorder="little").view(np.uint64)
        found.append(Rows(span, own, words, np.empty(0, np.int64)))
    return found


def label_components(rows: tuple[Rows, ...], device: "wp.Device") -> Labels:
    """Label the components of all set cells; cells are connected if they share a part of a face.

    Args:
        rows: Rows by size of their cells, smallest first.
        device: Where to compute.
    Raises:
        DeviceMemoryError: There are too many cells.
    """
    from geokit.volume.components import labels_kernels as kernels

    sizes = [len(part.origins) for part in rows]
    begins = np.cumsum([0, *sizes])
    count = int(begins[-1])
    need, have = count * BYTES_PER_ROW, available_memory.available(device)
    if need > have or count > MOST_ROWS:
        raise DeviceMemoryError(
            f"volume: labeling its {count:,} leaves needs {need >> 20} MiB of the {have >> 20} MiB free on "
            f"{device.alias}, and at most {MOST_ROWS:,} leaves can be counted; clip it, or resample it at a larger "
            "voxel_size",
            need=need,
        )
    if not count:
        none = tuple(np.empty((0, 512), np.int32) for _ in rows), tuple(part.words for part in rows)
        return Labels(rows, *none, np.empty(0, np.int64))

    def on_device(array: NDArray[Any], dtype: Any) -> "wp.array":
        return wp.array(array, dtype=dtype, device=device)

    def launch(kernel: Any, items: int, inputs: list[Any], outputs: list[Any]) -> None:
        launcher.launch(kernel, items, inputs, outputs, device, grain=GRAIN)

    words = on_device(np.concatenate([part.words for part in rows]).reshape(-1), wp.uint64)
    links = wp.empty(512 * count, dtype=wp.int32, device=device)
    size = wp.empty(512 * count, dtype=wp.int16, device=device)
    firsts = wp.empty_like(words)
    launch(kernels.rows_kernel, count, [words], [links, firsts, size])
    for kernel, items, face, here, there in _contacts(rows, begins):
        inputs = [words, on_device(here, wp.int32), on_device(there, wp.int32), face]
        launch(kernel, items * len(here), inputs, [links])
    roots = wp.empty(count, dtype=wp.int32, device=device)
    launch(kernels.count_roots_kernel, count, [firsts, links], [roots])
    ends, components = prefix_sum(roots)
    launch(kernels.number_roots_kernel, count, [firsts, ends], [links])
    voxels = wp.zeros(components, dtype=wp.int64, device=device)
    for part, begin in zip(rows, begins[:-1].tolist(), strict=True):
        inputs = [firsts, size, begin, wp.int64(part.span**3)]
        launch(kernels.number_firsts_kernel, len(part.origins), inputs, [links, voxels])
    counts = voxels.numpy()
    order = np.argsort(-counts, kind="stable")
    names = np.empty(components, np.int32)
    names[order] = np.arange(1, components + 1)
    launch(kernels.names_kernel, count, [words, on_device(names, wp.int32)], [links])
    cells = np.split(links.numpy().reshape(-1, 512), begins[1:-1])
    at_first = np.split(firsts.numpy().reshape(-1, 8), begins[1:-1])
    return Labels(rows, tuple(cells), tuple(at_first), counts[order])


def _contacts(rows: tuple[Rows, ...], begins: NDArray[np.int64]) -> list[tuple[Any, int, int, Any, Any]]:
    """Where rows may touch: kernel, its items a row, axis or face, rows, and rows or larger cells beyond."""
    from geokit.volume.components import labels_kernels as kernels

    tables = [RowTable(part.origins) for part in rows]
    found = []
    for number, part in enumerate(rows):
        larger = [other for other in range(number + 1, len(rows)) if len(rows[other].origins)]
        for face, step in enumerate(STEPS):
            if not (face % 2 or larger):
                continue
            place = part.origins + step * (8 * part.span)
            there = tables[number].find(place)
            here = np.flatnonzero(there >= 0)
            if face % 2 and len(here):
                found.append((kernels.faces_kernel, 8, face // 2, begins[number] + here, begins[number] + there[here]))
            for other in larger:
                alone = np.flatnonzero(there < 0)
                span = rows[other].span
                row = tables[other].find(place[alone] & ~(8 * span - 1))
                cell = slot_of(place[alone], 8, span)
                masks = rows[other].words.view(np.uint8)
                is_set = (row >= 0) & (masks[row, cell >> 3] >> (cell & 7) & 1 > 0)
                if is_set.any():
                    cells = 512 * (begins[other] + row[is_set]) + cell[is_set]
                    found.append((kernels.tiles_kernel, 1, face, begins[number] + alone[is_set], cells))
    return found
