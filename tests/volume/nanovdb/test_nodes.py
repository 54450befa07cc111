"""Views on the nodes of grids that were laid out by hand, of every type."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog.index_grids import ROOT_TILE, UPPER_TILE, IndexGrid
from benchmarks.catalog.typed_grids import LEAVES, QUANTIZED, VALUED, TypedGrid
from geokit.errors import UnsupportedGridError
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import aligned_buffer, grid_header
from geokit.volume.nanovdb.layout import INDEX_LAYOUTS
from geokit.volume.nanovdb.nodes import bits_of, grid_nodes, root_origins, set_bits, slot_of, slot_places

# The upper nodes of the two leaves of a TypedGrid start at (0, 0, 0) and (-4096, 0, 0).
UPPER = LEAVES & ~4095
LOWER = LEAVES & ~127


@pytest.mark.parametrize("grid_type", VALUED)
def test_every_level_shows_what_was_laid_out(grid_type):
    grid = TypedGrid(grid_type)
    nodes = grid_nodes(grid.volume.nanovdb)
    assert [level.count for level in (nodes.root, nodes.upper, nodes.lower, nodes.leaf)] == [1, 2, 2, 2]
    np.testing.assert_array_equal(nodes.background, grid.background)
    np.testing.assert_array_equal(root_origins(nodes.table["key"]), [[0, 0, 0], [4096, 0, 0], [-4096, 0, 0]])
    np.testing.assert_array_equal(nodes.table["value"][1], grid.root_tile)
    for level, tile in ((nodes.upper, grid.upper_tile), (nodes.lower, grid.lower_tile)):
        expected = np.broadcast_to(grid.background, (2, level.slots, *nodes.background.shape)).copy()
        expected[0, 1] = tile
        has_child = bits_of(level.child_mask)
        assert has_child.sum(axis=1).tolist() == [1, 1]
        np.testing.assert_array_equal(level.values[~has_child], expected[~has_child])
    if grid_type == "mask":
        np.testing.assert_array_equal(bits_of(nodes.leaf.value_mask), grid.leaves)
        return
    if grid_type != "fpn":  # leaves that differ in size have no views
        assert (nodes.leaf.value_mask == 255).all()
    if grid_type == "bool":
        np.testing.assert_array_equal(bits_of(nodes.leaf.bits), grid.leaves)
    elif grid_type not in QUANTIZED:
        np.testing.assert_array_equal(nodes.leaf.values, grid.leaves)


@pytest.mark.parametrize("grid_type", VALUED)
def test_nodes_are_found_from_the_root_and_from_their_boxes(grid_type):
    nodes = grid_nodes(TypedGrid(grid_type).volume.nanovdb)
    upper = nodes.upper_places()
    lower = nodes.upper.children(upper.origins)
    leaf = nodes.lower.children(lower.origins)
    levels = ((nodes.upper, upper, UPPER), (nodes.lower, lower, LOWER), (nodes.leaf, leaf, LEAVES))
    for level, places, origins in levels:
        np.testing.assert_array_equal(places.origins, origins)
        np.testing.assert_array_equal(places.starts, level.starts)
        if (level.name, grid_type) != ("leaf", "fpn"):
            np.testing.assert_array_equal(level.origins, origins)


def test_places_are_in_the_order_of_addresses():
    buffer = TypedGrid("float").volume.nanovdb.copy()
    nodes = grid_nodes(buffer)
    nodes.table["child"][[0, 2]] = nodes.table["child"][[2, 0]]
    upper = nodes.upper_places()
    np.testing.assert_array_equal(upper.starts, nodes.upper.starts)
    np.testing.assert_array_equal(upper.origins, UPPER[::-1])
    np.testing.assert_array_equal(upper.slots, [2, 0])


def test_parts_are_the_nodes_in_their_order():
    nodes = grid_nodes(TypedGrid("vec3d").volume.nanovdb)
    parts = list(nodes.lower.parts(1))
    assert [first for first, _ in parts] == [0, 1]
    np.testing.assert_array_equal(np.concatenate([part.values for _, part in parts]), nodes.lower.values)
    np.testing.assert_array_equal(np.concatenate([part.links()[2] for _, part in parts]), nodes.leaf.starts)


def test_views_share_the_memory_of_the_grid():
    buffer = TypedGrid("float").volume.nanovdb.copy()
    nodes = grid_nodes(buffer)
    for view in (nodes.table, nodes.background, nodes.upper.values, nodes.lower.child_offsets, nodes.leaf.value_mask):
        assert np.shares_memory(view, buffer)
    before = buffer.copy()
    nodes.lower.values[0, 1] = 77.0
    nodes.leaf.limits[1] = -1.0, 1.0
    assert set(np.flatnonzero(buffer != before)) <= {
        *range(nodes.lower.begin + nodes.lower.table + 8, nodes.lower.begin + nodes.lower.table + 12),
        *range(nodes.leaf.begin + 2144 + 80, nodes.leaf.begin + 2144 + 88),
    }
    assert (nodes.lower.values[0, 1], nodes.leaf.limits[1].tolist()) == (77.0, [-1.0, 1.0])


@pytest.mark.parametrize("grid_type", INDEX_LAYOUTS)
def test_index_grids_hold_indices_as_values(grid_type):
    grid = IndexGrid(grid_type)
    nodes = grid_nodes(grid.volume.nanovdb)
    assert (int(nodes.table["value"][1]), int(nodes.upper.values[0, 1])) == (ROOT_TILE, UPPER_TILE)
    np.testing.assert_array_equal(bits_of(nodes.leaf.value_mask), grid.masks)
    np.testing.assert_array_equal(nodes.leaf.column("<u8", nodes.leaf.table, 1)[:, 0], grid.offsets[:2])


def test_an_empty_grid_has_views_without_rows():
    from geokit.volume import from_dense

    nodes = grid_nodes(from_dense(np.zeros((4, 4, 4)), voxel_size=1.0).nanovdb)
    assert len(nodes.table) == 0
    for level in (nodes.upper, nodes.lower):
        assert level.values.shape == (0, level.slots)
        assert level.children(np.empty((0, 3), np.int32)).origins.shape == (0, 3)
    assert nodes.leaf.origins.shape == (0, 3)
    assert list(nodes.upper.parts()) == []


def test_a_type_without_a_layout_is_refused():
    buffer = aligned_buffer(1024, zeroed=True)
    grid_header(buffer)["grid_type"] = 23
    with pytest.raises(UnsupportedGridError, match="pointindex"):
        grid_nodes(buffer)


@pytest.mark.parametrize("density", [0.0, 0.01, 0.5, 1.0])
def test_set_bits_are_the_bits_that_unpackbits_finds(density):
    bits = np.random.default_rng(3).random((7, 4096)) < density
    masks = np.packbits(bits, axis=1, bitorder="little")
    np.testing.assert_array_equal(set_bits(masks), np.nonzero(bits))
    np.testing.assert_array_equal(bits_of(masks), bits)


@pytest.mark.parametrize(("width", "span"), [(8, 1), (16, 8), (32, 128), (1, 4096)])
def test_slots_and_places_are_inverse(width, span):
    slots = np.arange(width**3)
    places = slot_places(slots, width)
    np.testing.assert_array_equal(places, np.stack(np.unravel_index(slots, (width, width, width)), axis=1))
    for origin in ([0, 0, 0], [-width * span, 0, 5 * width * span]):
        np.testing.assert_array_equal(slot_of(places * span + origin + span // 2, width, span), slots)


def test_hand_made_grids_are_valid():
    for grid_type in VALUED:
        check_grid(TypedGrid(grid_type).volume.nanovdb, grid_type)
