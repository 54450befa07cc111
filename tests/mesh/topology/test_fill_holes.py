"""Holes filled: what stays, what is closed, and that the area is the least."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from benchmarks import inputs
from benchmarks.catalog import mesh_catalog as catalog
from geokit.errors import InputError, MissingDependencyError
from geokit.mesh import MeshPart, TriangleMesh, audit, fill_holes, orient
from geokit.mesh.topology import fairing
from tests.mesh.topology.test_repair import moebius

SOLIDS = (catalog.box, catalog.icosphere, catalog.torus, catalog.l_profile, catalog.nested_boxes, catalog.tetrahedron)


def without(mesh: TriangleMesh, rows) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, np.delete(mesh.faces, rows, axis=0), name=mesh.name)


def tube(rim: np.ndarray, height: float = 1.0) -> TriangleMesh:
    """A wall over a closed line (N, 3) and a point above it: its one hole is that line."""
    i = np.arange(len(rim))
    faces = np.stack([i, np.roll(i, -1), np.full(len(rim), len(rim))], axis=1)
    top = rim.mean(axis=0) + np.array([0.0, 0.0, height])
    return TriangleMesh(np.concatenate([rim, top[None]]), faces)


def circle(count: int, wave: float = 0.0) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle), wave * np.sin(3 * angle)], axis=1)


def triangulations(first: int, last: int):
    """All sets of triangles over the polygon first .. last, by the apex over the side from first to last."""
    if last - first < 2:
        yield ()
    for apex in range(first + 1, last):
        for one, other in itertools.product(triangulations(first, apex), triangulations(apex, last)):
            yield (*one, *other, (first, apex, last))


def require_sound(mesh: TriangleMesh, found) -> None:
    """All that fill_holes promises of any mesh."""
    before, after = audit(mesh, self_intersections=True), audit(found.mesh, self_intersections=True)
    assert np.array_equal(found.mesh.vertices[: mesh.vertex_count], mesh.vertices)
    assert len(found.mesh.vertices) == mesh.vertex_count or found.faired.any()
    assert np.array_equal(np.sort(found.mesh.faces[found.hole < 0], axis=1), np.sort(mesh.faces, axis=1))
    assert after.self_intersection_count == before.self_intersection_count
    assert after.non_manifold_edge_count == before.non_manifold_edge_count
    assert after.duplicate_count == before.duplicate_count
    assert set(found.hole[found.hole >= 0]) == set(np.flatnonzero(found.filled))
    # A patch over a loop of n sides with p points in between has n - 2 + 2 p faces.
    sides = np.bincount(found.hole[found.hole >= 0], minlength=len(found.filled))[found.filled] + 2
    added = found.mesh.vertex_count - mesh.vertex_count
    assert after.boundary_edge_count == before.boundary_edge_count - sides.sum() + 2 * added
    assert after.unreferenced_count <= before.unreferenced_count
    assert not (found.faired & ~found.filled).any()
    again = orient(found.mesh)
    assert not again.flipped.any()


@pytest.mark.parametrize("make", SOLIDS, ids=lambda make: make.__name__)
def test_each_missing_face_is_put_back(make):
    whole = make()
    for row in range(0, whole.face_count, max(1, whole.face_count // 20)):
        mesh = without(whole, row)
        found = fill_holes(mesh)
        require_sound(mesh, found)
        assert found.filled.tolist() == [True]
        corners = whole.vertices[whole.faces[row]]
        assert found.width[0] == pytest.approx(np.linalg.norm(corners - corners[[1, 2, 0]], axis=1).max(), rel=1e-12)
        assert np.allclose(found.center[0], corners.mean(axis=0), rtol=1e-12, atol=1e-12)
        assert found.mesh.volume == pytest.approx(whole.volume, rel=1e-12)


@settings(max_examples=25)
@given(st.sampled_from(SOLIDS), st.floats(0.02, 0.6), st.integers(0, 2**31))
def test_what_a_mesh_was_it_still_is(make, share, seed):
    whole = make()
    mesh = without(whole, np.random.default_rng(seed).random(whole.face_count) < share)
    require_sound(mesh, fill_holes(mesh))


@pytest.mark.parametrize("damage", [catalog.with_flips, catalog.with_duplicates, catalog.with_fins, catalog.soup])
def test_damaged_meshes_get_no_worse(damage):
    mesh = damage(catalog.with_holes(catalog.icosphere(3), 0.05))
    found = fill_holes(mesh)
    require_sound(mesh, found)
    assert found.filled.any()


@pytest.mark.parametrize("mesh", [make() for make in (*catalog.CLOSED, *catalog.DEFECTIVE)], ids=lambda mesh: mesh.name)
def test_any_mesh_is_taken(mesh):
    require_sound(mesh, fill_holes(mesh))


@given(st.integers(4, 8), st.integers(0, 2**31))
def test_the_area_is_the_least(count, seed):
    # A line around an axis is star-shaped from it, so that no patch crosses the far wall.
    rng = np.random.default_rng(seed)
    rim = circle(count, 0.0) * rng.uniform(0.7, 1.0, (count, 1)) + [0, 0, 1] * rng.uniform(-0.2, 0.2, (count, 1))
    found = fill_holes(tube(rim, 20.0))
    patch = found.mesh.vertices[found.mesh.faces[found.hole == 0]]
    size = found.width[0]

    def cost(triangles: np.ndarray) -> float:
        a, b, c = triangles.swapaxes(0, 1)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        edges = np.concatenate([b - a, c - b, a - c])
        # Inner edges count twice in the sum and once in the cost; the sides are the same in all.
        return float(area / size**2 + 1e-3 * (edges**2).sum() / size**2 / 2)

    best = min(cost(rim[np.array(each)]) for each in triangulations(0, count - 1))
    assert cost(patch) == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("count", [255, 256, 257, 2000])
@pytest.mark.parametrize("wave", [0.0, 0.3])
def test_long_rims_are_filled(count, wave):
    mesh = tube(circle(count, wave), 3.0)
    found = fill_holes(mesh)
    require_sound(mesh, found)
    assert found.filled.all()
    assert audit(found.mesh).watertight
    if not wave:
        flat = found.mesh.vertices[found.mesh.faces[found.hole == 0]]
        area = 0.5 * np.linalg.norm(np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]), axis=1).sum()
        assert area == pytest.approx(0.5 * count * np.sin(2 * np.pi / count), rel=1e-12)
        assert found.width[0] == pytest.approx(2.0, abs=1e-4)


@pytest.mark.parametrize("single", [False, True], ids=["float64", "float32"])
@pytest.mark.parametrize("count", [3, 12, 63, 100])
def test_straight_sides_of_many_points_are_filled(count, single):
    # A box's edge has points between its corners; three points of it are no triangle, whatever rounding makes of them.
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0.3, 1, 0], [0.3, 0.4, 0], [0, 0.4, 0]])
    share = np.arange(count)[:, None] / count
    rim = np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    turn, _ = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))
    mesh = tube(rim)
    for vertices in (mesh.vertices, mesh.vertices @ turn.T + turn[0]):
        given = TriangleMesh(vertices.astype(np.float32).astype(float) if single else vertices, mesh.faces)
        found = fill_holes(given)
        assert found.filled.all()
        assert abs(found.mesh.volume) == pytest.approx((0.4 + 0.7 * 0.6) / 3, rel=1e-5)
        assert audit(found.mesh, self_intersections=True).self_intersection_count == 0


@pytest.mark.parametrize("count", [40, 120, 300])
def test_the_area_is_the_same_far_from_the_origin(count):
    # There corners may be rounded by much, if they were read from float32; these were not.
    top = circle(count, 0.3) + 0.02 * np.random.default_rng(3).normal(size=(count, 1)) * [0, 0, 1]
    i = np.arange(count)
    j = np.roll(i, -1)
    faces = np.concatenate([np.stack([i, j, count + j], 1), np.stack([i, count + j, count + i], 1)])
    vertices = np.concatenate([top * [1, 1, 0] - [0, 0, 3], top])
    areas = []
    for away in (0.0, 1e5, 1e6):
        found = fill_holes(TriangleMesh(vertices + away, faces))
        assert found.filled.all()
        a, b, c = np.moveaxis(found.mesh.vertices[found.mesh.faces[found.hole >= 0]], 1, 0)
        areas.append(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    assert areas[1:] == pytest.approx(2 * areas[:1], rel=1e-6)


@pytest.mark.parametrize("height", [1.0, 0.5])
def test_long_rims_with_sharp_edges_are_filled(height):
    # Each ear of the lid of a cone turns back by more than half a right angle.
    mesh = tube(circle(300), height)
    found = fill_holes(mesh)
    require_sound(mesh, found)
    assert found.filled.all()


def test_wide_holes_stay():
    mesh = without(catalog.icosphere(3), [0, 5, 6, 7, 20, 21, 22, 23])
    every = fill_holes(mesh)
    narrow = fill_holes(mesh, max_width=np.sort(every.width)[0])
    assert every.filled.all()
    assert len(every.width) > 1
    assert np.array_equal(narrow.width, every.width)
    assert np.array_equal(narrow.filled, every.width <= every.width.min())
    require_sound(mesh, narrow)


def test_the_border_of_a_flat_sheet_stays():
    mesh = catalog.sheet()
    found = fill_holes(mesh)
    assert found.filled.tolist() == [False]
    assert np.array_equal(found.mesh.faces, mesh.faces)


def test_a_border_with_one_side_is_filled_where_faces_can_be_wound():
    found = fill_holes(moebius())
    require_sound(moebius(), found)
    assert not found.filled.all()


def test_holes_that_touch_at_a_vertex_are_two():
    whole = catalog.icosphere(2)
    shared = 20
    around = np.flatnonzero((whole.faces == shared).any(axis=1))
    first = around[0]
    apart = next(row for row in around if len(set(whole.faces[row]) & set(whole.faces[first])) == 1)
    mesh = without(whole, [first, apart])
    found = fill_holes(mesh)
    require_sound(mesh, found)
    assert found.filled.tolist() == [True, True]
    assert audit(found.mesh).watertight


def test_a_hole_within_an_edge_that_is_taken():
    # Both diagonals of the square hole are edges of the mesh already: no triangles are left for it.
    corners = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    roof = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    for braces in ([[0, 2, 5]], [[0, 2, 5], [1, 3, 5]]):
        mesh = TriangleMesh(corners, [*roof, *braces])
        found = fill_holes(mesh)
        require_sound(mesh, found)
        assert not found.filled[np.argmax(found.width)]


def test_attributes_and_parts_go_on():
    whole = catalog.join(catalog.box(), catalog.moved(catalog.box(), (3, 0, 0)))
    kept = np.delete(np.arange(24), [1, 14])
    faces = whole.faces[kept]
    mesh = TriangleMesh(
        whole.vertices,
        faces,
        name="two",
        parts=[MeshPart("a", 0, 11), MeshPart("b", 11, 11)],
        vertex_data={"v": np.arange(16)},
        face_data={"f": kept},
        corner_data={"c": whole.vertices[faces]},
        meters_per_unit=0.001,
        up_axis="z",
    )
    found = fill_holes(mesh)
    full = found.mesh
    assert [(part.name, part.face_count) for part in full.parts] == [("a", 12), ("b", 12)]
    for part, hole in zip(full.parts, found.hole[found.hole >= 0], strict=True):
        rows = slice(part.first_face, part.first_face + part.face_count)
        assert (found.hole[rows] >= 0).sum() == 1
        assert hole in found.hole[rows]
    assert np.array_equal(full.corner_data["c"], full.vertices[full.faces])
    assert np.array_equal(full.face_data["f"][found.hole < 0], kept)
    for row in np.flatnonzero(found.hole >= 0):
        beside = np.flatnonzero((full.face_data["f"] == full.face_data["f"][row]) & (found.hole < 0))
        assert len(set(full.faces[row]) & set(full.faces[beside[0]])) == 2
    assert (full.name, full.meters_per_unit, full.up_axis) == ("two", 0.001, "z")
    assert np.array_equal(full.vertex_data["v"], np.arange(16))


@pytest.mark.parametrize("scale", [1e-200, 1e-30, 1e30, 1e200])
def test_sizes_do_not_matter(scale):
    mesh = without(catalog.icosphere(2), [0, 1, 2, 50])
    found, large = fill_holes(mesh), fill_holes(catalog.scaled(mesh, scale))
    assert np.array_equal(found.mesh.faces, large.mesh.faces)
    assert np.allclose(large.width / scale, found.width, rtol=1e-12)


def test_meshes_of_other_sizes_than_expected():
    for vertices, faces in ([], []), ([[0, 0, 0]], []), ([[0, 0, 0]], [[0, 0, 0]]):
        mesh = TriangleMesh(np.reshape(vertices, (-1, 3)), np.reshape(faces, (-1, 3)).astype(int))
        found = fill_holes(mesh)
        assert (found.mesh.face_count, len(found.width), found.center.shape) == (mesh.face_count, 0, (0, 3))


def test_bad_input_is_named():
    for bad, message in ((np.nan, "max_width"), (-1.0, "0 or more"), ("wide", "max_width")):
        with pytest.raises(InputError, match=message):
            fill_holes(catalog.box(), max_width=bad)
    with pytest.raises(InputError, match="mesh"):
        fill_holes(3)


def test_a_scan_with_two_holes_becomes_closed():
    dome = gk.mesh.load(gk.sample_path("shell.stl"))
    found = fill_holes(dome)
    require_sound(dome, found)
    assert audit(found.mesh).watertight


# Patches that are fair.


def cap(whole: TriangleMesh, height: float, more: TriangleMesh | None = None) -> TriangleMesh:
    """What is below a height, and another mesh."""
    mesh = without(whole, whole.vertices[whole.faces].mean(axis=1)[:, 2] > height)
    return catalog.join(mesh, more) if more else mesh


def patch_points(found) -> np.ndarray:
    """Points on the patches (N, 3)."""
    corners = found.mesh.vertices[found.mesh.faces[found.hole >= 0]]
    shares = np.random.default_rng(0).dirichlet((1, 1, 1), 20)
    return np.einsum("sk,fkj->sfj", shares, corners).reshape(-1, 3)


@pytest.mark.parametrize("height", [0.9, 0.7, 0.4, 0.0])
def test_a_sphere_is_a_sphere_again(height):
    mesh = cap(catalog.icosphere(4), height)
    plain, fair = fill_holes(mesh), fill_holes(mesh, fair=True)
    require_sound(mesh, fair)
    assert (plain.faired.tolist(), fair.faired.tolist()) == ([False], [True])
    off, left = (np.abs(np.linalg.norm(patch_points(found), axis=1) - 1.0).max() for found in (fair, plain))
    # Faces of a sphere are as far from it by their size: 0.0014.
    assert off < max(0.003, left / 30.0)
    corners = fair.mesh.vertices[fair.mesh.faces[fair.hole >= 0]]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert 0.02 < edges.min() < edges.max() < 0.15  # 0.07 around it


def test_what_is_noisy_is_no_worse_than_its_noise():
    whole = catalog.icosphere(4)
    noisy = TriangleMesh(
        whole.vertices + 0.002 * np.random.default_rng(1).normal(size=(len(whole.vertices), 3)), whole.faces
    )
    found = fill_holes(cap(noisy, 0.7), fair=True)
    require_sound(cap(noisy, 0.7), found)
    assert np.abs(np.linalg.norm(patch_points(found), axis=1) - 1.0).max() < 0.02  # 0.28 without


def test_a_saddle_goes_on():
    # The inner side of a torus bends both ways.
    whole = catalog.torus(64, 32)
    middle = whole.vertices[whole.faces].mean(axis=1)
    mesh = without(whole, np.linalg.norm(middle - [0.65, 0.0, 0.0], axis=1) < 0.3)
    off = []
    for fair in (True, False):
        found = fill_holes(mesh, fair=fair)
        require_sound(mesh, found)
        points = patch_points(found)
        off.append(np.abs(np.hypot(np.hypot(*points[:, :2].T) - 1.0, points[:, 2]) - 0.35).max())
    assert off[0] < 0.006 < 0.09 < off[1]


def test_a_plane_stays_one():
    box = inputs.subdivided(catalog.box(), 4)
    middle = box.vertices[box.faces].mean(axis=1)
    mesh = without(box, np.linalg.norm(middle - [0.5, 0.5, 1.0], axis=1) < 0.25)
    found = fill_holes(mesh, fair=True)
    require_sound(mesh, found)
    assert found.faired.tolist() == [True]
    assert found.mesh.vertex_count > mesh.vertex_count
    assert found.mesh.volume == pytest.approx(1.0, rel=1e-12)


def test_what_is_in_the_way_keeps_a_patch_plain():
    # Above the plain patch at 0.7, below the sphere.
    mesh = cap(catalog.icosphere(3), 0.7, catalog.moved(catalog.scaled(catalog.icosphere(1), 0.05), (0.0, 0.0, 0.97)))
    plain, fair = fill_holes(mesh), fill_holes(mesh, fair=True)
    require_sound(mesh, fair)
    assert (fair.filled.tolist(), fair.faired.tolist()) == ([True], [False])
    assert np.array_equal(fair.mesh.faces, plain.mesh.faces)
    assert np.array_equal(fair.mesh.vertices, plain.mesh.vertices)


def test_large_patches_stay_plain(monkeypatch):
    mesh = catalog.join(cap(catalog.icosphere(4), 0.9), catalog.moved(cap(catalog.icosphere(3), 0.9), (3.0, 0.0, 0.0)))
    monkeypatch.setattr(fairing, "MOST_FACES", 100)
    found = fill_holes(mesh, fair=True)
    require_sound(mesh, found)
    assert found.filled.all()
    assert sorted(found.faired.tolist()) == [False, True]
    assert np.bincount(found.hole[found.hole >= 0])[found.faired] <= 100


@settings(max_examples=15)
@given(st.sampled_from(SOLIDS), st.floats(0.02, 0.6), st.integers(0, 2**31))
def test_fair_patches_keep_what_plain_ones_do(make, share, seed):
    whole = inputs.subdivided(make(), 1)
    mesh = without(whole, np.random.default_rng(seed).random(whole.face_count) < share)
    found = fill_holes(mesh, fair=True)
    require_sound(mesh, found)
    assert np.array_equal(found.filled, fill_holes(mesh).filled)


def test_new_vertices_have_attributes_of_the_rim():
    whole = catalog.icosphere(4)
    mesh = cap(whole, 0.8)
    values = np.arange(mesh.vertex_count)
    data = {
        "vertex_data": {"v": values},
        "corner_data": {"c": values[mesh.faces]},
        "face_data": {"f": mesh.faces[:, 0]},
    }
    given = TriangleMesh(mesh.vertices, mesh.faces, name="cap", meters_per_unit=0.001, **data)
    found = fill_holes(given, fair=True)
    full, new = found.mesh, found.hole >= 0
    rim = np.intersect1d(full.faces[new], values)
    assert np.array_equal(full.vertex_data["v"][: len(values)], values)
    assert np.isin(full.vertex_data["v"][len(values) :], rim).all()
    assert np.array_equal(full.vertex_data["v"][full.faces], full.corner_data["c"])
    assert (full.name, full.meters_per_unit) == ("cap", 0.001)


@pytest.mark.parametrize("scale", [2.0**-660, 2.0**660])
def test_sizes_do_not_matter_to_fair_patches(scale):
    mesh = cap(catalog.icosphere(3), 0.7)
    found, large = fill_holes(mesh, fair=True), fill_holes(catalog.scaled(mesh, scale), fair=True)
    assert large.faired.all()
    assert np.allclose(large.mesh.vertices / scale, found.mesh.vertices, atol=1e-9)


def test_without_scipy_there_is_a_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.sparse", None)
    with pytest.raises(MissingDependencyError, match=r"a fair patch of a hole needs the package scipy.*\[fair\]"):
        fill_holes(cap(catalog.icosphere(2), 0.7), fair=True)
    with pytest.raises(InputError, match="fair"):
        fill_holes(catalog.box(), fair=1)
