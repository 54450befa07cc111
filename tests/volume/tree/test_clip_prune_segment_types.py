"""Clipping, pruning, components and statistics of grids of every value type, against dense arrays."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from benchmarks.catalog.typed_grids import TypedGrid
from geokit import native
from geokit.errors import DeviceMemoryError, InputError, UnsupportedGridError
from geokit.volume._components import segment
from geokit.volume._csg import union
from geokit.volume._differential import divergence, gradient_field, laplacian
from geokit.volume._filters import smooth
from geokit.volume._io import save
from geokit.volume._morphology import dilate, renormalize
from geokit.volume._resample import resample
from geokit.volume._statistics import statistics
from geokit.volume._topology import clip, prune
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import tree_header
from geokit.volume.tree.typed_tree import VALUE_TYPES
from tests.support.effort import of_all, spread
from tests.support.nanovdb_validate import assert_validated, needs_validate
from tests.support.random_grids import HIGH, LOW, TRANSFORM, dense_of, random_grid

needs_openvdb = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
# In the world of a sheared transform: its faces run through leaves, and through tiles of 8^3 voxels.
BOX = np.array([[-3.1, -6.2, -1.9], [12.3, 5.7, 6.6]])


def world_inside(box):
    steps = np.arange(LOW, HIGH, dtype=float)
    voxels = np.stack(np.meshgrid(*3 * [steps], indexing="ij"), axis=-1)
    world = voxels @ TRANSFORM[:3, :3].T + TRANSFORM[:3, 3]
    return ((world >= box[0]) & (world <= box[1])).all(axis=-1)


REAL = ("float", "double", "fp8", "fpn")
VECTORS = ("vec3f", "vec3d")
SEVERAL = (*VECTORS, "vec4f", "vec4d", "vec3u8", "vec3u16", "rgba8")
EVERY = (*VALUE_TYPES, "fp8", "fpn")
POINTS = np.array([[0.3, 0.2, 0.1], [2.0, 1.0, 0.5]])
# What takes which types: the table of docs/design/operations.md.
TAKEN = {
    "sample": (lambda v: v.sample(POINTS, order=2, device="cpu"), EVERY),
    "gradient": (lambda v: v.gradient(POINTS, device="cpu"), EVERY),
    "active_at": (lambda v: v.active_at(POINTS, device="cpu"), EVERY),
    "to_dense": (lambda v: v.to_dense(device="cpu"), EVERY),
    "dilate": (lambda v: dilate(v, voxels=1, device="cpu"), EVERY),
    "prune": (prune, EVERY),
    "clip": (lambda v: clip(v, BOX), EVERY),
    "segment": (segment, EVERY),
    "statistics": (statistics, [name for name in EVERY if name != "rgba8"]),
    "hessian": (lambda v: v.hessian(POINTS, device="cpu"), [name for name in EVERY if name not in SEVERAL]),
    "raycast": (lambda v: v.raycast(POINTS, POINTS, device="cpu"), [name for name in EVERY if name not in SEVERAL]),
    "union": (lambda v: union(v, v), ("mask",)),
    "resample": (lambda v: resample(v, voxel_size=0.5, device="cpu"), (*REAL, *VECTORS)),
    "resample, nearest": (lambda v: resample(v, voxel_size=0.5, order=0, device="cpu"), EVERY),
    "smooth": (smooth, REAL),
    "renormalize": (renormalize, ()),
    "laplacian": (lambda v: laplacian(v, device="cpu"), REAL),
    "gradient_field": (lambda v: gradient_field(v, device="cpu"), REAL),
    "divergence": (lambda v: divergence(v, device="cpu"), ()),
    "quantize": (lambda v: v.quantize("fp16"), REAL),
}


@functools.cache
def of_type(grid_type):
    """A grid of this type without speckles; no operation changes it."""
    if grid_type in ("fp8", "fpn"):
        return of_type("float").quantize(grid_type, tolerance=1.0 if grid_type == "fpn" else None)
    return random_grid(grid_type, 1, speckles=False).volume


@pytest.mark.slow
@needs_openvdb
@pytest.mark.parametrize("name", TAKEN)
def test_what_takes_which_types(name):
    """Every type is taken, or refused by an error that names it; class and transform are another matter."""
    operation, taken = TAKEN[name]
    for grid_type in EVERY:
        grid = of_type(grid_type)
        if grid_type in taken:
            operation(grid)
            continue
        with pytest.raises((UnsupportedGridError, InputError)) as caught:
            operation(grid)
        if caught.type is InputError:
            # Taken as a type: these grids are no level sets, and their voxels are sheared.
            assert grid_type in {"union": REAL, "renormalize": REAL, "divergence": VECTORS}[name]
        else:
            assert f"type {grid_type}" in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("seed", of_all([1], [0, 1]))
@pytest.mark.parametrize("grid_type", VALUE_TYPES)
def test_clipped(grid_type, seed):
    grid = random_grid(grid_type, seed)
    before = grid.volume.nanovdb.copy()
    result = clip(grid.volume, BOX)
    inside = world_inside(BOX)
    expected = np.where(
        inside.reshape(inside.shape + (1,) * (grid.values.ndim - 3)),
        grid.values,
        np.asarray(grid.volume.info.background, grid.values.dtype),
    )
    values, active = dense_of(result)
    np.testing.assert_array_equal(active, grid.active & inside)
    np.testing.assert_array_equal(values, expected)
    assert 0 < result.info.active_voxel_count == active.sum() < grid.active.sum()
    info, was = result.info, grid.volume.info
    assert (info.grid_type, info.grid_class, info.name) == (was.grid_type, was.grid_class, was.name)
    assert (info.background, info.metadata) == (was.background, was.metadata)
    np.testing.assert_array_equal(info.transform, was.transform)
    np.testing.assert_array_equal(grid.volume.nanovdb, before)
    check_grid(result.nanovdb, "result")


@pytest.mark.parametrize("grid_type", ["uint32", "int16", "vec4f"])
def test_clipping_cuts_tiles_of_all_levels(grid_type):
    typed = TypedGrid(grid_type)
    # Through the inactive tile of the root (from x = 4096), and that of an upper node (z from 128 to 255).
    box = np.array([[-2.0, 0.0, 0.0], [4100.0, 9.0, 140.0]])
    result = clip(typed.volume, box)
    points = np.array(
        [[4096, 0, 0], [4100, 9, 140], [4101, 0, 0], [4100, 10, 140], [5, 5, 128], [5, 9, 140], [5, 9, 141],
         [5, 10, 140], [0, 0, 8], [7, 7, 15], [7, 8, 8], [-2, 3, 3], [-3, 3, 3], [7, 7, 7]],
    )  # fmt: skip
    inside = ((points >= box[0]) & (points <= box[1])).all(axis=1)
    expected = typed.at(points)
    expected[~inside] = typed.background
    found = np.asarray(result.sample(points.astype(float), order=0, space="index", device="cpu"))
    np.testing.assert_array_equal(found, expected)
    assert result.info.active_voxel_count == 10 * 64


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", spread(VALUE_TYPES, 9))
def test_pruned(grid_type):
    grid = random_grid(grid_type, 2)
    result = prune(grid.volume)
    values, active = dense_of(result)
    np.testing.assert_array_equal(active, grid.active)
    np.testing.assert_array_equal(values, grid.values)
    assert result.info.active_voxel_count == grid.active.sum()
    assert (result.info.grid_type, result.info.metadata) == (grid_type, grid.volume.info.metadata)
    check_grid(result.nanovdb, "result")


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", ["mask", "uint32", "half", "vec4d"])
def test_pruning_makes_tiles(grid_type):
    # Growing makes voxels of tiles; what is alike becomes tiles again, of a mask also what has grown.
    grid = random_grid(grid_type, 3)
    grown = dilate(grid.volume, voxels=1, device="cpu")
    result = prune(grown)
    leaves, tiles = (int(tree_header(v.nanovdb)["node_count"][0]) for v in (grown, result))
    assert tiles < leaves
    assert int(tree_header(result.nanovdb)["tile_count"][0]) > 0
    for one, other in zip(dense_of(grown), dense_of(result), strict=True):
        np.testing.assert_array_equal(one, other)
    assert result.info.active_voxel_count == grown.info.active_voxel_count
    check_grid(result.nanovdb, "result")


@pytest.mark.parametrize("grid_type", ["mask", "uint32"])
def test_pruning_of_a_node_full_of_tiles(grid_type):
    from geokit.volume.tree.typed_tree import tree_of
    from geokit.volume.tree.typed_writer import rebuilt

    source = TypedGrid(grid_type).volume
    steps = np.stack(np.unravel_index(np.arange(4096), (16, 16, 16)), axis=1).astype(np.int32) * 8
    ones = np.ones((4096, 512), bool if grid_type == "mask" else np.uint32)
    tree = replace(tree_of(source), origins=steps + 256, masks=np.full((4096, 64), 255, np.uint8), values=ones)
    result = prune(rebuilt(tree, source))
    header = tree_header(result.nanovdb)
    assert header["node_count"][0] == 0
    assert header["tile_count"].tolist() == [0, 1, 0]
    assert result.info.active_voxel_count == 128**3
    box = result.info.index_bounds
    assert box.tolist() == [[256] * 3, [383] * 3]


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", ["uint8", "half", "vec4f"])
def test_pruning_to_a_tolerance(grid_type):
    grid = random_grid(grid_type, 4)
    result = prune(grid.volume, tolerance=60.0)
    values, active = dense_of(result)
    np.testing.assert_array_equal(active, grid.active)
    error = np.abs(values.astype(float) - grid.values.astype(float)).max()
    assert error <= 60.0
    everything = prune(grid.volume, tolerance=300.0)
    full = ndimage.minimum_filter(grid.active, 8, origin=-4)[::8, ::8, ::8].sum()
    assert tree_header(everything.nanovdb)["tile_count"][0] == full


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", spread(VALUE_TYPES, 9))
def test_components_are_those_that_scipy_labels(grid_type):
    grid = random_grid(grid_type, 5, speckles=False)
    labels, count = ndimage.label(grid.active)
    components = segment(grid.volume)
    assert len(components) == count
    sizes = [component.info.active_voxel_count for component in components]
    assert sizes == sorted(np.bincount(labels.ravel())[1:], reverse=True)
    for component in (components[0], components[1], components[-1]):
        values, active = dense_of(component)
        number = labels[active][0]
        np.testing.assert_array_equal(active, labels == number)
        np.testing.assert_array_equal(values[active], grid.values[active])
        background = np.asarray(grid.volume.info.background, values.dtype)
        assert (values[~active] == background).all()
        info, was = component.info, grid.volume.info
        assert (info.grid_type, info.name, info.metadata) == (was.grid_type, was.name, was.metadata)
        check_grid(component.nanovdb, "component")


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", [name for name in VALUE_TYPES if name != "rgba8"])
def test_statistics_of_leaves_and_tiles(grid_type):
    grid = random_grid(grid_type, 6)
    values = grid.values[grid.active].astype(float)
    if values.ndim == 2:
        values = np.linalg.norm(values, axis=1)
    found = statistics(grid.volume)
    assert found.count == grid.active.sum()
    expected = [values.min(), values.max(), values.mean(), values.std()]
    np.testing.assert_allclose(found[1:5], expected, rtol=1e-12, atol=1e-12)
    assert found.area is None


def test_statistics_of_a_tile_of_the_root():
    from geokit.volume.tree.typed_tree import tree_of
    from geokit.volume.tree.typed_writer import rebuilt

    typed = TypedGrid("int32")
    tree = tree_of(typed.volume)
    on = rebuilt(replace(tree, root=tree.root._replace(active=np.ones(1, np.bool_))), typed.volume)
    found = statistics(on)
    count = 1024 + 4096**3
    assert found.count == count
    mean = (float(typed.root_tile) * 4096**3 + typed.leaves.sum()) / count
    assert found.mean == pytest.approx(mean, rel=1e-12)
    assert found.maximum == max(typed.leaves.max(), typed.root_tile)


@pytest.mark.slow
@pytest.mark.parametrize("operation", [prune, lambda v: clip(v, BOX), lambda v: segment(v)[0]])
def test_integer_vectors_stay_integers(operation):
    grid = random_grid("vec3d", 7)
    marked = replace(grid.volume.info, metadata={"geokit:value_type": "vec3i", "kept": 1})
    result = operation(SparseVolume(grid.volume.nanovdb, marked))
    assert dict(result.info.metadata) == {"geokit:value_type": "vec3i", "kept": 1}


@pytest.mark.slow
@needs_validate
@pytest.mark.parametrize("grid_type", ["mask", "uint32", "int16", "rgba8"])
def test_nanovdb_validate_accepts_results(tmp_path, grid_type):
    grid = random_grid(grid_type, 8)
    for number, result in enumerate((prune(grid.volume), clip(grid.volume, BOX))):
        save(tmp_path / f"{number}.nvdb", result)
        assert_validated(tmp_path / f"{number}.nvdb")


def test_clipping_beyond_memory(monkeypatch):
    from geokit.volume.tree import clip as typed_clip

    monkeypatch.setattr(typed_clip.available_memory, "available_host", lambda: 1000)
    with pytest.raises(DeviceMemoryError, match="the tiles of grid 'test' that the box cuts through"):
        clip(TypedGrid("uint32").volume, [[0.0] * 3, [5000.0, 100.0, 100.0]])


def test_nothing_inside_and_nothing_at_all():
    grid = random_grid("uint32", 9)
    nothing = clip(grid.volume, [[1000.0] * 3, [1001.0] * 3])
    assert (nothing.info.active_voxel_count, nothing.info.index_bounds) == (0, None)
    for operation in (prune, lambda v: clip(v, BOX)):
        assert operation(nothing).info.active_voxel_count == 0
    assert segment(nothing) == []
    assert statistics(nothing).count == 0
