"""Rays in scenes where triangles are huge and tiny, thin or unconnected: the tree selects, and changes no answer."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import scenes
from geokit.mesh import Surface, TriangleMesh
from tests.support import reference

RAYS = 150
SMALL = {name: make(1500) for name, make in scenes.SCENES.items()}


def rays_in(scene: scenes.Scene, surface: Surface, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Camera rays, bounces and random rays, one after another."""
    sets = scenes.ray_sets(scene, surface, count).values()
    origins, directions = (np.concatenate(parts) for parts in zip(*sets, strict=True))
    return origins, directions


@pytest.mark.parametrize("name", SMALL)
def test_hits_are_those_of_brute_force(name):
    scene = SMALL[name]
    mesh, surface = scene.mesh, Surface(scene.mesh, device="cpu")
    origins, directions = rays_in(scene, surface, RAYS)
    found = surface.raycast(origins, directions)
    expected = reference.first_hit(mesh.vertices, mesh.faces, origins, directions)
    hit = expected.triangle_id >= 0
    assert hit.any()
    np.testing.assert_array_equal(found.triangle_id >= 0, hit)
    length = np.linalg.norm(directions, axis=1)
    np.testing.assert_allclose((found.t * length)[hit], (expected.t * length)[hit], rtol=0, atol=1e-11 * mesh.diagonal)
    np.testing.assert_array_equal(surface.occluded(origins, directions), hit)


@pytest.mark.parametrize("name", scenes.SCENES)
def test_hits_are_the_nearest_of_those_of_parts(name):
    # Trees of random parts of the faces have nothing in common with the tree of all, but the nearest hit of each part
    # has the same bits.
    scene = scenes.SCENES[name](12_000)
    mesh, surface = scene.mesh, Surface(scene.mesh, device="cpu")
    origins, directions = rays_in(scene, surface, 4000)
    limits = {"t_min": 1e-3, "max_distance": 0.3 * mesh.diagonal}
    part = np.random.default_rng(5).integers(3, size=len(mesh.faces))
    for given in ({}, limits):
        nearest, triangle = np.full(len(origins), np.inf), np.full(len(origins), -1)
        for k in range(3):
            faces = np.flatnonzero(part == k)
            found = Surface(TriangleMesh(mesh.vertices, mesh.faces[faces]), device="cpu")
            found = found.raycast(origins, directions, **given)
            number = np.where(found.triangle_id >= 0, faces[found.triangle_id], -1)
            nearer = (found.t < nearest) | ((found.t == nearest) & (number >= 0) & (number < triangle))
            nearest[nearer], triangle[nearer] = found.t[nearer], number[nearer]
        whole = surface.raycast(origins, directions, **given)
        assert (triangle >= 0).any()
        np.testing.assert_array_equal(whole.t, nearest)
        np.testing.assert_array_equal(whole.triangle_id, triangle)
        np.testing.assert_array_equal(surface.occluded(origins, directions, **given), triangle >= 0)


def test_huge_triangles_widen_no_box_of_tiny_ones():
    # Walls, floor and ceiling of a hall are leaves of the root, and come last: any ray that meets them ends there.
    surface = Surface(scenes.hall(20_000).mesh, device="cpu")
    children = surface._tree.children.numpy().reshape(-1, 8)[0]
    slots = surface._tree.slot_triangle.numpy().reshape(-1, 8)
    leaves = np.flatnonzero(children < 0)
    found = slots[-1 - children[leaves]]
    assert set(found[found >= 0]) == set(range(12))
    assert (children[: leaves[0]] > 0).all()
