"""Many grids written at once have the bytes that each gets alone, for every value type; nodes that hold no tile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import tree_header
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.tree.grid_head import head_like
from geokit.volume.tree.typed_tree import VALUE_TYPES, Nodes, tree_of, tree_of_leaves
from geokit.volume.tree.typed_writer import Tiles, build_grid, build_grids, rebuilt
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
    grid_of = np.repeat(np.arange(3), [len(t.origins) for t in trees])
    shuffled = np.random.default_rng(0).permutation(len(grid_of))
    leaves = (np.concatenate([getattr(t, name) for t in trees])[shuffled] for name in ("origins", "masks", "values"))
    whole = tree_of_leaves(trees[0].layout, background, *leaves)
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


@pytest.mark.parametrize("active", [False, True])
def test_a_leaf_in_a_tile_of_the_root_keeps_the_tile_around_it(active):
    like = random_grid("float", 1).volume
    leaf = np.array([[-8, 16, 200]], np.int32)
    tree = tree_of_leaves(
        LAYOUTS["float"], np.float32(1), leaf, np.full((1, 64), 255, np.uint8), np.full((1, 512), 5.0, np.float32)
    )
    corner = np.array([[-4096, 0, 0]], np.int32)
    tree = replace(tree, root=Nodes(corner, np.array([-3.0], np.float32), np.array([active])))
    volume = rebuilt(tree, like)
    check_grid(volume.nanovdb, "grid")
    assert volume.info.active_voxel_count == (4096**3 if active else 512)
    made = tree_of(volume)
    np.testing.assert_array_equal(made.origins, leaf)
    assert not len(made.root.origins)
    # Beside the leaf, in another lower node, at the far corner; then outside of the tile.
    places = np.array([[-16, 16, 200], [-8, 16, 256], [-4096, 4088, 4088], [0, 16, 200]], np.int32)
    values, states = made.tiles_at(places)
    np.testing.assert_array_equal(values, [-3.0, -3.0, -3.0, 1.0])
    np.testing.assert_array_equal(states, [active, active, active, False])


def test_a_node_of_background_alone_is_kept():
    like = random_grid("float", 1).volume
    none = np.empty((0, 3), np.int32), np.empty((0, 64), np.uint8), np.empty((0, 512), np.float32)
    tree = tree_of_leaves(LAYOUTS["float"], np.float32(1), *none)
    origins, values = np.array([[128, -128, 0]], np.int32), np.full((1, 4096), 1.0, np.float32)
    volume = rebuilt(replace(tree, lower=Nodes(origins, values, np.zeros((1, 4096), bool))), like)
    check_grid(volume.nanovdb, "grid")
    assert tree_header(volume.nanovdb)["node_count"].tolist() == [0, 1, 1]
    assert volume.info.active_voxel_count == 0
