"""Quantization towards its limits: scales, offsets that eat the bits, subnormal ranges, and gradients of level sets."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.sphere_volumes import sphere
from geokit.errors import InputError
from geokit.volume._dense import to_dense
from geokit.volume.at_points.sample import gradient
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import info_of
from geokit.volume.retyped.quantize import quantize


def leaf(values: np.ndarray) -> SparseVolume:
    buffer = build_float_grid(
        np.zeros((1, 3), np.int32), np.float32(values).reshape(1, 512), np.ones((1, 512), bool),
        background=0.0, transform=np.eye(4), name="", grid_class="unknown", signed_fill=False,
    )  # fmt: skip
    return SparseVolume(buffer, info_of(buffer))


def errors(volume: SparseVolume, small: SparseVolume) -> float:
    box = [[0, 0, 0], [7, 7, 7]]
    return float(np.abs(to_dense(small, bounds=box).values.astype(float) - to_dense(volume, bounds=box).values).max())


@pytest.mark.parametrize("codec", ["fp4", "fp8", "fp16"])
@pytest.mark.parametrize("scale", [1e-37, 1e-30, 1e-6, 1.0, 1e6, 1e30, 1.6e38])
def test_error_scales_with_the_range(codec, scale):
    volume = leaf(scale * np.random.default_rng(0).uniform(-1, 1, 512))
    small = quantize(volume, codec)
    check_grid(small.nanovdb, codec)
    error = small.info.metadata["geokit:achieved_error"]
    assert errors(volume, small) <= error
    steps = 2 ** int(codec[2:]) - 1
    # The step is a float32: where it is subnormal, its rounding counts once for each code.
    assert error <= 1.0001 * scale / steps + 2.0**-23 * scale + 2.0**-150 * steps


@pytest.mark.parametrize("offset", [0.0, 1.0, 1e3, 1e6, 1e9])
def test_offsets_cost_what_float32_costs(offset):
    volume = leaf(offset + np.random.default_rng(1).uniform(0, 1, 512))
    small = quantize(volume, "fp16")
    error = small.info.metadata["geokit:achieved_error"]
    assert errors(volume, small) <= error <= 0.5 / 65535 + 2.0 * np.spacing(np.float32(offset + 1.0))


@pytest.mark.parametrize("exponent", range(-149, -120, 4))
def test_subnormal_ranges_are_measured(exponent):
    # Steps below 2^-149 do not exist: the error grows to the range, and the metadata knows.
    values = np.random.default_rng(2).integers(0, 9, 512) * 2.0**exponent
    volume = leaf(values)
    for codec in ("fp4", "fp8", "fp16"):
        small = quantize(volume, codec)
        check_grid(small.nanovdb, codec)
        assert errors(volume, small) <= small.info.metadata["geokit:achieved_error"] <= 8.0 * 2.0**exponent
    with pytest.raises(InputError, match="reaches"):
        quantize(leaf(np.arange(512) * 2.0**-149), tolerance=0.0)


@pytest.mark.parametrize("tolerance", [0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 1e-4])
def test_size_falls_with_the_tolerance_and_gradients_keep_to_it(tolerance):
    volume = sphere(30.0)
    small = quantize(volume, tolerance=tolerance)
    rng = np.random.default_rng(3)
    direction = rng.standard_normal((2000, 3))
    points = 30.0 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    difference = np.abs(gradient(small, points, device="cpu") - gradient(volume, points, device="cpu")).max()
    # Each component is a mean of differences of two voxels.
    assert difference <= 2.0 * small.info.metadata["geokit:achieved_error"] + 1e-6
    assert small.info.byte_count < volume.info.byte_count
    if tolerance < 0.1:
        assert quantize(volume, tolerance=3.0 * tolerance).info.byte_count <= small.info.byte_count


def test_many_leaves_of_many_widths():
    rng = np.random.default_rng(4)
    count = 700  # more than two blocks of leaves
    cells = 8 * np.stack(np.unravel_index(rng.permutation(16**3)[:count], (16, 16, 16)), axis=1).astype(np.int32)
    values = (rng.standard_normal((count, 512)) * 10.0 ** rng.uniform(-6, 0, (count, 1))).astype(np.float32)
    buffer = build_float_grid(
        cells, values, rng.random((count, 512)) < 0.5, background=0.0, transform=np.eye(4), name="",
        grid_class="unknown", signed_fill=False,
    )  # fmt: skip
    volume = SparseVolume(buffer, info_of(buffer))
    small = quantize(volume, tolerance=1e-3)
    check_grid(small.nanovdb, "many")
    assert small.info.grid_type == "fpn"
    box = [[0, 0, 0], [127, 127, 127]]
    error = np.abs(to_dense(small, bounds=box).values.astype(float) - to_dense(volume, bounds=box).values).max()
    assert error <= small.info.metadata["geokit:achieved_error"] <= 1e-3
