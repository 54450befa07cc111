"""Whatever shape of spheres and planes, box and voxel size: the level set is what dense evaluation gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from geokit.volume._dense import to_dense
from geokit.volume._from_function import from_function
from geokit.volume.nanovdb.checks import check_grid
from tests.support.effort import of_all

pytestmark = pytest.mark.slow

SETTINGS = settings(max_examples=of_all(20, 40), deadline=None, suppress_health_check=[HealthCheck.too_slow])


def solid(seed: int):
    """Unions, intersections and complements of balls and half-spaces: slopes up to 1."""
    rng = np.random.default_rng(seed)
    center, radius = rng.uniform(-1, 1, (4, 3)), rng.uniform(0.1, 1.2, 4)
    normal = rng.standard_normal(3)
    normal /= np.linalg.norm(normal)
    offset, sign = rng.uniform(-1, 1), rng.choice([-1.0, 1.0])

    def function(points):
        balls = [np.linalg.norm(points - c, axis=1) - r for c, r in zip(center, radius, strict=True)]
        return sign * np.maximum(np.minimum(np.minimum(balls[0], balls[1]), balls[2]), points @ normal - offset)

    return function


@SETTINGS
@given(st.integers(0, 2**32), st.floats(0.05, 0.4), st.floats(1.0, 6.0), st.floats(1.0, 2.0))
def test_as_dense_evaluation(seed, voxel_size, half_width, lipschitz):
    function = solid(seed)
    rng = np.random.default_rng(seed)
    lower, size = rng.uniform(-2, 0.5, 3), rng.uniform(0.3, 2.5, 3)
    bounds = np.stack([lower, lower + size])
    half_width = max(half_width, lipschitz)
    volume = from_function(function, bounds, voxel_size, lipschitz=lipschitz, half_width=half_width)
    check_grid(volume.nanovdb, "function")
    first = np.floor(lower / voxel_size).astype(int) - 10
    last = np.ceil(bounds[1] / voxel_size).astype(int) + 10
    dense = to_dense(volume, bounds=[first, last], device="cpu").values
    points = (first + np.stack(np.meshgrid(*(np.arange(n) for n in dense.shape), indexing="ij"), axis=-1)) * voxel_size
    exact = function(points.reshape(-1, 3)).reshape(dense.shape)
    # The bounds in whole voxels, as the function divides them.
    index = np.round(points / voxel_size)
    within = ((index >= np.ceil(bounds[0] / voxel_size)) & (index <= np.floor(bounds[1] / voxel_size))).all(axis=-1)
    band = half_width * voxel_size
    expected = np.where(within, np.where(np.abs(exact) < band, exact, np.copysign(band, exact)), band)
    assert np.array_equal(dense, expected.astype(np.float32))
    assert volume.info.active_voxel_count == (within & (np.abs(exact) < band)).sum()
