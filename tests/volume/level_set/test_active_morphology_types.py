"""Growing and shrinking of active voxels of every value type, against scipy and against OpenVDB."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from benchmarks.catalog.typed_grids import QUANTIZED, VALUED, TypedGrid
from geokit import native
from geokit.errors import UnsupportedGridError
from geokit.volume._dense import from_dense
from geokit.volume._io import load, save
from geokit.volume._morphology import closing, dilate, erode, opening
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import grid_header, info_of
from geokit.volume.retyped.quantize import quantize
from geokit.volume.tree.typed_tree import VALUE_TYPES
from tests.support.effort import of_all, spread
from tests.support.nanovdb_validate import OPENVDB, VALIDATED, assert_validated, needs_validate
from tests.support.random_grids import HIGH, LOW, RandomGrid, dense_of, random_grid
from tests.support.scipy_morphology import CONNECTIVITY, GEOKIT, SCIPY


def expected_of(grid, name, voxels, neighbors="faces"):
    """Values and states of the result, from dense arrays alone."""
    structure = ndimage.generate_binary_structure(3, CONNECTIVITY[neighbors])
    active = SCIPY[name](grid.active, structure, iterations=voxels)
    values = grid.values.copy()
    values[grid.active & ~active] = np.asarray(grid.volume.info.background, values.dtype)
    if grid.volume.info.grid_type == "mask":
        values = active
    return values, active


def assert_is(volume, values, active):
    found, states = dense_of(volume)
    np.testing.assert_array_equal(states, active)
    np.testing.assert_array_equal(found, values)
    assert volume.info.active_voxel_count == active.sum()
    some = np.argwhere(active)
    if len(some):
        np.testing.assert_array_equal(volume.info.index_bounds, np.stack([some.min(axis=0), some.max(axis=0)]) + LOW)
    check_grid(volume.nanovdb, "result")


def test_the_types_are_all_that_hold_values():
    assert set(OPENVDB) | set(VALIDATED) < set(VALUE_TYPES)
    assert set(VALUE_TYPES) == set(VALUED) - set(QUANTIZED)


@pytest.mark.slow
@pytest.mark.parametrize("seed", of_all([1], [0, 1]))
@pytest.mark.parametrize("name", GEOKIT)
@pytest.mark.parametrize("grid_type", spread(VALUE_TYPES, 5))
def test_states_are_scipys_and_values_stay(grid_type, name, seed):
    grid = random_grid(grid_type, seed)
    before = grid.volume.nanovdb.copy()
    neighbors = list(CONNECTIVITY)[(seed + list(GEOKIT).index(name)) % 3]
    voxels = 1 + 2 * seed
    result = GEOKIT[name](grid.volume, voxels=voxels, neighbors=neighbors, device="cpu")
    assert_is(result, *expected_of(grid, name, voxels, neighbors))
    np.testing.assert_array_equal(grid.volume.nanovdb, before)
    info, was = result.info, grid.volume.info
    assert (info.grid_type, info.grid_class, info.name) == (was.grid_type, was.grid_class, was.name)
    assert (info.background, info.metadata) == (was.background, was.metadata)
    np.testing.assert_array_equal(info.transform, was.transform)


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", ["bool", "mask", "int64", "vec4d"])
def test_far_growth_and_growth_to_nothing(grid_type):
    grid = random_grid(grid_type, 5)
    assert_is(dilate(grid.volume, voxels=13, device="cpu"), *expected_of(grid, "dilate", 13))
    nothing = erode(grid.volume, voxels=40, device="cpu")
    assert (nothing.info.active_voxel_count, nothing.info.index_bounds) == (0, None)
    assert_is(nothing, *expected_of(grid, "erode", 40))
    assert dilate(nothing, voxels=2, device="cpu").info.active_voxel_count == 0


@pytest.mark.parametrize("grid_type", ["int32", "mask", "vec3d"])
def test_tiles_of_the_upper_levels(grid_type):
    typed = TypedGrid(grid_type)
    # Two full leaves, and inactive tiles of 8^3, 128^3 and 4096^3 voxels with values of their own.
    source = typed.volume
    active = source.active_at(VOXELS_AROUND, space="index", device="cpu").reshape(SHAPE_AROUND)
    result = dilate(source, voxels=9, neighbors="vertices", device="cpu")
    expected = ndimage.binary_dilation(active, np.ones((3, 3, 3)), iterations=9)
    found = result.active_at(VOXELS_AROUND, space="index", device="cpu").reshape(SHAPE_AROUND)
    np.testing.assert_array_equal(found, expected)
    if grid_type != "mask":
        for points in (VOXELS_AROUND, np.array([[5000.0, 7.0, 9.0], [3.0, 4.0, 200.0], [4095.0, 0.0, 0.0]])):
            values = result.sample(points, order=0, space="index", device="cpu")
            np.testing.assert_array_equal(values, typed.at(points.astype(int)))
    check_grid(result.nanovdb, "result")
    # Turned on over the border of an inactive tile of the root: what is inside keeps the tile's value.
    near = clipped_to_the_root_tile(typed)
    grown = dilate(near, voxels=1, device="cpu")
    assert grown.active_at([[4096.0, 3.0, 3.0]], space="index", device="cpu").tolist() == [True]
    if grid_type != "mask":
        value = np.asarray(grown.sample([[4096.0, 3.0, 3.0]], order=0, space="index", device="cpu"))
        np.testing.assert_array_equal(value[0], typed.root_tile)


AROUND = [np.arange(-24, 24), np.arange(-16, 24), np.arange(-16, 40)]
SHAPE_AROUND = tuple(map(len, AROUND))
VOXELS_AROUND = np.stack(np.meshgrid(*AROUND, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


def clipped_to_the_root_tile(typed):
    """The typed grid with a leaf whose last voxels lie beside its tile of the root."""
    from geokit.volume.tree.typed_tree import tree_of
    from geokit.volume.tree.typed_writer import rebuilt

    tree = tree_of(typed.volume)
    masks = np.concatenate([tree.masks, np.full((1, 64), 255, np.uint8)])
    origins = np.concatenate([tree.origins, np.array([[4088, 0, 0]], np.int32)])
    values = np.concatenate([tree.values, tree.values[:1]])
    return rebuilt(replace(tree, origins=origins, masks=masks, values=values), typed.volume)


@pytest.mark.parametrize("corner", [2**31 - 8, -(2**31)])
def test_growth_ends_where_indices_do(corner):
    from geokit.volume.tree.typed_tree import tree_of
    from geokit.volume.tree.typed_writer import rebuilt

    source = tiled("int32")
    tree = tree_of(source)
    leaf = np.full((1, 3), corner, np.int32)
    masks, values = np.full((1, 64), 255, np.uint8), np.ones((1, 512), np.int32)
    none = tree.upper.rows(slice(0, 0))
    alone = rebuilt(replace(tree, origins=leaf, masks=masks, values=values, upper=none), source)
    grown = dilate(alone, voxels=1, device="cpu")
    # Across three of six faces there is nothing.
    assert grown.info.active_voxel_count == 512 + 3 * 64
    inner = corner - 1 if corner > 0 else corner
    np.testing.assert_array_equal(grown.info.index_bounds, [[inner] * 3, [inner + 8] * 3])
    check_grid(grown.nanovdb, "result")


@pytest.mark.parametrize("grid_type", ["float", "mask", "bool"])
def test_active_tiles_of_128_voxels(grid_type):
    volume = tiled(grid_type)
    assert volume.info.active_voxel_count == 128**3
    count = 126**3
    assert erode(volume, voxels=1, device="cpu").info.active_voxel_count == count
    grown = dilate(volume, voxels=1, neighbors="vertices", device="cpu")
    assert grown.info.active_voxel_count == 130**3
    np.testing.assert_array_equal(grown.info.index_bounds, [[-129] * 3, [0] * 3])
    assert not grown.active_at([[1.0, 0.0, 0.0], [-130.0, 0.0, 0.0]], space="index", device="cpu").any()


def tiled(grid_type):
    """One active tile of 128^3 voxels, at (-128, -128, -128)."""
    from geokit.volume.nanovdb.layout import LAYOUTS
    from geokit.volume.tree.typed_tree import Nodes, TypedTree
    from geokit.volume.tree.typed_writer import rebuilt

    layout = LAYOUTS[grid_type]
    kind = layout.background
    values, active = np.zeros((1, 32**3), kind), np.zeros((1, 32**3), np.bool_)
    values[0, -1], active[0, -1] = 1, True
    none = np.empty((0, 3), np.int32)
    tree = TypedTree(
        layout,
        np.zeros((), kind),
        none,
        np.empty((0, 64), np.uint8),
        np.empty((0, 512), kind),
        Nodes(none, np.empty((0, 4096), kind), np.empty((0, 4096), np.bool_)),
        Nodes(np.full((1, 3), -4096, np.int32), values, active),
        Nodes(none, np.empty(0, kind), np.empty(0, np.bool_)),
    )
    return rebuilt(tree, from_dense(np.zeros((1, 1, 1)), voxel_size=1.0))


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
@pytest.mark.parametrize(
    ("name", "ending"),
    [("dilate", "vdb"), *of_all([], [("erode", "nvdb"), ("dilate", "nvdb"), ("erode", "vdb")])],
)
@pytest.mark.parametrize("grid_type", OPENVDB)
def test_results_survive_files(tmp_path, grid_type, name, ending):
    grid = random_grid(grid_type, 3)
    path = tmp_path / f"grid.{ending}"
    save(path, GEOKIT[name](grid.volume, voxels=2, device="cpu"))
    found = load(path)
    assert_is(found, *expected_of(grid, name, 2))
    info, was = found.info, grid.volume.info
    assert (info.grid_type, info.grid_class, info.name) == (was.grid_type, was.grid_class, was.name)
    assert (info.background, dict(info.metadata)) == (was.background, dict(was.metadata))
    np.testing.assert_array_equal(info.transform, was.transform)
    # And the other way: what came from a file is taken on.
    again = RandomGrid(found, *expected_of(grid, name, 2))
    assert_is(GEOKIT[name](found, voxels=1, device="cpu"), *expected_of(again, name, 1))


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", [name for name in VALUE_TYPES if name not in OPENVDB])
def test_results_of_other_types_survive_nvdb(tmp_path, grid_type):
    grid = random_grid(grid_type, 4)
    save(tmp_path / "grid.nvdb", closing(grid.volume, voxels=2, device="cpu"))
    found = load(tmp_path / "grid.nvdb")
    assert_is(found, *expected_of(grid, "closing", 2))
    assert dict(found.info.metadata) == dict(grid.volume.info.metadata)


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
def test_integer_vectors_stay_integers(tmp_path):
    grid = random_grid("vec3d", 6)
    rounded = np.round(grid.values)
    marked = replace(grid.volume.info, metadata={"geokit:value_type": "vec3i"})
    source = SparseVolume(integers_in(grid.volume), marked)
    save(tmp_path / "ids.vdb", dilate(source, voxels=1, device="cpu"))
    found = load(tmp_path / "ids.vdb")
    assert found.info.metadata["geokit:value_type"] == "vec3i"
    _, active = expected_of(grid, "dilate", 1)
    assert_is(found, rounded, active)


def integers_in(volume):
    """The buffer of a grid, with its values rounded."""
    from geokit.volume.tree.typed_tree import tree_of
    from geokit.volume.tree.typed_writer import rebuilt

    tree = tree_of(volume)
    lower = tree.lower._replace(values=np.round(tree.lower.values))
    rounded = replace(tree, background=np.round(tree.background), values=np.round(tree.values), lower=lower)
    return rebuilt(rounded, volume).nanovdb


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
@pytest.mark.parametrize("codec", ["fp4", "fp8", "fp16", "fpn"])
def test_quantized_grids_become_float(codec):
    grid = random_grid("float", 8)
    quantized = quantize(grid.volume, codec, tolerance=1.0 if codec == "fpn" else None)
    result = dilate(quantized, voxels=2, device="cpu")
    assert result.info.grid_type == "float"
    _, active = expected_of(grid, "dilate", 2)
    np.testing.assert_array_equal(dense_of(result)[1], active)
    points = np.argwhere(grid.active)[::97] + float(LOW)
    np.testing.assert_array_equal(
        result.sample(points, order=0, space="index", device="cpu"),
        quantized.sample(points, order=0, space="index", device="cpu"),
    )


@pytest.mark.slow
@needs_validate
@pytest.mark.parametrize("name", ["dilate", "erode"])
@pytest.mark.parametrize("grid_type", VALIDATED)
def test_nanovdb_validate_accepts_results(tmp_path, grid_type, name):
    result = GEOKIT[name](random_grid(grid_type, 9).volume, voxels=1, device="cpu")
    save(tmp_path / "x.nvdb", result)
    assert_validated(tmp_path / "x.nvdb")


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
@pytest.mark.parametrize("grid_type", OPENVDB)
def test_headers_and_extrema_are_those_of_openvdb(tmp_path, grid_type):
    """The same tree, converted by NanoVDB's own tool: counts of nodes, tiles and voxels, boxes, least and greatest."""
    from geokit.volume.nanovdb.header import TREE_OFFSET, tree_header
    from geokit.volume.nanovdb.layout import LAYOUTS

    ours = dilate(random_grid(grid_type, 10).volume, voxels=1, device="cpu")
    save(tmp_path / "x.vdb", ours)
    theirs = load(tmp_path / "x.vdb")
    first, second = ours.nanovdb, theirs.nanovdb
    for field in ("node_count", "tile_count", "voxel_count", "node_offset"):
        np.testing.assert_array_equal(tree_header(first)[field], tree_header(second)[field])
    np.testing.assert_allclose(grid_header(first)["world_bbox"], grid_header(second)["world_bbox"], rtol=1e-15)
    layout = LAYOUTS[grid_type]
    root = TREE_OFFSET + int(tree_header(first)["node_offset"][3])
    end = root + layout.root_background + 3 * layout.background.itemsize
    if layout.leaf_bits > 1:
        np.testing.assert_array_equal(first[root:end], second[root:end])
    leaves = [sorted_leaves(buffer, layout, int(tree_header(first)["node_count"][0])) for buffer in (first, second)]
    stop = 80 if layout.leaf_bits <= 1 else -(-80 // layout.align) * layout.align + 2 * layout.background.itemsize
    # All but the flags of a leaf.
    np.testing.assert_array_equal(leaves[0][:, :15], leaves[1][:, :15])
    np.testing.assert_array_equal(leaves[0][:, 16:stop], leaves[1][:, 16:stop])


def sorted_leaves(buffer, layout, count):
    from geokit.volume.nanovdb.header import TREE_OFFSET, tree_header

    begin = TREE_OFFSET + int(tree_header(buffer)["node_offset"][0])
    rows = buffer[begin : begin + count * layout.leaf_size].reshape(count, -1)
    corners = np.ascontiguousarray(rows[:, :12]).view("<i4") >> 3
    return rows[np.lexsort(corners.T)]


def test_long_names_stay():
    grid = random_grid("int32", 11).volume
    long = named(grid, "x" * 300)
    assert info_of(long.nanovdb).name == "x" * 300
    result = dilate(long, voxels=1, device="cpu")
    assert result.info.name == "x" * 300
    assert info_of(result.nanovdb).name == "x" * 300
    check_grid(result.nanovdb, "result")


def named(volume, name):
    """The grid under a name that does not fit its header."""
    from geokit.volume.nanovdb.header import BLIND_CLASS_NAME, BLIND_DATA, aligned_buffer

    text = np.frombuffer(name.encode() + b"\0", np.uint8)
    size = len(volume.nanovdb)
    buffer = aligned_buffer(-(-(size + 288 + len(text)) // 32) * 32, zeroed=True)
    buffer[:size] = volume.nanovdb
    entry = buffer[size : size + 288].view(BLIND_DATA)[0]
    entry["offset"], entry["value_count"], entry["value_size"] = 288, len(text), 1
    entry["data_class"] = BLIND_CLASS_NAME
    buffer[size + 288 : size + 288 + len(text)] = text
    grid = grid_header(buffer)
    grid["flags"] |= 1
    grid["blind_offset"], grid["blind_count"], grid["grid_size"] = size, 1, len(buffer)
    return SparseVolume(buffer, info_of(buffer))


PYOPENVDB = """
import json, sys
import numpy as np
import pyopenvdb
grids, _ = pyopenvdb.readAll(sys.argv[1])
low, size = int(sys.argv[2]), int(sys.argv[3])
grid = grids[0]
values = np.zeros((size,) * 3, np.float32 if type(grid).__name__ == "FloatGrid" else bool)
grid.copyToArray(values, ijk=(low, low, low))
active = [item.min + item.max for item in grid.citerOnValues()]
np.savez(sys.argv[4], values=values, boxes=np.array(active))
print(json.dumps({"type": type(grid).__name__, "name": grid.name, "class": grid.gridClass,
                  "count": grid.activeVoxelCount(), "author": grid["author"], "background": float(grid.background)}))
"""


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
@pytest.mark.parametrize(("grid_type", "kind"), [("float", "FloatGrid"), ("bool", "BoolGrid")])
def test_openvdb_reads_the_same_voxels(tmp_path, grid_type, kind):
    """OpenVDB's own Python module, where the system has it."""
    python = Path("/usr/bin/python3")
    if not python.exists() or subprocess.run([python, "-c", "import pyopenvdb"], capture_output=True).returncode:
        pytest.skip("python3-openvdb is not installed")
    grid = random_grid(grid_type, 12)
    save(tmp_path / "x.vdb", opening(grid.volume, voxels=1, device="cpu"))
    values, active = expected_of(grid, "opening", 1)
    arguments = [tmp_path / "x.vdb", LOW, HIGH - LOW, tmp_path / "out.npz"]
    done = subprocess.run([python, "-c", PYOPENVDB, *map(str, arguments)], capture_output=True, text=True, check=True)
    about = json.loads(done.stdout)
    assert (about["type"], about["name"], about["author"]) == (kind, "some voxels", "tests")
    assert about["count"] == active.sum()
    found = np.load(tmp_path / "out.npz")
    np.testing.assert_array_equal(found["values"], values)
    states = np.zeros_like(active)
    for box in found["boxes"] - LOW:
        states[box[0] : box[3] + 1, box[1] : box[4] + 1, box[2] : box[5] + 1] = True
    np.testing.assert_array_equal(states, active)


@pytest.mark.parametrize("operation", GEOKIT.values())
def test_index_grids_are_refused_by_name(operation):
    source = random_grid("float", 0, tiles=False).volume
    for grid_type in ("onindex", "pointindex"):
        other = SparseVolume(source.nanovdb, replace(source.info, grid_type=grid_type))
        with pytest.raises(UnsupportedGridError, match=f"type {grid_type}"):
            operation(other, voxels=1)


def test_too_many_voxels_in_tiles_are_refused():
    from geokit.errors import DeviceMemoryError
    from geokit.volume.tree.typed_tree import tree_of
    from geokit.volume.tree.typed_writer import rebuilt

    typed = TypedGrid("double")
    tree = tree_of(typed.volume)
    on = rebuilt(replace(tree, root=tree.root._replace(active=np.ones(1, np.bool_))), typed.volume)
    assert on.info.active_voxel_count == 1024 + 4096**3
    with pytest.raises(DeviceMemoryError, match="the active tiles of grid 'test' need about"):
        dilate(on, voxels=1, device="cpu")
