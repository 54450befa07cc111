"""One volume for each connected component, and one volume of their labels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory import available_memory
from geokit.volume.components.labels import CELL_SPANS, Labels, Rows
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.grid_head import head_like, result_head, volume_from_buffer
from geokit.volume.tree.typed_tree import Nodes, TypedTree, tree_of_leaves
from geokit.volume.tree.typed_writer import Tiles, build_grid, build_grids

# Leaves and grids that are built together: 16 MiB of floats, and 8 MiB of nodes without their tables.
LEAVES_AT_A_TIME, GRIDS_AT_A_TIME = 8192, 1024
# Bytes of a grid's nodes that are written, if the background is zero: heads, and a page of each table.
SPARSE_NODES = 1 << 15

Contents = Callable[[slice], tuple[NDArray[np.uint8], NDArray[Any]]]


def label_volume(labels: Labels, volume: SparseVolume) -> SparseVolume:
    """An int32 grid whose set cells are active and hold their labels; the background is 0."""
    layout = LAYOUTS["int32"]
    head = result_head(volume, layout, 0, "unknown", volume.info.transform)
    rows, cells = labels.rows[0], labels.cells[0]
    masks = rows.words.view(np.uint8)
    if len(labels.rows) == 1 and not head.has_long_name:
        return volume_from_buffer(build_leaves(head, rows.origins, cells, masks, signed=False), volume)
    tree = tree_of_leaves(layout, head.background, rows.origins, masks, cells)
    for number, part in enumerate(labels.rows[1:], 1):
        origins, values = labels.tiles(number)
        if part.span == CELL_SPANS[3]:
            tree = replace(tree, root=Nodes(origins, values, np.ones(len(origins), np.bool_)))
        elif part.span == CELL_SPANS[2]:
            tree = replace(tree, upper=Nodes.of_tiles(origins, values, True, head.background, 32, part.span))
        else:
            tree = replace(tree, lower=Nodes.of_tiles(origins, values, True, head.background, 16, part.span))
    return volume_from_buffer(build_grid(tree, head), volume)


def split_active(labels: Labels, tree: TypedTree, volume: SparseVolume) -> list[SparseVolume]:
    """The components of a tree's active voxels and tiles, in the order of their labels."""
    component, row = labels.pieces()
    rows: Rows = labels.rows[0]
    leaves = rows.leaves[row]

    def contents(part: slice) -> tuple[NDArray[np.uint8], NDArray[Any]]:
        own = labels.cells[0][row[part]] == component[part, None] + 1
        values = np.array(tree.values[leaves[part]])
        values[~own] = tree.background
        return np.packbits(own, axis=1, bitorder="little"), values

    tiles = [tiles_of(labels, tree, span) for span in CELL_SPANS[1:]]
    count = len(labels.voxel_counts)
    return list(volumes_of(tree, component, tree.origins[leaves], contents, tiles, count, volume))


def tiles_of(labels: Labels, tree: TypedTree, span: int) -> Tiles:
    """The labeled tiles of one size, by component."""
    number = next((n for n, part in enumerate(labels.rows) if n and part.span == span), 0)
    origins, label = labels.tiles(number) if number else (np.empty((0, 3), np.int32), np.empty(0, np.int32))
    values, active = tree.tiles_at(origins)
    order = np.argsort(label, kind="stable")
    return Tiles(label[order].astype(np.int64) - 1, origins[order], values[order], active[order])


def volumes_of(
    tree: TypedTree,
    component: NDArray[np.int64],
    origins: NDArray[np.int32],
    contents: Contents,
    tiles: Sequence[Tiles],
    count: int,
    volume: SparseVolume,
) -> Iterator[SparseVolume]:
    """Build a volume for each component.

    Args:
        tree: The whole, for its type and background.
        component: Component of each leaf, ascending, from 0 to ``count`` - 1.
        origins: First voxels of the leaves.
        contents: Masks (N, 64) and values (N, 512) or (N, 512, C) of a slice of the leaves.
        tiles: Tiles of 8^3, 128^3 and 4096^3 voxels, by component.
        count: Number of components.
        volume: The whole, for its name, class, metadata and transform.
    Raises:
        DeviceMemoryError: The volumes are larger than the free memory.
    """
    layout = tree.layout
    nodes = layout.upper_size + layout.lower_size if tree.background.tobytes().strip(b"\0") else SPARSE_NODES
    remedy = "use connected_components, which labels them in one volume"
    need = count * nodes + len(component) * layout.leaf_size
    available_memory.require_room(need, f"volume: as volumes, its {count:,} components need", remedy)
    head = head_like(volume, layout, tree.background)
    begin = 0
    while begin < count:
        full = np.searchsorted(component, begin) + LEAVES_AT_A_TIME
        end = count if full >= len(component) else max(begin + 1, int(component[full]))
        end = min(end, begin + GRIDS_AT_A_TIME)
        part = slice(*np.searchsorted(component, [begin, end]))
        masks, values = contents(part)
        alone = tree_of_leaves(layout, tree.background, origins[part], masks, values)
        few = [t.rows(slice(*np.searchsorted(t.grid, [begin, end]))) for t in tiles]
        few = [t._replace(grid=t.grid - begin) for t in few]
        for buffer in build_grids(alone, component[part] - begin, few, end - begin, head):
            info = info_of(buffer, name=volume.info.name)
            yield SparseVolume(buffer, replace(info, grid_class=volume.info.grid_class, metadata=volume.info.metadata))
        begin = end
