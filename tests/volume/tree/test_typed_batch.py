"""Many grids written at once have the bytes that each gets alone, for every value type."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.tree.grid_head import head_like
from geokit.volume.tree.typed_batch import Tiles, build_grids
from geokit.volume.tree.typed_tree import VALUE_TYPES, tree_of
from geokit.volume.tree.typed_writer import build_grid
from tests.support.random_grids import random_grid


def tiles_of(nodes, width, span, number):
    node, slot = np.nonzero(nodes.active)
    steps = np.stack(np.unravel_index(slot, 3 * (width,)), axis=1).astype(np.int32) * span
    count = len(node)
    return Tiles(np.full(count, number), nodes.origins[node] + steps, nodes.values[node, slot], np.ones(count, bool))


def with_background(tree, background):
    """The tree with inactive tiles and all other places of another background, without nodes of nothing else."""
    lower = tree.lower.rows(np.flatnonzero(tree.lower.active.any(axis=1)))
    kept = lower.active.reshape(lower.active.shape + (1,) * (lower.values.ndim - 2))
    return replace(tree, background=background, lower=lower._replace(values=np.where(kept, lower.values, background)))


@pytest.mark.parametrize("grid_type", VALUE_TYPES)
def test_the_bytes_are_those_of_single_grids(grid_type):
    volume = random_grid(grid_type, 1).volume
    background = tree_of(volume).background
    trees = [with_background(tree_of(random_grid(grid_type, seed).volume), background) for seed in (1, 2, 3)]
    # A tile of the root, and a tile of an upper node without a neighbor.
    value = trees[1].values[0, 0]
    root = Tiles(np.array([1]), np.array([[4096, 0, -4096]], np.int32), value[None], np.array([True]))
    large = Tiles(np.array([2]), np.array([[-256, 128, 1024]], np.int32), value[None], np.array([False]))
    small = Tiles(*map(np.concatenate, zip(*(tiles_of(t.lower, 16, 8, i) for i, t in enumerate(trees)), strict=True)))
    names = ("origins", "masks", "values")
    whole = replace(trees[0], **{name: np.concatenate([getattr(t, name) for t in trees]) for name in names})
    grid_of = np.repeat(np.arange(3), [len(t.origins) for t in trees])
    shuffled = np.random.default_rng(0).permutation(len(grid_of))
    whole = replace(whole, **{name: getattr(whole, name)[shuffled] for name in names})
    head = head_like(volume, trees[0].layout, background)
    found = list(build_grids(whole, grid_of[shuffled], (small, large, root), 3, head))

    trees[1] = replace(
        trees[1], root=trees[1].root._replace(origins=root.origins, values=root.values, active=root.active)
    )
    upper = trees[2].upper
    slots = np.empty((1, 32768, *background.shape), background.dtype)
    slots[:] = background
    slots[0, 30 * 1024 + 1 * 32 + 8] = value
    origins = np.array([[-4096, 0, 0]], np.int32)
    upper = upper._replace(origins=origins, values=slots, active=np.zeros((1, 32768), bool))
    trees[2] = replace(trees[2], upper=upper)
    for buffer, tree in zip(found, trees, strict=True):
        np.testing.assert_array_equal(buffer, build_grid(tree, head))
        check_grid(buffer, "grid")
