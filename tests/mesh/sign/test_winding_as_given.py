"""Winding numbers of faces as they are given, and as signs use them."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, orient
from tests.support import reference
from tests.support.devices import DEVICES

# The bounds of the docstring.
WINDING_ERROR, WINDING_ERROR_CUDA = 0.005, 0.02

MESHES = [
    mesh_catalog.torus(),
    mesh_catalog.inside_out_box(),
    mesh_catalog.flipped_faces(),
    mesh_catalog.with_flips(mesh_catalog.torus(), 0.4),
    mesh_catalog.half_shell(mesh_catalog.with_flips(mesh_catalog.icosphere(), 0.3)),
    mesh_catalog.doubled(mesh_catalog.icosphere()),
    mesh_catalog.doubled(mesh_catalog.open_shell(), slice(0, 40)),
]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("mesh", MESHES, ids=lambda mesh: mesh.name)
def test_both_are_those_of_their_faces(mesh, device):
    surface = Surface(mesh, device=device)
    error = WINDING_ERROR if device == "cpu" else WINDING_ERROR_CUDA
    points = mesh.bounds[0] - 0.2 + np.random.default_rng(5).random((1200, 3)) * (np.ptp(mesh.bounds, axis=0) + 0.4)
    given = reference.winding_number(mesh.vertices, mesh.faces, points)
    np.testing.assert_allclose(surface.winding_number(points, as_given=True), given, atol=error)
    counted = orient(surface._signs.mesh).mesh
    used = reference.winding_number(counted.vertices, counted.faces, points)
    np.testing.assert_allclose(surface.winding_number(points), used, atol=error)
    unlike = np.abs(given - used).max() > WINDING_ERROR
    assert unlike == (surface.orientation != 1 or surface._signs is not surface)


def test_an_inside_out_box_winds_once_backwards():
    surface = Surface(mesh_catalog.inside_out_box(), device="cpu")
    points = [[0.5, 0.5, 0.5], [2, 2, 2]]
    np.testing.assert_allclose(surface.winding_number(points, as_given=True), [-1, 0], atol=1e-6)
    np.testing.assert_allclose(surface.winding_number(points), [1, 0], atol=1e-6)
    assert surface.orientation == -1


def test_a_moved_mesh_is_wound_as_given_too():
    mesh = mesh_catalog.flipped_faces()
    surface = Surface(mesh, device="cpu")
    points = np.random.default_rng(6).normal(size=(300, 3)) * 2
    surface.winding_number(points, as_given=True)
    surface.update(mesh.vertices * 2)
    expected = reference.winding_number(mesh.vertices * 2, mesh.faces, points)
    np.testing.assert_allclose(surface.winding_number(points, as_given=True), expected, atol=WINDING_ERROR)
