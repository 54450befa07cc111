"""What works where geokit was built without OpenVDB: everything that only lays out grids."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

import geokit as gk
from geokit import native
from geokit.errors import MissingDependencyError
from geokit.native import _openvdb
from geokit.volume._resample import resampled
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.nodes import grid_nodes
from geokit.volume.tree.grid_head import checked_head
from geokit.volume.tree.leaves import build_real_grid
from geokit.volume.tree.typed_tree import tree_of
from tests.support.analytic_volumes import SHEARED, active_voxels, ball, cubes, field, level_set
from tests.support.effort import of_all

RADIUS = of_all(18.0, 21.0)
LEAVES = of_all(3, 4)
SLOPE = np.array([0.5, -1.25, 2.0])
DTYPES = {"float": np.float32, "double": np.float64}


@pytest.fixture(autouse=True)
def without_openvdb(monkeypatch):
    monkeypatch.setattr(_openvdb, "_load", lambda: (None, "not built"))
    with pytest.raises(MissingDependencyError):
        native.require()


def body(grid_type: str, half_width: float = 3.0):
    dtype = DTYPES.get(grid_type, np.float32)
    made = level_set(ball(RADIUS), leaves=LEAVES, half_width=half_width, dtype=dtype)
    return made if grid_type in DTYPES else made.quantize(grid_type)


def sound(volume):
    check_grid(volume.nanovdb, "result")
    assert checksum_matches(volume.nanovdb)
    return volume


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", ["float", "double", "fp16"])
@pytest.mark.parametrize("distance", of_all([-3.5, 6.0], [2.5, -3.5, 6.0]))
def test_offsets_of_a_ball(grid_type, distance):
    result = sound(gk.volume.offset(body(grid_type), distance, device="cpu"))
    assert result.info.grid_type == ("double" if grid_type == "double" else "float")
    assert result.info.grid_class == "level set"
    points, values = active_voxels(result)
    assert len(points) > of_all(5_000, 10_000)
    expected = np.linalg.norm(points, axis=1) - (RADIUS + distance)
    np.testing.assert_allclose(values, expected, rtol=0, atol=0.05)
    # The inside is full of tiles, and outside there is nothing.
    inner = np.array([[0.0, 0.0, 0.0], [5.0, -3.0, 2.0], [9.0, 0.0, 0.0]])
    found = result.sample(np.concatenate([inner, 100.0 + inner]), order=0, device="cpu")
    np.testing.assert_array_equal(found, [-3.0] * 3 + [3.0] * 3)


@pytest.mark.slow
def test_empty_lower_nodes_inside_a_double_level_set():
    # The middle of this ball is a whole lower node of 128 voxels without a leaf: a tile of an upper node.
    made = gk.volume.from_function(ball(120.0, (64.0, 64.0, 64.0)), [[-58.0] * 3, [186.0] * 3], 1.0)
    dense = made.to_dense(bounds=[[-61, 60, 60], [189, 67, 67]])
    assert dense.values[125, 4, 4] < 0.0
    lower = grid_nodes(made.nanovdb).lower
    assert [0, 0, 0] not in np.atleast_2d(lower.column("<i4", 0, 3)).tolist()
    tree = gk.volume.resample(made, transform=cubes(1.0), order=0, device="cpu")
    result = sound(resampled(made, cubes(1.0), order=1, dtype=np.float64, device="cpu"))
    assert result.info.grid_type == "double"
    voxels = np.random.default_rng(5).integers(-70, 200, (5000, 3)).astype(float)
    expected = made.sample(voxels, order=0, space="index", device="cpu")
    for volume in (tree, result):
        np.testing.assert_array_equal(volume.sample(voxels, order=0, space="index", device="cpu"), expected)


@pytest.mark.parametrize("start", [0, -8192])
def test_a_whole_upper_node_inside_a_double_level_set(start):
    origins = np.array([[8, 8, start], [4000, 8, start + 8192], [8, 8, start + 16384]], np.int32)
    values = np.repeat(np.array([-3.0, -3.0, 3.0])[:, None], 512, axis=1)
    head = checked_head("double", np.array(3.0), np.array(-3.0), np.eye(4), "slab", "level set")
    buffer = build_real_grid(head, origins, np.full((3, 64), 255, np.uint8), values)
    volume = sound(SparseVolume(buffer, info_of(buffer)))
    middle = np.array([[100, 2, start + 5000], [3000, 4000, start + 4096], [7, 7, start + 8191]], float)
    beyond = np.array([[100, 2, start + 12288], [100, 2, start - 1], [-1, 0, start + 5000]], float)
    found = volume.sample(np.concatenate([middle, beyond]), order=0, device="cpu")
    np.testing.assert_array_equal(found, [-3.0] * 3 + [3.0] * 3)
    root = tree_of(volume).root
    assert root.origins.tolist() == [[0, 0, start + 4096]]
    assert root.values.tolist() == [-3.0]


@pytest.mark.parametrize("grid_type", ["float", "double"])
def test_renormalized_values_are_distances_again(grid_type):
    doubled = level_set(ball(RADIUS), values=lambda p: 1.5 * ball(RADIUS)(p), leaves=LEAVES, dtype=DTYPES[grid_type])
    points, values = active_voxels(sound(gk.volume.renormalize(doubled, half_width=4.0, device="cpu")))
    np.testing.assert_allclose(values, np.linalg.norm(points, axis=1) - RADIUS, rtol=0, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", ["float", "double"])
@pytest.mark.parametrize("transform", [cubes(0.1), SHEARED], ids=["cubes", "sheared"])
def test_derivatives_of_linear_and_quadratic_fields(grid_type, transform):
    linear = field(lambda p: p @ SLOPE, transform=transform, dtype=DTYPES[grid_type])
    gradient = sound(gk.volume.gradient_field(linear, device="cpu"))
    assert gradient.info.grid_type == {"float": "vec3f", "double": "vec3d"}[grid_type]
    assert gradient.info.active_voxel_count == linear.info.active_voxel_count
    middle = np.random.default_rng(6).integers(-12, 12, (500, 3)) @ transform[:3, :3].T + transform[:3, 3]
    tolerance = 2e-4 if grid_type == "float" else 1e-11
    found = gradient.sample(middle, order=0, device="cpu")
    np.testing.assert_allclose(found, np.broadcast_to(SLOPE, found.shape), rtol=0, atol=tolerance)
    turning = field(lambda p: np.cross(SLOPE, p) + p, transform=transform, dtype=DTYPES[grid_type])
    spin = sound(gk.volume.curl(turning, device="cpu")).sample(middle, order=0, device="cpu")
    np.testing.assert_allclose(spin, np.broadcast_to(2.0 * SLOPE, spin.shape), rtol=0, atol=10 * tolerance)
    growth = sound(gk.volume.divergence(turning, device="cpu")).sample(middle, order=0, device="cpu")
    np.testing.assert_allclose(growth, 3.0, rtol=0, atol=10 * tolerance)
    square = field(lambda p: (p**2).sum(axis=1), transform=transform, dtype=DTYPES[grid_type])
    bend = sound(gk.volume.laplacian(square, device="cpu")).sample(middle, order=0, device="cpu")
    np.testing.assert_allclose(bend, 6.0, rtol=0, atol=100 * tolerance)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "grid_type"),
    of_all([(0, "fp16"), (1, "float"), (2, "double"), (3, "fp16")], [*product(range(4), ("float", "double", "fp16"))]),
)
def test_resampled_fields_and_level_sets(grid_type, order):
    fog = field(lambda p: p @ SLOPE, dtype=DTYPES.get(grid_type, np.float32), background=-7.0)
    fog = fog if grid_type in DTYPES else fog.quantize(grid_type)
    result = sound(gk.volume.resample(fog, voxel_size=0.75, order=order, device="cpu"))
    assert result.info.background == -7.0
    points = np.random.default_rng(7).integers(-12, 12, (500, 3)) * 0.75
    if order:
        found = result.sample(points, order=0, device="cpu")
        np.testing.assert_allclose(found, points @ SLOPE, rtol=0, atol=2e-3 if grid_type == "fp16" else 1e-5)
    shell = sound(gk.volume.resample(body(grid_type), voxel_size=0.75, order=order, device="cpu"))
    if order:
        points, values = active_voxels(shell)
        np.testing.assert_allclose(values, np.linalg.norm(points, axis=1) - RADIUS, rtol=0, atol=0.02)
    assert shell.sample([[0.0, 0.0, 0.0]], order=0, device="cpu")[0] == -2.25


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", ["float", "double", "fp16"])
def test_pruned_and_clipped(grid_type):
    volume = body(grid_type)
    rng = np.random.default_rng(8)
    voxels = rng.integers(-36, 36, (20_000, 3)).astype(float)
    values, active = (volume.sample(voxels, order=0, device="cpu"), volume.active_at(voxels, device="cpu"))
    pruned = sound(gk.volume.prune(volume))
    np.testing.assert_array_equal(pruned.sample(voxels, order=0, device="cpu"), values)
    np.testing.assert_array_equal(pruned.active_at(voxels, device="cpu"), active)
    box = np.array([[-9.0, -30.0, -4.5], [25.0, 11.0, 30.0]])
    clipped = sound(gk.volume.clip(volume, box))
    inside = ((voxels >= box[0]) & (voxels <= box[1])).all(axis=1)
    np.testing.assert_array_equal(clipped.sample(voxels, order=0, device="cpu"), np.where(inside, values, 3.0))
    np.testing.assert_array_equal(clipped.active_at(voxels, device="cpu"), active & inside)


def test_what_a_pruned_tile_holds_is_the_median():
    values = np.tile(np.arange(512.0).reshape(8, 8, 8), (2, 1, 1))
    volume = gk.volume.from_dense(values, voxel_size=1.0, background=-1.0)
    pruned = sound(gk.volume.prune(volume, 511.0))
    assert pruned.sample([[0.0, 0.0, 0.0], [15.0, 7.0, 7.0]], order=0, device="cpu").tolist() == [255.0, 255.0]
    assert gk.volume.prune(volume, 510.0).sample([[0.0, 0.0, 0.0]], order=0, device="cpu").tolist() == [0.0]
    flags = gk.volume.from_dense(values % 2 == 1, voxel_size=1.0, background=True, grid_type="bool")
    assert gk.volume.prune(flags, 5.0).sample([[0.0] * 3, [0.0, 0.0, 1.0]], order=0, device="cpu").tolist() == [0, 1]


def test_components_of_a_mask_and_of_a_level_set():
    states = np.zeros((20, 9, 9), bool)
    states[:4] = states[10:13, 2:] = True
    mask = gk.volume.from_dense(states, voxel_size=1.0, grid_type="mask")
    found = gk.volume.connected_components(mask, device="cpu")
    assert (found.count, found.voxel_counts.tolist()) == (2, [4 * 81, 3 * 63])
    labels = sound(found.labels).sample([[0.0] * 3, [11.0, 4.0, 8.0], [6.0] * 3], order=0, device="cpu")
    assert labels.tolist() == [1, 2, 0]
    for component, count in zip(gk.volume.segment(mask, device="cpu"), found.voxel_counts, strict=True):
        assert sound(component).info.active_voxel_count == count
    pair = level_set(lambda p: np.minimum(ball(6.0, (-8.0, 0.0, 0.0))(p), ball(6.0, (8.0, 0.0, 0.0))(p)))
    assert len([sound(component) for component in gk.volume.segment(pair, device="cpu")]) == 2


def test_quantized_fog_grows_and_is_measured():
    fog = field(lambda p: 1.0 + p[:, 0] ** 2, grid_class="fog volume").quantize("fp16")
    grown = sound(gk.volume.dilate(fog, voxels=1, device="cpu"))
    assert grown.info.active_voxel_count == 32**3 + 6 * 32**2
    found = gk.volume.statistics(fog)
    assert found.count == 32**3
    assert found.minimum == pytest.approx(1.0, abs=1e-2)


def test_what_needs_openvdb_says_so():
    volume = body("float")
    for call in (gk.volume.smooth, lambda v: gk.volume.union(v, v), gk.volume.statistics):
        with pytest.raises(MissingDependencyError, match="libopenvdb-dev"):
            call(volume)
