"""Polygons of many corners: as many triangles as there must be, none turned over, the area of the outline."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geokit.formats.ears import FEW, clip_ears
from geokit.formats.polygons import triangulate

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


SHAPES = {
    "nearly convex": lambda n: _round(n, 0.01),
    "rough": lambda n: _round(n, 0.5),
    "star": lambda n: _round(n, 30.0),
    "spiral": _spiral,
    "comb": _comb,
    "steps": _steps,
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
    x, y = flat.T
    outline = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
    assert areas.min() >= 0.0
    np.testing.assert_allclose(areas.sum(), outline, rtol=1e-11)
    # Each edge of the outline is that of one triangle, each other edge that of two, once in each direction.
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    kinds, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 1
    inner = {tuple(edge) for edge in kinds.tolist()}
    border = {edge for edge in inner if edge[::-1] not in inner}
    assert border == {(at, (at + 1) % len(flat)) for at in range(len(flat))}


@pytest.mark.slow
@pytest.mark.parametrize("count", [20, 300])
def test_outlines_that_cross_themselves_end_too(count: int) -> None:
    for flat in (RANDOM.random((count, 2)), np.zeros((count, 2)), RANDOM.integers(0, 3, (count, 2)).astype(float)):
        triangles = np.array(clip_ears(flat))
        assert triangles.shape == (count - 2, 3)
        assert set(triangles.ravel().tolist()) == set(range(count))


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
