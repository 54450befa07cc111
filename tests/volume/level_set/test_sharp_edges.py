"""Erosion, dilation, opening and closing of bodies with sharp edges, against distances in closed form."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from geokit import native
from geokit.volume._morphology import closing, dilate, erode, offset, opening
from tests.support.analytic_volumes import TURNED, active_voxels, ball, level_set
from tests.support.edged_bodies import cuboid, polygon, revolved, turned

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

HALF = np.array([12.0, 10.5, 9.3])
ODD = ((0.31, 0.47, 0.73), (0.3, 0.2, -0.1))
# What the docstrings promise, in voxels.
EDGE_ERROR = 0.3


def errors(volume, true):
    """Largest error of the active voxels, and of the vertices of the surface."""
    points, values = active_voxels(volume)
    vertices = gk.mesh.from_volume(volume, method="marching_cubes").vertices
    assert len(points) > 1000
    return np.abs(values - np.clip(true(points), -3.0, 3.0)).max(), np.abs(true(vertices)).max()


class TestBox:
    @pytest.mark.parametrize("distance", [1.0, 2.6, 6.0])
    def test_eroded(self, distance):
        distances, _ = errors(
            erode(level_set(turned(cuboid(HALF), *ODD)), distance), turned(cuboid(HALF - distance), *ODD)
        )
        assert distances < 0.15

    @pytest.mark.slow
    @pytest.mark.parametrize("distance", [1.0, 4.0])
    def test_opened_edges_are_round(self, distance):
        core = turned(cuboid(HALF - distance), *ODD)
        found = errors(opening(level_set(turned(cuboid(HALF), *ODD)), distance), lambda p: core(p) - distance)
        assert max(found) < 0.2

    @pytest.mark.slow
    def test_closing_changes_nothing(self):
        body = turned(cuboid(HALF), *ODD)
        assert max(errors(closing(level_set(body), 1.0), body)) < EDGE_ERROR

    def test_dilated(self):
        body = turned(cuboid(HALF), *ODD)
        assert max(errors(dilate(level_set(body), 1.0), lambda p: body(p) - 1.0)) < EDGE_ERROR

    @pytest.mark.slow
    def test_erosion_is_an_offset(self):
        body = level_set(turned(cuboid(HALF), *ODD))
        np.testing.assert_array_equal(erode(body, 1.5).nanovdb, offset(body, -1.5).nanovdb)

    @pytest.mark.slow
    def test_threads_do_not_change_a_bit(self, monkeypatch):
        body, results = level_set(turned(cuboid(HALF), *ODD)), []
        for threads in ("1", "2"):
            monkeypatch.setenv("GEOKIT_THREADS", threads)
            results.append(opening(body, 2.0, device="cpu").nanovdb)
        np.testing.assert_array_equal(*results)


@pytest.mark.parametrize("distance", [1.0, 4.0])
def test_eroded_cylinder(distance):
    def body(by):
        r, h = 10.0 - by, 12.0 - by
        return turned(revolved(polygon([(-r, -h), (r, -h), (r, h), (-r, h)])), *ODD)

    assert errors(erode(level_set(body(0.0)), distance), body(distance))[0] < 0.1


@pytest.mark.slow
def test_world_units_and_types():
    def body(by):
        return lambda p: 0.1 * turned(cuboid(HALF - by), *ODD)((p - TURNED[:3, 3]) * 10.0)

    for dtype in (np.float32, np.float64):
        points, values = active_voxels(erode(level_set(body(0.0), transform=TURNED, dtype=dtype), 0.2))
        assert np.abs(values - np.clip(body(2.0)(points), -0.3, 0.3)).max() < 0.015


def test_values_that_are_no_distances_keep_their_answer():
    sphere = ball(10.0)
    steep = level_set(sphere, values=lambda p: 1.6 * sphere(p), half_width=4.0)
    points, values = active_voxels(erode(steep, 0.8))
    assert np.abs(values - np.clip(sphere(points) + 0.5, -4.0, 4.0)).max() < 0.02


@pytest.mark.parametrize("half_width", [1.0, 2.0, 5.0])
def test_other_bands(half_width):
    body, core = turned(cuboid(HALF), *ODD), turned(cuboid(HALF - 2.0), *ODD)
    points, values = active_voxels(erode(level_set(body, half_width=half_width), 2.0))
    assert np.abs(values - np.clip(core(points), -half_width, half_width)).max() < EDGE_ERROR


def test_bodies_that_share_an_edge():
    def pair(by):
        half = np.array([6.0, 6.0, 9.0])
        step = np.array([6.0, 6.0, 0.0])
        return turned(lambda p: np.minimum(cuboid(half - by)(p - step), cuboid(half - by)(p + step)), *ODD)

    assert errors(erode(level_set(pair(0.0)), 1.0), pair(1.0))[0] < EDGE_ERROR
