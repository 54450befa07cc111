"""Every program on the page that follows warp's introduction runs, and agrees with geokit's own queries."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from tests.support.page_blocks import blocks_of, run_block

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "warp-tour.md"
# Coordinates up to 2 in float32, through some ten operations each rounded at 6e-8.
SINGLE = 4e-6


@pytest.fixture
def run(tmp_path, monkeypatch):
    return lambda name: run_block(PAGE, name, tmp_path, monkeypatch)


def test_every_block_is_checked():
    assert set(blocks_of(PAGE)) == {"kernel", "projection", "volume", "neighbors", "tape"}
    for target in re.findall(r"\]\(([^)#]+)\)", PAGE.read_text(encoding="utf-8")):
        assert (PAGE.parent / target).exists(), target


def test_a_kernel(run):
    np.testing.assert_allclose(run("kernel").heights.numpy(), 2.0, atol=1e-2)


def test_projection(run):
    page = run("projection")
    found = page.surface.closest_point(page.positions)
    near = np.asarray(found.distance) <= 0.5
    assert 100 < near.sum() < 900
    faces, projected = page.faces.numpy(), page.projected.numpy()
    assert ((faces >= 0) == near).all()
    np.testing.assert_array_equal(projected[~near], page.positions[~near])
    # Of two triangles that are equally near float32 may take the other one.
    away = np.linalg.norm(projected - page.positions, axis=1)
    np.testing.assert_allclose(away[near], found.distance[near], atol=SINGLE)


def test_volume(run):
    page = run("volume")
    places = page.points.astype(np.float64)
    np.testing.assert_allclose(page.sampled.numpy(), page.field.sample(places), atol=SINGLE)
    nearest = np.rint(places / 0.04)
    inner = (np.abs(places / 0.04 - np.floor(places / 0.04) - 0.5) > 1e-4).all(axis=1)
    assert inner.mean() > 0.99
    np.testing.assert_allclose(page.centers.numpy()[inner], 0.04 * nearest[inner], atol=SINGLE)
    stored = gk.volume.sample(page.field, nearest, space="index", order=0)
    np.testing.assert_array_equal(page.stored.numpy()[inner], np.asarray(stored, np.float32)[inner])


def test_neighbors(run):
    page = run("neighbors")
    found = page.grid.radius_search(page.points)
    expected = np.add.reduceat(page.points[found.indices], found.offsets[:-1])
    assert np.diff(found.offsets).min() >= 1
    np.testing.assert_allclose(page.sums.numpy(), expected, atol=10 * SINGLE)


def test_tape(run):
    page = run("tape")
    found = page.surface.signed_distance(2.0 * page.start)
    np.testing.assert_allclose(page.loss.numpy(), [(found.distance**2).sum()], rtol=1e-12)
    away = 2.0 * page.start - np.asarray(found.points)
    # d(distance^2)/d(grown) is twice the way from the foot to the point, and grown is twice the point.
    np.testing.assert_allclose(page.gradient.numpy(), 4.0 * away, atol=1e-12)
