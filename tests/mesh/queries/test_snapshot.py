"""Queries beside Surface.update: each answers for one state of the surface, never for a mixture of two."""

from __future__ import annotations

import threading

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog

QUERIES = {
    "closest_point": lambda surface, points: surface.closest_point(points).distance,
    "signed_distance": lambda surface, points: surface.signed_distance(points).distance,
    "winding_number": lambda surface, points: surface.winding_number(points),
    "raycast": lambda surface, points: surface.raycast(points, np.tile([0.3, 0.2, -1.0], (len(points), 1))).t,
    "overlapping": lambda surface, points: surface.overlapping(points - 0.2, points + 0.2).triangle_id,
    "self_intersections": lambda surface, points: surface.self_intersections(),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", QUERIES)
def test_no_torn_answers(name):
    query = QUERIES[name]
    mesh = mesh_catalog.torus()
    states = [mesh.vertices, 1.5 * mesh.vertices + [3.0, 0.0, 0.0]]
    points = np.random.default_rng(1).uniform(-2.0, 5.0, (4000, 3))
    surface = gk.mesh.Surface(mesh, device="cpu")
    expected = []
    for state in states:
        surface.update(state)
        expected.append(query(surface, points))
    torn, stop = [], threading.Event()

    def ask() -> None:
        while not stop.is_set():
            answer = query(surface, points)
            if not any(np.array_equal(answer, known, equal_nan=True) for known in expected):
                torn.append(answer)

    threads = [threading.Thread(target=ask) for _ in range(3)]
    for thread in threads:
        thread.start()
    for k in range(60):
        surface.update(states[k % 2])
    stop.set()
    for thread in threads:
        thread.join()
    assert not torn


def test_a_refused_update_leaves_the_surface_as_it_was():
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    before = surface.closest_point([[2.0, 0.0, 0.0]]).distance
    vertices = surface.mesh.vertices.copy()
    vertices[3, 1] = np.nan
    with pytest.raises(gk.errors.InputError, match="row 3"):
        surface.update(vertices)
    np.testing.assert_array_equal(surface.closest_point([[2.0, 0.0, 0.0]]).distance, before)


def test_what_a_query_derives_is_kept():
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    surface.signed_distance([[2.0, 0.0, 0.0]])
    assert "audit" in surface.__dict__ or "_sign_choice" in surface.__dict__
