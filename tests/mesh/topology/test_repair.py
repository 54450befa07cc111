"""Consistent and outward winding, merged vertices, removed faces: on meshes small enough to know the answer."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, InputError
from geokit.mesh import MeshPart, Surface, TriangleMesh, audit
from geokit.mesh._repair import drop_degenerate, merge_vertices, orient
from geokit.mesh.topology import connectivity, merge_near, orientation
from geokit.mesh.topology.orientation import orient_faces


def turned(mesh: TriangleMesh, rows=slice(None)) -> TriangleMesh:
    faces = mesh.faces.copy()
    faces[rows] = faces[rows, ::-1]
    return TriangleMesh(mesh.vertices, faces, name=mesh.name, parts=mesh.parts)


def cube(lower: float, upper: float, outward: bool = True) -> TriangleMesh:
    box = mesh_catalog.box((lower,) * 3, (upper,) * 3)
    return box if outward else turned(box)


def moebius(count: int = 9) -> TriangleMesh:
    """A strip of 2 count triangles with half a turn in it: one side only."""
    angle = 2 * np.pi * np.arange(count) / count
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    across = np.stack([np.cos(angle) * np.cos(angle / 2), np.sin(angle) * np.cos(angle / 2), np.sin(angle / 2)], axis=1)
    vertices = np.concatenate([ring + 0.3 * across, ring - 0.3 * across])
    i = np.arange(count)
    j, last = (i + 1) % count, i == count - 1
    # The strip closes with its two borders exchanged.
    top, bottom = np.where(last, j + count, j), np.where(last, j, j + count)
    faces = np.concatenate([np.stack([i, top, i + count], axis=1), np.stack([top, bottom, i + count], axis=1)])
    return TriangleMesh(vertices, faces, name="moebius")


@pytest.mark.parametrize("make", [*mesh_catalog.CLOSED, *mesh_catalog.OPEN], ids=lambda make: make.__name__)
def test_what_is_oriented_stays(make):
    mesh = make()
    found = orient(mesh)
    assert found.mesh is mesh
    assert found.consistent
    assert not found.flipped.any()
    assert orient_faces(mesh, Surface).closed == (make in mesh_catalog.CLOSED)


@pytest.mark.parametrize("make", mesh_catalog.CLOSED, ids=lambda make: make.__name__)
def test_what_is_inside_out_is_turned_as_a_whole(make):
    found = orient(turned(make()))
    assert found.flipped.all()
    assert np.array_equal(found.mesh.faces, make().faces)
    assert orient(mesh_catalog.scaled(make(), -1.0)).flipped.all()


@pytest.mark.parametrize("share", [0.05, 0.3])
@pytest.mark.parametrize("make", mesh_catalog.CLOSED, ids=lambda make: make.__name__)
def test_flipped_faces_of_solids_are_turned_back(make, share):
    mesh = make()
    broken = mesh_catalog.with_flips(mesh, share)
    found = orient(broken)
    assert np.array_equal(found.mesh.faces, mesh.faces)
    assert np.array_equal(found.flipped, (broken.faces != mesh.faces).any(axis=1))
    assert found.consistent
    assert orient_faces(broken, Surface).closed


def test_half_of_the_faces_of_a_solid():
    # The volume decides, not the winding of the majority.
    sphere = mesh_catalog.icosphere()
    assert np.array_equal(orient(turned(sphere, slice(0, 200))).mesh.faces, sphere.faces)
    assert np.array_equal(orient(turned(mesh_catalog.soup(sphere), slice(1, None, 2))).flipped, np.arange(320) % 2 == 1)


def test_open_pieces_go_with_most_of_their_faces():
    shell = mesh_catalog.open_shell()
    some = turned(shell, slice(0, None, 3))
    assert np.array_equal(orient(some).mesh.faces, shell.faces)
    # However many faces are reversed: an open mesh has no inside.
    assert np.array_equal(orient(turned(some)).mesh.faces, turned(shell).faces)
    assert not orient_faces(some, Surface).closed
    # Half of the faces each way: the lowest face stays.
    square = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 2, 3]])
    assert orient(square).flipped.tolist() == [False, True]


def test_pieces_are_told_apart():
    box, shell = mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.open_shell(2), (5, 0, 0))
    mesh = mesh_catalog.join(turned(box), shell, turned(mesh_catalog.moved(box, (9, 0, 0)), [3, 4]))
    found = orient(mesh)
    assert np.flatnonzero(found.flipped).tolist() == [*range(12), 12 + len(shell.faces) + 3, 12 + len(shell.faces) + 4]
    assert found.mesh.parts == mesh.parts
    assert audit(found.mesh).oriented


def test_one_sided_pieces_are_left_and_told():
    strip = moebius()
    assert audit(strip).boundary_edge_count == 18
    found = orient(strip)
    assert not found.consistent
    assert not found.flipped.any()
    # The other components are oriented nevertheless.
    beside = mesh_catalog.join(strip, turned(mesh_catalog.moved(mesh_catalog.box(), (5, 0, 0)), [0]))
    assert np.flatnonzero(orient(beside).flipped).tolist() == [len(strip.faces)]
    assert not orient(beside).consistent
    assert not orient_faces(beside, Surface).closed


def test_moebius_with_a_whole_turn_is_consistent():
    ring = mesh_catalog.torus(9, 6)
    assert orient(turned(ring, slice(0, 20))).consistent


NESTED = {
    # name: windings of the cubes from the outermost to the innermost, as given and in the result (True: outward).
    "cavity": ([True, False], [True, False]),
    "inside out with its cavity": ([False, True], [True, False]),
    "a solid in a solid": ([True, True], [True, True]),
    "two solids inside out": ([False, False], [True, True]),
    "a solid in a cavity": ([True, False, True], [True, False, True]),
    "a solid in a cavity, all inside out": ([False, True, False], [True, False, True]),
    "a hollow solid in a solid": ([True, True, False], [True, True, False]),
    "a cavity in a cavity": ([True, False, False], [True, False, True]),
    "a cavity in a cavity in a solid in a solid": ([True, True, False, False], [True, True, False, False]),
    "more cavities than solids": ([True, False, False, False], [True, False, True, False]),
}


@pytest.mark.parametrize("ways", NESTED.values(), ids=NESTED)
@pytest.mark.parametrize("backwards", [False, True])
def test_nested_pieces_turn_with_the_outermost(ways, backwards):
    given, expected = ways
    cubes = [cube(k, 20 - k, outward) for k, outward in enumerate(given)]
    flipped = np.repeat(np.array(given) != np.array(expected), 12)
    if backwards:
        cubes, flipped = cubes[::-1], flipped[::-1]
    mesh = mesh_catalog.join(*cubes)
    found = orient(mesh)
    assert np.array_equal(found.flipped, flipped)
    # An existing surface is used, and gives the same answer.
    assert np.array_equal(orient_faces(mesh, Surface, surface=Surface(mesh, device="cpu")).flipped, flipped)
    # No point has a negative winding number.
    points = np.linspace(0.5, 10, 20)[:, None] + np.array([0.0, 0.03, 0.07])
    assert (_signed_passages(found.mesh, points) >= 0).all()


def _signed_passages(mesh: TriangleMesh, points: np.ndarray) -> np.ndarray:
    from tests.support import reference

    return np.round(reference.winding_number(mesh.vertices, mesh.faces, points)).astype(int)


@pytest.mark.parametrize("threads", ["1", "2"])
def test_large_meshes_are_oriented_as_small_ones(threads, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", threads)
    torus = mesh_catalog.torus(160, 80)
    mesh = mesh_catalog.join(
        *(mesh_catalog.moved(torus, (3.0 * k, 0, 0)) for k in range(3)), moebius(), mesh_catalog.open_shell(60)
    )
    broken = mesh_catalog.with_flips(mesh, 0.2)
    found = []
    for threshold in (0, 1 << 62):
        monkeypatch.setattr(connectivity, "KERNELS_PAY", threshold)
        found.append(orient(broken))
        assert not found[-1].consistent
    assert np.array_equal(found[0].flipped, found[1].flipped)
    strip = slice(3 * len(torus.faces), 3 * len(torus.faces) + 18)
    assert not found[0].flipped[strip].any()
    assert np.array_equal(np.delete(found[0].mesh.faces, strip, axis=0), np.delete(mesh.faces, strip, axis=0))


def test_flips_within_a_cavity_keep_it_one():
    mesh = mesh_catalog.nested_boxes()
    assert np.array_equal(orient(turned(mesh, [1, 14, 20])).mesh.faces, mesh.faces)
    # At a distance from each other, nested boxes do not matter.
    apart = mesh_catalog.join(mesh, mesh_catalog.moved(turned(mesh), (100, 0, 0)))
    assert orient(apart).flipped.tolist() == [False] * 24 + [True] * 24


def test_a_box_in_the_box_but_not_in_the_solid():
    # The box of the L holds the cube, the L does not.
    ell = mesh_catalog.l_profile()
    beside = mesh_catalog.box((1.2, 1.2, 0.2), (1.8, 1.8, 0.8))
    within = mesh_catalog.box((0.2, 0.2, 0.2), (0.8, 0.8, 0.8))
    assert orient(mesh_catalog.join(ell, turned(beside))).flipped.tolist() == [False] * 20 + [True] * 12
    assert not orient(mesh_catalog.join(ell, turned(within))).flipped.any()


def test_many_pieces(monkeypatch):
    # More components than are compared box by box.
    monkeypatch.setattr(orientation, "MANY_PIECES", 4)
    boxes = [mesh_catalog.moved(cube(0, 1, k % 2 == 0), (3.0 * k, 0, 0)) for k in range(9)]
    assert np.array_equal(orient(mesh_catalog.join(*boxes)).flipped, np.repeat(np.arange(9) % 2 == 1, 12))


def test_pieces_that_touch_at_vertices_and_edges():
    box = mesh_catalog.box()
    at_vertex = mesh_catalog.join(box, turned(mesh_catalog.box((1, 1, 1), (2, 2, 2))))
    assert orient(at_vertex).flipped.tolist() == [False] * 12 + [True] * 12
    # Four faces at the common edge: still two solids.
    at_edge = mesh_catalog.join(box, turned(mesh_catalog.box((1, 1, 0), (2, 2, 1))))
    assert audit(at_edge).non_manifold_edge_count == 1
    assert orient(at_edge).flipped.tolist() == [False] * 12 + [True] * 12
    assert orient(at_edge).consistent
    assert not orient_faces(at_edge, Surface).closed


@pytest.mark.parametrize("merged", [False, True])
def test_hollow_solids_with_a_wall_in_common_stay_hollow(merged):
    # Each has four edges of three or four faces, and bounds a volume only together with the other.
    hollow = mesh_catalog.join(cube(0, 3), cube(1, 2, outward=False))
    both = mesh_catalog.join(hollow, mesh_catalog.moved(hollow, (3.0, 0, 0)), cube(3.1, 4), cube(-3, 0))
    both = merge_vertices(both) if merged else both
    assert not orient(both).flipped.any()
    assert orient(turned(both)).flipped.all()
    inside = [[0.5, 1.5, 1.5], [3.5, 1.5, 1.5]]
    for mesh in (both, turned(both)):
        assert Surface(mesh, device="cpu").contains([[1.5] * 3, [4.5, 1.5, 1.5], *inside]).tolist() == [
            False,
            False,
            True,
            True,
        ]


def test_copies_of_faces_turn_along():
    mesh = mesh_catalog.duplicate_faces()
    assert not orient(mesh).flipped.any()
    assert orient(turned(mesh)).flipped.all()
    flipped = orient(turned(mesh, [1])).flipped
    # Face 13 is a copy of face 1.
    assert np.flatnonzero(flipped).tolist() == [1, 13]
    twice = mesh_catalog.join(mesh_catalog.box(), mesh_catalog.box())
    assert orient(turned(twice)).flipped.all()
    assert not orient_faces(twice, Surface).closed
    # A single face, given twice: in the same winding and reversed.
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert not orient(TriangleMesh(corners, [[0, 1, 2], [0, 1, 2]])).flipped.any()
    assert not orient_faces(TriangleMesh(corners, [[0, 1, 2], [0, 1, 2]]), Surface).closed
    assert not orient(TriangleMesh(corners, [[0, 1, 2], [2, 1, 0]])).flipped.any()


def test_faces_that_take_no_part():
    mesh = mesh_catalog.collapsed_faces()
    found = orient(turned(mesh))
    assert found.flipped.tolist() == [True] * 12 + [False] * 3
    assert orient_faces(mesh, Surface).closed
    points = TriangleMesh([[0, 0, 0]] * 3, [[0, 1, 2]])
    assert orient(points).mesh is points
    assert not orient_faces(points, Surface).closed


def test_sheets_folded_flat_have_no_volume():
    # A square as two sheets of different triangles: closed, but with either winding it bounds no volume.
    square = [[0, 0, 0.1], [1, 0, 0.2], [1, 1, 0.3], [0, 1, 0.2]]
    sheet = TriangleMesh(square, [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    flat = TriangleMesh(np.array(square) * [1, 1, 0], sheet.faces)
    for mesh in (flat, turned(flat)):
        assert audit(mesh).watertight
        assert not orient(mesh).flipped.any()


@pytest.mark.parametrize("factor", [1e-150, 1e-9, 1e9, 1e150])
@pytest.mark.parametrize("distance", [0.0, 1e6])
def test_any_size_and_place(factor, distance):
    mesh = turned(mesh_catalog.far_away(mesh_catalog.nested_boxes(), distance), [0, 3, 17])
    assert np.flatnonzero(orient(mesh_catalog.scaled(mesh, factor)).flipped).tolist() == [0, 3, 17]


def test_empty_meshes():
    for vertices in (np.zeros((0, 3)), np.eye(3)):
        empty = TriangleMesh(vertices, np.zeros((0, 3), int))
        assert orient(empty).mesh is empty
        assert orient(empty).consistent
        assert not orient_faces(empty, Surface).closed
        assert len(merge_vertices(empty, tolerance=2.0).vertices) == min(len(vertices), 1)
        assert len(merge_vertices(empty).vertices) == len(vertices)
        assert len(drop_degenerate(empty, duplicates=True).vertices) == len(vertices)
        assert len(drop_degenerate(empty, unreferenced=True).vertices) == 0


def test_equal_vertices_become_one():
    torus = mesh_catalog.torus()
    merged = merge_vertices(mesh_catalog.soup(torus))
    assert len(merged.vertices) == len(torus.vertices)
    assert np.array_equal(merged.vertices[merged.faces], torus.vertices[torus.faces])
    mesh = mesh_catalog.join(mesh_catalog.box(), mesh_catalog.box((1, 0, 0), (2, 1, 1)))
    merged = merge_vertices(mesh)
    assert (len(merged.vertices), merged.parts, merged.name) == (12, mesh.parts, mesh.name)
    # The first of each group stays, in order; -0.0 equals 0.0; unused vertices are merged like the others.
    vertices = [[0, 0, 0], [1, 0, 0], [-0.0, 0, 0], [0, 1, 0], [7, 7, 7], [1, 0, 0]]
    merged = merge_vertices(TriangleMesh(vertices, [[2, 5, 3]]))
    assert merged.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [7, 7, 7]]
    assert merged.faces.tolist() == [[0, 1, 2]]


def test_near_vertices_become_the_first():
    line = np.zeros((6, 3))
    line[:, 0] = [0.0, 0.6, 1.2, 1.8, 1.0, 9.0]
    merged = merge_vertices(TriangleMesh(line, [[0, 1, 2], [3, 4, 5]]), tolerance=1.0)
    # 0 absorbs 0.6 and 1.0; 1.2 stays and absorbs 1.8: the chain does not collapse.
    assert merged.vertices[:, 0].tolist() == [0.0, 1.2, 9.0]
    assert merged.faces.tolist() == [[0, 0, 1], [1, 0, 2]]
    # Just below the distance nothing is absorbed.
    assert len(merge_vertices(TriangleMesh(line, [[0, 1, 2]]), tolerance=np.nextafter(1.2 - 1.0, 0)).vertices) == 6
    # A box with noisy corners.
    rng = np.random.default_rng(5)
    soup = mesh_catalog.soup(mesh_catalog.box())
    shaky = TriangleMesh(soup.vertices + rng.uniform(-1e-7, 1e-7, soup.vertices.shape), soup.faces)
    assert not audit(shaky).watertight
    assert audit(merge_vertices(shaky, tolerance=1e-6)).watertight
    assert len(merge_vertices(shaky, tolerance=1e-6).vertices) == 8


def test_rows_of_near_vertices(monkeypatch):
    # Each vertex waits for the previous one: more than the rounds in which all are decided at once.
    line = np.zeros((300, 3))
    line[:, 0] = np.arange(300)
    for rounds in (0, 2, 1000):
        monkeypatch.setattr(merge_near, "ROUNDS", rounds)
        kept = merge_vertices(TriangleMesh(line, [[0, 1, 299]]), tolerance=2.5).vertices[:, 0]
        assert kept.tolist() == list(range(0, 300, 3))


@pytest.mark.parametrize("size", [1e-200, 1e-9, 1e9, 1e300])
def test_tolerance_of_any_size(size):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0.99, 0]]) * size
    mesh = TriangleMesh(corners, [[0, 1, 2], [0, 1, 3]])
    assert len(merge_vertices(mesh, tolerance=0.011 * size).vertices) == 3
    assert len(merge_vertices(mesh, tolerance=0.009 * size).vertices) == 4
    assert len(merge_vertices(mesh, tolerance=1e308).vertices) == 1
    assert len(merge_vertices(mesh, tolerance=5e-324).vertices) == 4


@pytest.mark.parametrize(
    ("tolerance", "message"), [(-1e-9, "not a distance"), (np.nan, "finite"), (np.inf, "finite"), ("wide", "a number")]
)
def test_tolerance_must_be_a_distance(tolerance, message):
    with pytest.raises(InputError, match=f"tolerance: .* {message}"):
        merge_vertices(mesh_catalog.box(), tolerance=tolerance)


def test_tolerance_far_above_the_resolution():
    with pytest.raises(InputError, match="tolerance: 10 takes in 2562 vertices around the average one"):
        merge_vertices(mesh_catalog.icosphere(4), tolerance=10.0)


def test_pairs_that_do_not_fit_in_memory(monkeypatch):
    monkeypatch.setattr(available_memory, "available", lambda device: 0)
    with pytest.raises(DeviceMemoryError, match="8 queries have 8 neighbors"):
        merge_vertices(mesh_catalog.box(), tolerance=0.1)


def test_faces_without_area_are_dropped():
    box = mesh_catalog.box()
    for make in (mesh_catalog.collapsed_faces, mesh_catalog.zero_area_triangles):
        mesh = make()
        assert drop_degenerate(mesh).faces.tolist() == box.faces.tolist()
        assert np.array_equal(drop_degenerate(mesh).vertices, mesh.vertices)
        assert audit(drop_degenerate(mesh)).degenerate_count == 0
    # Equal positions of different indices.
    points = TriangleMesh([[0, 0, 0], [1, 0, 0], [1, 0, 0]], [[0, 1, 2]])
    assert len(drop_degenerate(points).faces) == 0
    fan = mesh_catalog.sliver_fan()
    assert len(drop_degenerate(fan).faces) == len(fan.faces)


def test_copies_are_dropped_on_request():
    mesh = mesh_catalog.duplicate_faces()
    assert len(drop_degenerate(mesh).faces) == 15
    assert drop_degenerate(mesh, duplicates=True).faces.tolist() == mesh_catalog.box().faces.tolist()
    twice = mesh_catalog.join(mesh_catalog.box(), mesh_catalog.box())
    dropped = drop_degenerate(twice, duplicates=True)
    assert dropped.faces.tolist() == mesh_catalog.box().faces.tolist()
    assert dropped.parts == (MeshPart("box", 0, 12), MeshPart("box", 12, 0))


def test_unreferenced_vertices_are_dropped_on_request():
    mesh = mesh_catalog.unreferenced_vertices()
    assert len(drop_degenerate(mesh).vertices) == 10
    assert drop_degenerate(mesh, unreferenced=True).vertices.tolist() == mesh_catalog.box().vertices.tolist()
    last = TriangleMesh([[9, 9, 9], [0, 0, 0], [8, 8, 8], [1, 0, 0], [0, 1, 0]], [[1, 3, 4], [0, 2, 0]])
    kept = drop_degenerate(last, unreferenced=True)
    assert (kept.vertices.tolist(), kept.faces.tolist()) == ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])


def test_parts_follow_their_faces():
    whole = mesh_catalog.join(
        mesh_catalog.collapsed_faces(), mesh_catalog.single_triangle(), mesh_catalog.zero_area_triangles()
    )
    dropped = drop_degenerate(whole)
    assert [tuple(part) for part in dropped.parts] == [
        ("collapsed_faces", 0, 12),
        ("single_triangle", 12, 1),
        ("zero_area_triangles", 13, 12),
    ]
    assert dropped.name == whole.name


def test_inputs_are_not_changed():
    mesh = mesh_catalog.join(turned(mesh_catalog.box(), [2]), mesh_catalog.collapsed_faces())
    before = mesh.vertices.copy(), mesh.faces.copy()
    orient(mesh)
    merge_vertices(mesh, tolerance=0.1)
    drop_degenerate(mesh, duplicates=True, unreferenced=True)
    assert np.array_equal(mesh.vertices, before[0])
    assert np.array_equal(mesh.faces, before[1])
