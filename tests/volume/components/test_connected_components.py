"""Labels of connected components: hand-sized grids, tiles of every level, level sets, order and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.catalog.typed_grids import TypedGrid
from geokit.errors import DeviceMemoryError, InputError, UnsupportedGridError
from geokit.volume._components import connected_components, segment
from geokit.volume._dense import from_dense
from geokit.volume._topology import prune
from geokit.volume.components import labels as labels_module
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.tree.typed_tree import tree_of
from geokit.volume.tree.typed_writer import rebuilt
from tests.support.analytic_volumes import ball, dense, level_set


def mask(voxels, size=32, origin=(0, 0, 0)):
    states = np.zeros(3 * (size,), bool)
    states[tuple(np.array(voxels).T)] = True
    transform = np.eye(4)
    transform[:3, 3] = origin
    return from_dense(states, transform=transform, grid_type="mask")


def labels_at(found, voxels):
    return found.labels.sample(np.array(voxels, float), order=0, space="index", device="cpu").tolist()


def test_faces_connect_and_edges_do_not():
    found = connected_components(mask([[1, 1, 1], [1, 1, 2], [1, 2, 3], [9, 9, 9]]), device="cpu")
    assert (found.count, found.voxel_counts.tolist()) == (3, [2, 1, 1])
    # The largest first, then by the order of leaves and voxels.
    assert labels_at(found, [[1, 1, 1], [1, 1, 2], [1, 2, 3], [9, 9, 9], [0, 0, 0]]) == [1, 1, 2, 3, 0]
    assert (found.labels.info.grid_type, found.labels.info.active_voxel_count) == ("int32", 4)
    check_grid(found.labels.nanovdb, "labels")


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_line_through_leaves_is_one(axis):
    line = np.full((30, 3), 5)
    line[:, axis] = np.arange(30)
    found = connected_components(mask(line), device="cpu")
    assert found.voxel_counts.tolist() == [30]


def test_a_long_way_round_is_one():
    # A comb: its teeth meet in the last row only, so roots are replaced late.
    comb = [[x, y, z] for x in range(0, 32, 2) for y in (3,) for z in range(32)]
    comb += [[x, 3, 31] for x in range(32)]
    assert connected_components(mask(comb), device="cpu").count == 1


def test_tiles_of_every_level_connect():
    # Two full leaves with x from -8 to 7, and tiles of 8, 128 and 4096 voxels; all are active here.
    source = TypedGrid("int32").volume
    tree = tree_of(source)
    on = rebuilt(
        replace(
            tree,
            lower=tree.lower._replace(active=tree.lower.values != tree.background),
            upper=tree.upper._replace(active=tree.upper.values != tree.background),
            root=tree.root._replace(active=np.ones(1, np.bool_)),
        ),
        source,
    )
    found = connected_components(on, device="cpu")
    # The tile at (0, 0, 8) touches a leaf; the others stand alone.
    assert found.voxel_counts.tolist() == [4096**3, 128**3, 1024 + 512]
    assert labels_at(found, [[5000, 9, 9], [9, 9, 130], [3, 3, 12], [-3, 3, 3], [0, 0, 17]]) == [1, 2, 3, 3, 0]
    assert found.labels.info.active_voxel_count == on.info.active_voxel_count
    check_grid(found.labels.nanovdb, "labels")
    assert [component.info.active_voxel_count for component in segment(on, device="cpu")] == found.voxel_counts.tolist()


def test_a_leaf_beside_a_larger_tile():
    states = np.zeros((136, 128, 128), bool)
    states[:128] = True
    states[128, 64, 70] = states[130, 64, 70] = True
    whole = prune(from_dense(states, voxel_size=1.0, grid_type="mask"))
    found = connected_components(whole, device="cpu")
    assert found.voxel_counts.tolist() == [128**3 + 1, 1]
    for component, count in zip(segment(whole, device="cpu"), found.voxel_counts, strict=True):
        assert component.info.active_voxel_count == count
        check_grid(component.nanovdb, "component")


@pytest.mark.slow
def test_level_sets_are_labeled_inside():
    distance = lambda p: np.minimum(ball(19.3, (-2.0, 0.0, 0.0))(p), ball(4.3, (25.0, 0.0, 0.0))(p))  # noqa: E731
    volume = level_set(distance, leaves=4)
    found = connected_components(volume, device="cpu")
    inside = dense(volume, -32, 32) < 0.0
    labels = dense(found.labels, -32, 32)
    np.testing.assert_array_equal(labels > 0, inside)
    steps = np.arange(-32, 32)
    np.testing.assert_array_equal(labels[inside], np.where(steps < 19, 1, 2)[np.nonzero(inside)[0]])
    # Tiles in the middle of the larger ball count too.
    assert found.voxel_counts.tolist() == [(labels == 1).sum(), (labels == 2).sum()]
    assert found.labels.info.active_voxel_count == inside.sum()


def test_nothing():
    volume = from_dense(np.zeros((1, 1, 1)), voxel_size=1.0)
    empty = rebuilt(replace(tree_of(volume), masks=np.zeros_like(tree_of(volume).masks)), volume)
    found = connected_components(empty, device="cpu")
    assert (found.count, found.labels.info.active_voxel_count, found.voxel_counts.tolist()) == (0, 0, [])


def test_refusals(monkeypatch):
    with pytest.raises(InputError, match="not a SparseVolume"):
        connected_components("a.vdb")
    volume = mask([[1, 1, 1], [5, 5, 5]])
    with pytest.raises(UnsupportedGridError, match="type onindex"):
        connected_components(SparseVolume(volume.nanovdb, replace(volume.info, grid_type="onindex")))
    monkeypatch.setattr(labels_module.available_memory, "available", lambda device: 100)
    with pytest.raises(DeviceMemoryError, match="labeling its 1 leaves"):
        connected_components(volume, device="cpu")
    monkeypatch.undo()
    monkeypatch.setattr(labels_module.available_memory, "available_host", lambda: 50_000)
    with pytest.raises(DeviceMemoryError, match=r"its 2 components .* connected_components"):
        segment(volume, device="cpu")
