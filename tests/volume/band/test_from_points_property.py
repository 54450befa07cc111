"""Whatever balls: the level set is the brute-force one, in whatever order they come, and moves with them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from geokit.volume._dense import to_dense
from geokit.volume._from_points import from_points
from tests.support.effort import of_all
from tests.support.reference import union_of_balls

pytestmark = pytest.mark.slow

SETTINGS = settings(max_examples=of_all(20, 40), deadline=None, suppress_health_check=[HealthCheck.too_slow])
# One rounding to float32 of values up to the band, and of coordinates below 2000 voxels in float64.
ROUNDING = 7.0e-8


@st.composite
def balls(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.integers(1, 40))
    spread = draw(st.sampled_from([0.5, 6.0, 60.0]))
    points = rng.uniform(-spread, spread, (count, 3)) + rng.uniform(-1000, 1000, 3)
    widest = draw(st.sampled_from([1.0, 5.0, 30.0]))
    return points, widest * rng.uniform(0.02, 1.0, count) if draw(st.booleans()) else np.full(count, widest)


@SETTINGS
@given(balls(), st.floats(1.0, 6.0))
def test_brute_force(given_balls, half_width):
    points, radii = given_balls
    kept = points.copy(), radii.copy()
    volume = from_points(points, radii, voxel_size=1.0, half_width=half_width, device="cpu")
    assert all(np.array_equal(a, b) for a, b in zip(kept, (points, radii), strict=True))
    rng = np.random.default_rng(0)
    # Voxels near the surface of some ball, and anywhere in its inside.
    nearest = rng.integers(0, len(points), 3000)
    direction = rng.standard_normal((3000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    reach = np.maximum(radii[nearest] + rng.normal(0, half_width, 3000), 0.0) * rng.choice([1.0, 0.5], 3000)
    voxels = np.round(points[nearest] + direction * reach[:, None])
    found = volume.sample(voxels, order=0, device="cpu")
    exact = np.clip(union_of_balls(voxels, points, radii), -half_width, half_width)
    np.testing.assert_allclose(found, exact, rtol=0, atol=ROUNDING * half_width)


@SETTINGS
@given(balls())
def test_order_does_not_matter(given_balls):
    points, radii = given_balls
    shuffle = np.random.default_rng(1).permutation(len(points))
    volume = from_points(points, radii, voxel_size=1.0, device="cpu")
    again = from_points(points[shuffle], radii[shuffle], voxel_size=1.0, device="cpu")
    assert np.array_equal(volume.nanovdb, again.nanovdb)


@SETTINGS
@given(balls(), st.tuples(*[st.integers(-50, 50)] * 3))
def test_whole_voxels_move_the_values(given_balls, shift):
    # Coordinates in steps of 2^-10 below 2^11 are exact, moved or not: so are the distances' arguments.
    points, radii = np.round(given_balls[0] * 1024) / 1024, given_balls[1]
    volume = from_points(points, radii, voxel_size=1.0, device="cpu")
    moved = from_points(points + shift, radii, voxel_size=1.0, device="cpu")
    bounds = volume.info.index_bounds
    if bounds is None:
        assert moved.info.index_bounds is None
        return
    box = np.stack([bounds[0], np.minimum(bounds[1], bounds[0] + 40)])
    first, second = (to_dense(v, bounds=b, device="cpu").values for v, b in ((volume, box), (moved, box + shift)))
    assert np.array_equal(first, second)
    assert volume.info.active_voxel_count == moved.info.active_voxel_count
