"""Signs of normals pushed towards failure: thin bodies, close sheets, tips, creases, noise, uneven density.

Truth is the analytic outward normal. Lengths are in spacings, the side of a point's share of the surface. Wherever a
share of wrong signs is allowed, it is two to three times what was measured.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.catalog.oriented_clouds import (
    COUNT,
    box,
    cone,
    nested_spheres,
    parallel_sheets,
    plate,
    sphere,
    torus,
    uneven,
)
from geokit.points._normals import normals


def wrong(shape, seed, noise=0.0, part=None, scale=1.0, **settings):
    """Share of wrong signs of a turned and noisy shape; with parts, up to the sign of each."""
    random = np.random.default_rng(1000 + seed)
    points, normal, spacing = shape
    turn = Rotation.random(random_state=seed).as_matrix()
    points = (points + noise * spacing * random.normal(size=points.shape)) @ turn.T * scale
    found = normals(points, device="cpu", **settings).normals
    bad = (found * (normal @ turn.T)).sum(axis=1) <= 0.0
    if part is None:
        return bad.mean()
    return sum(min(bad[part == p].sum(), (~bad[part == p]).sum()) for p in np.unique(part)) / len(bad)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    ("thickness", "most"), [(2.1, 0.04), (2.4, 0.006), (2.7, 0.003), (3.0, 0.002), (3.2, 0.002), (4.0, 0.002)]
)
def test_thin_plates(thickness, most, seed):
    assert wrong(plate(np.random.default_rng(seed), thickness), seed) <= most


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("thickness", "noise", "most"),
    [(3.2, 0.2, 0.002), (3.2, 0.3, 0.006), (3.2, 0.5, 0.06), (4.5, 0.3, 0.005), (4.5, 0.5, 0.025), (6.0, 0.6, 0.04)],
)
def test_noisy_plates(thickness, noise, most, seed):
    assert wrong(plate(np.random.default_rng(seed), thickness), seed, noise) <= most


@pytest.mark.parametrize("k", [24, 32, 48])
def test_plates_thinner_than_neighborhoods(k):
    # Neighborhoods have a radius of sqrt(k / pi) spacings: the plate is nine tenths of one thick.
    assert wrong(plate(np.random.default_rng(0), 0.9 * np.sqrt(k / np.pi)), 0, k=k) <= 0.05


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("noise", "most"), [(0.0, 0.001), (0.2, 0.004), (0.5, 0.03), (0.7, 0.07), (0.8, 0.09), (0.9, 0.12)]
)
def test_noisy_boxes(noise, most, seed):
    assert wrong(box(np.random.default_rng(seed), [1.0, 0.7, 0.5]), seed, noise) <= most


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("gap", "most"), [(1.0, 0.02), (2.0, 0.06), (2.5, 0.006), (3.0, 0.001), (4.0, 0.0)])
def test_nested_spheres_each_have_one_sign(gap, most, seed):
    shape, part = nested_spheres(np.random.default_rng(seed), gap)
    assert wrong(shape, seed, part=part) <= most


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("gap", "most"), [(2.5, 0.06), (3.0, 0.015), (4.0, 0.0)])
def test_parallel_sheets_each_have_one_sign(gap, most, seed):
    shape, part = parallel_sheets(np.random.default_rng(seed), gap)
    assert wrong(shape, seed, part=part) <= most


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("half_angle", "most"), [(5, 0.03), (10, 0.015), (20, 0.01)])
def test_cones_up_to_the_tip(half_angle, most, seed):
    # Where a cone is thinner than the spacing a plane is no model of it.
    assert wrong(cone(np.random.default_rng(seed), half_angle), seed) <= most


@pytest.mark.parametrize("half_angle", [45, 70])
def test_edges_sharper_than_60_degrees_lose_the_sign(half_angle):
    # The base meets the cone at 45 or 20 degrees: normals at the edge are means of both sides, and agree with both.
    assert wrong(cone(np.random.default_rng(0), half_angle), 0) > 0.2


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("diameter", [3.0, 4.0])
def test_thin_tubes(diameter, seed):
    # A ring of spacing 2 pi sqrt(r / count) is so many spacings thick.
    minor = (diameter * np.pi) ** 2 / COUNT
    assert wrong(torus(np.random.default_rng(seed), minor), seed) <= 0.001
    assert wrong(torus(np.random.default_rng(seed), minor), seed, noise=0.2) <= 0.003


@pytest.mark.parametrize("minor", [0.2, 0.35, 0.8])
def test_tori(minor):
    for noise in (0.0, 0.3, 0.5):
        assert wrong(torus(np.random.default_rng(2), minor), 2, noise) <= 0.005


@pytest.mark.parametrize("ratio", [10.0, 100.0, 1000.0])
def test_uneven_density(ratio):
    # From pole to pole; and along a plate that is 4 spacings of an even one thick.
    random = np.random.default_rng(0)
    assert wrong(uneven(random, sphere(random, count=40 * COUNT), 2, ratio), 0) == 0.0
    assert wrong(uneven(random, plate(random, 4.0 * np.sqrt(6.0), 6 * COUNT), 0, ratio), 0) <= 0.015


@pytest.mark.parametrize("scale", [1e-100, 1e-6, 1e6, 1e100])
def test_scale_changes_no_sign(scale):
    assert wrong(plate(np.random.default_rng(1), 3.0), 1, scale=scale) <= 0.002


def test_an_outlier_turns_nothing():
    random = np.random.default_rng(0)
    points, normal, _ = sphere(random)
    for place in ([0.0, 0.0, 50.0], [0.0, 3.0, -50.0], [30.0, 0.0, 0.0]):
        found = normals(np.concatenate([points, [place]]), device="cpu").normals[:-1]
        assert ((found * normal).sum(axis=1) > 0.0).all()


def test_open_height_fields_point_up():
    # Bowls, too, whose highest points are a rim where normals are nearly level.
    xy = np.random.default_rng(0).uniform(-1.0, 1.0, (COUNT, 2))
    for bend in (-3.0, -0.1, 0.0, 0.1, 3.0):
        points = np.concatenate([xy, bend * (xy**2).sum(axis=1, keepdims=True)], axis=1)
        assert (normals(points, device="cpu").normals[:, 2] > 0.0).all()
