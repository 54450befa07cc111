"""Operations towards their limits: tiny and huge voxels, far away, narrow bands, thin and missing bodies."""

from __future__ import annotations

import numpy as np
import pytest

from geokit import native
from geokit.volume._components import segment
from geokit.volume._csg import difference, intersection, union
from geokit.volume._differential import gradient_field
from geokit.volume._filters import smooth
from geokit.volume._morphology import closing, erode, offset, opening, renormalize
from geokit.volume._resample import resample
from geokit.volume._statistics import statistics
from geokit.volume._topology import clip, prune
from tests.support.analytic_volumes import active_voxels, ball, cubes, dense, field, level_set

pytestmark = [
    pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB"),
    pytest.mark.filterwarnings("ignore:.*nothing of grid:UserWarning"),
]

BALL = ball(8.3, (0.3, 0.2, -0.1))


def scaled(size, origin=0.0):
    transform = cubes(size)
    transform[:3, 3] = origin
    center = tuple(origin + size * np.array([0.3, 0.2, -0.1]))
    return level_set(ball(8.3 * size, center), transform=transform, dtype=np.float64, leaves=2), ball(
        8.3 * size, center
    )


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-6, 1e-4, 1.0, 1e3, 1e6])
def test_voxel_sizes(size):
    body, distance = scaled(size)
    for result, moved in ((renormalize(body), 0.0), (offset(body, 1.5 * size), 1.5), (erode(body, 2.0 * size), -2.0)):
        points, values = active_voxels(result)
        assert np.abs(values / size - (distance(points) / size - moved)).max() < 0.05
        np.testing.assert_array_equal(result.info.transform, body.info.transform)
        assert result.info.background == pytest.approx(3.0 * size)
    assert union(body, body).info.active_voxel_count == body.info.active_voxel_count
    assert len(segment(body)) == 1
    assert clip(body, [[-3 * size] * 3, [3 * size] * 3]).info.index_bounds is not None
    points, values = active_voxels(resample(body, voxel_size=1.3 * size, device="cpu"))
    assert np.abs(values - distance(points)).max() < 0.15 * size
    slope = gradient_field(body, device="cpu")
    points, values = active_voxels(slope)
    inner = np.abs(distance(points)) < 1.9 * size
    assert np.abs(np.linalg.norm(values[inner], axis=1) - 1.0).max() < 0.02


@pytest.mark.parametrize("origin", [1e3, 1e6, 1e9])
def test_far_from_the_origin(origin):
    body, distance = scaled(0.5, origin)
    points, values = active_voxels(offset(body, 0.5))
    # Points near 1e9 are rounded to 1e-7.
    assert np.abs(values - (distance(points) - 0.5)).max() < 0.025 + 1e-15 * origin
    np.testing.assert_array_equal(offset(body, 0.5).info.transform, body.info.transform)


@pytest.mark.slow
@pytest.mark.parametrize(("half_width", "error"), [(1.0, 0.12), (1.5, 0.12), (2.0, 0.05), (8.0, 0.05)])
def test_band_widths(half_width, error):
    body = level_set(BALL, half_width=half_width)
    points, values = active_voxels(renormalize(body, half_width=3.0))
    assert np.abs(values - BALL(points)).max() < error
    points, values = active_voxels(offset(body, 0.5))
    assert np.abs(values - (BALL(points) - 0.5)).max() < error + 0.05


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.6, 1.2, 2.4, 4.8])
def test_small_bodies(radius):
    body = level_set(ball(radius, (0.3, 0.2, -0.1)))
    result = renormalize(body)
    np.testing.assert_array_equal(dense(result, -8, 8) < 0, dense(body, -8, 8) < 0)
    gone = erode(body, radius + 1.0)
    assert gone.info.active_voxel_count == 0
    assert (dense(gone, -8, 8) > 0).all()


@pytest.mark.parametrize("thickness", [0.5, 1.0, 2.0, 4.0])
def test_thin_walls(thickness):
    wall = lambda p: np.abs(BALL(p)) - thickness / 2.0  # noqa: E731
    body = level_set(wall)
    before = dense(body, -16, 16)
    after = dense(renormalize(body), -16, 16)
    np.testing.assert_array_equal(before < 0, after < 0)
    assert np.isfinite(after).all()


def test_without_a_surface():
    empty = erode(level_set(ball(4.3)), 6.0)
    body = level_set(BALL)
    for nothing in (
        renormalize(empty), offset(empty, 1.0), opening(empty, 1.0), closing(empty, 1.0), smooth(empty), prune(empty),
        clip(empty, [[0] * 3, [1] * 3]), intersection(empty, body), intersection(body, empty), difference(empty, body),
        resample(empty, voxel_size=0.5, device="cpu"), gradient_field(empty, device="cpu"),
    ):  # fmt: skip
        assert nothing.info.active_voxel_count == 0
    for whole in (union(empty, body), union(body, empty), difference(body, empty)):
        np.testing.assert_array_equal(dense(whole, -14, 14), dense(body, -14, 14))
    assert segment(empty) == []
    assert statistics(empty).count == 0


def test_one_voxel():
    source = clip(field(lambda p: np.full(len(p), 4.0)), [[-0.4] * 3, [0.4] * 3])
    assert source.info.active_voxel_count == 1
    assert statistics(source)[:5] == (1, 4.0, 4.0, 4.0, 0.0)
    assert len(segment(source)) == 1
    assert resample(source, voxel_size=0.5, device="cpu").info.active_voxel_count == 8
    _, values = active_voxels(gradient_field(source, device="cpu"))
    assert values.tolist() == [[0.0, 0.0, 0.0]]


def test_values_that_are_not_finite_do_not_hang_or_spread_far():
    def broken(points):
        values = BALL(points)
        values[np.linalg.norm(points - np.array([8.0, 0.0, 0.0]), axis=1) < 0.5] = np.nan
        return values

    body = level_set(BALL, values=broken)
    values = dense(renormalize(body), -14, 14)
    steps = np.arange(-14, 14, dtype=float)
    points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.linalg.norm(points - np.array([8.0, 0.0, 0.0]), axis=1) > 10.0
    assert np.abs(values.ravel()[away] - np.clip(BALL(points[away]), -3.0, 3.0)).max() < 0.05
