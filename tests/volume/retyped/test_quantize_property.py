"""Whatever values: no voxel is off by more than the metadata says, and no sample between them either."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.catalog.float_grids import build_float_grid
from geokit.errors import InputError
from geokit.volume._dense import to_dense
from geokit.volume.at_points.sample import sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import info_of
from geokit.volume.retyped.quantize import quantize
from tests.support.effort import of_all

SETTINGS = settings(max_examples=of_all(20, 40), deadline=None, suppress_health_check=[HealthCheck.too_slow])
CODECS = ["fp4", "fp8", "fp16"]


@st.composite
def volumes(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    cells = 8 * np.unique(rng.integers(-2, 3, (draw(st.integers(1, 8)), 3)), axis=0).astype(np.int32)
    scale = 10.0 ** draw(st.integers(-20, 20))
    offset = draw(st.sampled_from([0.0, 1.0, -1e3])) * scale
    values = (rng.standard_normal((len(cells), 512)) * scale + offset).astype(np.float32)
    if draw(st.booleans()):
        values = np.round(values / np.float32(scale)) * np.float32(scale)
    masks = rng.random((len(cells), 512)) < draw(st.sampled_from([0.01, 0.5, 1.0]))
    masks[0, 0] = True
    buffer = build_float_grid(
        cells, values, masks, background=float(np.float32(offset)), transform=np.eye(4), name="", grid_class="unknown",
        signed_fill=False,
    )  # fmt: skip
    return SparseVolume(buffer, info_of(buffer))


def box_of(volume: SparseVolume) -> np.ndarray:
    return volume.info.index_bounds // 8 * 8 + np.array([[-8], [15]])


@pytest.mark.slow
@SETTINGS
@given(volumes(), st.sampled_from(CODECS), st.booleans())
def test_error_is_what_the_metadata_says(volume, codec, dither):
    kept = volume.nanovdb.copy()
    small = quantize(volume, codec, dither=dither)
    assert np.array_equal(volume.nanovdb, kept)
    check_grid(small.nanovdb, codec)
    before, after = (to_dense(v, bounds=box_of(volume), device="cpu").values.astype(float) for v in (volume, small))
    error = np.abs(after - before).max()
    known = small.info.metadata["geokit:achieved_error"]
    # The readers' way of rounding is one of the two that were measured: one of them may be a little larger.
    assert error <= known <= error + 2.0**-22 * np.abs(before).max()
    span = np.ptp(before)
    steps = 2 ** int(codec[2:]) - 1
    assert known <= span / steps * (1.0 if dither else 0.5) + 2.0**-22 * (np.abs(before).max() + span)


@pytest.mark.slow
@SETTINGS
@given(volumes(), st.floats(1e-5, 1.0), st.booleans())
def test_tolerance_is_kept_or_refused(volume, fraction, dither):
    before = to_dense(volume, bounds=box_of(volume), device="cpu").values.astype(float)
    tolerance = fraction * float(np.ptp(before))
    try:
        small = quantize(volume, tolerance=tolerance, dither=dither)
    except InputError:
        # 16 bits reach half a step of 1/65535 of the span, or what float32 makes of the values.
        assert tolerance < np.ptp(before) / 65535 * (1.0 if dither else 0.5) + 2.0**-22 * np.abs(before).max()
        return
    check_grid(small.nanovdb, "small")
    after = to_dense(small, bounds=box_of(volume), device="cpu").values.astype(float)
    assert np.abs(after - before).max() <= small.info.metadata["geokit:achieved_error"] <= tolerance
    assert small.info.byte_count < volume.info.byte_count
    for codec in CODECS:
        try:
            other = quantize(volume, codec, tolerance=tolerance, dither=dither)
        except InputError:
            continue
        assert small.info.byte_count <= other.info.byte_count


@pytest.mark.slow
@SETTINGS
@given(volumes(), st.sampled_from(CODECS))
def test_samples_between_voxels_are_off_by_no_more(volume, codec):
    small = quantize(volume, codec)
    lower, upper = box_of(volume)
    points = np.random.default_rng(0).uniform(lower, upper, (500, 3))
    before, after = (sample(v, points, device="cpu") for v in (volume, small))
    # Interpolation in float64 rounds values up to 1e3 scales seven times.
    rounding = 1e-14 * np.abs(before).max()
    assert np.abs(after - before).max() <= small.info.metadata["geokit:achieved_error"] + rounding


@pytest.mark.slow
@SETTINGS
@given(volumes(), st.sampled_from([*CODECS, "fpn"]))
def test_coding_codes_again_changes_next_to_nothing(volume, codec):
    span = float(np.ptp(to_dense(volume, bounds=box_of(volume), device="cpu").values.astype(float)))
    small = quantize(volume, codec, tolerance=span if codec == "fpn" else None)
    floats = quantize(small, "float")
    again = quantize(floats, codec, tolerance=span if codec == "fpn" else None)
    first, second = (to_dense(v, bounds=box_of(volume), device="cpu").values.astype(float) for v in (small, again))
    # The same extrema give the same steps; float32 rounds twice each time.
    np.testing.assert_allclose(second, first, rtol=0, atol=2.0**-21 * max(np.abs(first).max(), span))
