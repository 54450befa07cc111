"""simplify on small meshes: merged parts, kept parts, unchanged meshes, and every error."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh._audit import audit
from geokit.mesh._simplify import Simplified, simplify
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.simplification import collapse
from geokit.mesh.simplification.collapse import collapsed
from geokit.mesh.simplification.invariants import shape_of, turned_faces
from geokit.mesh.simplification.proof import far_faces
from geokit.mesh.surfaces.surface import Surface
from tests.support.reference import closest_point


def rough(count: int, seed: int) -> TriangleMesh:
    """A square sheet of bumps about as wide as its triangles."""
    x, y = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count), indexing="ij")
    rng = np.random.default_rng(seed)
    z = sum(0.01 * np.sin(rng.uniform(20, 60) * x + rng.uniform(20, 60) * y + rng.uniform(0, 6)) for _ in range(4))
    i = np.arange(count * count).reshape(count, count)
    quads = np.stack([i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]], axis=-1).reshape(-1, 4)
    return TriangleMesh(np.stack([x, y, z], -1).reshape(-1, 3), np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]))


def flat_box(count: int = 6) -> TriangleMesh:
    """The surface of a unit cube, count^2 squares on each side."""
    line = np.linspace(0.0, 1.0, count + 1)
    x, y = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    a, b, c, d = ((i + di) * (count + 1) + j + dj for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)))
    square = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    sides = []
    for axis in range(3):
        for level in (0.0, 1.0):
            points = np.roll(np.stack([x, y, np.full_like(x, level)], axis=1), axis, axis=1)
            sides.append(TriangleMesh(points, square if level else square[:, ::-1], name="side"))
    return gk.mesh.merge_vertices(mesh_catalog.join(*sides))


def test_flat_sides_become_two_triangles_each():
    mesh = flat_box()
    assert audit(mesh).watertight
    found = simplify(mesh, tolerance=1e-3, device="cpu")
    assert isinstance(found, Simplified)
    assert len(found.mesh.faces) == 12
    # The corners stay where they were, to the bit.
    assert sorted(found.mesh.vertices.tolist()) == sorted(mesh_catalog.box().vertices.tolist())
    assert found.deviation < 1e-4
    assert audit(found.mesh).signed_volume == 1.0


def test_a_mesh_of_which_nothing_can_go_comes_back_as_it_is():
    for mesh in (
        mesh_catalog.tetrahedron(),
        mesh_catalog.box(),
        mesh_catalog.l_profile(),
        mesh_catalog.single_triangle(),
    ):
        found = simplify(mesh, tolerance=1e-3, device="cpu")
        assert found.mesh is mesh
        assert (found.deviation, found.deviation_p999) == (0.0, 0.0)


def test_tolerance_below_the_rounding_of_the_coordinates_changes_nothing():
    far = mesh_catalog.far_away(mesh_catalog.icosphere(2), 1e9)
    assert simplify(far, tolerance=1e-8, device="cpu").mesh is far


@pytest.mark.slow
def test_more_tolerance_takes_more_faces():
    mesh = mesh_catalog.icosphere(2)
    counts = [len(simplify(mesh, tolerance=t, device="cpu").mesh.faces) for t in (0.03, 0.12, 0.4)]
    assert 4 <= counts[2] < 0.7 * counts[1] < 0.7 * 0.7 * counts[0] < 0.7 * 0.7 * 0.7 * len(mesh.faces)


@pytest.mark.slow
def test_deviation_and_percentile_are_those_of_brute_force():
    mesh = mesh_catalog.torus(32, 16)
    found = simplify(mesh, tolerance=0.03, device="cpu")
    distances = []
    for one, other in ((mesh, found.mesh), (found.mesh, mesh)):
        points = gk.mesh.sample_surface(one, 16000, seed=9).points
        points = np.concatenate([points, one.vertices])
        distances.append(closest_point(other.vertices, other.faces, points).distance)
    largest = max(d.max() for d in distances)
    assert largest <= found.deviation <= 0.03
    assert type(found.deviation) is type(found.deviation_p999) is float
    # Bounds are 2% of the tolerance wide; samples slightly underestimate the largest distance.
    assert found.deviation <= largest + 0.1 * 0.03
    p999 = max(np.quantile(d, 0.999) for d in distances)
    assert found.deviation_p999 == pytest.approx(p999, rel=0.1)
    assert found.deviation_p999 <= found.deviation


@pytest.mark.slow
@pytest.mark.parametrize("make", [*mesh_catalog.CLOSED, *mesh_catalog.OPEN, *mesh_catalog.DEFECTIVE])
def test_hangs_together_as_before(make):
    mesh = make()
    found = simplify(mesh, tolerance=0.05 * mesh.diagonal, device="cpu").mesh
    before, after = audit(mesh), audit(found)
    assert (after.watertight, after.manifold, after.oriented) == (before.watertight, before.manifold, before.oriented)
    assert after.component_count == before.component_count
    if before.manifold:
        assert after.euler_number == before.euler_number
    assert after.degenerate_count <= before.degenerate_count
    assert (after.boundary_edge_count == 0) == (before.boundary_edge_count == 0)
    if before.watertight and before.oriented:
        assert (after.signed_volume > 0) == (before.signed_volume > 0)


@pytest.mark.slow
def test_boundaries_are_followed():
    mesh = mesh_catalog.open_shell(24)
    found = simplify(mesh, tolerance=0.02, device="cpu").mesh
    # The square's outline, seen from above, is still the outline.
    lower, upper = found.vertices.min(axis=0), found.vertices.max(axis=0)
    np.testing.assert_allclose([lower[:2], upper[:2]], [[-1, -1], [1, 1]], atol=0.02)
    a, b, c = (found.vertices[corner, :2] for corner in found.faces.T)
    ab, ac = b - a, c - a
    area = 0.5 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    assert (area > 0).all()
    assert area.sum() == pytest.approx(4.0, abs=0.1)


def test_vertices_at_one_position_are_one():
    mesh = mesh_catalog.icosphere(2)
    whole, soup = (simplify(m, tolerance=0.05, device="cpu").mesh for m in (mesh, mesh_catalog.soup(mesh)))
    assert len(soup.faces) < 0.4 * len(mesh.faces)
    assert audit(soup).watertight
    assert audit(soup).coincident_count == 0
    assert abs(len(whole.faces) - len(soup.faces)) < 0.25 * len(whole.faces)


def test_unused_vertices_go_and_the_name_stays():
    mesh = mesh_catalog.icosphere(2)
    more = TriangleMesh(np.concatenate([[[50.0, 0, 0]], mesh.vertices]), mesh.faces + 1, name="ball")
    found = simplify(more, tolerance=0.05, device="cpu").mesh
    assert found.name == "ball"
    assert audit(found).unreferenced_count == 0
    assert found.diagonal < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("part", [1 << 14, 100])
def test_input_runs_and_threads_change_nothing(monkeypatch, part):
    monkeypatch.setattr(collapse, "PART", part)
    mesh = mesh_catalog.torus(48, 24) if part == 100 else mesh_catalog.torus(24, 12)
    vertices, faces = mesh.vertices.copy(), mesh.faces.copy()
    found = [simplify(mesh, tolerance=0.1, device="cpu")]
    for threads in ("1", "2"):
        monkeypatch.setenv("GEOKIT_THREADS", threads)
        found.append(simplify(mesh, tolerance=0.1, device="cpu"))
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
    for other in found[1:]:
        np.testing.assert_array_equal(other.mesh.vertices, found[0].mesh.vertices)
        np.testing.assert_array_equal(other.mesh.faces, found[0].mesh.faces)
        assert other[1:] == found[0][1:]


def test_parts_leave_no_seams(monkeypatch):
    # Borders of parts stay in one round, and lie within parts in the next one.
    mesh = mesh_catalog.icosphere(5)
    whole = simplify(mesh, tolerance=0.01, device="cpu")
    monkeypatch.setattr(collapse, "PART", 2000)
    found = simplify(mesh, tolerance=0.01, device="cpu")
    assert found.deviation <= 0.01
    assert audit(found.mesh).watertight
    assert len(found.mesh.faces) < 1.1 * len(whole.mesh.faces)
    assert not np.array_equal(found.mesh.vertices, whole.mesh.vertices)


def test_where_the_proof_fails_alone_less_is_collapsed(monkeypatch):
    # A wave whose crests run between the vertices of a fine, flat frame: points that are looked at miss the crests.
    x, y = np.meshgrid(np.linspace(0, 1, 61), np.linspace(0, 1, 61), indexing="ij")
    z = np.where((x > 0.4) & (x < 0.6) & (y > 0.4) & (y < 0.6), 0.02 * np.sin(70 * (x + 0.3 * y)), 0.0)
    i = np.arange(61 * 61).reshape(61, 61)
    quads = np.stack([i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]], axis=-1).reshape(-1, 4)
    mesh = TriangleMesh(np.stack([x, y, z], -1).reshape(-1, 3), np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]))
    asked = []

    def counted(mesh, limit, *rest, **options):
        asked.append(limit.copy())
        return collapsed(mesh, limit, *rest, **options)

    monkeypatch.setattr(collapse, "collapsed", counted)
    found = simplify(mesh, tolerance=0.003, device="cpu")
    assert found.deviation <= 0.003
    assert len(asked) > 1
    assert 0 < (asked[-1] < asked[0]).mean() < 0.2
    flat = np.abs(mesh.vertices[mesh.faces][..., 2]).max(axis=1) == 0.0
    assert (asked[-1] < asked[0])[flat].mean() < 0.05


class TestFaceCount:
    @pytest.mark.parametrize("wanted", [640, 100, 21])
    def test_no_more_than_asked_for(self, wanted):
        mesh = mesh_catalog.icosphere(3)
        found = simplify(mesh, face_count=wanted, device="cpu")
        assert 0.9 * wanted - 2 <= len(found.mesh.faces) <= wanted
        points = np.concatenate([mesh.vertices, gk.mesh.sample_surface(mesh, 500, seed=1).points])
        largest = closest_point(found.mesh.vertices, found.mesh.faces, points).distance.max()
        assert largest <= found.deviation < largest + 0.1 * mesh.diagonal

    def test_parts_take_the_edges_that_one_would(self, monkeypatch):
        # Flat on one side, rough on the other: parts that each lost the same share would waste faces on the flat one.
        mesh = rough(90, 0)
        z = mesh.vertices[:, 2] * (mesh.vertices[:, 0] > 0.5)
        mesh = TriangleMesh(np.column_stack([mesh.vertices[:, :2], z]), mesh.faces)
        whole = simplify(mesh, face_count=4000, device="cpu")
        monkeypatch.setattr(collapse, "PART", 1000)
        found = [simplify(mesh, face_count=4000, device="cpu")]
        for threads in ("1", "2"):
            monkeypatch.setenv("GEOKIT_THREADS", threads)
            found.append(simplify(mesh, face_count=4000, device="cpu"))
        assert (found[0].mesh.vertices[found[0].mesh.faces].mean(axis=1)[:, 0] < 0.4).mean() < 0.08
        assert 3990 <= found[0].mesh.face_count <= 4000
        assert found[0].deviation_p999 < 1.2 * whole.deviation_p999
        assert not np.array_equal(found[0].mesh.vertices, whole.mesh.vertices)
        for other in found[1:]:
            np.testing.assert_array_equal(other.mesh.vertices, found[0].mesh.vertices)
            np.testing.assert_array_equal(other.mesh.faces, found[0].mesh.faces)

    def test_faces_do_not_turn_over_little_by_little(self):
        # Two of its faces did, and the mesh was refused.
        mesh = rough(90, 0)
        steep = TriangleMesh(mesh.vertices * [1.0, 1.0, 4.0], mesh.faces)
        found = simplify(steep, face_count=3168, device="cpu").mesh
        assert (found.face_normals[:, 2] > 0.0).all()

    def test_the_deviation_is_measured_when_it_is_read(self, monkeypatch):
        mesh, asked, module = mesh_catalog.icosphere(3), [], sys.modules["geokit.mesh._hausdorff"]
        hausdorff = module.hausdorff
        monkeypatch.setattr(module, "hausdorff", lambda *a, **k: asked.append(1) or hausdorff(*a, **k))
        found, other = (simplify(mesh, face_count=300, device="cpu") for _ in range(2))
        assert (found.mesh.face_count, asked) == (300, [])
        assert found.deviation > found.deviation_p999 > 0.0
        assert type(found.deviation) is type(found.deviation_p999) is float
        assert asked == [1]
        # In all else it is the tuple of these three.
        _, deviation, p999 = other
        known = (found.mesh, deviation, p999)
        assert tuple(found) == known == found
        assert found == Simplified(*known)
        assert Simplified(*known) == found
        assert found[1:] == (deviation, p999)
        assert found == other != other._replace(deviation=1.0)
        assert found != other._replace(deviation=1.0)
        assert hash(found) == hash(known)
        assert repr(found) == repr(Simplified(*known))
        assert found._replace(deviation=1.0) == (found.mesh, 1.0, p999)
        assert pickle.loads(pickle.dumps(other))[1:] == (deviation, p999)

    def test_as_many_as_there_are_changes_nothing(self):
        mesh = mesh_catalog.box()
        assert simplify(mesh, face_count=12, device="cpu") == Simplified(mesh, 0.0, 0.0)

    def test_too_few_to_hang_together_says_how_many_do(self):
        mesh = mesh_catalog.torus()
        with pytest.raises(gk.InputError, match=r"face_count: with 4 faces torus .* ask for (\d+) or more") as caught:
            simplify(mesh, face_count=4, device="cpu")
        reachable = int(str(caught.value).split("ask for ")[1].split()[0])
        assert 8 <= reachable <= 60
        assert audit(simplify(mesh, tolerance=10.0, device="cpu").mesh).euler_number == 0


class TestRefused:
    def test_neither_or_both(self):
        with pytest.raises(gk.InputError, match="neither given"):
            simplify(mesh_catalog.box())
        with pytest.raises(gk.InputError, match="both given"):
            simplify(mesh_catalog.box(), tolerance=0.1, face_count=4)

    @pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "fine"])
    def test_tolerance(self, value):
        with pytest.raises(gk.InputError, match="tolerance"):
            simplify(mesh_catalog.box(), tolerance=value)

    @pytest.mark.parametrize("value", [-1, 2.5, True, "few"])
    def test_face_count(self, value):
        with pytest.raises(gk.InputError, match="face_count"):
            simplify(mesh_catalog.box(), face_count=value)

    def test_mesh(self):
        with pytest.raises(gk.InputError, match="not a TriangleMesh"):
            simplify(np.zeros((3, 3)), tolerance=1.0)
        with pytest.raises(gk.InputError, match="no faces"):
            simplify(TriangleMesh([[0, 0, 0]], []), tolerance=1.0)

    def test_device(self):
        with pytest.raises(gk.InputError, match="device"):
            simplify(mesh_catalog.box(), tolerance=1.0, device="abacus")


def within(one: Surface, other: Surface, limit: float) -> bool:
    """Whether no face of either has a point beyond the limit; each point that is named is one."""
    for mesh, surface in ((one.mesh, other), (other.mesh, one)):
        points = far_faces(mesh, surface, limit)
        far = ~np.isnan(points[:, 0])
        assert (closest_point(surface.mesh.vertices, surface.mesh.faces, points[far]).distance > 0.99 * limit).all()
        if far.any():
            return False
    return True


class TestParts:
    """Each check on its own must notice the defect that it is for."""

    def test_within_is_decided_on_both_sides_and_between_vertices(self):
        low = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        high = mesh_catalog.moved(low, (0, 0, 0.5))
        # Half of the triangle: near in one direction only.
        half = TriangleMesh([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]], [[0, 1, 2]])
        # Its corners are on the box, its center is not: no vertex reveals the distance.
        inner = TriangleMesh([[0, 0, 0], [1, 1, 0], [0, 1, 1]], [[0, 1, 2]])
        low, high, half, inner, box = (Surface(m, device="cpu") for m in (low, high, half, inner, flat_box()))
        assert within(low, high, 0.51)
        assert not within(low, high, 0.49)
        assert not within(low, half, 0.4)
        assert not within(half, low, 0.4)
        assert within(low, half, 0.51)
        assert within(low, half, 0.6)
        depth = closest_point(box.mesh.vertices, box.mesh.faces, inner.mesh.vertices.mean(axis=0)[None]).distance[0]
        assert depth > 0.3
        assert not within(box, inner, 0.9)
        assert within(box, inner, 2.0)

    def test_decided_where_no_vertex_is_far(self):
        # A frame of width 1/4 and the square that fills it: every vertex of either lies on the other, and only the
        # middle of the square is far from the frame.
        outer = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64)
        k = np.arange(4)
        after = (k + 1) % 4
        sides = np.concatenate([np.stack([k, after, 4 + after], axis=1), np.stack([k, 4 + after, 4 + k], axis=1)])
        frame = Surface(TriangleMesh(np.concatenate([outer, 0.75 * outer]), sides), device="cpu")
        square = Surface(TriangleMesh(outer, [[0, 1, 2], [0, 2, 3]]), device="cpu")
        for one, other in ((frame, square), (square, frame)):
            assert not within(one, other, 0.74)
            assert within(one, other, 0.76)

    def test_turned_faces_are_noticed(self):
        mesh = mesh_catalog.icosphere(2)
        original = Surface(mesh, device="cpu")
        assert not len(turned_faces(mesh, original, 0.05))
        faces = mesh.faces.copy()
        faces[7] = faces[7][::-1]
        assert turned_faces(TriangleMesh(mesh.vertices, faces), original, 0.05).tolist() == [7]

    def test_thin_walls_are_no_turned_faces(self):
        plate = mesh_catalog.box((0, 0, 0), (1, 1, 0.01))
        moved = mesh_catalog.moved(plate, (0, 0, -0.008))
        # The upper side now lies next to the lower side of the original.
        assert not len(turned_faces(moved, Surface(plate, device="cpu"), 0.02))
        assert len(turned_faces(moved, Surface(plate, device="cpu"), 0.001))

    @pytest.mark.parametrize(
        "other",
        [
            mesh_catalog.holed_sphere,
            mesh_catalog.torus,
            mesh_catalog.flipped_faces,
            mesh_catalog.overlapping_spheres,
            lambda: mesh_catalog.with_fins(mesh_catalog.icosphere()),
            lambda: mesh_catalog.with_duplicates(mesh_catalog.icosphere()),
        ],
    )
    def test_another_shape_is_noticed(self, other):
        sphere = shape_of(mesh_catalog.icosphere())
        assert sphere.is_kept_by(shape_of(mesh_catalog.icosphere(1)))
        assert not sphere.is_kept_by(shape_of(other()))

    def test_boundary_loops_are_counted(self):
        assert shape_of(mesh_catalog.icosphere()).boundary_loop_count == 0
        assert shape_of(mesh_catalog.open_shell()).boundary_loop_count == 1
        sphere = mesh_catalog.icosphere()
        centers = sphere.vertices[sphere.faces].mean(axis=1)
        keep = np.abs(centers[:, 2]) < 0.8
        assert shape_of(TriangleMesh(sphere.vertices, sphere.faces[keep])).boundary_loop_count == 2

    def test_unmoved_vertices_keep_float64(self):
        mesh = flat_box()
        shaken = TriangleMesh(mesh.vertices * (1.0 + 1e-9), mesh.faces)
        found, _ = collapsed(shaken, math.inf, 12)
        assert len(found.faces) == 12
        assert set(map(tuple, found.vertices.tolist())) <= set(map(tuple, shaken.vertices.tolist()))


def test_nothing_is_imported_until_it_is_used():
    code = "import sys, geokit.mesh; geokit.mesh.simplify\n"
    code += "print([m for m in sys.modules if m.startswith(('vtk', 'warp'))])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
