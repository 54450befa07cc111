"""Connected components of grids of any value type, computed on a mask of their active voxels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.tree.typed_tree import (
    Nodes,
    RootTiles,
    TypedTree,
    bits_of,
    rows_in,
    tree_of,
    tree_of_leaves,
    voxelized_tree,
)
from geokit.volume.tree.typed_writer import rebuilt

__all__ = ["mask_of", "segmented"]


def segmented(volume: SparseVolume, parts_of: Callable[[SparseVolume], list[SparseVolume]]) -> list[SparseVolume]:
    """Split a volume of one of VALUE_TYPES into parts, in the order in which ``parts_of`` returns those of its mask."""
    tree = voxelized_tree(tree_of(volume), volume.info.name)
    found = []
    for part in parts_of(mask_of(volume)):
        own = voxelized_tree(tree_of(part), volume.info.name)
        values = np.array(tree.values[rows_in(tree.origins, own.origins)])
        values[~bits_of(own.masks)] = tree.background
        alone = tree_of_leaves(tree.layout, tree.background, own.origins, own.masks, values)
        found.append(rebuilt(alone, volume))
    return found


def mask_of(volume: SparseVolume) -> SparseVolume:
    """A mask grid of a volume's active voxels, on the same lattice; tiles stay tiles."""
    tree = tree_of(volume)

    def states(nodes: Nodes) -> Nodes:
        some = nodes.active.any(axis=1)
        return Nodes(nodes.origins[some], nodes.active[some], nodes.active[some])

    root = tree.root.rows(tree.root.active)
    some = tree.masks.any(axis=1)
    masks = tree.masks[some]
    mask = TypedTree(
        LAYOUTS["mask"],
        np.zeros((), np.bool_),
        tree.origins[some],
        masks,
        bits_of(masks),
        states(tree.lower),
        states(tree.upper),
        RootTiles(root.origins, root.active, root.active),
    )
    return rebuilt(mask, volume)
