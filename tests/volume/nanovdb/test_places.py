"""Nodes that say another place than their slot has are refused: OpenVDB walks by what they say, kernels by slots."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog.mesh_catalog import torus
from benchmarks.catalog.typed_grids import VALUED, TypedGrid
from geokit.errors import FileFormatError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import aligned_buffer
from geokit.volume.nanovdb.nodes import GridNodes, grid_nodes


def copied(volume: SparseVolume) -> tuple[SparseVolume, GridNodes]:
    buffer = aligned_buffer(len(volume.nanovdb))
    buffer[:] = volume.nanovdb
    return SparseVolume(buffer, volume.info), grid_nodes(buffer)


@pytest.fixture
def damaged():
    return copied(gk.volume.from_mesh(torus(), voxel_size=0.05, device="cpu"))


def refused(volume: SparseVolume, what: str) -> None:
    with pytest.raises(FileFormatError, match=what):
        volume.sample([[0.0, 0.0, 0.0]], device="cpu")


@pytest.mark.parametrize("level", ["upper", "lower", "leaf"])
@pytest.mark.parametrize("bit", [8, 1 << 12, 1 << 20, -(1 << 31)])
def test_one_node_elsewhere(damaged, level, bit):
    volume, nodes = damaged
    node = getattr(nodes, level)
    node.column("<i4", 0, 3)[-1, 0] ^= np.int32(max(bit, node.width * node.span) if bit > 0 else bit)
    refused(volume, f"{level} node {node.count - 1} says that it begins at")


def test_all_leaves_in_one_place(damaged):
    volume, nodes = damaged
    nodes.leaf.column("<i4", 0, 3)[:] = 0
    refused(volume, "leaf node")


def test_swapped_children(damaged):
    volume, nodes = damaged
    node, slot, _ = nodes.lower.links()
    offsets = nodes.lower.child_offsets
    one, other = [k for k in range(len(node)) if node[k] == node[0]][:2]
    offsets[node[one], [slot[one], slot[other]]] = offsets[node[one], [slot[other], slot[one]]]
    refused(volume, "leaf node")


def test_a_key_of_no_place(damaged):
    volume, nodes = damaged
    nodes.table["key"][0] |= np.uint64(1 << 63)
    refused(volume, "a tile of the root stands for no place")


@pytest.mark.parametrize("grid_type", VALUED)
def test_a_leaf_of_every_type(grid_type):
    volume, nodes = copied(TypedGrid(grid_type).volume)
    start = int(nodes.leaf.starts[-1])
    volume.nanovdb[start : start + 4].view("<i4")[0] += 8
    with pytest.raises(FileFormatError, match="leaf node 1 says that it begins at"):
        check_grid(volume.nanovdb, "here")


@pytest.mark.parametrize("level", ["upper", "lower"])
def test_a_node_that_says_it_is_empty(damaged, level):
    volume, nodes = damaged
    box = getattr(nodes, level).column("<i4", 0, 6)
    box[0] = [2**31 - 1] * 3 + [-(2**31)] * 3
    refused(volume, f"{level} node 0 has active voxels, and says that it has none")


@pytest.mark.parametrize("grid_type", ["bool", "mask"])
@pytest.mark.parametrize("where", ["background", "root", "upper", "lower"])
def test_a_tile_that_is_neither_true_nor_false(grid_type, where):
    volume, nodes = copied(TypedGrid(grid_type).volume)
    values = {"background": nodes.background[None], "root": nodes.table["value"][1:2]}
    tile = values[where] if where in values else getattr(nodes, where).values[1, 9:10]
    tile.view(np.uint8)[...] = 128
    with pytest.raises(FileFormatError, match="a tile or the background is neither true nor false"):
        check_grid(volume.nanovdb, "here")
