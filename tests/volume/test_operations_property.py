"""What must hold for any operands of operations on volumes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geokit import native
from geokit.volume._components import segment
from geokit.volume._csg import difference, intersection, union
from geokit.volume._morphology import offset, renormalize
from geokit.volume._resample import resample
from geokit.volume._topology import clip, prune
from tests.support.analytic_volumes import active_voxels, ball, cubes, dense, field, level_set
from tests.support.effort import of_all

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

EXAMPLES = settings(max_examples=of_all(4, 8), deadline=None)
centers = st.tuples(*3 * [st.floats(-6.0, 6.0)])
radii = st.floats(4.0, 8.0)
bodies = st.builds(ball, radii, centers)


@pytest.mark.slow
@EXAMPLES
@given(bodies, bodies)
def test_csg_is_an_algebra_of_sets(first, second):
    a, b = level_set(first, leaves=3), level_set(second, leaves=3)
    before = a.nanovdb.copy(), b.nanovdb.copy()
    here = {"lower": -16, "upper": 16}
    joined, common, rest = union(a, b), intersection(a, b), difference(a, b)
    np.testing.assert_array_equal(dense(joined, **here), dense(union(b, a), **here))
    np.testing.assert_array_equal(dense(common, **here), dense(intersection(b, a), **here))
    np.testing.assert_array_equal(dense(union(a, a), **here), dense(a, **here))
    # Inclusion and exclusion, per voxel.
    inside = [dense(volume, **here) < 0 for volume in (a, b, joined, common, rest)]
    np.testing.assert_array_equal(inside[2], inside[0] | inside[1])
    np.testing.assert_array_equal(inside[3], inside[0] & inside[1])
    # Voxels on b's surface belong to b, not to what it is taken from.
    surface = dense(b, **here) == 0
    np.testing.assert_array_equal(inside[4][~surface], (inside[0] & ~inside[1])[~surface])
    np.testing.assert_array_equal(a.nanovdb, before[0])
    np.testing.assert_array_equal(b.nanovdb, before[1])


@pytest.mark.slow
@EXAMPLES
@given(bodies, st.tuples(*3 * [st.integers(-5, 5)]))
def test_results_do_not_depend_on_where_leaves_begin(body, shift):
    step = np.array(shift)
    moved = renormalize(level_set(lambda p: 1.3 * body(p - step) / 1.3, values=lambda p: 1.3 * body(p - step)))
    still = renormalize(level_set(body, values=lambda p: 1.3 * body(p)))
    first = dense(still, -10, 10)
    points = np.stack(np.meshgrid(*3 * [np.arange(-10, 10)], indexing="ij"), axis=-1).reshape(-1, 3) + step
    second = np.asarray(moved.sample(points.astype(float), order=0, device="cpu")).reshape(first.shape)
    # The same arithmetic on values that differ by the rounding of the shifted points; sweeps go the same ways.
    assert np.quantile(np.abs(first - second), 0.999) < 1e-4


@pytest.mark.slow
@EXAMPLES
@given(bodies, st.floats(-1.5, 1.5))
def test_offset_moves_every_ball(body, distance):
    points, values = active_voxels(offset(level_set(body), distance))
    # Radii down to 2.5 voxels: coarser than what the docstring speaks of.
    near = np.abs(values) < 1.0
    assert np.abs(values - (body(points) - distance))[near].max() < 0.1


@EXAMPLES
@given(st.integers(0, 2**31), st.floats(0.0, 0.5))
def test_pruning_keeps_values_to_the_tolerance_and_states(seed, tolerance):
    rng = np.random.default_rng(seed)
    levels = rng.integers(0, 3, 64)
    source = field(lambda p: np.repeat(levels, 512) + rng.uniform(-0.3, 0.3, len(p)) * rng.integers(0, 2))
    result = prune(source, tolerance)
    assert np.abs(dense(result, -16, 16) - dense(source, -16, 16)).max() <= tolerance
    assert result.info.active_voxel_count == source.info.active_voxel_count
    np.testing.assert_array_equal(result.info.index_bounds, source.info.index_bounds)


@EXAMPLES
@given(st.lists(st.floats(-18.0, 18.0), min_size=6, max_size=6))
def test_clipping_twice_is_clipping_once(ends):
    bounds = np.sort(np.array(ends).reshape(2, 3), axis=0)
    once = clip(field(lambda p: p[:, 0]), bounds)
    twice = clip(once, bounds)
    np.testing.assert_array_equal(dense(once, -18, 18), dense(twice, -18, 18))
    assert once.info.active_voxel_count == twice.info.active_voxel_count


@pytest.mark.slow
@EXAMPLES
@given(st.tuples(*3 * [st.floats(-3.0, 3.0)]), st.floats(0.4, 2.5))
def test_resampling_reproduces_planes(slope, size):
    plane = lambda p: p @ np.array(slope) + 1.0  # noqa: E731
    source = field(plane, dtype=np.float64)
    points, values = active_voxels(resample(source, transform=cubes(size), device="cpu"))
    kept = (np.abs(points + 0.5) < 15.0).all(axis=1)
    assert np.abs(values - plane(points))[kept].max() < 1e-12


@pytest.mark.slow
@EXAMPLES
@given(st.integers(1, 4))
def test_components_are_counted_and_make_up_the_whole(count):
    spots = [(-14.0, -14.0, -14.0), (14.0, 14.0, 14.0), (-14.0, 14.0, 0.0), (14.0, -14.0, 0.0)][:count]
    whole = level_set(ball(4.5, spots[0]))
    for spot in spots[1:]:
        whole = union(whole, level_set(ball(4.5, spot)))
    parts = segment(whole)
    assert len(parts) == count
    assert sum(part.info.active_voxel_count for part in parts) == whole.info.active_voxel_count
    together = np.min([dense(part, -20, 20) for part in parts], axis=0)
    np.testing.assert_array_equal(together, dense(whole, -20, 20))
