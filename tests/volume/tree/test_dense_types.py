"""Dense arrays to grids of every value type: what comes back, what is stored, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from geokit import native
from geokit.core.memory import available_memory
from geokit.core.running.thread_placement import Pool
from geokit.errors import DeviceMemoryError, InputError
from geokit.volume._dense import from_dense, to_dense
from geokit.volume._io import load, save
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches
from geokit.volume.nanovdb.header import tree_header
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.tree.typed_tree import VALUE_TYPES
from tests.support.nanovdb_validate import OPENVDB, VALIDATED, assert_validated, needs_validate
from tests.support.random_grids import TRANSFORM, random_values

SHAPE = (21, 17, 40)


def speckled(grid_type, seed=0, shape=SHAPE):
    """An array of which most is background, that background, and where it is something else."""
    rng = np.random.default_rng(seed)
    kind = LAYOUTS[grid_type].background
    background = np.zeros(kind.shape, kind.base)
    if grid_type != "mask":
        background = np.asarray(random_values(grid_type, rng, ()), kind.base)
    values = np.empty((*shape, *kind.shape), kind.base)
    values[:] = background
    some = rng.random(shape) < 0.02
    some[: shape[0] // 2, :9, 9:20] = True
    values[some] = random_values(grid_type, rng, shape)[some]
    active = values != background
    return values, background, active.any(axis=-1) if kind.shape else active


def boxed(array, origin, margin=0):
    first = np.asarray(origin)
    return [first - margin, first + array.shape[:3] - 1 + margin]


@pytest.mark.slow
@pytest.mark.parametrize("origin", [(0, 0, 0), (5, -3, 121), (-(2**31), 2**31 - 40, -4096)])
@pytest.mark.parametrize("grid_type", VALUE_TYPES)
def test_every_type_comes_back(grid_type, origin):
    values, background, active = speckled(grid_type)
    kept = values.copy()
    volume = from_dense(
        values, transform=TRANSFORM, origin=origin, background=background, name="some", grid_type=grid_type
    )
    np.testing.assert_array_equal(values, kept)
    dense = to_dense(volume, bounds=boxed(values, origin), device="cpu")
    np.testing.assert_array_equal(dense.values, values)
    assert dense.values.dtype == values.dtype
    check_grid(volume.nanovdb, "dense")
    assert checksum_matches(volume.nanovdb)
    info = volume.info
    assert (info.grid_type, info.grid_class, info.name) == (grid_type, "unknown", "some")
    np.testing.assert_array_equal(np.asarray(info.background, values.dtype), background)
    np.testing.assert_array_equal(info.transform, TRANSFORM)
    assert info.active_voxel_count == active.sum()
    box = np.argwhere(active)
    np.testing.assert_array_equal(info.index_bounds, np.array([box.min(axis=0), box.max(axis=0)]) + origin)
    voxels = np.argwhere(np.ones(SHAPE, np.bool_)) + np.array(origin, float)
    # Beyond two voxels from the ends of int32, where active_at looks no more.
    seen = (np.abs(voxels) < 2**31 - 4).all(axis=1)
    states = np.asarray(volume.active_at(voxels[seen], space="index", device="cpu"))
    np.testing.assert_array_equal(states, active.reshape(-1)[seen])


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", VALUE_TYPES)
def test_what_to_dense_gives_goes_back(grid_type):
    values, background, _ = speckled(grid_type, 1)
    first = from_dense(values, voxel_size=0.1, origin=(-9, 4, 3), background=background, grid_type=grid_type)
    dense, info = to_dense(first, device="cpu"), first.info
    again = from_dense(
        dense.values,
        transform=dense.transform,
        origin=dense.origin,
        background=info.background,
        grid_class=info.grid_class,
        grid_type=info.grid_type,
    )
    np.testing.assert_array_equal(again.nanovdb, first.nanovdb)


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", VALUE_TYPES)
def test_outside_is_background_and_takes_no_leaf(grid_type):
    kind = LAYOUTS[grid_type].background
    background = np.zeros(kind.shape, kind.base) if grid_type == "mask" else np.full(kind.shape, 1, kind.base)
    values = np.empty((64, 64, 64, *kind.shape), kind.base)
    values[:] = background
    values[9, 9, 9] = values[40, 63, 0] = grid_type == "mask"
    volume = from_dense(values, voxel_size=1.0, origin=(-16, 0, 0), background=background, grid_type=grid_type)
    assert tree_header(volume.nanovdb)["node_count"].tolist() == [2, 2, 2]
    assert volume.info.active_voxel_count == 2
    wide = to_dense(volume, bounds=boxed(values, (-16, 0, 0), 9), device="cpu").values
    np.testing.assert_array_equal(wide[9:-9, 9:-9, 9:-9], values)
    wide[9:-9, 9:-9, 9:-9] = background
    assert (wide == background).all()


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", VALUE_TYPES)
def test_nothing_and_one_voxel(grid_type):
    kind = LAYOUTS[grid_type].background
    for shape in ((0, 3, 3), (3, 3, 0), (9, 9, 9)):
        empty = from_dense(np.zeros((*shape, *kind.shape), kind.base), voxel_size=1.0, grid_type=grid_type)
        assert (empty.info.active_voxel_count, empty.info.index_bounds) == (0, None)
        assert tree_header(empty.nanovdb)["node_count"].tolist() == [0, 0, 0]
        check_grid(empty.nanovdb, "empty")
        assert not np.any(to_dense(empty, bounds=[[0, 0, 0], [1, 1, 1]], device="cpu").values)
    one = from_dense(
        np.ones((1, 1, 1, *kind.shape), kind.base), voxel_size=1.0, origin=(-1, 7, -9), grid_type=grid_type
    )
    assert one.info.active_voxel_count == 1
    np.testing.assert_array_equal(one.info.index_bounds, [[-1, 7, -9]] * 2)
    assert to_dense(one, device="cpu").values.tolist() == np.ones((1, 1, 1, *kind.shape), kind.base).tolist()


@pytest.mark.parametrize(
    ("dtype", "components", "grid_type"),
    [
        *[(dtype, 1, "float") for dtype in ("f2", "f4", "f8", "g")],
        *[(dtype, 3, "vec3f") for dtype in ("f2", "f4", "f8")],
        *[(dtype, 4, "vec4f") for dtype in ("f4", "f8")],
        *[(name, 1, name) for name in ("bool", "int16", "int32", "int64", "uint8", "uint32")],
        (">i4", 1, "int32"),
        ("int8", 1, "int16"),
        ("uint16", 1, "int32"),
        ("uint8", 3, "vec3u8"),
        ("uint16", 3, "vec3u16"),
        ("uint8", 4, "rgba8"),
    ],
)
def test_the_type_is_the_arrays(dtype, components, grid_type):
    values = np.arange(24).reshape(2, 3, 4).astype(dtype)
    values = values if components == 1 else np.stack(components * [values], axis=-1)
    volume = from_dense(values, voxel_size=1.0)
    assert volume.info.grid_type == grid_type
    dense = to_dense(volume, bounds=[[0, 0, 0], [1, 2, 3]], device="cpu").values
    np.testing.assert_array_equal(dense, values)


@pytest.mark.parametrize("grid_class", ["level set", "fog volume"])
@pytest.mark.parametrize("dtype", [np.int16, np.bool_, np.uint8])
def test_level_sets_and_fog_become_float(dtype, grid_class):
    volume = from_dense(np.eye(9, dtype=dtype)[None], voxel_size=1.0, background=1, grid_class=grid_class)
    assert (volume.info.grid_type, volume.info.grid_class) == ("float", grid_class)


def test_float_grids_are_what_they_were():
    values, _, _ = speckled("int16", 2)
    numbers = from_dense(values.astype(np.float64), voxel_size=1.0, background=values[-1, -1, -1].item())
    asked = from_dense(values, voxel_size=1.0, background=values[-1, -1, -1].item(), grid_type="float")
    np.testing.assert_array_equal(asked.nanovdb, numbers.nanovdb)
    assert asked.info.grid_type == "float"


def test_tolerance_of_whole_numbers_is_exact():
    top, low = 2**63 - 1, -(2**63)
    values = np.array([2**62, 2**62 + 1, 2**62 + 2, 2**62 - 2, top, low], np.int64).reshape(1, 1, 6)
    volume = from_dense(values, voxel_size=1.0, background=2**62, tolerance=1.9)
    dense = to_dense(volume, bounds=[[0, 0, 0], [0, 0, 5]], device="cpu").values[0, 0]
    assert dense.tolist() == [2**62, 2**62, 2**62 + 2, 2**62 - 2, top, low]
    assert volume.info.active_voxel_count == 4
    # The limits of the type are no limits of the comparison.
    near = from_dense(values, voxel_size=1.0, background=top, tolerance=3.0)
    assert near.info.active_voxel_count == 5
    assert from_dense(values, voxel_size=1.0, background=low, tolerance=1e300).info.active_voxel_count == 0
    small = np.array([250, 255, 5, 0], np.uint8).reshape(1, 1, 4)
    assert from_dense(small, voxel_size=1.0, background=253, tolerance=10.0).info.active_voxel_count == 2
    assert from_dense(small > 100, voxel_size=1.0, tolerance=0.9).info.active_voxel_count == 2
    assert from_dense(small > 100, voxel_size=1.0, tolerance=1.0).info.active_voxel_count == 0


def test_tolerance_is_for_each_component():
    values = np.array([[1.0, 2.0, 3.0], [1.1, 2.1, 3.1], [1.0, 2.0, 3.2], [1.0, 1.0, 3.0]]).reshape(1, 1, 4, 3)
    volume = from_dense(values, voxel_size=1.0, background=(1, 2, 3), tolerance=0.15, grid_type="vec3d")
    assert volume.info.active_voxel_count == 2
    dense = to_dense(volume, bounds=[[0, 0, 0], [0, 0, 3]], device="cpu").values[0, 0]
    np.testing.assert_array_equal(dense, [[1, 2, 3], [1, 2, 3], [1, 2, 3.2], [1, 1, 3]])
    # One number is the background of all components.
    assert (
        from_dense(np.full((1, 1, 4, 3), 7), voxel_size=1.0, background=7, grid_type="vec3f").info.index_bounds is None
    )


@pytest.mark.parametrize("tolerance", [0.0, 0.3])
@pytest.mark.parametrize("grid_type", ["double", "half"])
def test_level_sets_of_other_floats(grid_type, tolerance):
    """The same voxels, leaves and tiles as of a float level set, which has kernels of its own."""
    rng = np.random.default_rng(3)
    steps = np.stack(np.meshgrid(*[np.arange(n) for n in (150, 40, 44)], indexing="ij"), axis=-1)
    values = np.clip(np.linalg.norm(steps - (80, 20, 20), axis=-1) - 60.0, -2.0, 2.0).round(2)
    values[140:] = rng.choice([2.0, -2.0, -1.75, 0.5], values[140:].shape)
    values = values.astype(LAYOUTS[grid_type].background)
    options = {"voxel_size": 1.0, "origin": (-7, 3, 5), "background": 2.0, "grid_class": "level set"}
    expected = from_dense(values, tolerance=tolerance, **options)
    volume = from_dense(values, tolerance=tolerance, grid_type=grid_type, **options)
    check_grid(volume.nanovdb, "level set")
    assert (volume.info.grid_class, volume.info.background) == ("level set", 2.0)
    assert volume.info.active_voxel_count == expected.info.active_voxel_count > 0
    bounds = boxed(values, (-7, 3, 5), 9)
    dense = [to_dense(v, bounds=bounds, device="cpu").values for v in (volume, expected)]
    np.testing.assert_array_equal(dense[0].astype(np.float32), dense[1])
    leaves = [int(tree_header(v.nanovdb)["node_count"][0]) for v in (volume, expected)]
    # A float grid stores a leaf for each node that only has tiles inside.
    assert leaves[1] - 2 <= leaves[0] <= leaves[1] < dense[0].size / 512 / 2


@pytest.mark.parametrize("grid_type", ["int32", "bool", "vec3f", "double"])
def test_parts_and_threads_do_not_matter(grid_type, monkeypatch):
    values, background, _ = speckled(grid_type, 4)
    options = {"voxel_size": 1.0, "origin": (3, 4, 5), "background": background, "grid_type": grid_type}
    made = from_dense(values, **options).nanovdb
    for numbers, threads in ((1, 1), (9000, 3), (1 << 30, 2)):
        monkeypatch.setattr("geokit.volume.tree.dense_typed.NUMBERS_AT_A_TIME", numbers)
        workers = Pool(threads, "test")
        monkeypatch.setattr("geokit.volume.tree.dense_typed.pool", lambda workers=workers: workers)
        np.testing.assert_array_equal(from_dense(values, **options).nanovdb, made)


@pytest.mark.parametrize("grid_type", ["int32", "vec3f"])
def test_containers(grid_type):
    values, background, _ = speckled(grid_type, 5, (16, 16, 16))
    options = {"voxel_size": 1.0, "background": background}
    made = from_dense(values, **options).nanovdb
    dtype = {"int32": wp.int32, "vec3f": wp.vec3f}[grid_type]
    padded = np.zeros((32, 16, 16, *values.shape[3:]), values.dtype)
    padded[::2] = values
    for given in (
        wp.array(values, dtype=dtype, device="cpu"),
        values.tolist() if grid_type == "int32" else np.asfortranarray(values),
        np.asfortranarray(values),
        values.astype(values.dtype.newbyteorder(">")),
        padded[::2],
    ):
        np.testing.assert_array_equal(from_dense(given, **options, grid_type=grid_type).nanovdb, made)


@pytest.mark.parametrize(
    ("values", "grid_type", "message"),
    [
        (np.array([[[0.0, np.nan]]]), "double", r"voxel \[0, 0, 1\] is nan, which double cannot hold"),
        (np.array([[[0.0], [1e5]]]), "half", r"voxel \[0, 1, 0\] is 100000.0, which half cannot hold"),
        (np.array([[[[0.0, 0.0, 1e39]]]]), None, r"voxel \[0, 0, 0\] .* which vec3f cannot hold"),
        (np.array([[[[0.0, np.inf, 0.0]]]]), "vec3d", r"voxel \[0, 0, 0\] "),
        (np.array([[[1.0, 1.5]]]), "int32", r"voxel \[0, 0, 1\] is 1.5, which int32"),
        (np.array([[[np.nan]]]), "int64", r"voxel \[0, 0, 0\] is nan"),
        (np.array([[[9.3e18]]]), "int64", r"voxel \[0, 0, 0\] is 9.3e\+18"),
        (np.array([[[-1]]]), "uint32", r"voxel \[0, 0, 0\] is -1, which uint32"),
        (np.array([[[2**64 - 1]]], np.uint64), "int64", r"is 18446744073709551615, which int64"),
        (np.full((30, 1, 1), 70000) * (np.arange(30) == 29)[:, None, None], "int16", r"voxel \[29, 0, 0\] is 70000"),
        (np.array([[[2]]]), "bool", r"is 2, which bool"),
        (np.array([[[0.5]]]), "mask", r"is 0.5, which mask"),
        (np.array([[[1]]], np.uint64), None, r"no grid has 1 uint64 in a voxel; name a grid_type, 'int64' or 'float'"),
        (np.ones((1, 1, 1, 3), np.int32), None, "no grid has 3 int32 in a voxel; name a grid_type, 'vec3f' or 'vec3d'"),
        (np.ones((1, 1, 1, 2)), None, "has 2 components; give"),
        (np.ones((1, 1, 1, 1)), None, "has 1 components; give"),
        (np.ones((1, 1, 1, 3)), "vec4f", r"is not \(X, Y, Z, 4\)"),
        (np.ones((1, 1, 1, 3)), "float", r"is not \(X, Y, Z\)"),
        (np.ones((1, 1, 1)), "vec3f", r"is not \(X, Y, Z, 3\)"),
        (np.ones((1, 1, 1)), "fp8", r"grid_type: 'fp8' .* quantize\(\) it"),
        (np.ones((1, 1, 1)), "int8", "grid_type: 'int8' .* use one of float, double"),
        (np.ones((1, 1, 1)), "onindex", "grid_type: 'onindex'"),
        (np.ones((1, 1, 1)), np.float32, "grid_type: "),
        (np.ones((1, 1, 1, 3), complex), None, "real number"),
    ],
)
def test_values_are_refused(values, grid_type, message):
    with pytest.raises(InputError, match=message):
        from_dense(values, voxel_size=1.0, grid_type=grid_type)


@pytest.mark.parametrize(
    ("grid_type", "options", "message"),
    [
        ("int32", {"background": 0.5}, "background: 0.5 is no value of type int32; give a number that int32 holds"),
        ("uint8", {"background": 256}, "background: 256"),
        ("uint32", {"background": -1}, "background: -1"),
        ("double", {"background": np.nan}, "background: nan"),
        ("double", {"background": "x"}, "background"),
        ("double", {"background": [[1], [2, 3]]}, "background"),
        ("half", {"background": 1e6}, "background"),
        ("vec3f", {"background": (1, 2)}, "one number, or 3, that vec3f holds"),
        ("int32", {"background": (1, 2, 3)}, "background"),
        ("bool", {"background": 2}, "background"),
        ("mask", {"background": True}, "what a mask does not store is off"),
        ("double", {"grid_class": "level set"}, "not positive"),
        ("int32", {"tolerance": -1.0}, "tolerance"),
        ("int32", {"tolerance": np.inf}, "tolerance"),
        ("int32", {"grid_class": "level set"}, "no level set is of type int32; use 'unknown', or grid_type='float'"),
        ("vec3f", {"grid_class": "fog volume"}, "no fog volume is of type vec3f"),
        ("double", {"grid_class": "staggered"}, "no staggered is of type double"),
        ("bool", {"grid_class": "topology"}, "or grid_type='mask'"),
        ("int32", {"grid_class": "index grid"}, "no index grid is of type int32; use 'unknown'$"),
        ("int32", {"grid_class": "no class"}, "grid_class: NanoVDB has no class"),
        ("int32", {"name": "x" * 300}, "name"),
        ("int32", {"voxel_size": None, "transform": np.zeros((4, 4))}, "transform"),
        ("int32", {"origin": (2**31 - 1, 0, 0)}, "origin"),
    ],
)
def test_options_are_refused(grid_type, options, message):
    values = np.ones((2, 2, 2, *LAYOUTS[grid_type].background.shape), np.uint8)
    with pytest.raises(InputError, match=message):
        from_dense(values, **{"voxel_size": 1.0, "grid_type": grid_type, **options})


def test_grids_beyond_the_memory_are_refused(monkeypatch):
    monkeypatch.setattr(available_memory, "available_host", lambda: 1000)
    with pytest.raises(DeviceMemoryError, match="8 leaves need"):
        from_dense(np.ones((9, 9, 9), np.int64), voxel_size=1.0)


@pytest.mark.slow
@needs_validate
@pytest.mark.parametrize("grid_type", VALIDATED)
def test_nanovdb_validate_accepts_them(tmp_path, grid_type):
    values, background, _ = speckled(grid_type, 6)
    full = from_dense(values, voxel_size=0.5, origin=(-9, 4, 3), background=background, grid_type=grid_type)
    empty = from_dense(values[:0], voxel_size=0.5, grid_type=grid_type)
    save(tmp_path / "x.nvdb", full, empty)
    assert_validated(tmp_path / "x.nvdb", 2)


@needs_validate
@pytest.mark.parametrize(
    ("grid_type", "grid_class"),
    [("double", "level set"), ("double", "fog volume"), ("vec3f", "staggered"),
     ("mask", "topology"), ("uint32", "point index"), ("rgba8", "voxel volume"), ("vec3d", "voxel volume")],
)  # fmt: skip
def test_nanovdb_validate_accepts_classes(tmp_path, grid_type, grid_class):
    values = np.ones((9, 9, 9, *LAYOUTS[grid_type].background.shape), np.uint8)
    background = 2 if grid_class == "level set" else 0
    made = from_dense(values, voxel_size=0.5, background=background, grid_type=grid_type, grid_class=grid_class)
    assert made.info.grid_class == grid_class
    save(tmp_path / "x.nvdb", made)
    assert_validated(tmp_path / "x.nvdb")


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
@pytest.mark.parametrize("grid_type", OPENVDB)
def test_openvdb_files_give_the_array_back(tmp_path, grid_type):
    values, background, active = speckled(grid_type, 7)
    made = from_dense(values, transform=TRANSFORM, origin=(-9, 4, 3), background=background, grid_type=grid_type)
    save(tmp_path / "x.vdb", made)
    found = load(tmp_path / "x.vdb")
    assert (found.info.grid_type, found.info.active_voxel_count) == (grid_type, active.sum())
    dense = to_dense(found, bounds=boxed(values, (-9, 4, 3)), device="cpu").values
    np.testing.assert_array_equal(dense, values)
    np.testing.assert_allclose(found.info.transform, TRANSFORM, rtol=0, atol=1e-15)
