"""Moved vertices: a refitted surface answers as a new one does."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog


def bent(mesh, amount):
    """The mesh sheared, twisted, moved and enlarged: another frame and other boxes everywhere."""
    x, y, z = mesh.vertices.T
    angle = amount * z
    return (1.0 + amount) * np.stack(
        [
            x * np.cos(angle) - y * np.sin(angle) + 5.0 * amount,
            x * np.sin(angle) + y * np.cos(angle),
            z + amount * x * y,
        ],
        axis=1,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [mesh_catalog.torus, mesh_catalog.icosphere, mesh_catalog.open_shell, mesh_catalog.collapsed_faces]
)
@pytest.mark.parametrize("amount", [1e-3, 0.4, 30.0])
def test_refit_equals_rebuild(make, amount):
    surface = gk.mesh.Surface(make(), device="cpu")
    surface.closest_point(surface.mesh.vertices)
    vertices = bent(surface.mesh, amount)
    surface.update(vertices)
    fresh = gk.mesh.Surface(gk.mesh.TriangleMesh(vertices, surface.mesh.faces), device="cpu")
    rng = np.random.default_rng(0)
    lower, upper = fresh.bounds
    points = lower + (rng.random((3000, 3)) * 1.5 - 0.25) * (upper - lower)
    for one, other in zip(surface.closest_point(points), fresh.closest_point(points), strict=True):
        np.testing.assert_array_equal(one, other)
    directions = rng.normal(size=points.shape)
    for one, other in zip(surface.raycast(points, directions), fresh.raycast(points, directions), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(surface.furthest_point(points).distance, fresh.furthest_point(points).distance)
    # The far field of the winding number depends on the clusters, which differ in a new tree: where it is near 1/2, in
    # the opening of a shell, either sign may result.
    clear = fresh.sign_confidence(points) > 0.01
    assert clear.mean() > 0.95
    signed = [s.signed_distance(points).distance[clear] for s in (surface, fresh)]
    np.testing.assert_array_equal(*signed)
    np.testing.assert_allclose(surface.winding_number(points), fresh.winding_number(points), atol=0.01)
    np.testing.assert_array_equal(surface.bounds, fresh.bounds)


def test_what_was_derived_is_derived_anew():
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    assert surface.audit.signed_volume == pytest.approx(1.0)
    assert surface.orientation == 1
    before = surface._warp_mesh  # kept, so that its address cannot be given out again
    handle = surface.id
    surface.update(surface.mesh.vertices * [-2.0, 1.0, 1.0])
    assert surface.audit.signed_volume == pytest.approx(-2.0)
    assert surface.orientation == -1
    assert surface._warp_mesh is not before
    assert surface.id != handle
    assert surface.signed_distance([[-1.0, 0.5, 0.5]]).distance[0] == pytest.approx(-0.5)


def test_bad_vertices_leave_the_surface_as_it_was():
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    with pytest.raises(gk.InputError, match="9 rows for a mesh of 8 vertices"):
        surface.update(np.zeros((9, 3)))
    with pytest.raises(gk.InputError, match="7 rows for a mesh of 8 vertices"):
        surface.update(surface.mesh.vertices[:7])
    bad = surface.mesh.vertices.copy()
    bad[3, 1] = np.nan
    with pytest.raises(gk.InputError, match="row 3 is not finite"):
        surface.update(bad)
    assert surface.closest_point([[0.5, 0.5, 2.0]]).distance[0] == 1.0
