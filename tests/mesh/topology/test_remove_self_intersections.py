"""Self-intersections removed: nothing crosses, all else is as it was, the deviation holds; or nothing is done."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from benchmarks.catalog import mesh_catalog as catalog
from geokit.errors import InputError
from geokit.mesh import MeshPart, TriangleMesh, audit, hausdorff, remove_self_intersections
from tests.support import reference
from tests.support.effort import of_all

KEPT = ("component_count", "euler_number", "boundary_edge_count", "non_manifold_edge_count", "watertight", "oriented")


def bent(mesh: TriangleMesh, vertices: np.ndarray) -> TriangleMesh:
    return TriangleMesh(vertices, mesh.faces)


def pushed(mesh: TriangleMesh, count: int, seed: int, low: float = 0.2, high: float = 1.5) -> TriangleMesh:
    """Some vertices of a body around the origin pushed through its other side, or into it."""
    rng = np.random.default_rng(seed)
    vertices, rows = mesh.vertices.copy(), rng.permutation(mesh.vertex_count)[:count]
    vertices[rows] *= -rng.uniform(low, high, (count, 1))
    return bent(mesh, vertices)


def noisy(mesh: TriangleMesh, width: float, size: float, seed: int, at: int = 0) -> TriangleMesh:
    """Noise on all vertices near one."""
    vertices = mesh.vertices.copy()
    near = np.linalg.norm(vertices - vertices[at], axis=1) < width
    vertices[near] += np.random.default_rng(seed).normal(0.0, size, (near.sum(), 3))
    return bent(mesh, vertices)


def spike(height: float, subdivisions: int = 5) -> TriangleMesh:
    """A sphere with a smooth dent, several faces wide, which comes out of the other side."""
    ball = catalog.icosphere(subdivisions)
    away = np.linalg.norm(ball.vertices - ball.vertices[7], axis=1)
    return bent(ball, ball.vertices - height * np.exp(-((away / 0.12) ** 2))[:, None] * ball.vertices[7])


def grid(count: int) -> TriangleMesh:
    """A flat sheet of unit squares."""
    x, y = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    low = (x[:-1, :-1] * count + y[:-1, :-1]).ravel()
    square = [low, low + count, low + count + 1, low + 1]
    faces = np.concatenate([np.stack([square[i] for i in each], axis=1) for each in ((0, 1, 2), (0, 2, 3))])
    return TriangleMesh(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(float), faces)


def figure_eight() -> TriangleMesh:
    """A torus whose section is an 8: it crosses itself all around, and nothing local mends that."""
    torus = catalog.torus(60, 32)
    i, j = np.divmod(np.arange(torus.vertex_count), 32)
    a, b = 2 * np.pi * i / 60, 2 * np.pi * (j + 0.5) / 32
    ring = 3.0 + np.sin(b)
    return bent(torus, np.stack([ring * np.cos(a), ring * np.sin(a), 0.5 * np.sin(2 * b)], axis=1))


def require_untangled(mesh: TriangleMesh, found, samples: int = 2000) -> None:
    """All that remove_self_intersections promises of any mesh."""
    before, after = audit(mesh, self_intersections=True), audit(found.mesh, self_intersections=True)
    assert before.self_intersection_count > 0
    assert after.self_intersection_count == 0
    assert [getattr(after, name) for name in KEPT] == [getattr(before, name) for name in KEPT]
    assert after.degenerate_count <= before.degenerate_count
    assert np.array_equal(found.mesh.vertices, mesh.vertices)
    # What is left are faces of the input, in their order, and none of those that crossed others.
    row = {tuple(face): number for number, face in enumerate(mesh.faces.tolist())}
    left = [row[tuple(face)] for face in found.mesh.faces[found.patch < 0].tolist()]
    assert left == sorted(left)
    assert len(left) + found.faces_cut == mesh.face_count
    assert not np.isin(gk.mesh.Surface(mesh, device="cpu").self_intersections(), left).any()
    assert set(found.patch.tolist()) - {-1} == set(range(found.places))
    for place in range(min(found.places, 10)):
        patch = audit(TriangleMesh(mesh.vertices, found.mesh.faces[found.patch == place]))
        assert (patch.euler_number, patch.component_count, patch.boundary_edge_count) == (1, 1, patch.face_count + 2)
    for one, other in ((mesh, found.mesh), (found.mesh, mesh)):
        points = gk.mesh.sample_surface(one, samples, seed=1).points
        distance = gk.mesh.Surface(other, device="cpu").closest_point(points).distance
        assert distance.max() <= found.deviation + 1e-12 * before.diagonal
    largest = hausdorff(mesh, found.mesh, samples=0, device="cpu").max
    assert 0.0 <= found.deviation <= largest + 1.2e-4 * before.diagonal


@pytest.mark.parametrize(
    "make", [one for one in catalog.CLOSED if one is not catalog.overlapping_spheres], ids=lambda make: make.__name__
)
def test_what_is_sound_comes_back_as_it_is(make):
    mesh = make()
    found = remove_self_intersections(mesh)
    assert found.mesh is mesh
    assert (found.faces_cut, found.places, found.deviation) == (0, 0, 0.0)
    assert np.array_equal(found.patch, np.full(mesh.face_count, -1))


@pytest.mark.parametrize("seed", range(3))
def test_vertices_pushed_through_the_other_side(seed):
    ball = catalog.icosphere(4)
    mesh = pushed(ball, 12, seed)
    found = remove_self_intersections(mesh)
    require_untangled(mesh, found)
    assert found.mesh.volume == pytest.approx(ball.volume, rel=0.02)
    # Nothing lies within it twice: for winding numbers it is a body as well.
    assert gk.mesh.union(found.mesh).volume == pytest.approx(found.mesh.volume, rel=1e-12)


@pytest.mark.parametrize(("width", "size"), [(0.25, 0.03), (0.15, 0.06)])
def test_noise_in_a_part_of_a_torus(width, size):
    torus = catalog.torus(96, 48)
    mesh = noisy(torus, width, size, 0, at=1000)
    found = remove_self_intersections(mesh)
    require_untangled(mesh, found, samples=100_000)
    assert found.mesh.volume == pytest.approx(torus.volume, rel=0.01)


def test_a_hundred_places_in_a_bumpy_body():
    ball = catalog.icosphere(6)
    bumps = 1.0 + 0.1 * np.sin(7 * ball.vertices[:, :1]) * np.sin(5 * ball.vertices[:, 1:2])
    body = bent(ball, ball.vertices * bumps)
    mesh = pushed(body, 100, 1)
    found = remove_self_intersections(mesh)
    require_untangled(mesh, found)
    assert found.places > 100
    assert found.faces_cut < 0.05 * mesh.face_count
    assert found.mesh.volume == pytest.approx(body.volume, rel=0.001)


def test_what_cuts_cut_off_goes_with_them():
    # The tip is beyond the faces that cross: these are a ring around the dent, which is no disc.
    mesh = spike(3.0)
    found = remove_self_intersections(mesh)
    require_untangled(mesh, found)
    assert found.places == 2
    assert found.mesh.volume == pytest.approx(catalog.icosphere(5).volume, rel=0.03)
    with pytest.raises(InputError, match="within 1 rings"):
        remove_self_intersections(mesh, rings=1)


def test_wider_rings_are_tried_at_those_places_alone():
    pierced = pushed(catalog.icosphere(4), 1, 3)
    mesh = noisy(pierced, 0.35, 0.06, 3)
    with pytest.raises(InputError, match="and 1 such places cannot be mended within 1 rings"):
        remove_self_intersections(mesh, rings=1)
    found = remove_self_intersections(mesh)
    require_untangled(mesh, found)
    # Far from the noise one ring was enough.
    alone = remove_self_intersections(pierced, rings=1)
    assert (alone.places, found.places) == (2, 3)
    wanted = set(map(tuple, alone.mesh.faces[alone.patch >= 0].tolist()))
    assert wanted < set(map(tuple, found.mesh.faces[found.patch >= 0].tolist()))


@settings(max_examples=of_all(5, 40), deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([1, 2, 8]))
def test_small_bodies_against_rational_numbers(seed, rings):
    mesh = noisy(pushed(catalog.icosphere(2), 2, seed), 0.5, 0.1, seed)
    try:
        found = remove_self_intersections(mesh, rings=rings)
    except InputError as error:
        # Refused means that it does cross itself, where the message says.
        one, other = map(int, re.search(r"faces (\d+) and (\d+)", str(error)).groups())
        assert reference.intersecting_pairs(mesh.vertices[mesh.faces[[one, other]]]) == [[0, 1]]
        return
    assert reference.intersecting_pairs(found.mesh.vertices[found.mesh.faces]) == []
    if found.mesh is not mesh:
        require_untangled(mesh, found)


def test_open_sheets_keep_their_borders():
    sheet = grid(40)
    rng = np.random.default_rng(4)
    vertices = sheet.vertices + rng.normal(0.0, 0.02, sheet.vertices.shape)
    # In the middle, near the border, on it, and at a corner.
    vertices[[20 * 40 + 20, 30 * 40 + 2, 10, 0]] += [2.4, 1.3, 0.1]
    mesh = bent(sheet, vertices)
    found = remove_self_intersections(mesh)
    require_untangled(mesh, found)


def test_flat_folds_become_flat():
    vertices = grid(40).vertices.copy()
    vertices[[20 * 40 + 20, 30 * 40 + 10]] += [2.4, 1.3, 0.0]
    mesh = bent(grid(40), vertices)
    found = remove_self_intersections(mesh)
    require_untangled(mesh, found)
    assert found.mesh.area == pytest.approx(39.0**2, rel=1e-12)
    assert not found.mesh.vertices[found.mesh.faces][..., 2].any()


def test_what_cannot_be_mended_is_refused():
    mesh = figure_eight()
    copy = mesh.faces.copy()
    for rings, count in ((1, 2), (8, 1), (40, 1)):
        with pytest.raises(InputError, match=f"{count} such places cannot be mended within {rings} rings") as caught:
            remove_self_intersections(mesh, rings=rings)
        for words in ("faces 15 and 31", "near (", "repair first", "union", "wrap", "more rings"):
            assert words in str(caught.value)
    assert np.array_equal(mesh.faces, copy)


@pytest.mark.parametrize("subdivisions", [2, 4])
def test_half_of_a_body_stays(subdivisions):
    # A few triangles would have the right topology too.
    ball = catalog.icosphere(subdivisions)
    mesh = noisy(ball, 3.0, 1.3 * 0.5**subdivisions, 0)
    assert audit(mesh, self_intersections=True).self_intersection_count > ball.face_count / 4
    with pytest.raises(InputError, match="1 such places cannot be mended within 8 rings"):
        remove_self_intersections(mesh)


def test_bodies_that_overlap_are_for_union():
    box = gk.mesh.box()
    two = catalog.join(box, catalog.moved(box, (0.5, 0.4, 0.3)))
    with pytest.raises(InputError, match=r"faces \d+ and \d+ .*near.*different components.*; union") as caught:
        remove_self_intersections(two)
    assert "wrap" in str(caught.value)
    assert not audit(gk.mesh.union(two), self_intersections=True).self_intersection_count
    # At once: also where a part of it could be mended.
    with pytest.raises(InputError, match="union"):
        remove_self_intersections(catalog.join(two, pushed(catalog.icosphere(3), 1, 3)))


def test_repeated_faces_are_for_repair():
    ball = pushed(catalog.icosphere(3), 1, 3)
    twice = TriangleMesh(ball.vertices, [*ball.faces, ball.faces[5], ball.faces[900][[1, 0, 2]]])
    with pytest.raises(InputError, match=r"faces 5 and 1280 .*equal corners.*pairs like this: 2\); repair"):
        remove_self_intersections(twice)
    require_untangled(ball, remove_self_intersections(gk.mesh.repair(twice).mesh))


def test_faces_that_are_none_stay_where_nothing_crosses():
    ball = pushed(catalog.icosphere(3), 1, 3)
    far = int(np.argmax(np.linalg.norm(ball.vertices - [0, 0, 5], axis=1)))
    ends = ball.faces[(ball.faces == far).any(axis=1)][0]
    mesh = TriangleMesh(ball.vertices, [*ball.faces[:40], ends[[0, 1, 1]], *ball.faces[40:]])
    found = remove_self_intersections(mesh)
    require_untangled(mesh, found)
    assert (found.mesh.faces == ends[[0, 1, 1]]).all(axis=1).any()


def test_edges_of_three_faces_are_not_mended_over():
    ball = pushed(catalog.icosphere(3), 1, 3)
    tip = int(np.argmax(np.linalg.norm(ball.vertices - catalog.icosphere(3).vertices, axis=1)))
    crossing = ball.faces[(ball.faces == tip).any(axis=1)][0]
    edge = crossing[crossing != tip]
    fin = TriangleMesh([*ball.vertices, 1.2 * ball.vertices[edge].mean(axis=0)], [*ball.faces, [*edge, 642]])
    with pytest.raises(InputError, match="such places cannot be mended"):
        remove_self_intersections(fin)


def test_bodies_wound_inward_and_soups():
    ball = pushed(catalog.icosphere(3), 3, 8)
    found = remove_self_intersections(ball)
    require_untangled(ball, found)
    inward = TriangleMesh(ball.vertices, ball.faces[:, ::-1])
    turned = remove_self_intersections(inward)
    require_untangled(inward, turned)
    assert turned.mesh.volume == pytest.approx(-found.mesh.volume, rel=0.01)
    soup = catalog.soup(ball)
    loose = remove_self_intersections(soup)
    require_untangled(soup, loose)
    assert (loose.faces_cut, loose.places) == (found.faces_cut, found.places)
    assert loose.mesh.volume == pytest.approx(found.mesh.volume, rel=1e-3)


def test_flipped_faces_in_a_place_are_wound_like_its_rim():
    ball = pushed(catalog.icosphere(3), 1, 3)
    pairs = gk.mesh.Surface(ball, device="cpu").self_intersections()
    faces = ball.faces.copy()
    faces[pairs[0, 0]] = faces[pairs[0, 0], ::-1]
    mesh = TriangleMesh(ball.vertices, faces)
    assert not audit(mesh).oriented
    found = remove_self_intersections(mesh)
    assert audit(found.mesh).oriented
    assert np.array_equal(found.mesh.faces, remove_self_intersections(ball).mesh.faces)
    # Others stay as they are.
    far = np.delete(np.arange(ball.face_count), np.unique(pairs))[-1]
    faces[far] = faces[far, ::-1]
    found = remove_self_intersections(TriangleMesh(ball.vertices, faces))
    require_untangled(TriangleMesh(ball.vertices, faces), found)
    assert (found.mesh.faces == faces[far]).all(axis=1).any()


def test_attributes_and_parts_go_on():
    whole = pushed(catalog.icosphere(3), 3, 8)
    mesh = TriangleMesh(
        whole.vertices,
        whole.faces,
        name="ball",
        parts=[MeshPart("a", 0, 640), MeshPart("b", 640, 640)],
        vertex_data={"v": np.arange(642)},
        face_data={"f": np.arange(1280)},
        corner_data={"c": whole.vertices[whole.faces]},
        meters_per_unit=0.001,
        up_axis="z",
    )
    found = remove_self_intersections(mesh)
    full = found.mesh
    assert (full.name, full.meters_per_unit, full.up_axis) == ("ball", 0.001, "z")
    assert np.array_equal(full.vertex_data["v"], np.arange(642))
    assert np.array_equal(full.corner_data["c"], full.vertices[full.faces])
    source = full.face_data["f"]
    assert np.array_equal(mesh.faces[source[found.patch < 0]], full.faces[found.patch < 0])
    assert (np.diff(source) >= 0).all()
    # Each patch lies in the part of a face that was at its rim.
    ends = [part.first_face + part.face_count for part in full.parts]
    assert ends[-1] == full.face_count
    assert ((source < 640) == (np.arange(full.face_count) < ends[0])).all()
    for row in np.flatnonzero(found.patch >= 0):
        rim = full.faces[found.patch == found.patch[row]]
        assert len(np.intersect1d(mesh.faces[source[row]], rim)) >= 2
        assert not np.isin(source[row], source[found.patch < 0])


@pytest.mark.parametrize("scale", [2.0**-200, 2.0**-30, 2.0**200])
def test_sizes_do_not_matter(scale):
    ball = pushed(catalog.icosphere(3), 3, 8)
    found, other = remove_self_intersections(ball), remove_self_intersections(catalog.scaled(ball, scale))
    assert np.array_equal(found.mesh.faces, other.mesh.faces)
    assert other.deviation == pytest.approx(found.deviation * scale, rel=1e-12)


def test_what_is_not_proven_is_not_returned(monkeypatch):
    from geokit.mesh import _fill_holes

    mesh = noisy(catalog.icosphere(3), 0.4, 0.12, 4)
    require_untangled(mesh, remove_self_intersections(mesh, rings=1))
    # Patches that are held against nothing cross something here, which the proof finds.
    monkeypatch.setattr(_fill_holes, "_clashing", lambda *_: np.zeros(0, np.int64))
    with pytest.raises(InputError, match="1 such places cannot be mended"):
        remove_self_intersections(mesh, rings=1)


def test_bodies_that_hang_together_at_a_point_stay_together():
    ball = catalog.icosphere(3)
    top, low = ball.vertices[:, 2].argmax(), ball.vertices[:, 2].argmin()
    away = np.linalg.norm(ball.vertices - ball.vertices[top], axis=1)
    near = (away > 0.0) & (away < 0.4)
    vertices = ball.vertices.copy()
    vertices[near] = 0.8 * vertices[near] + np.random.default_rng(1).uniform(-0.12, 0.12, (near.sum(), 3))
    place = bent(ball, vertices)
    other = catalog.moved(ball, tuple(vertices[top] - vertices[low]))
    require_untangled(place, remove_self_intersections(place))
    assert np.array_equal(other.vertices[low], vertices[top])
    # A disc whose inner point another body has too would leave that body alone.
    with pytest.raises(InputError, match="such places cannot be mended"):
        remove_self_intersections(catalog.join(place, other))


def test_meshes_of_other_sizes_than_expected():
    for vertices, faces in ([], []), ([[0, 0, 0]], []), ([[0, 0, 0]], [[0, 0, 0]]):
        mesh = TriangleMesh(np.reshape(vertices, (-1, 3)), np.reshape(faces, (-1, 3)).astype(int))
        found = remove_self_intersections(mesh)
        assert found.mesh is mesh
        assert len(found.patch) == mesh.face_count


def test_bad_input_is_named():
    for bad in (0, -1, 2.5, "wide"):
        with pytest.raises(InputError, match="rings"):
            remove_self_intersections(catalog.box(), rings=bad)
    with pytest.raises(InputError, match="mesh"):
        remove_self_intersections(3)
    with pytest.raises(InputError, match="across; scale it"):
        remove_self_intersections(catalog.scaled(pushed(catalog.icosphere(3), 1, 3), 1e100))
