"""Density on hand-sized inputs: formulas, normalization, masses, queries, containers and every error."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.points._density import density

KERNELS = ["count", "cubic_spline", "wendland_c2", "poly6"]
# Some 100 terms, each rounded a few times, and their sum: the bound of the docstring is (n + 20) * 1.1e-16.
CLOSE = 3e-14


def smoothing(kernel, q):
    """The kernels for radius 1 as their papers write them, with h = 1/2 for the spline."""
    q = np.asarray(q, dtype=float)
    if kernel == "count":
        return np.where(q <= 1, 3 / (4 * np.pi), 0.0)
    if kernel == "cubic_spline":
        s = q / 0.5
        inner, outer = 1 - 1.5 * s**2 + 0.75 * s**3, 0.25 * (2 - s) ** 3
        return np.where(s <= 1, inner, np.where(s <= 2, outer, 0.0)) / (np.pi * 0.5**3)
    if kernel == "wendland_c2":
        return np.where(q <= 1, 21 / (2 * np.pi) * (1 - q) ** 4 * (4 * q + 1), 0.0)
    return np.where(q <= 1, 315 / (64 * np.pi) * (1 - q**2) ** 3, 0.0)


def reference(points, queries, radius, kernel, mass=1.0):
    distance = np.linalg.norm(queries[:, None] - points[None], axis=-1)
    weighted = mass * smoothing(kernel, distance / radius)
    return np.array([math.fsum(row) for row in weighted]) / radius**3


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("radius", [0.05, 0.2, 0.7, 3.0])
def test_equals_the_formula(kernel, radius):
    random = np.random.default_rng(0)
    points, queries = random.random((400, 3)), random.random((90, 3)) * 1.4 - 0.2
    found = density(points, radius=radius, kernel=kernel, queries=queries, device="cpu")
    np.testing.assert_allclose(found, reference(points, queries, radius, kernel), rtol=CLOSE)
    found = density(points, radius=radius, kernel=kernel, device="cpu")
    np.testing.assert_allclose(found, reference(points, points, radius, kernel), rtol=CLOSE)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("radius", [0.5, 2.0])
def test_integral_over_space_is_one(kernel, radius):
    # One point, queried along a ray at Gauss-Legendre nodes: exact for polynomials, in each of two halves.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    r = np.concatenate([(nodes + 1) / 4, (nodes + 3) / 4]) * radius
    queries = np.zeros((len(r), 3))
    queries[:, 1] = r
    value = density(np.zeros((1, 3)), radius=radius, kernel=kernel, queries=queries, device="cpu")
    integral = np.sum(np.tile(weights, 2) * radius / 4 * 4 * np.pi * r**2 * value)
    assert integral == pytest.approx(1.0, abs=1e-13)


@pytest.mark.parametrize("kernel", KERNELS)
def test_support_ends_at_the_radius(kernel):
    radius = 0.3
    queries = [[radius, 0, 0], [np.nextafter(radius, 1.0), 0, 0], [radius * (1 - 1e-3), 0, 0]]
    at, beyond, before = density([[0, 0, 0]], radius=radius, kernel=kernel, queries=queries, device="cpu")
    assert beyond == 0.0
    assert before > 0.0
    assert at == (pytest.approx(3 / (4 * np.pi * radius**3)) if kernel == "count" else 0.0)


def test_count_is_the_number_of_neighbors_by_volume():
    points = np.random.default_rng(2).random((300, 3))
    found = density(points, radius=0.25, device="cpu") * (4 / 3 * np.pi * 0.25**3)
    np.testing.assert_allclose(found, gk.points.NeighborGrid(points, 0.25, device="cpu").count(points), rtol=1e-15)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_mass_for_each_point(kernel):
    random = np.random.default_rng(1)
    points, mass = random.random((200, 3)), random.random(200)
    found = density(points, radius=0.3, kernel=kernel, mass=mass, device="cpu")
    np.testing.assert_allclose(found, reference(points, points, 0.3, kernel, mass), rtol=CLOSE)
    same = density(points, radius=0.3, kernel=kernel, mass=wp.array(mass, dtype=wp.float64, device="cpu"), device="cpu")
    np.testing.assert_array_equal(same, found)
    np.testing.assert_allclose(
        density(points, radius=0.3, kernel=kernel, mass=2.5, device="cpu"),
        2.5 * density(points, radius=0.3, kernel=kernel, device="cpu"),
        rtol=CLOSE,
    )


def test_few_points():
    assert density(np.zeros((0, 3)), radius=1.0, device="cpu").shape == (0,)
    assert density(np.zeros((0, 3)), radius=1.0, mass=[], device="cpu").shape == (0,)
    assert density(np.zeros((0, 3)), radius=1.0, queries=[[0, 0, 0]], device="cpu").tolist() == [0.0]
    assert density([[1, 2, 3]], radius=1.0, queries=np.zeros((0, 3)), device="cpu").shape == (0,)
    alone = density([[1, 2, 3]], radius=2.0, kernel="wendland_c2", device="cpu")
    assert alone.tolist() == [pytest.approx(21 / (2 * np.pi) / 8)]


def test_duplicates_add_up():
    points = np.full((100, 3), 0.7)
    found = density(points, radius=0.1, kernel="poly6", device="cpu")
    np.testing.assert_allclose(found, 100 * 315 / (64 * np.pi * 0.1**3), rtol=CLOSE)


def test_containers():
    points = np.random.default_rng(0).random((50, 3))
    wide = density(points, radius=0.3, device="cpu")
    assert wide.dtype == np.float64
    narrow = density(points.astype(np.float32), radius=0.3, device="cpu")
    assert narrow.dtype == np.float32
    found = density(wp.array(points, dtype=wp.vec3d, device="cpu"), radius=0.3, device="cpu")
    assert isinstance(found, wp.array)
    np.testing.assert_array_equal(found.numpy(), wide)
    # The queries' container decides where there are queries.
    assert density(points, radius=0.3, queries=points.astype(np.float32), device="cpu").dtype == np.float32


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan, np.inf, "wide", 1e-120, 1e120])
def test_radius_must_have_a_volume(radius):
    with pytest.raises(gk.InputError, match="radius"):
        density([[0, 0, 0]], radius=radius, device="cpu")


def test_kernel_must_be_known():
    with pytest.raises(gk.InputError, match="kernel: 'gauss' is not known"):
        density([[0, 0, 0]], radius=1.0, kernel="gauss", device="cpu")


@pytest.mark.parametrize("mass", [np.nan, np.inf, "heavy", [1.0], [1.0, 2.0, 3.0], [[1.0, 2.0]], [1.0, np.nan]])
def test_mass_is_checked(mass):
    with pytest.raises(gk.InputError, match="mass"):
        density([[0, 0, 0], [1, 0, 0]], radius=1.0, mass=mass, device="cpu")


def test_points_queries_and_device_are_checked():
    bad = [[0, 0, 0], [0, np.nan, 0]]
    with pytest.raises(gk.InputError, match="points: row 1"):
        density(bad, radius=1.0, device="cpu")
    with pytest.raises(gk.InputError, match="queries: row 1"):
        density([[0, 0, 0]], radius=1.0, queries=bad, device="cpu")
    with pytest.raises(gk.InputError, match=r"points: shape \(2, 2\)"):
        density(np.zeros((2, 2)), radius=1.0, device="cpu")
    with pytest.raises(gk.InputError, match="device"):
        density([[0, 0, 0]], radius=1.0, device="abacus")
