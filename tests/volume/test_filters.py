"""Smoothing: what each filter does to a body, to a field and to noise."""

from __future__ import annotations

import numpy as np
import pytest

from geokit import native
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._filters import FIELD_METHODS, LEVEL_SET_METHODS, smooth
from geokit.volume._statistics import statistics
from tests.support.analytic_volumes import SHEARED, active_voxels, ball, cubes, dense, field, level_set
from tests.support.effort import of_all

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

BALL = ball(10.3, (0.3, 0.2, -0.1))


def bumpy(points):
    """A ball with bumps of 0.6 voxels; close to a distance."""
    return BALL(points) + 0.3 * np.sin(2.0 * points[:, 0]) * np.sin(2.0 * points[:, 1]) * np.sin(2.0 * points[:, 2])


@pytest.mark.parametrize("method", LEVEL_SET_METHODS)
class TestLevelSets:
    @pytest.mark.slow
    def test_volume_is_roughly_kept(self, method):
        before, after = level_set(BALL), smooth(level_set(BALL), method)
        assert statistics(after).volume == pytest.approx(statistics(before).volume, rel=0.08)
        assert (after.info.grid_class, after.info.background) == ("level set", 3.0)
        assert after.info.metadata == {"author": "tests"}

    @pytest.mark.slow
    def test_bumps_become_lower(self, method):
        before = level_set(BALL, values=bumpy)
        after = smooth(before, method, iterations=2)

        def roughness(volume):
            points, values = active_voxels(volume)
            near = np.abs(values) < 1.0
            return np.std((values - BALL(points))[near])

        assert roughness(after) < 0.8 * roughness(before)

    @pytest.mark.slow
    def test_every_voxel_is_finite_and_on_its_side(self, method):
        values = dense(smooth(level_set(BALL), method, iterations=3), -16, 16)
        assert np.isfinite(values).all()
        assert np.abs(values).max() <= 3.0
        steps = np.arange(-16, 16, dtype=float)
        true = BALL(np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3))
        # Three steps move the surface of a ball of ten voxels by less than two.
        clear = np.abs(true) > 2.0
        np.testing.assert_array_equal(values.ravel()[clear] < 0, true[clear] < 0)

    @pytest.mark.slow
    @pytest.mark.parametrize("size", of_all([1e-3], [1e-3, 50.0]))
    def test_voxel_size_only_scales(self, method, size):
        unit = smooth(level_set(BALL), method)
        scaled = smooth(
            level_set(ball(10.3 * size, (0.3 * size, 0.2 * size, -0.1 * size)), transform=cubes(size)), method
        )
        difference = dense(scaled, -16, 16) / size - dense(unit, -16, 16)
        # Values are rounded once more; where a voxel is at the band's very end it may fall to either side.
        assert np.quantile(np.abs(difference), 0.999) < 1e-4
        assert scaled.info.background == pytest.approx(3.0 * size)


@pytest.mark.parametrize("method", FIELD_METHODS)
def test_fields_lose_noise_and_keep_constants(method):
    rng = np.random.default_rng(3)
    noise = field(lambda p: rng.normal(size=len(p)))
    before, after = dense(noise, -8, 8), dense(smooth(noise, method), -8, 8)
    assert after.std() < 0.5 * before.std()
    constant = field(lambda p: np.full(len(p), 2.5))
    np.testing.assert_allclose(dense(smooth(constant, method), -8, 8), 2.5, rtol=1e-6)


def test_mean_of_a_cube():
    noise = field(lambda p: np.sin(p[:, 0] ** 2 + 3.0 * p[:, 1] + p[:, 2] * p[:, 0]))
    before = dense(noise, -8, 8)
    after = dense(smooth(noise, "mean", width=1), -8, 8)
    windows = np.lib.stride_tricks.sliding_window_view(before, (3, 3, 3)).mean(axis=(3, 4, 5))
    np.testing.assert_allclose(after[1:-1, 1:-1, 1:-1], windows, atol=1e-6)


def test_every_run_gives_the_same_bytes():
    # Values of all magnitudes: any other order of the sums behind the averages of nodes rounds otherwise.
    rng = np.random.default_rng(5)
    noise = field(lambda p: rng.normal(size=len(p)) * 10.0 ** rng.uniform(-6, 6, len(p)), leaves=4, dtype=np.float64)
    first = smooth(noise, "mean").nanovdb
    for _ in range(10):
        np.testing.assert_array_equal(smooth(noise, "mean").nanovdb, first)


def test_operand_is_not_changed():
    body = level_set(BALL)
    before = body.nanovdb.copy()
    smooth(body)
    np.testing.assert_array_equal(body.nanovdb, before)


class TestRefusals:
    def test_method(self):
        with pytest.raises(InputError, match="'blur' does not smooth a level set"):
            smooth(level_set(BALL), "blur")
        with pytest.raises(InputError, match="'mean_curvature' does not smooth a grid of class unknown"):
            smooth(field(BALL), "mean_curvature")

    @pytest.mark.parametrize("value", [0, -1, 1.5, True, 10**6])
    @pytest.mark.parametrize("name", ["width", "iterations"])
    def test_counts(self, name, value):
        with pytest.raises(InputError, match=name):
            smooth(level_set(BALL), **{name: value})

    def test_volume(self):
        with pytest.raises(InputError, match="not a SparseVolume"):
            smooth(3)
        with pytest.raises(InputError, match="not cubes"):
            smooth(level_set(BALL, transform=SHEARED))
        with pytest.raises(UnsupportedGridError, match="type vec3f"):
            smooth(field(lambda p: p, background=np.zeros(3)))
