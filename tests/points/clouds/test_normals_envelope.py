"""Normals pushed towards failure: curvature, noise, offset, scale, thin sheets, scan lines, and where they stop.

What the surfaces are is known here, so that an angle is one to the true normal, not to the definition's plane.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from geokit.points._density import density
from geokit.points._normals import normals

K = 16
# On a surface of curvature c the plane through neighbors up to h away is tilted by 0.1 c h usually and by at most 0.75
# of it (measured: 0.57 on spheres and tori of 500 to 60,000 random points): an uneven neighborhood sees one side's
# slope, which is c h / 2 on average.
TILT = 0.75
# As many neighbors there must be within a radius for this. Few may be nearly a line, and tilt any way.
ENOUGH = 12
# Rounding coordinates by 2^-53 of themselves tilts the plane through K of them by their share of the neighborhood's
# size (measured: 1.0 of it; the test's rows are rounded twice, by offset and scale: 2.1), and the plane itself was
# rounded when it was made (measured: 1.5e-15).
ROUNDING_TILT = 4.0
MADE = 5e-15


def angles(found, true):
    """Angle [rad] of unoriented normals, also where it is small."""
    return np.arcsin(np.clip(np.linalg.norm(np.cross(found, true), axis=1), 0.0, 1.0))


def reach(points, k=K):
    """Distance of each point's farthest neighbor."""
    return cKDTree(points).query(points, k)[0][:, -1]


def sphere(count):
    points = np.random.default_rng(0).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points, points, 1.0


def torus(count, minor=0.35):
    random = np.random.default_rng(1)
    u, v = random.random((2, count)) * 2 * np.pi
    normal = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
    return np.stack([np.cos(u), np.sin(u), np.zeros(count)], axis=1) + minor * normal, normal, 1.0 / minor


def plane(count):
    """A square of a plane with one point in each cell of it: no neighborhood is nearly a line."""
    side = int(np.sqrt(count))
    u, v = (np.stack(np.meshgrid(*[np.arange(side)] * 2), axis=-1).reshape(-1, 2).T).astype(float)
    u, v = (np.stack([u, v]) + np.random.default_rng(2).random((2, side * side))) / side
    normal = np.array([2.0, -3.0, 6.0]) / 7.0
    points = u[:, None] * (np.array([3.0, 6.0, 2.0]) / 7.0) + v[:, None] * (np.array([-6.0, 2.0, 3.0]) / 7.0)
    return points, np.tile(normal, (side * side, 1)), 0.0


@pytest.mark.slow
@pytest.mark.parametrize("surface", [sphere, torus])
@pytest.mark.parametrize("count", [500, 2000, 20_000])
def test_curved_surfaces(surface, count):
    points, true, curvature = surface(count)
    h = reach(points)
    found = normals(points, k=K, device="cpu")
    assert (angles(found.normals, true) <= TILT * curvature * h).all()
    # Where a neighborhood is smaller than the radius of curvature, all are outward.
    assert (h * curvature).max() > 1.0 or ((found.normals * true).sum(axis=1) > 0.0).all()
    radius = float(np.median(h))
    within = normals(points, k=K, radius=radius, orientation="none", device="cpu")
    enough = cKDTree(points).query_ball_point(points, radius, return_length=True) >= ENOUGH
    assert (angles(within.normals, true)[enough] <= TILT * curvature * radius).all()


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-100, 1e-6, 1.0, 1e6, 1e100])
@pytest.mark.parametrize("offset", [0.0, 1.0, 1e3, 1e6, 1e9])
def test_offset_and_scale(offset, scale):
    # The offset is in sizes of the object: a millimeter's worth of points a kilometer away is 1e6.
    points, true, _ = plane(2025)
    moved = (points + offset) * scale
    largest = np.abs(moved).max(axis=1)
    for settings in ({}, {"radius": 0.06 * scale}):
        found = normals(moved, k=K, orientation="none", device="cpu", **settings)
        h = 0.06 * scale if settings else reach(points) * scale
        bound = ROUNDING_TILT * 2.0**-53 * largest / h + MADE
        assert (angles(found.normals, true) <= bound).all()


@pytest.mark.parametrize("offset", [1e15, 1e18])
def test_offset_that_leaves_no_digits(offset):
    # Steps of the coordinates are 0.125 and 128: the points become lattice points, then coincide.
    points, _, _ = plane(529)
    found = normals(points + offset, k=K, device="cpu").normals
    assert np.isfinite(found).all()
    if offset == 1e18:
        assert not found.any()


@pytest.mark.parametrize("noise", [1e-6, 1e-3, 0.01, 0.1])
def test_noise(noise):
    # Noise of a share of the neighborhood tilts a plane through k points by 2.4 / sqrt(k) of it, in the median.
    points, true, _ = plane(3025)
    h = np.median(reach(points))
    noisy = points + np.random.default_rng(3).normal(size=(3025, 1)) * noise * h * true
    found = normals(noisy, k=K, orientation="none", device="cpu")
    assert np.median(angles(found.normals, true)) <= 3.0 * noise / np.sqrt(K)
    # The curvature measures the square of the noise's share; 1.5 of it is allowed.
    assert 1.0 * noise**2 <= np.median(found.curvature) <= 2.0 * noise**2


@pytest.mark.parametrize("gap", [3.0, 1.5])
def test_sheets_farther_apart_than_neighbors(gap):
    points, true, _ = plane(2025)
    sheets = np.concatenate([points, points + gap * reach(points).max() * true])
    found = normals(sheets, k=K, device="cpu").normals
    assert angles(found, np.tile(true, (2, 1))).max() < 1e-12
    assert (found[:, 2] > 0.0).all()


def test_sheets_nearer_than_neighbors_are_one_thick_surface():
    # A gap well under the spacing is noise to a plane, one of the neighborhood's own size is not.
    points, true, _ = plane(2025)
    h = np.median(reach(points))
    for gap, most in ((0.01, 0.01), (0.1, 0.1)):
        sheets = np.concatenate([points, points + gap * h * true])
        found = normals(sheets, k=K, orientation="none", device="cpu")
        assert angles(found.normals, np.tile(true, (2, 1))).max() < most
    sheets = np.concatenate([points, points + 0.7 * h * true])
    found = normals(sheets, k=K, orientation="none", device="cpu")
    # Half of them are off by 0.45 and more; the curvature says so.
    assert np.median(angles(found.normals, np.tile(true, (2, 1)))) > 0.3
    assert np.median(found.curvature) > 0.1


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0, 4.0, 20.0])
def test_scan_lines(ratio):
    # Points on lines of a plane, the lines ``ratio`` spacings apart: 16 neighbors reach the next line up to a ratio
    # of 7; beyond, a neighborhood is a line, and has no normal rather than any.
    x, y = np.meshgrid(np.arange(60.0), np.arange(30.0) * ratio)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    found = normals(points, k=K, device="cpu").normals
    wanted = [0.0, 0.0, 0.0] if ratio > 8.0 else [0.0, 0.0, 1.0]
    inner = (points[:, 0] > 10) & (points[:, 0] < 50)
    np.testing.assert_array_equal(found[inner], np.tile(wanted, (inner.sum(), 1)))


@pytest.mark.parametrize("aspect", [1.0, 1e-2, 1e-4, 1e-6, 1e-8])
def test_strips_that_become_lines(aspect):
    # A neighborhood that is narrower than 1e-7 of its length is a line: its direction across would be rounding.
    random = np.random.default_rng(0)
    points = random.random((500, 3)) * [1.0, aspect, 0.0]
    found = normals(points, k=500, device="cpu").normals
    wanted = [0.0, 0.0, 1.0] if aspect > 1e-7 else [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(found, np.tile(wanted, (500, 1)))


@pytest.mark.parametrize("kernel", ["count", "cubic_spline", "wendland_c2", "poly6"])
@pytest.mark.parametrize("offset", [2.0**20, -(2.0**30)])
@pytest.mark.parametrize("scale", [2.0**-20, 1.0, 2.0**20])
def test_density_far_away_and_small(kernel, offset, scale):
    # Coordinates with 2^-20 as their last digit move without being rounded: not even a bit of the density may change.
    points = np.round(np.random.default_rng(5).random((600, 3)) * 2**20) / 2**20
    near = density(points, radius=0.2, kernel=kernel, device="cpu")
    far = density((points + offset) * scale, radius=0.2 * scale, kernel=kernel, mass=scale**3, device="cpu")
    np.testing.assert_allclose(far, near, rtol=1e-14)
