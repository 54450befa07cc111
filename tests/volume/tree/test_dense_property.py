"""Whatever array: what to_dense gives of from_dense is the array again, and its place in the index space is kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from geokit.volume._dense import from_dense, to_dense
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.tree.typed_tree import VALUE_TYPES
from tests.support.effort import of_all

pytestmark = pytest.mark.slow

SETTINGS = settings(max_examples=of_all(20, 40), deadline=None, suppress_health_check=[HealthCheck.too_slow])
START = st.one_of(st.integers(-300, 300), st.sampled_from([-(2**31), 2**31 - 40, -4097, 4090]))


@st.composite
def arrays(draw):
    shape = tuple(draw(st.integers(1, 33)) for _ in range(3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    values = rng.choice(np.float32([2.0, -2.0, 0.5, -0.25, 1.5, 3.0]), shape, p=rng.dirichlet(np.full(6, 0.3)))
    # Regions of one value, so that there are tiles.
    values[rng.integers(shape[0]) :] = rng.choice(np.float32([2.0, -2.0, 1.0]))
    return values, tuple(draw(START) for _ in range(3))


@SETTINGS
@given(arrays(), st.sampled_from(["unknown", "level set", "fog volume"]), st.sampled_from([0.0, 0.6]))
def test_round_trip(array, grid_class, tolerance):
    values, origin = array
    volume = from_dense(
        values, voxel_size=0.5, origin=origin, background=2.0, tolerance=tolerance, grid_class=grid_class
    )
    check_grid(volume.nanovdb, "dense")
    last = np.array(origin) + values.shape - 1
    dense = to_dense(volume, bounds=[origin, last], device="cpu")
    level = np.abs(values) if grid_class == "level set" else values
    inactive = np.abs(level - np.float32(2.0)) <= tolerance
    resting = np.copysign(np.float32(2.0), values) if grid_class == "level set" else np.float32(2.0)
    assert np.array_equal(dense.values, np.where(inactive, resting, values))
    assert volume.info.active_voxel_count == (~inactive).sum()
    around = np.clip([np.array(origin) - 9, last + 9], -(2**31), 2**31 - 1)
    wide = to_dense(volume, bounds=around, device="cpu").values
    inside = tuple(slice(o - a, o - a + n) for o, a, n in zip(origin, around[0], values.shape, strict=True))
    assert np.array_equal(wide[inside], dense.values)
    wide[inside] = 2.0
    assert (wide == 2.0).all()


@SETTINGS
@given(st.sampled_from(VALUE_TYPES), arrays(), st.sampled_from([0.0, 0.4, 1.0]))
def test_round_trip_of_every_type(grid_type, array, tolerance):
    kind = LAYOUTS[grid_type].background
    numbers, origin = array
    scale = 1 if kind.base.kind == "f" else 4
    values = np.abs(numbers * scale) if kind.base.kind in "ub" else numbers * scale
    values = values > 2 if kind.base.kind == "b" else values
    if kind.shape:
        values = np.stack([values, *(kind.shape[0] - 1) * [np.roll(values, 1, axis=2)]], axis=-1)
    values = values.astype(kind.base)
    background = np.asarray(False if kind.base.kind == "b" else 2 * scale, kind.base)
    volume = from_dense(
        values, voxel_size=0.5, origin=origin, background=background, tolerance=tolerance, grid_type=grid_type
    )
    check_grid(volume.nanovdb, "dense")
    dense = to_dense(volume, bounds=[origin, np.array(origin) + values.shape[:3] - 1], device="cpu")
    active = np.abs(values.astype(float) - float(background)) > tolerance
    active = active.any(axis=-1) if kind.shape else active
    expected = values.copy()
    expected[~active] = background
    assert np.array_equal(dense.values, expected)
    assert dense.values.dtype == values.dtype
    assert volume.info.active_voxel_count == active.sum()
