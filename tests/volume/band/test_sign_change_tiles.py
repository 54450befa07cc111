"""Signs of the fields of open meshes: one sign for active and inactive voxels, by winding numbers also of sheets."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit import volume
from geokit.mesh import Surface, TriangleMesh
from tests.support import reference
from tests.support.devices import DEVICES

# Open sheets may have no inside, which from_mesh reports.
pytestmark = pytest.mark.filterwarnings("ignore:.* of its pieces are too thin:UserWarning")

# A few inactive voxels beside the sign change may have the other sign: this share of the box, and this near to 1/2.
WRONG_SHARE, WRONG_MARGIN = 2e-5, 0.05
# More voxels than this are sampled at random.
MOST_VOXELS = 300_000
TURNED = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]


def turned(mesh):
    return TriangleMesh(mesh.vertices @ TURNED.T + 0.123, mesh.faces, name=f"{mesh.name}_turned")


OPEN = [
    gk.mesh.load("data/samples/shell.stl"),
    mesh_catalog.spherical_cap(0.5),
    mesh_catalog.spherical_cap(0.25),
    mesh_catalog.box_without_a_lid(),
    mesh_catalog.open_cylinder(),
    mesh_catalog.sheet(),
    mesh_catalog.crossing_sheets(),
    mesh_catalog.open_shell(),
    mesh_catalog.half_shell(mesh_catalog.torus()),
]


def voxels_around(mesh, size, margin=16):
    low, high = (
        np.floor(mesh.bounds[0] / size).astype(int) - margin,
        np.ceil(mesh.bounds[1] / size).astype(int) + margin,
    )
    axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    return size * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def require_signs(mesh, size, device="cpu", **options):
    """Signs of all voxels in a box around the mesh, and of places far from it."""
    surface = Surface(mesh, device=device)
    grid = volume.from_mesh(surface, size, **options)
    points = voxels_around(mesh, size)
    if len(points) > MOST_VOXELS:
        points = np.random.default_rng(8).choice(points, MOST_VOXELS, replace=False)
    expected = surface.signed_distance(points, sign="winding").distance
    found = grid.sample(points, order=0, device="cpu")
    band = np.abs(expected) < 0.999 * grid.info.background
    clear = np.abs(expected) > 1e-6 * mesh.diagonal
    # Exactly between inside and outside, as in the plane of a box's missing lid, rounding decides on a GPU.
    clear &= np.abs(surface.winding_number(points) - 0.5) > 1e-6
    wrong = ((found < 0) != (expected < 0)) & clear
    assert not wrong[band].any()
    assert wrong.mean() <= WRONG_SHARE
    assert (np.abs(surface.winding_number(points[wrong]) - 0.5) < WRONG_MARGIN).all()
    far = mesh.diagonal * 30 * np.concatenate([np.eye(3), -np.eye(3)])
    assert (grid.sample(far, order=0, device="cpu") > 0).all()
    return grid


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("across", [11.3, 33.0])
@pytest.mark.parametrize("mesh", OPEN, ids=lambda mesh: mesh.name)
def test_every_voxel_has_the_sign_of_the_surface(mesh, across, device):
    require_signs(mesh, float(np.ptp(mesh.bounds, axis=0).max()) / across, device)


def test_signs_are_those_of_an_exact_winding_number():
    mesh = mesh_catalog.spherical_cap(0.5, 24, 8)
    grid = volume.from_mesh(mesh, 0.11, device="cpu")
    points = voxels_around(mesh, 0.11, 4)[::7]
    winding = reference.winding_number(mesh.vertices, mesh.faces, points)
    clear = (np.abs(winding - 0.5) > 0.01) & (
        reference.closest_point(mesh.vertices, mesh.faces, points).distance > 1e-6
    )
    found = grid.sample(points, order=0, device="cpu")
    np.testing.assert_array_equal(found[clear] < 0, winding[clear] > 0.5)


@pytest.mark.slow
def test_the_sign_change_may_lie_exactly_between_two_tiles():
    # The rim lies between the voxel planes z = -1 and z = 0, where two tiles meet.
    cap = mesh_catalog.spherical_cap(0.5)
    size = 1 / 37.0
    grid = require_signs(mesh_catalog.moved(cap, (0, 0, -0.5 * size)), size)
    points = size * np.array([[0, 0, 0], [0, 0, -1], [5, 5, 12], [5, 5, -12]])
    np.testing.assert_array_equal(grid.sample(points, order=0, device="cpu") < 0, [True, False, True, False])


def test_sheets_upon_each_other_reach_beyond_their_box():
    sheet = mesh_catalog.sheet(3)
    mesh = TriangleMesh(sheet.vertices, np.concatenate([sheet.faces] * 4), name="four_sheets")
    surface = Surface(mesh, device="cpu")
    grid = volume.from_mesh(surface, 0.05)
    points = np.array([[0, 0, -0.5], [0, 0, 0.5], [0, 0, -0.7], [0, 0, 0.7], [0, 0, -2], [0, 0, 2]])
    np.testing.assert_array_equal(
        grid.sample(points, order=0, device="cpu") < 0, surface.signed_distance(points, sign="winding").distance < 0
    )
    assert (surface.signed_distance(points, sign="winding").distance < 0).any()


@pytest.mark.parametrize("sign", ["pseudonormal", "parity"])
def test_other_methods_end_at_the_box_of_the_band(sign):
    # Behind a sheet all is inside by pseudonormal, without an end.
    mesh = mesh_catalog.sheet()
    surface = Surface(mesh, device="cpu")
    grid = volume.from_mesh(surface, 0.1, sign=sign)
    points = voxels_around(mesh, 0.1, 3)
    expected = surface.signed_distance(points, sign=sign).distance
    found = grid.sample(points, order=0, device="cpu")
    clear = np.abs(expected) > 1e-6
    np.testing.assert_array_equal(found[clear] < 0, expected[clear] < 0)
    assert (grid.sample([[0, 0, -30], [0, 0, 30], [30, 0, -0.1]], order=0, device="cpu") > 0).all()


def test_leaves_that_hold_a_sign_change_have_no_active_voxel():
    mesh = mesh_catalog.spherical_cap(0.5)
    signed, unsigned = (volume.from_mesh(mesh, 0.03, sign=sign, device="cpu") for sign in ("auto", "none"))
    assert signed.info.active_voxel_count == unsigned.info.active_voxel_count
    np.testing.assert_array_equal(signed.info.index_bounds, unsigned.info.index_bounds)


@pytest.mark.slow
def test_triangles_and_tolerances_follow():
    mesh = mesh_catalog.spherical_cap(0.5)
    surface = Surface(mesh, device="cpu")
    both = volume.from_mesh_with_triangles(surface, 0.06)
    alone = volume.from_mesh(surface, 0.06)
    np.testing.assert_array_equal(both.distance.nanovdb, alone.nanovdb)
    fine = volume.from_mesh(surface, tolerance=0.02, order=1, codec="float")
    size, start = float(fine.info.voxel_size[0]), fine.info.transform[:3, 3]
    points = start + size * np.random.default_rng(9).integers(-4, np.ceil(2.2 / size), (40000, 3))
    expected = surface.signed_distance(points, sign="winding").distance
    found = fine.sample(points, order=0, device="cpu")
    clear = np.abs(expected) > 0.04
    assert ((found < 0) != (expected < 0))[clear].mean() <= WRONG_SHARE


def rim_of(mesh):
    """Its boundary edges, as triangles without area."""
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    rim = edges[uses == 1]
    return TriangleMesh(mesh.vertices, np.column_stack([rim, rim[:, :1]]))


def require_no_second_surface(mesh, size, method):
    """Away from the mesh there is only the sign change, as far as the band reaches; its share of the vertices."""
    surface = Surface(mesh, device="cpu")
    shown = gk.mesh.from_volume(volume.from_mesh(surface, size), method=method, device="cpu")
    distance = surface.closest_point(shown.vertices).distance / size
    far = shown.vertices[distance > 1.5]
    assert distance.max() <= 4.0
    corners = far[:, None] + size * np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 3)
    inside = surface.contains(corners.reshape(-1, 3), sign="winding").reshape(-1, 8)
    assert (inside.any(axis=1) & ~inside.all(axis=1)).all()
    to_rim = Surface(rim_of(mesh), device="cpu").closest_point(far).distance / size
    return len(far) / len(shown.vertices), to_rim.max(initial=0.0)


@pytest.mark.parametrize("method", ["marching_cubes", "surface_nets"])
def test_the_shell_has_no_second_surface(method):
    mesh = gk.mesh.load("data/samples/shell.stl")
    share, to_rim = require_no_second_surface(mesh, 2.06 / 80, method)
    assert share <= 0.04
    assert to_rim <= 4.0
