"""Quantized grids: codes bit for bit as NanoVDB's own, errors as measured, and what is refused."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.sphere_volumes import ROTATED, sphere
from benchmarks.catalog.typed_grids import QUANTIZED, TypedGrid
from geokit import native
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume import load, load_all, save
from geokit.volume._dense import to_dense
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches
from geokit.volume.nanovdb.file import read
from geokit.volume.nanovdb.header import grid_header, info_of, tree_header
from geokit.volume.retyped.quantize import quantize
from geokit.volume.tree.leaf_codecs import BITS, thresholds, unpack
from tests.support.nanovdb_validate import assert_validated, needs_validate

FIXED = {"fp4": 4, "fp8": 8, "fp16": 16}
# NanoVDB's decoding rounds product and sum to float32, relative to the range of a leaf (6 voxels of the sphere).
DECODING = 6.0 * 1.2e-7
LEAF_HEAD = 96


def voxels_of(volume: SparseVolume) -> np.ndarray:
    """Every voxel of the leaves and around them, as float64."""
    box = volume.info.index_bounds + np.array([[-9], [9]])
    return to_dense(volume, bounds=box, device="cpu").values.astype(np.float64)


def leaf_of(values: np.ndarray, masks=None, background=0.0, **options) -> SparseVolume:
    """One leaf with the given voxels."""
    masks = np.ones((1, 512), bool) if masks is None else masks
    buffer = build_float_grid(
        np.zeros((1, 3), np.int32), np.float32(values).reshape(1, 512), masks,
        background=background, transform=np.eye(4), name="leaf",
        **{"grid_class": "unknown", "signed_fill": False, **options},
    )  # fmt: skip
    return SparseVolume(buffer, info_of(buffer))


def leaf_starts(volume: SparseVolume) -> list[int]:
    tree = tree_header(volume.nanovdb)
    at, starts = 672 + int(tree["node_offset"][0]), []
    for _ in range(int(tree["node_count"][0])):
        starts.append(at)
        bits = FIXED.get(volume.info.grid_type) or 1 << (int(volume.nanovdb[at + 15]) >> 5)
        at += LEAF_HEAD + 64 * bits
    assert at == len(volume.nanovdb)
    return starts


@pytest.mark.parametrize("codec", FIXED)
@pytest.mark.parametrize("dither", [False, True])
def test_error_is_half_a_step_and_what_the_metadata_says(codec, dither):
    volume = sphere(20.0, (3, -70, 4090), transform=ROTATED)
    small = quantize(volume, codec, dither=dither)
    check_grid(small.nanovdb, codec)
    assert checksum_matches(small.nanovdb)
    assert small.info.grid_type == codec
    error = np.abs(voxels_of(small) - voxels_of(volume)).max()
    # A leaf's values span six voxels at most.
    step = 6.0 / (2 ** FIXED[codec] - 1)
    assert error <= step * (1.0 if dither else 0.5) + DECODING
    assert small.info.metadata["geokit:achieved_error"] == pytest.approx(error, abs=DECODING)
    assert "geokit:tolerance" not in small.info.metadata
    for field in ("name", "grid_class", "background", "active_voxel_count"):
        assert getattr(small.info, field) == getattr(volume.info, field)
    for field in ("transform", "index_bounds", "voxel_size"):
        assert np.array_equal(getattr(small.info, field), getattr(volume.info, field))


@pytest.mark.parametrize("codec", [*FIXED, "fpn"])
def test_floats_again_are_what_the_codes_say(codec):
    small = quantize(sphere(20.0), codec, tolerance=0.3)
    floats = quantize(small, "float")
    check_grid(floats.nanovdb, "floats")
    assert floats.info.grid_type == "float"
    assert np.array_equal(voxels_of(floats), voxels_of(small))
    assert floats.info.metadata["geokit:achieved_error"] == small.info.metadata["geokit:achieved_error"]


def test_a_float_grid_as_floats_is_itself():
    volume = sphere(20.0, (-8, 4096, -4096))
    again = quantize(volume, "float")
    assert np.array_equal(again.nanovdb[672:], volume.nanovdb[672:])
    assert again.info.metadata["geokit:achieved_error"] == 0.0


@pytest.mark.parametrize("tolerance", [1e-5, 1e-3, 0.02, 0.5, 10.0])
def test_every_leaf_has_the_fewest_bits_that_keep_the_tolerance(tolerance):
    volume = sphere(20.0)
    if tolerance < 4e-5:
        with pytest.raises(InputError, match="reaches"):
            quantize(volume, "fpn", tolerance=tolerance)
        return
    small = quantize(volume, "fpn", tolerance=tolerance)
    check_grid(small.nanovdb, "fpn")
    assert np.abs(voxels_of(small) - voxels_of(volume)).max() <= tolerance
    assert small.info.metadata["geokit:achieved_error"] <= tolerance == small.info.metadata["geokit:tolerance"]
    source = volume.nanovdb
    begin = 672 + int(tree_header(source)["node_offset"][0])
    for i, at in enumerate(leaf_starts(small)):
        values = source[begin + 2144 * i + 96 : begin + 2144 * (i + 1)].view("<f4").astype(np.float64)
        span = values.max() - values.min()
        bits = 1 << (int(small.nanovdb[at + 15]) >> 5)
        for fewer in (b for b in BITS if b < bits):
            step = span / (2**fewer - 1)
            codes = np.round((values - values.min()) / step)
            assert np.abs(values.min() + step * codes - values).max() > tolerance - DECODING


@pytest.mark.parametrize(("tolerance", "codec"), [(0.21, "fp4"), (0.0118, "fp8"), (5e-5, "fp16"), (0.15, "fpn")])
def test_leaves_of_one_width_become_a_fixed_codec(tolerance, codec):
    rng = np.random.default_rng(0)
    values = rng.uniform(-3, 3, 512)
    values[:2] = -3, 3
    second = values[::-1].copy() if codec != "fpn" else np.full(512, 1.0)
    buffer = build_float_grid(
        np.array([[0, 0, 0], [8, 0, 0]], np.int32), np.float32([values, second]), np.ones((2, 512), bool),
        background=0.0, transform=np.eye(4), name="", grid_class="unknown", signed_fill=False,
    )  # fmt: skip
    small = quantize(SparseVolume(buffer, info_of(buffer)), tolerance=tolerance)
    assert small.info.grid_type == codec


def test_constant_leaves_are_exact_in_one_bit():
    small = quantize(leaf_of(np.full(512, 0.1)), "fpn", tolerance=0.0)
    assert len(small.nanovdb) - leaf_starts(small)[0] == LEAF_HEAD + 64
    assert (voxels_of(small)[9:17, 9:17, 9:17] == np.float32(0.1)).all()


@pytest.mark.parametrize("bits", BITS)
def test_packing_is_as_the_format_says(bits):
    codes = np.random.default_rng(bits).integers(0, 1 << bits, (3, 512)).astype(np.uint16)
    words = [sum(int(code) << bits * n for n, code in enumerate(row)) for row in codes]
    packed = np.stack([np.frombuffer(word.to_bytes(64 * bits, "little"), np.uint8) for word in words])
    assert np.array_equal(unpack(packed, bits), codes)


def test_dithering_keeps_means():
    # A slope that 4 bits cannot follow: rounding shows stairs, dithered voxels average to the slope.
    ramp = np.linspace(0.0, 1.0, 512) * 0.3
    ramp[-1] = 4.0
    volume = leaf_of(ramp)
    means = {}
    for dither in (False, True):
        values = voxels_of(quantize(volume, "fp4", dither=dither))[9:17, 9:17, 9:17]
        exact = ramp.reshape(8, 8, 8)
        # Over pairs of planes: a plane alone has one half of the levels.
        means[dither] = np.abs((values - exact).reshape(4, 128).mean(axis=1)[1:3]).max()
    assert means[True] < 0.25 * means[False]


def test_thresholds_are_spread_over_every_part_of_a_leaf():
    levels = thresholds(True)
    assert np.array_equal(np.sort(levels), np.float32((np.arange(512) + 0.5) / 512))
    cubes = levels.reshape(4, 2, 4, 2, 4, 2).transpose(0, 2, 4, 1, 3, 5).reshape(64, 8)
    # Each cube of eight voxels has one level in each eighth.
    assert np.array_equal(np.sort(np.floor(cubes * 8), axis=1), np.tile(np.arange(8.0), (64, 1)))
    assert (thresholds(False) == 0.5).all()


def test_statistics_are_those_of_the_decoded_active_voxels():
    volume = sphere(20.0, (-70, 5, 400))
    for codec in ("fp4", "fp16", "fpn", "float"):
        small = quantize(volume, codec, tolerance=0.5)
        buffer = small.nanovdb
        box = to_dense(small, device="cpu")
        known = to_dense(volume, device="cpu").values
        active = np.abs(known) < 3.0
        root = 672 + int(tree_header(buffer)["node_offset"][3])
        least, most = buffer[root + 32 : root + 40].view("<f4")
        assert (least, most) == (box.values[active].min(), box.values[active].max())
        assert int(grid_header(buffer)["flags"]) & 4
    for at in leaf_starts(quantize(volume, "fp8")):
        head = quantize(volume, "fp8").nanovdb[at : at + LEAF_HEAD + 512]
        on = np.unpackbits(head[16:80], bitorder="little").astype(bool)
        codes = head[96:][on]
        low, high = head[88:92].view("<u2")
        assert (low, high) == ((codes.min(), codes.max()) if on.any() else (0, 0))
        break


def test_active_tiles_count_in_the_statistics():
    grid = TypedGrid("float")
    buffer = grid.volume.nanovdb
    # The tile of a lower node at (0, 0, 8) becomes active.
    lower = 672 + int(tree_header(buffer)["node_offset"][1])
    buffer[lower + 32] |= 2
    buffer[lower + grid.layout.lower_table + 8 : lower + grid.layout.lower_table + 12] = np.float32([1e3]).view(
        np.uint8
    )
    small = quantize(SparseVolume(buffer, info_of(buffer)), "fp8")
    node = 672 + int(tree_header(small.nanovdb)["node_offset"][1])
    assert small.nanovdb[node + 32 + 1024 + 4 : node + 32 + 1024 + 8].view("<f4")[0] == 1e3


@pytest.mark.parametrize("source", ["double", *QUANTIZED])
@pytest.mark.parametrize("codec", ["float", "fp8", "fpn"])
def test_tiles_and_leaves_of_other_sources(source, codec):
    grid = TypedGrid(source)
    small = quantize(grid.volume, codec, tolerance=50.0 if codec == "fpn" else None)
    check_grid(small.nanovdb, codec)
    box = [[-12, -2, -1], [9, 9, 131]]
    before, after = (to_dense(v, bounds=box, device="cpu").values.astype(np.float64) for v in (grid.volume, small))
    error = small.info.metadata["geokit:achieved_error"]
    assert np.abs(after - before).max() <= error
    tiles = (slice(12, 20), slice(2, 10), slice(9, 17)), (slice(12, None), slice(2, None), slice(129, None))
    for tile in tiles:
        assert np.array_equal(after[tile], before[tile].astype(np.float32))
    root = to_dense(small, bounds=[[4096, 0, 0], [4097, 1, 1]], device="cpu").values
    assert (root == np.float32(grid.root_tile)).all()
    assert small.info.background == np.float32(grid.background)


def test_double_grids_count_what_float_loses():
    grid = TypedGrid("double")
    floats = quantize(grid.volume, "float")
    lost = max(np.abs(v - np.float32(v)).max() for v in (grid.leaves, grid.lower_tile, grid.upper_tile, grid.root_tile))
    assert floats.info.metadata["geokit:achieved_error"] == pytest.approx(lost, rel=1e-12)


def test_errors_and_tolerances_add_up():
    first = quantize(sphere(12.0), "fp8", tolerance=0.1)
    second = quantize(first, "fp4", tolerance=0.3)
    third = quantize(second, "fp4")
    known = [v.info.metadata["geokit:achieved_error"] for v in (first, second, third)]
    assert known[0] < known[1] <= known[2]
    assert second.info.metadata["geokit:tolerance"] == pytest.approx(0.4)
    assert "geokit:tolerance" not in third.info.metadata
    assert np.abs(voxels_of(third) - voxels_of(sphere(12.0))).max() <= known[2]


@pytest.mark.skipif(not native.available(), reason="the OpenVDB extension is not built")
def test_metadata_stays():
    volume = load("data/samples/smoke.vdb", grid="density")
    small = quantize(volume, "fp8")
    assert small.info.metadata["creator"] == volume.info.metadata["creator"]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nanovdb_convert") is None, reason="nanovdb_convert is not installed")
@pytest.mark.skipif(not native.available(), reason="the OpenVDB extension is not built")
@pytest.mark.parametrize("name", ["torus", "smoke"])
@pytest.mark.parametrize(
    ("flags", "codec"), [(["--fp4"], "fp4"), (["--fp8"], "fp8"), (["--fp16"], "fp16"), (["--fpN", "-a", "0.01"], "fpn")]
)
def test_codes_are_those_of_nanovdb_convert(tmp_path, name, flags, codec):
    path = f"data/samples/{name}.vdb"
    done = subprocess.run(["nanovdb_convert", *flags, path, tmp_path / "x.nvdb"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    theirs = next(grid.buffer for grid in read(tmp_path / "x.nvdb") if grid.name != "velocity")
    volume = next(v for v in load_all(path).values() if v.info.name != "velocity")
    ours = quantize(volume, codec, tolerance=np.float32(0.01) if codec == "fpn" else None).nanovdb.copy()
    theirs = theirs.copy()
    assert len(ours) == len(theirs)
    # Theirs are averages and deviations of decoded values; ours those of the values before.
    for buffer in (ours, theirs):
        grid_header(buffer)["checksum"] = 0
        tree = tree_header(buffer)
        root, upper, lower = (672 + int(tree["node_offset"][level]) for level in (3, 2, 1))
        buffer[root + 40 : root + 48] = 0
        for begin, size, count, bits in ((upper, 270400, 2, 8192), (lower, 33856, 1, 1024)):
            for i in range(int(tree["node_count"][count])):
                start = begin + i * size + 32 + bits + 8
                buffer[start : start + 8] = 0
        info = info_of(buffer)
        for at in leaf_starts(SparseVolume(buffer, info)):
            buffer[at + 92 : at + 96] = 0
    assert np.array_equal(ours, theirs)


@pytest.mark.slow
@needs_validate
@pytest.mark.parametrize("file_codec", ["none", "zip", "blosc"])
@pytest.mark.parametrize("codec", ["float", *FIXED, "fpn"])
def test_nanovdb_validate_accepts_every_codec(tmp_path, file_codec, codec):
    volumes = [quantize(v, codec, tolerance=0.5) for v in (sphere(12.0), sphere(40.0, name="large"))]
    save(tmp_path / "x.nvdb", *volumes, codec=file_codec)
    assert_validated(tmp_path / "x.nvdb", 2)
    for volume, again in zip(volumes, load_all(tmp_path / "x.nvdb").values(), strict=True):
        assert np.array_equal(again.nanovdb[672:], volume.nanovdb[672:])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "tolerance: codec None needs one"),
        ({"codec": "fpn"}, "tolerance: codec 'fpn' needs one"),
        ({"codec": "fp3"}, "codec: 'fp3' is not known"),
        ({"codec": "half"}, "codec: 'half' is not known"),
        ({"tolerance": -1.0}, "tolerance: -1.0 is not usable; give a finite number, 0 or more"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"tolerance": "x"}, "tolerance"),
        ({"codec": "fp4", "tolerance": 0.1}, "tolerance: fp4 reaches 0.2"),
        ({"tolerance": 1e-6}, "tolerance: fpn reaches 4.58e-05"),
    ],
)
def test_refused(options, message):
    with pytest.raises(InputError, match=message):
        quantize(sphere(12.0), **options)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("codec", ["fp8", "float"])
def test_values_that_are_not_finite_are_refused(bad, codec):
    values = np.zeros(512)
    values[77] = bad
    with pytest.raises(InputError, match=r"leaf at voxel \[0, 0, 0\]"):
        quantize(leaf_of(values), codec)


def test_ranges_beyond_float32_are_refused():
    values = np.zeros(512)
    values[0], values[1] = -3.0e38, 3.0e38
    with pytest.raises(InputError, match="spread over more"):
        quantize(leaf_of(values), "fp8")


def test_other_types_and_classes_are_refused():
    with pytest.raises(UnsupportedGridError, match="vec3f"):
        quantize(TypedGrid("vec3f").volume, "fp8")
    with pytest.raises(UnsupportedGridError, match="voxel volume"):
        quantize(leaf_of(np.ones(512), grid_class="voxel volume"), "fp8")


@pytest.mark.parametrize("codec", ["float", *FIXED, "fpn", None])
def test_grids_without_leaves_and_read_only_grids(tmp_path, codec):
    empty = build_float_grid(
        np.empty((0, 3), np.int32), np.empty((0, 512), np.float32), np.empty((0, 512), bool),
        background=0.1, transform=np.eye(4), name="empty", grid_class="unknown", signed_fill=False,
    )  # fmt: skip
    save(tmp_path / "x.nvdb", SparseVolume(empty, info_of(empty)), sphere(6.0))
    for volume in load_all(tmp_path / "x.nvdb").values():
        assert not volume.nanovdb.flags.writeable
        small = quantize(volume, codec, tolerance=0.5)
        check_grid(small.nanovdb, "small")
        assert small.info.background == volume.info.background
        assert small.info.active_voxel_count == volume.info.active_voxel_count
        save(tmp_path / "y.nvdb", small)
        if shutil.which("nanovdb_validate"):
            assert_validated(tmp_path / "y.nvdb")
