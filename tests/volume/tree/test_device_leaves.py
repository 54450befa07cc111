"""Float grids built from leaves: values, signs of empty regions, statistics, and what other readers say of them."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.sphere_volumes import ROTATED, VOXELS, lookup, sphere, sphere_distance, sphere_leaves
from geokit import native
from geokit.errors import InputError
from geokit.volume import save
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches, checksum_mode
from geokit.volume.nanovdb.header import info_of, tree_header
from geokit.volume.nanovdb.write import write
from geokit.volume.tree.flood_signs import flood
from geokit.volume.tree.node_signs_kernels import INSIDE, OUTSIDE
from tests.support.nanovdb_validate import assert_validated, needs_validate

OPTIONS = {"background": 3.0, "transform": np.eye(4), "name": "g", "grid_class": "level set", "signed_fill": True}


def one_leaf(origin=(0, 0, 0), value=1.0):
    origins = np.array([origin], np.int32)
    return origins, np.full((1, 512), value, np.float32), np.ones((1, 512), np.bool_)


@pytest.mark.parametrize("center", [(0, 0, 0), (-4100, 37, 12345), (-8, 4095, -4096)])
@pytest.mark.parametrize("radius", [6.0, 40.0])
def test_every_voxel_of_a_sphere_has_its_value(radius, center):
    volume = sphere(radius, center)
    reach = int(radius) + 12
    rng = np.random.default_rng(1)
    voxels = np.array(center) + rng.integers(-reach, reach, (4000, 3))
    expected = np.clip(sphere_distance(voxels, radius, center), -3.0, 3.0)
    assert np.array_equal(lookup(volume.nanovdb, voxels), expected)


@pytest.mark.slow
def test_empty_tiles_inside_are_negative_at_both_levels():
    # A radius of 230 leaves whole lower nodes (128 voxels) empty inside: tiles of upper nodes.
    radius = 230.0
    volume = sphere(radius)
    rng = np.random.default_rng(2)
    voxels = rng.integers(-260, 260, (6000, 3))
    got = lookup(volume.nanovdb, voxels)
    assert np.array_equal(got, np.clip(sphere_distance(voxels, radius), -3.0, 3.0))
    middle = np.array([[64, 64, 64], [-65, -65, -65], [0, 0, 0], [-1, 127, -128], [5000, 0, 0], [0, -4000, 0]])
    assert lookup(volume.nanovdb, middle).tolist() == [-3.0, -3.0, -3.0, -3.0, 3.0, 3.0]


@pytest.mark.parametrize(("below", "above", "between"), [(-3.0, -3.0, -3.0), (-3.0, 3.0, 3.0), (3.0, 3.0, 3.0)])
@pytest.mark.parametrize("start", [0, -8192, -4096])
def test_a_whole_upper_node_inside_becomes_a_root_tile(start, below, above, between):
    # Leaves in the first and the third of three upper nodes along z: the one between them has no leaf at all.
    origins = np.array([[8, 8, start], [4000, 8, start + 8192]], np.int32)
    values = np.repeat(np.array([below, above], np.float32)[:, None], 512, axis=1)
    buffer = build_float_grid(origins, values, np.ones((2, 512), np.bool_), **OPTIONS)
    check_grid(buffer, "slab")
    middle = np.array([[100, 2, start + 5000], [3000, 4000, start + 4096], [7, 7, start + 8191]])
    assert lookup(buffer, middle).tolist() == [between] * 3
    ends = np.array([[100, 2, start + 4095], [100, 2, start + 8192], [100, 2, start - 1], [-1, 0, start + 5000]])
    assert lookup(buffer, ends).tolist() == [below, above, 3.0, 3.0]


def test_gaps_between_separate_bodies_stay_outside():
    parts = [sphere_leaves(10.0, (0, 0, 0)), sphere_leaves(10.0, (0, 0, 40000))]
    buffer = build_float_grid(*(np.concatenate(columns) for columns in zip(*parts, strict=True)), **OPTIONS)
    check_grid(buffer, "bodies")
    voxels = np.array([[0, 0, 0], [0, 0, 40000], [0, 0, 20000], [0, 0, 4096], [0, 0, -5000]])
    assert lookup(buffer, voxels).tolist() == [-3.0, -3.0, 3.0, 3.0, 3.0]


def test_flood_reaches_every_slot_from_one_child():
    faces = np.array([0b010101], np.uint8)
    states, own = flood(1, 4, np.array([0]), np.array([5 << 8 | 6 << 4 | 7]), faces)
    assert np.isin(states, (int(OUTSIDE), int(INSIDE))).sum() == 16**3 - 1
    table = states.reshape(16, 16, 16)
    assert table[5, 6, 6] == int(INSIDE)
    assert table[5, 6, 8] == int(OUTSIDE)
    assert own.shape == (1,)


def test_without_signed_fill_empty_regions_have_the_background():
    origins, values, masks = sphere_leaves(30.0)
    buffer = build_float_grid(origins, values, masks, **{**OPTIONS, "signed_fill": False, "grid_class": "unknown"})
    assert lookup(buffer, np.array([[0, 0, 0], [4096, 0, 0]])).tolist() == [3.0, 3.0]
    assert lookup(buffer, np.array([[30, 0, 0]])).tolist() == [0.0]


def test_leaf_order_and_packed_masks_do_not_matter():
    origins, values, masks = sphere_leaves(20.0, (-4096, 0, 0))
    shuffled = np.random.default_rng(3).permutation(len(origins))
    first = build_float_grid(origins, values, masks, **OPTIONS)
    packed = np.packbits(masks, axis=1, bitorder="little")
    second = build_float_grid(origins[shuffled], values[shuffled], packed[shuffled], **OPTIONS)
    assert np.array_equal(first, second)


def test_counts_boxes_and_extrema_are_those_of_the_active_voxels():
    origins, values, masks = sphere_leaves(20.0, (-70, 5, 400))
    buffer = build_float_grid(origins, values, masks, **OPTIONS)
    active = (origins[:, None, :] + VOXELS)[masks]
    info = info_of(buffer)
    assert info.active_voxel_count == masks.sum()
    assert np.array_equal(info.index_bounds, [active.min(axis=0), active.max(axis=0)])
    root = buffer[736:800].view(np.float32)
    assert (root[7], root[8], root[9]) == (3.0, values[masks].min(), values[masks].max())
    offsets = tree_header(buffer)["node_offset"]
    leaf = buffer[672 + int(offsets[0]) :][: 2144 * len(origins)].reshape(-1, 2144)
    boxes = leaf[:, :12].copy().view(np.int32)
    order = np.array([np.flatnonzero((origins == b & ~7).all(axis=1))[0] for b in boxes])
    for row, i in enumerate(order):
        voxels = (origins[i] + VOXELS)[masks[i]]
        if not len(voxels):
            continue
        assert np.array_equal(boxes[row], voxels.min(axis=0))
        assert np.array_equal(boxes[row] + leaf[row, 12:15], voxels.max(axis=0))
        limits = leaf[row, 80:88].copy().view(np.float32)
        assert limits.tolist() == [values[i][masks[i]].min(), values[i][masks[i]].max()]


def test_a_grid_without_leaves_is_valid():
    empty = np.empty((0, 3), np.int32), np.empty((0, 512), np.float32), np.empty((0, 512), np.bool_)
    buffer = build_float_grid(*empty, **OPTIONS)
    check_grid(buffer, "empty")
    info = info_of(buffer)
    assert (info.active_voxel_count, info.index_bounds, info.background) == (0, None, 3.0)
    assert lookup(buffer, np.array([[1, 2, 3]])).tolist() == [3.0]


def test_leaves_without_active_voxels_have_no_box():
    origins, values, _ = one_leaf((8, -16, 24))
    buffer = build_float_grid(origins, values, np.zeros((1, 512), np.bool_), **OPTIONS)
    check_grid(buffer, "inactive")
    assert info_of(buffer).index_bounds is None
    assert lookup(buffer, np.array([[8, -16, 24]])).tolist() == [1.0]


def test_a_leaf_without_active_voxels_does_not_widen_the_box():
    origins = np.array([[0, 0, 0], [0, 0, 8], [-4096, 0, 0]], np.int32)
    masks = np.zeros((3, 512), np.bool_)
    masks[0, 0] = True
    buffer = build_float_grid(origins, np.ones((3, 512), np.float32), masks, **OPTIONS)
    assert info_of(buffer).index_bounds.tolist() == [[0, 0, 0], [0, 0, 0]]
    # NanoVDB's readers derive a node's origin from its box, even from an empty one.
    offsets = tree_header(buffer)["node_offset"]
    for level, span, origins_of in ((1, 128, [[0, 0, 0], [-128 * 32, 0, 0]]), (2, 4096, [[0, 0, 0], [-4096, 0, 0]])):
        size = {1: 33856, 2: 270400}[level]
        nodes = buffer[672 + int(offsets[level]) :][: 2 * size].reshape(2, size)
        assert (nodes[:, :12].copy().view(np.int32) & ~(span - 1)).tolist() == origins_of


def test_the_header_says_what_was_asked_for():
    info = info_of(build_float_grid(*one_leaf(), **{**OPTIONS, "transform": ROTATED, "name": "Höhe"}))
    assert (info.name, info.grid_type, info.grid_class) == ("Höhe", "float", "level set")
    assert np.array_equal(info.transform, ROTATED)
    assert info.voxel_size == pytest.approx([0.1, 0.1, 0.1], rel=1e-15)


def test_the_checksum_matches_and_covers_headers_and_root():
    buffer = build_float_grid(*sphere_leaves(12.0), **OPTIONS)
    assert checksum_mode(buffer) == "partial"
    assert checksum_matches(buffer)
    buffer[len(buffer) - 100] ^= 1
    assert checksum_matches(buffer)
    buffer[800] ^= 1
    assert not checksum_matches(buffer)


def test_buffers_start_where_nanovdb_wants_them():
    assert all(sphere(r).nanovdb.ctypes.data % 32 == 0 for r in (3.0, 5.0, 9.0))


@pytest.mark.parametrize(
    ("change", "argument"),
    [
        ({"transform": np.zeros((4, 4))}, "transform"),
        ({"transform": np.full((4, 4), np.nan)}, "transform"),
        ({"transform": np.eye(3)}, "transform"),
        ({"transform": np.diag([1.0, 1.0, 1.0, 2.0])}, "transform"),
        ({"name": "n" * 256}, "name"),
        ({"background": np.inf}, "background"),
        ({"grid_class": "smoke"}, "grid_class"),
    ],
)
def test_unusable_options_are_refused(change, argument):
    with pytest.raises(InputError, match=f"^{argument}"):
        build_float_grid(*one_leaf(), **{**OPTIONS, **change})


@pytest.mark.parametrize(
    ("origins", "text"),
    [
        ([[0, 0, 0], [0, 4, 0]], "row 1"),
        ([[0, 0, 0], [8, 0, 0], [0, 0, 0]], "row 2 repeats row 0"),
        ([[0, 0, 1 << 31]], "row 0"),
        ([[0, 0]], r"\(1, 2\)"),
        ([[0.0, 0.0, 0.0]], "float64"),
        ([[0, 0, -(1 << 31)], [0, 0, (1 << 31) - 8]], "empty nodes"),
    ],
)
def test_unusable_origins_are_refused(origins, text):
    rows = np.ones((len(origins), 512), np.float32), np.ones((len(origins), 512), np.bool_)
    with pytest.raises(InputError, match=text):
        build_float_grid(np.array(origins), *rows, **OPTIONS)


def test_rows_must_belong_to_leaves():
    origins, values, masks = one_leaf()
    with pytest.raises(InputError, match="leaf_values"):
        build_float_grid(origins, values[:, :100], masks, **OPTIONS)
    with pytest.raises(InputError, match="leaf_masks"):
        build_float_grid(origins, values, masks[:0], **OPTIONS)


@wp.kernel
def lookup_kernel(volume: wp.uint64, voxels: wp.array(dtype=wp.vec3i), out_values: wp.array(dtype=wp.float32)):
    i = wp.tid()
    out_values[i] = wp.volume_lookup_f(volume, voxels[i][0], voxels[i][1], voxels[i][2])


def test_warp_reads_the_same_values(tmp_path: Path):
    center = (-4100, 0, 50)
    volume = sphere(40.0, center, transform=ROTATED)
    voxels = np.array(center) + np.random.default_rng(4).integers(-60, 60, (20000, 3))
    out = wp.empty(len(voxels), dtype=wp.float32, device="cpu")
    # The file's way runs warp's own checks of the tree; the other shares the buffer.
    write(tmp_path / "s.nvdb", [volume])
    with open(tmp_path / "s.nvdb", "rb") as file:
        loaded = wp.Volume.load_from_nvdb(file, device="cpu")
    for made in (volume.on("cpu"), loaded):
        wp.launch(
            lookup_kernel,
            len(voxels),
            [made.id, wp.array(voxels, dtype=wp.vec3i, device="cpu")],
            [out],
            device="cpu",
        )
        assert np.array_equal(out.numpy(), np.clip(sphere_distance(voxels, 40.0, center), -3.0, 3.0))


@needs_validate
def test_nanovdb_validate_accepts_the_file(tmp_path: Path):
    write(tmp_path / "s.nvdb", [sphere(40.0, transform=ROTATED), sphere(5.0, (-9000, 0, 0), name="other")])
    assert_validated(tmp_path / "s.nvdb", 2)


PYOPENVDB = """
import json, sys
import pyopenvdb as vdb
path, voxels = sys.argv[1], json.load(sys.stdin)
grid = vdb.readAllGridMetadata(path)[0]
grid = vdb.read(path, grid.name)
accessor = grid.getConstAccessor()
print(json.dumps({
    "values": [accessor.getValue(tuple(v)) for v in voxels],
    "active": grid.activeVoxelCount(),
    "leaves": grid.leafCount(),
    "class": grid.gridClass,
    "background": grid.background,
    "world": [list(grid.transform.indexToWorld(tuple(v))) for v in voxels[:10]],
}))
"""


def has_pyopenvdb() -> bool:
    if not (native.available() and Path("/usr/bin/python3").exists()):
        return False
    done = subprocess.run(["/usr/bin/python3", "-c", "import pyopenvdb"], capture_output=True, check=False)
    return done.returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not has_pyopenvdb(), reason="pyopenvdb or the OpenVDB extension is not installed")
@pytest.mark.parametrize("center", [(0, 0, 0), (-4100, 70, 9000)])
def test_openvdb_finds_the_same_values(tmp_path: Path, center):
    radius = 90.0  # empty lower-level tiles inside
    volume = sphere(radius, center, transform=ROTATED)
    save(tmp_path / "s.vdb", volume)
    voxels = np.array(center) + np.random.default_rng(5).integers(-100, 100, (3000, 3))
    done = subprocess.run(
        ["/usr/bin/python3", "-c", PYOPENVDB, tmp_path / "s.vdb"],
        input=json.dumps(voxels.tolist()),
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(done.stdout)
    assert np.array_equal(found["values"], np.clip(sphere_distance(voxels, radius, center), -3.0, 3.0))
    assert (found["active"], found["class"], found["background"]) == (volume.info.active_voxel_count, "level set", 3.0)
    assert found["leaves"] == int(tree_header(volume.nanovdb)["node_count"][0])
    assert np.allclose(found["world"], voxels[:10] @ ROTATED[:3, :3].T + ROTATED[:3, 3], rtol=1e-15, atol=0.0)
