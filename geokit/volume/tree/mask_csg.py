"""Union, intersection and difference of mask grids, as sets of voxels that are on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.nodes import bits_of
from geokit.volume.tree.leaves import require_volume
from geokit.volume.tree.typed_tree import rows_in, tree_of, tree_of_leaves, voxelized_tree
from geokit.volume.tree.typed_writer import rebuilt

__all__ = ["combined_masks"]


def combined_masks(kind: str, operands: Sequence[SparseVolume], names: Sequence[str]) -> SparseVolume:
    """The voxels on in at least one mask ("union"), in all of them ("intersection"), or only in the first.

    Raises:
        InputError: The masks lie on different lattices.
        UnsupportedGridError: A grid is not a mask.
        DeviceMemoryError: Their tiles hold more voxels than fit into memory.
    """
    wanted = operands[0].info.transform
    tolerance = 8 * math.ulp(float(np.abs(wanted).max()))
    for volume, name in zip(operands, names, strict=True):
        require_volume(volume, name, ("mask",))
        if not np.allclose(volume.info.transform, wanted, rtol=0.0, atol=tolerance):
            raise InputError(
                f"{name}: the voxels of mask {volume.info.name!r} are not those of {operands[0].info.name!r}; resample "
                "it with order=0 and the transform of the first"
            )
    trees = [voxelized_tree(tree_of(volume), volume.info.name) for volume in operands]
    origins = np.unique(np.concatenate([tree.origins for tree in trees]), axis=0)
    masks: NDArray[np.uint8] = np.zeros((len(origins), 64), np.uint8)
    for number, tree in enumerate(trees):
        own = np.zeros_like(masks)
        own[rows_in(origins, tree.origins)] = tree.masks
        if number == 0 or kind == "union":
            masks |= own
        elif kind == "intersection":
            masks &= own
        else:
            masks &= ~own
    some = masks.any(axis=1)
    masks = masks[some]
    alone = tree_of_leaves(trees[0].layout, trees[0].background, origins[some], masks, bits_of(masks))
    return rebuilt(alone, operands[0])
