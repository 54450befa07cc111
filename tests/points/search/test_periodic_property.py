"""Periodic cells against all images in float64, written without geokit."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geokit.points import NeighborGrid
from tests.support.devices import DEVICES
from tests.support.effort import of_all

relaxed = settings(deadline=None, max_examples=of_all(12, 40))


def images_within(points, queries, cell, radius):
    """Query, point, shift and distance of every image within the radius, ascending."""
    inverse = np.linalg.inv(cell)
    heights = 1.0 / np.linalg.norm(inverse, axis=0)
    low = np.vstack([points, queries]) @ inverse
    most = np.ceil(radius / heights + np.ptp(low, axis=0)).astype(int)
    found = []
    for s in itertools.product(*(range(-k, k + 1) for k in most)):
        image = points + ((s[0] * cell[0] + s[1] * cell[1]) + s[2] * cell[2])
        d = image[None] - queries[:, None]
        squared = (d[..., 0] ** 2 + d[..., 1] ** 2) + d[..., 2] ** 2
        found += [
            (i, j, *s, np.sqrt(squared[i, j])) for i, j in zip(*np.nonzero(squared <= radius * radius), strict=True)
        ]
    return sorted(found)


@st.composite
def cells(draw):
    """Points and queries in or around a box or a triclinic cell, left-handed ones too, and a radius."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    cell = np.diag(random.uniform(0.5, 2.0, 3))
    if draw(st.booleans()):
        cell = cell @ (np.eye(3) + random.uniform(-0.6, 0.6, (3, 3)))[random.permutation(3)]
    scale = draw(st.sampled_from([1.0, 1e-6, 1e9]))
    around = draw(st.sampled_from([0, 0, 2]))
    points, queries = (
        (random.random((n, 3)) + random.integers(-around, around + 1, (n, 3))) @ cell * scale
        for n in draw(st.tuples(st.integers(1, 25), st.integers(1, 12)))
    )
    if abs(np.linalg.det(cell)) < 0.05:
        cell = np.diag([1.0, 0.7, 1.3])
    return points, queries, cell * scale, draw(st.sampled_from([0.05, 0.31, 0.57, 1.37])) * scale, around


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@relaxed
@given(cells())
def test_all_images_are_found(device, given_cell):
    points, queries, cell, radius, _ = given_cell
    grid = NeighborGrid(points, radius, periodic=cell, device=device)
    for asked in (None, queries):
        wanted = images_within(points, points if asked is None else asked, cell, radius)
        found = grid.neighbor_list(asked)
        owner = np.repeat(np.arange(len(found.offsets) - 1), np.diff(found.offsets))
        named = np.column_stack([owner, found.indices, found.shifts])
        np.testing.assert_array_equal(named, np.array([row[:5] for row in wanted]).reshape(-1, 5))
        distance = np.array([row[5] for row in wanted])
        # Moving a point into the cell rounds each coordinate once.
        np.testing.assert_allclose(found.distance, distance, rtol=1e-13, atol=1e-14 * np.abs(cell).max() * 10)
        np.testing.assert_array_equal(grid.count(asked), np.diff(found.offsets))
        plain = grid.radius_search(asked)
        np.testing.assert_array_equal(plain.indices, found.indices)
        np.testing.assert_array_equal(plain.distance, found.distance)
        # The other orders hold the same rows.
        by_distance, any_order = grid.neighbor_list(asked, order="distance"), grid.neighbor_list(asked, order="any")
        for other, keys in ((by_distance, (found.distance,)), (any_order, ())):
            rows = np.repeat(np.arange(len(other.offsets) - 1), np.diff(other.offsets))
            order = np.lexsort((*found.shifts.T[::-1], found.indices, *keys, owner))
            there = np.lexsort((*other.shifts.T[::-1], other.indices, rows)) if not keys else slice(None)
            np.testing.assert_array_equal(other.indices[there], found.indices[order])
            np.testing.assert_array_equal(other.shifts[there], found.shifts[order])
            np.testing.assert_array_equal(other.distance[there], found.distance[order])


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@relaxed
@given(cells())
def test_inside_the_cell_the_bits_are_those_of_the_formula(device, given_cell):
    points, queries, cell, radius, around = given_cell
    if around:
        return
    inside = np.floor(np.vstack([points, queries]) @ np.linalg.inv(cell)) == 0
    if not inside.all():
        return
    found = NeighborGrid(points, radius, periodic=cell, device=device).neighbor_list(queries)
    wanted = images_within(points, queries, cell, radius)
    np.testing.assert_array_equal(found.distance, [row[5] for row in wanted])


@pytest.mark.slow
def test_a_crystal_has_its_shells():
    # Points at exactly the radius count: shells of a simple cubic lattice with 1, 6, 12, 8 and 6 points.
    lattice = np.stack(np.meshgrid(*[np.arange(4.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = NeighborGrid(lattice, 1.0, periodic=[4.0, 4.0, 4.0], device="cpu")
    for squared, count in ((0, 1), (1, 7), (2, 19), (3, 27), (4, 33), (36, 925)):
        assert set(grid.count(radius=np.sqrt(squared) * (1 + 1e-15)).tolist()) == {count}
    found = grid.neighbor_list(radius=2.0)
    back = {
        (i, j, *s) for i, j, s in zip(np.repeat(np.arange(64), 33), found.indices, found.shifts.tolist(), strict=True)
    }
    assert all((j, i, -x, -y, -z) in back for i, j, x, y, z in back)
