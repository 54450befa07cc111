"""The audit's findings on meshes with known defects, and against trimesh on clean and random ones."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.core import equal_rows
from geokit.mesh import Surface, TriangleMesh, audit
from geokit.mesh.topology import connectivity
from geokit.mesh.topology.measures import DEGENERATE_RATIO


@pytest.mark.parametrize("make", mesh_catalog.CLOSED, ids=lambda make: make.__name__)
def test_closed_meshes(make):
    report = audit(make())
    assert report.watertight
    assert report.oriented
    assert not report.inside_out
    assert (report.boundary_edge_count, report.non_manifold_edge_count) == (0, 0)
    assert (report.degenerate_count, report.duplicate_count, report.coincident_count) in ((0, 0, 0), (0, 0, 1))
    assert report.signed_volume > 0


def test_known_measures():
    assert audit(mesh_catalog.tetrahedron()).signed_volume == pytest.approx(1 / 6, rel=1e-14)
    assert audit(mesh_catalog.tetrahedron()).area == pytest.approx((3 + np.sqrt(3)) / 2, rel=1e-14)
    assert audit(mesh_catalog.l_profile()).signed_volume == pytest.approx(3, rel=1e-14)
    assert audit(mesh_catalog.l_profile()).area == pytest.approx(14, rel=1e-14)
    assert audit(mesh_catalog.nested_boxes()).signed_volume == pytest.approx(26, rel=1e-14)
    assert audit(mesh_catalog.nested_boxes()).area == pytest.approx(60, rel=1e-14)
    sphere = audit(mesh_catalog.icosphere(5))
    assert sphere.signed_volume == pytest.approx(4 / 3 * np.pi, rel=2e-3)
    assert sphere.area == pytest.approx(4 * np.pi, rel=1e-3)
    report = audit(mesh_catalog.box((1, 2, 3), (2, 4, 6)))
    assert report.bounds.tolist() == [[1, 2, 3], [2, 4, 6]]
    assert report.diagonal == pytest.approx(np.sqrt(14), rel=1e-15)


def test_counts_components_and_euler_numbers():
    found = {
        make.__name__: (audit(make()).component_count, audit(make()).euler_number, audit(make()).manifold)
        for make in (*mesh_catalog.CLOSED, *mesh_catalog.OPEN)
    }
    assert found == {
        "tetrahedron": (1, 2, True),
        "box": (1, 2, True),
        "nested_boxes": (2, 4, True),
        "icosphere": (1, 2, True),
        "torus": (1, 0, True),
        "l_profile": (1, 2, True),
        "two_boxes_touching_at_a_vertex": (1, 3, False),
        "overlapping_spheres": (2, 4, True),
        "single_triangle": (1, 1, True),
        "open_shell": (1, 1, True),
        "holed_sphere": (1, -3, True),
        "sliver_fan": (1, 1, True),
        "bowtie": (1, 1, False),
    }


def test_open_meshes():
    assert audit(mesh_catalog.single_triangle()).boundary_edge_count == 3
    assert audit(mesh_catalog.open_shell(12)).boundary_edge_count == 48
    for make in mesh_catalog.OPEN:
        report = audit(make())
        assert not report.watertight
        assert not report.inside_out
        assert report.oriented
        assert report.degenerate_count == 0


def test_inside_out():
    report = audit(mesh_catalog.inside_out_box())
    assert report.watertight
    assert report.oriented
    assert report.inside_out
    assert report.signed_volume == -1.0
    assert audit(mesh_catalog.scaled(mesh_catalog.torus(), -1.0)).inside_out
    # An open mesh has no inside, so it cannot be inside out.
    shell = mesh_catalog.holed_sphere()
    assert not audit(TriangleMesh(shell.vertices, shell.faces[:, ::-1])).inside_out


def test_flipped_faces():
    report = audit(mesh_catalog.flipped_faces())
    assert report.watertight
    assert report.manifold
    assert not report.oriented
    assert not report.inside_out


def test_duplicates():
    report = audit(mesh_catalog.duplicate_faces())
    assert report.duplicate_count == 3
    assert report.non_manifold_edge_count > 0
    assert not report.watertight
    assert not report.manifold
    # A copy with its own vertices is still a copy of the surface.
    assert audit(mesh_catalog.join(mesh_catalog.box(), mesh_catalog.box())).duplicate_count == 12
    assert audit(TriangleMesh(np.eye(3), [[0, 1, 2]] * 4)).duplicate_count == 3


def test_duplicates_are_compared_corner_by_corner(monkeypatch):
    # The numbers used to find equal faces do not matter: here they are all the same.
    monkeypatch.setattr(equal_rows, "_scrambled", lambda count: np.zeros(count, np.uint64))
    assert audit(mesh_catalog.duplicate_faces()).duplicate_count == 3
    assert audit(mesh_catalog.torus()).duplicate_count == 0


def test_triangles_without_area():
    report = audit(mesh_catalog.zero_area_triangles())
    assert report.degenerate_count == 2
    assert report.area == 6.0
    report = audit(mesh_catalog.collapsed_faces())
    assert report.degenerate_count == 3
    assert report.watertight
    assert report.manifold
    assert report.euler_number == 2
    points = audit(TriangleMesh([[0, 0, 0]] * 3, [[0, 1, 2]]))
    assert (points.degenerate_count, points.component_count, points.area, points.euler_number) == (1, 1, 0.0, 0)


@pytest.mark.parametrize("size", [1e-150, 1e-8, 1.0, 1e8, 1e100])
def test_degenerate_is_relative_to_the_longest_edge(size):
    def height(share: float) -> TriangleMesh:
        return TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [0.5, share, 0]]) * size, [[0, 1, 2]])

    assert audit(height(2 * DEGENERATE_RATIO)).degenerate_count == 0
    assert audit(height(DEGENERATE_RATIO / 2)).degenerate_count == 1
    assert audit(mesh_catalog.scaled(mesh_catalog.sliver_fan(), size)).degenerate_count == 0


def test_non_manifold_edge():
    report = audit(mesh_catalog.three_on_an_edge())
    assert (report.non_manifold_edge_count, report.boundary_edge_count) == (1, 6)
    assert not report.manifold
    assert not report.watertight
    # Both ends of the edge.
    assert report.non_manifold_vertex_count == 2


def test_non_manifold_vertices():
    assert audit(mesh_catalog.two_boxes_touching_at_a_vertex()).non_manifold_vertex_count == 1
    assert audit(mesh_catalog.bowtie()).non_manifold_vertex_count == 1
    for make in mesh_catalog.CLOSED:
        if audit(make()).manifold:
            assert audit(make()).non_manifold_vertex_count == 0
    # Two cones tip to tip: more faces at the tip than are walked one by one.
    cone = mesh_catalog.cone(200, 1.0)
    tips = mesh_catalog.join(cone, mesh_catalog.moved(mesh_catalog.scaled(cone, -1.0), (0, 0, 2)))
    assert audit(cone).non_manifold_vertex_count == 0
    assert audit(tips).non_manifold_vertex_count == 1
    half = TriangleMesh(cone.vertices, cone.faces[:100])
    assert audit(half).non_manifold_vertex_count == 0


def test_aspect_ratios():
    side = TriangleMesh([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(3) / 2, 0]], [[0, 1, 2]])
    assert audit(side).aspect_ratio_quantiles == pytest.approx(np.ones(5), rel=1e-14)
    # 3, 4, 5: the radius of the inscribed circle is 1.
    right = TriangleMesh([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]])
    assert audit(right).aspect_ratio_quantiles == pytest.approx(np.full(5, 5 / (2 * np.sqrt(3))), rel=1e-14)
    both = audit(mesh_catalog.join(side, right, mesh_catalog.collapsed_faces())).aspect_ratio_quantiles
    assert both[0] == pytest.approx(1.0, rel=1e-14)
    assert both[4] == np.inf
    legs = (1 + np.sqrt(2) / 2) * np.sqrt(2) * 2 / (2 * np.sqrt(3))
    assert both[2] == pytest.approx(legs, rel=1e-14)
    assert np.isnan(audit(TriangleMesh(np.eye(3), np.zeros((0, 3), int))).aspect_ratio_quantiles).all()


@pytest.mark.parametrize("seed", range(3))
def test_aspect_ratio_quantiles_are_those_of_triangles(seed):
    random = np.random.default_rng(seed)
    corners = random.normal(size=(random.integers(1, 40), 3, 3))
    report = audit(TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)))
    ratios = []
    for triangle in corners:
        edges = [np.linalg.norm(triangle[k] - triangle[k - 1]) for k in range(3)]
        half = sum(edges) / 2
        # Heron's formula.
        radius = np.sqrt(np.prod([half - edge for edge in edges]) / half)
        ratios.append(max(edges) / (2 * np.sqrt(3) * radius))
    expected = np.quantile(ratios, [0, 0.25, 0.5, 0.75, 1], method="nearest")
    assert report.aspect_ratio_quantiles == pytest.approx(expected, rel=1e-9)


def test_self_intersections_are_counted_on_request():
    spheres = mesh_catalog.overlapping_spheres()
    assert audit(spheres).self_intersection_count is None
    found = Surface(spheres, device="cpu").self_intersections()
    assert len(found) > 0
    assert audit(spheres, self_intersections=True).self_intersection_count == len(found)
    assert audit(mesh_catalog.box(), self_intersections=True).self_intersection_count == 0
    assert audit(TriangleMesh(np.eye(3), np.zeros((0, 3), int)), self_intersections=True).self_intersection_count == 0


def test_unreferenced_and_coincident_vertices():
    report = audit(mesh_catalog.unreferenced_vertices())
    assert report.unreferenced_count == 2
    assert report.bounds.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert report.watertight
    assert report.euler_number == 2
    whole, parts = audit(mesh_catalog.torus()), audit(mesh_catalog.soup(mesh_catalog.torus()))
    assert parts.coincident_count == 3 * whole.face_count - whole.vertex_count
    different = {"vertex_count", "coincident_count", "bounds"}
    for field in dataclasses.fields(whole):
        if field.name not in different and getattr(whole, field.name) is not None:
            assert getattr(parts, field.name) == pytest.approx(getattr(whole, field.name), rel=1e-13), field.name


def test_negative_zero_is_zero():
    vertices = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, -0.0, 0], [1, -0.0, -0.0], [0, 0, 1]]
    report = audit(TriangleMesh(vertices, [[0, 1, 2], [4, 3, 5]]))
    assert (report.coincident_count, report.component_count, report.boundary_edge_count) == (2, 1, 4)


def test_mesh_without_faces():
    for vertices in (np.zeros((0, 3)), np.eye(3)):
        report = audit(TriangleMesh(vertices, np.zeros((0, 3), int)))
        assert (report.face_count, report.component_count, report.euler_number) == (0, 0, 0)
        assert (report.area, report.signed_volume) == (0.0, 0.0)
        assert not any((report.watertight, report.manifold, report.oriented, report.inside_out))
        assert np.isnan(report.bounds).all()
        assert report.unreferenced_count == len(vertices)


@pytest.mark.parametrize("make", mesh_catalog.CLOSED, ids=lambda make: make.__name__)
def test_far_away_keeps_the_digits_of_the_coordinates(make):
    here, there = audit(make()), audit(mesh_catalog.far_away(make(), 1e6))
    # Coordinates near 1e6 are rounded by up to 1e-10 of the unit-sized mesh.
    assert there.signed_volume == pytest.approx(here.signed_volume, rel=1e-8)
    assert there.area == pytest.approx(here.area, rel=1e-8)
    assert (there.watertight, there.oriented, there.manifold) == (here.watertight, here.oriented, here.manifold)
    assert there.degenerate_count == 0


@pytest.mark.parametrize("size", [1e-300, 1e-150, 1e150, 1.7e308])
def test_any_size_that_float64_holds(size):
    report = audit(mesh_catalog.box((-size, -size, -size), (size, size, size)))
    with np.errstate(over="ignore", under="ignore"):
        assert report.signed_volume == pytest.approx(float(8 * np.float64(size) ** 3), rel=1e-12)
        assert report.area == pytest.approx(float(24 * np.float64(size) ** 2), rel=1e-12)
        assert report.diagonal == pytest.approx(float(np.float64(size) * 2 * np.sqrt(3)), rel=1e-12)
    assert report.watertight
    assert report.degenerate_count == 0


@pytest.fixture(params=["NumPy", "kernels", "sorted indices"])
def way(request, monkeypatch):
    """The three code paths: NumPy for small meshes, kernels for large ones, another sort for very large ones."""
    monkeypatch.setattr(connectivity, "KERNELS_PAY", 0 if request.param == "kernels" else 1 << 62)
    if request.param == "sorted indices":
        monkeypatch.setattr(connectivity, "PACKED_END", 0)
    return request.param


@pytest.mark.parametrize("seed", range(20))
def test_agrees_with_trimesh_on_random_triangles(seed, way):
    import trimesh

    random = np.random.default_rng(seed)
    vertices = random.normal(size=(random.integers(4, 30), 3))
    faces = random.integers(0, len(vertices), (random.integers(1, 60), 3))
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    if not len(faces):
        faces = np.array([[0, 1, 2]])
    report = audit(TriangleMesh(vertices, faces))
    other = trimesh.Trimesh(vertices, faces, process=False)
    _, uses = np.unique(other.edges_sorted, axis=0, return_counts=True)
    assert report.boundary_edge_count == np.count_nonzero(uses == 1)
    assert report.non_manifold_edge_count == np.count_nonzero(uses > 2)
    assert report.euler_number == len(np.unique(faces)) - len(uses) + len(faces)
    assert report.component_count == _component_count(faces)
    assert report.area == pytest.approx(other.area, rel=1e-12)
    assert report.duplicate_count == len(faces) - len({frozenset(face) for face in faces.tolist()})
    assert report.manifold == (not (uses > 2).any() and _single_fans(faces))
    assert report.non_manifold_vertex_count == _split_vertex_count(faces)


def _component_count(faces: np.ndarray) -> int:
    pieces: list[set[int]] = []
    for face in faces.tolist():
        touching = [piece for piece in pieces if piece & set(face)]
        pieces = [piece for piece in pieces if not piece & set(face)] + [set(face).union(*touching)]
    return len(pieces)


def _split_vertex_count(faces: np.ndarray) -> int:
    """Vertices whose faces are not connected through edges of exactly two faces."""
    uses: dict[frozenset, int] = {}
    for face in faces.tolist():
        for k in range(3):
            edge = frozenset((face[k], face[k - 1]))
            uses[edge] = uses.get(edge, 0) + 1
    found = 0
    for vertex in np.unique(faces).tolist():
        fans: list[list[list[int]]] = []
        for face in (face for face in faces.tolist() if vertex in face):
            inner = {frozenset((vertex, other)) for other in face if other != vertex}
            joined = [fan for fan in fans if any(uses[e] == 2 and e <= set(f) for e in inner for f in fan)]
            fans = [fan for fan in fans if fan not in joined] + [[face, *(f for fan in joined for f in fan)]]
        found += len(fans) > 1
    return found


def _single_fans(faces: np.ndarray) -> bool:
    for vertex in np.unique(faces):
        # The edges opposite to the vertex are connected exactly if its faces form one fan.
        rings = [[corner for corner in face if corner != vertex] for face in faces.tolist() if vertex in face]
        if _component_count(np.array(rings)) > 1:
            return False
    return True


@pytest.mark.parametrize("seed", range(10))
def test_fans_on_random_manifold_pieces(seed, way):
    # A torus with random holes, some of them meeting at a vertex only, and random windings.
    random = np.random.default_rng(seed)
    torus = mesh_catalog.torus(8, 6)
    faces = torus.faces[random.random(len(torus.faces)) < 0.7]
    flips = random.random(len(faces)) < 0.3
    faces = np.where(flips[:, None], faces[:, ::-1], faces)
    report = audit(TriangleMesh(torus.vertices, faces))
    assert report.manifold == _single_fans(faces)
    assert report.non_manifold_vertex_count == _split_vertex_count(faces)


@pytest.mark.parametrize("make", [*mesh_catalog.CLOSED, *mesh_catalog.OPEN, *mesh_catalog.DEFECTIVE])
def test_large_meshes_are_audited_as_small_ones(make, monkeypatch):
    found = []
    for threshold in (0, 1 << 62):
        monkeypatch.setattr(connectivity, "KERNELS_PAY", threshold)
        found.append(audit(make()))
    # Equal to the last bit, because the path depends on whether warp is loaded.
    for field in dataclasses.fields(found[0]):
        np.testing.assert_array_equal(*(getattr(report, field.name) for report in found), err_msg=field.name)


@pytest.mark.parametrize("threads", ["1", "2"])
def test_a_mesh_of_many_pieces_and_slices(threads, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", threads)
    torus = mesh_catalog.torus(200, 100)
    report = audit(mesh_catalog.join(*(mesh_catalog.moved(torus, (3.0 * k, 0, 0)) for k in range(4))))
    assert (report.component_count, report.euler_number, report.manifold, report.oriented) == (4, 0, True, True)
    # One half of each quad: no two share an edge, and each vertex has three.
    half = audit(TriangleMesh(torus.vertices, torus.faces[: len(torus.faces) // 2]))
    assert (half.boundary_edge_count, half.non_manifold_vertex_count) == (60000, 20000)
