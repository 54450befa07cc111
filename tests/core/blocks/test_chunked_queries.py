"""Queries in blocks answer as one would, say how far they are, and name rows as the caller counts them."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core.blocks import chunked_queries

COUNT = 1050


@pytest.fixture(scope="module")
def surface():
    return gk.mesh.Surface(mesh_catalog.torus(), device="cpu")


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(-1.5, 1.5, (COUNT, 3))


QUERIES = {
    "closest_point": lambda surface, points, **options: surface.closest_point(points, **options),
    "signed_distance": lambda surface, points, **options: surface.signed_distance(points, **options),
    "contains": lambda surface, points, **options: surface.contains(points, **options),
    "winding_number": lambda surface, points, **options: surface.winding_number(points, **options),
    "raycast": lambda surface, points, **options: surface.raycast(points, points[::-1] + 0.1, **options),
    "occluded": lambda surface, points, **options: surface.occluded(points, points[::-1] + 0.1, **options),
    "crossing_count": lambda surface, points, **options: surface.crossing_count(points, points[::-1] + 0.1, **options),
}


@pytest.mark.parametrize("query", QUERIES.values(), ids=QUERIES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_blocks_answer_as_one(surface, points, query, dtype, monkeypatch):
    points = points.astype(dtype)
    expected = query(surface, points)
    monkeypatch.setattr(chunked_queries, "MOST_ROWS", 100)
    seen = []
    found = query(surface, points, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(min(100 * k, COUNT), COUNT) for k in range(1, 12)]
    assert type(found) is type(expected)
    for one, other in (
        zip(np.atleast_1d(found), np.atleast_1d(expected), strict=True)
        if not isinstance(found, tuple)
        else zip(found, expected, strict=True)
    ):
        np.testing.assert_array_equal(one, other)
        assert np.asarray(one).dtype == np.asarray(other).dtype


def test_progress_of_few_rows(surface, points):
    seen = []
    surface.closest_point(points.tolist(), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(COUNT, COUNT)]


def test_rows_are_named_as_the_caller_counts(surface, points, monkeypatch):
    monkeypatch.setattr(chunked_queries, "MOST_ROWS", 100)
    directions = np.ones_like(points)
    directions[777] = 0.0
    with pytest.raises(gk.InputError, match="directions: row 777 is zero"):
        surface.raycast(points, directions, progress=lambda done, total: None)
    points[903, 1] = np.inf
    with pytest.raises(gk.InputError, match="points: row 903 is not finite"):
        surface.closest_point(points, progress=lambda done, total: None)


def test_what_progress_raises_stops_the_query(surface, points, monkeypatch):
    monkeypatch.setattr(chunked_queries, "MOST_ROWS", 100)

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        surface.closest_point(points, progress=stop)
