"""A line always crosses a closed surface an even number of times; a ray's parity tells whether its start is inside."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support import reference

SURFACES = {make.__name__: gk.mesh.Surface(make(), device="cpu") for make in mesh_catalog.CLOSED}


def aimed(mesh, rng, count):
    """Rays from outside at vertices, at points of edges, and along edges, where parities can go wrong."""
    faces = mesh.faces[rng.integers(len(mesh.faces), size=count)]
    a, b = mesh.vertices[faces[:, 0]], mesh.vertices[faces[:, 1]]
    share = rng.choice([0.0, 0.5, 1.0, 0.25], size=(count, 1))
    targets = a + share * (b - a)
    outside = mesh.bounds.mean(axis=0) + 3.0 * mesh.diagonal * rng.choice([-1.0, 0.0, 1.0, 0.5], size=(count, 3))
    outside[np.all(np.abs(outside - mesh.bounds.mean(axis=0)) < mesh.diagonal, axis=1), 0] += 4.0 * mesh.diagonal
    directions = targets - outside
    along = rng.random(count) < 0.2
    directions[along] = (b - a)[along]
    outside[along] = (
        a[along] - 8.0 * directions[along] * mesh.diagonal / np.linalg.norm(directions[along], axis=1)[:, None]
    )
    return outside, directions


@pytest.mark.parametrize("name", SURFACES)
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_lines_cross_closed_surfaces_an_even_number_of_times(name, seed):
    surface = SURFACES[name]
    starts, directions = aimed(surface.mesh, np.random.default_rng(seed), 2000)
    odd = np.flatnonzero(surface.crossing_count(starts, directions) % 2)
    assert len(odd) == 0, (starts[odd[:3]], directions[odd[:3]])


@pytest.mark.parametrize("name", [name for name in SURFACES if name != "overlapping_spheres"])
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_rays_at_vertices_tell_inside_from_outside(name, seed):
    surface = SURFACES[name]
    mesh, rng = surface.mesh, np.random.default_rng(seed)
    starts = mesh.bounds[0] + rng.random((300, 3)) * (mesh.bounds[1] - mesh.bounds[0])
    targets = mesh.vertices[rng.integers(len(mesh.vertices), size=300)]
    inside = np.rint(reference.winding_number(mesh.vertices, mesh.faces, starts)).astype(int) != 0
    np.testing.assert_array_equal(surface.crossing_count(starts, targets - starts) % 2 == 1, inside)
