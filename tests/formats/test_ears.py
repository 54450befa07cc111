"""Polygons of many corners: as many triangles as there must be, none turned over, the area of the outline."""

from __future__ import annotations

import time

import numpy as np
import pytest
from numpy.typing import NDArray

from geokit.formats import polygons
from geokit.formats.polygons import FEW, clip_ears, triangulate

RANDOM = np.random.default_rng(11)


def _round(n: int, rough: float) -> NDArray[np.float64]:
    angle, radius = np.arange(n) * 2 * np.pi / n, 1.0 + rough * RANDOM.random(n)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def _spiral(n: int) -> NDArray[np.float64]:
    angle = np.linspace(0.0, 12 * np.pi, n // 2)
    arms = [np.column_stack([(r + angle) * np.cos(angle), (r + angle) * np.sin(angle)]) for r in (1.5, 1.0)]
    return np.concatenate([arms[0], arms[1][::-1]])


def _comb(n: int) -> NDArray[np.float64]:
    teeth = np.column_stack([np.arange(n - 2.0), np.where(np.arange(n - 2) % 2, 3.0, 0.5)])
    return np.concatenate([teeth[::-1], [[0.0, 0.0], [n - 3.0, 0.0]]])


def _steps(n: int) -> NDArray[np.float64]:
    """Steps of a lattice above a line, with many corners on it."""
    count = n // 3
    x = np.repeat(np.arange(count), 2)[1:-1].astype(float)
    height = np.repeat(RANDOM.integers(1, 4, count - 1), 2).astype(float)
    below = np.column_stack([np.arange(count), np.zeros(count)])
    return np.concatenate([np.column_stack([x, height])[::-1], below])


def _turned(flat: NDArray[np.float64]) -> NDArray[np.float64]:
    return flat @ np.array([[0.8, 0.6], [-0.6, 0.8]])


def _area(flat: NDArray[np.float64]) -> float:
    x, y = flat.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


SHAPES = {
    "nearly convex": lambda n: _round(n, 0.01),
    "rough": lambda n: _round(n, 0.5),
    "star": lambda n: _round(n, 30.0),
    "spiral": _spiral,
    "comb": _comb,
    "steps": _steps,
    "turned comb": lambda n: _turned(_comb(n)),
    "in a line": lambda n: _comb(n) * [1.0, 1e-9],
}


def _doubled(flat: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    a, b, c = flat[triangles].transpose(1, 0, 2)
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


@pytest.mark.parametrize("count", [FEW - 1, FEW + 2, 300, 1500])
@pytest.mark.parametrize("shape", SHAPES)
def test_outlines(shape: str, count: int) -> None:
    flat = SHAPES[shape](count)
    triangles = np.array(clip_ears(flat))
    assert triangles.shape == (len(flat) - 2, 3)
    areas = _doubled(flat, triangles)
    assert areas.min() >= 0.0
    np.testing.assert_allclose(areas.sum(), _area(flat), rtol=1e-11)
    # Each edge of the outline is that of one triangle, each other edge that of two, once in each direction.
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    kinds, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 1
    inner = {tuple(edge) for edge in kinds.tolist()}
    border = {edge for edge in inner if edge[::-1] not in inner}
    assert border == {(at, (at + 1) % len(flat)) for at in range(len(flat))}


CROSSED = {
    "random": lambda n: RANDOM.random((n, 2)),
    "walk": lambda n: RANDOM.normal(size=(n, 2)).cumsum(axis=0),
    "lattice": lambda n: RANDOM.integers(0, 3, (n, 2)).astype(float),
    "one stroke": lambda n: _round(n, 0.0)[np.arange(n) * (n // 2 - 1) % n],
    "in a point": lambda n: np.zeros((n, 2)),
    "in a line": lambda n: np.column_stack([RANDOM.random(n), np.zeros(n)]),
    "doubled": lambda n: np.repeat(_round(n // 2, 0.5), 2, axis=0),
}


@pytest.mark.parametrize("count", [20, 700])
@pytest.mark.parametrize("shape", CROSSED)
def test_outlines_that_cross_or_touch_themselves_end_soon(shape: str, count: int) -> None:
    """The rule is the same for all: as many triangles, of all corners, with the outline's signed area."""
    flat = CROSSED[shape](count)
    flat = flat[::-1] if _area(flat) < 0.0 else flat
    begin = time.process_time()
    triangles = np.array(clip_ears(flat))
    assert time.process_time() - begin < 2.0  # 0.1 s; 5 s where each ear is looked for among all corners
    assert triangles.shape == (count - 2, 3)
    assert set(triangles.ravel().tolist()) == set(range(count))
    areas = _doubled(flat, triangles)
    np.testing.assert_allclose(areas.sum(), _area(flat), rtol=1e-9, atol=1e-9 * np.abs(areas).sum())


def test_two_corners_that_changed_places_cost_their_neighborhood_only() -> None:
    flat = _round(400, 0.01)
    flat[[200, 201]] = flat[[201, 200]]
    areas = _doubled(flat, np.array(clip_ears(flat)))
    assert areas[areas < 0.0].sum() > -1e-3 * _area(flat)


def test_the_looks_for_ears_are_used_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polygons, "LOOKS", 0)
    monkeypatch.setattr(polygons, "FREE_LOOKS", 500)
    flat = _comb(2000)
    triangles = np.array(clip_ears(flat))
    assert set(triangles.ravel().tolist()) == set(range(2000))
    np.testing.assert_allclose(_doubled(flat, triangles).sum(), _area(flat), rtol=1e-9)


def test_a_polygon_of_many_corners_in_space_beside_others() -> None:
    flat = _spiral(400)
    points = np.column_stack([flat, flat @ [0.3, -0.7]])
    points = np.concatenate([points, [[0, 0, 9], [1, 0, 9], [0, 1, 9]]])
    counts, indices = np.array([3, 400]), np.concatenate([[400, 401, 402], np.arange(400)])
    triangles, polygon = triangulate(points, counts, indices)
    assert polygon.tolist() == [0] + [1] * 398
    a, b, c = points[triangles[1:]].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    whole = np.cross(points[:400], np.roll(points[:400], -1, axis=0)).sum(axis=0)
    np.testing.assert_allclose(normals.sum(axis=0), whole, rtol=1e-11)
    assert (normals @ whole).min() >= -1e-9
