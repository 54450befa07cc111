"""Gradients of distances on surfaces and next to them: the outward normal, whatever the sign of a rounding is."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
import warp as wp

torch = pytest.importorskip("torch")

import geokit as gk  # noqa: E402
from benchmarks.catalog import mesh_catalog  # noqa: E402
from tests.support.gradient_checks import tensor  # noqa: E402

SAMPLES = Path(__file__).resolve().parents[3] / "data/samples"
TURN = np.linalg.qr(np.random.default_rng(8).standard_normal((3, 3)))[0]
SIGNS = ("winding", "pseudonormal", "parity")


def turned(mesh):
    """The mesh in no special position, so that points on it are rounded."""
    return gk.mesh.TriangleMesh(mesh.vertices @ TURN.T, mesh.faces)


BODIES = {
    "torus": gk.mesh.load(SAMPLES / "torus.ply"),
    "bracket": gk.mesh.load(SAMPLES / "bracket.obj"),
    "profile": turned(mesh_catalog.l_profile()),
    "ball": gk.mesh.sphere(segments=12),
}


@functools.cache
def placed(name, away, *, inside_out):
    """A body so many diagonals from the origin."""
    body = BODIES[name]
    shift = away * np.linalg.norm(np.ptp(body.bounds, axis=0)) * np.array([0.8, -0.5, 0.3])
    return gk.mesh.TriangleMesh(body.vertices + shift, body.faces[:, ::-1] if inside_out else body.faces)


def outward_normals(mesh):
    """Unit normals of the faces of one closed body (F, 3), by its signed volume."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.vertices[0], 1, 0)
    normals = np.cross(b - a, c - a)
    side = np.sign((a * np.cross(b, c)).sum())
    return side * normals / np.linalg.norm(normals, axis=1)[:, None]


@functools.cache
def surface_of(mesh):
    return gk.mesh.Surface(mesh, device="cpu")


@functools.cache
def surfaces_of(mesh):
    return gk.mesh.Surfaces([mesh, mesh], device="cpu")


def by_torch(mesh, rows, query="signed_distance", **options):
    given = tensor(rows).requires_grad_()
    answer = getattr(surface_of(mesh), query)(given, **options)
    return torch.autograd.grad(answer.distance.sum(), given)[0]


def by_closed_form(mesh, rows, query="signed_distance", **options):
    given = tensor(rows).requires_grad_()
    answer = getattr(surface_of(mesh), query)(given, **options)
    return torch.autograd.grad(answer.distance.sum(), given, create_graph=True)[0].detach()


def by_tape(mesh, rows, query="signed_distance", **options):
    given = wp.array(rows, dtype=wp.vec3d, device="cpu", requires_grad=True)
    with wp.Tape() as tape:
        answer = getattr(surface_of(mesh), query)(given, **options)
    answer.distance.grad.fill_(1.0)
    tape.backward()
    return given.grad.numpy()


def by_tape_on_the_host(mesh, rows, query="signed_distance", **options):
    # Strided arrays have no kernel.
    given = wp.array(np.repeat(rows, 2, axis=0), dtype=wp.vec3d, device="cpu", requires_grad=True)[::2]
    with wp.Tape() as tape:
        answer = getattr(surface_of(mesh), query)(given, **options)
    answer.distance.grad.fill_(1.0)
    answer.points.grad.fill_(0.0)
    tape.backward()
    return given.grad.numpy()


def by_surfaces(mesh, rows, query="signed_distance", **options):
    given = tensor(np.stack([rows, rows])).requires_grad_()
    answer = getattr(surfaces_of(mesh), query)(given, **options)
    slopes = torch.autograd.grad(answer.distance.sum(), given)[0]
    assert torch.equal(slopes[0], slopes[1])
    return slopes[0]


WAYS = [by_torch, by_closed_form, by_tape, by_tape_on_the_host, by_surfaces]


@pytest.fixture(params=WAYS, ids=lambda way: way.__name__)
def slopes(request):
    return lambda *given, **options: np.asarray(request.param(*given, **options))


PLACES = [("bracket", 0), ("bracket", 1000), ("profile", 0), ("ball", 7)]
PLACES += [pytest.param("torus", away, marks=pytest.mark.slow) for away in (0, 1000)]


@pytest.mark.parametrize("inside_out", [False, True])
@pytest.mark.parametrize(("name", "away"), PLACES)
def test_samples_of_a_surface_have_its_normals(name, away, inside_out, slopes):
    mesh = placed(name, away, inside_out=inside_out)
    found = gk.mesh.sample_surface(mesh, 800, seed=1)
    np.testing.assert_allclose(slopes(mesh, found.points), outward_normals(mesh)[found.triangle_id], atol=1e-7)


@pytest.mark.parametrize("inside_out", [False, True])
@pytest.mark.parametrize(("name", "away"), PLACES)
def test_vertices_and_edges_have_the_normal_of_the_face_found(name, away, inside_out, slopes):
    mesh = placed(name, away, inside_out=inside_out)
    share = np.random.default_rng(2).random((len(mesh.faces), 1))
    begin, end = mesh.vertices[mesh.faces[:, 0]], mesh.vertices[mesh.faces[:, 1]]
    rows = np.concatenate([mesh.vertices, begin + share * (end - begin), 0.5 * begin + 0.5 * end])[::3]
    face = surface_of(mesh).signed_distance(rows).triangle_id
    np.testing.assert_allclose(slopes(mesh, rows), outward_normals(mesh)[face], atol=1e-9)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_kernels_of_torch_have_them_too(kind):
    mesh = placed("bracket", 0, inside_out=True)
    found = gk.mesh.sample_surface(mesh, 800, seed=1)
    given = torch.tensor(found.points, dtype=kind, requires_grad=True)
    surface = surface_of(mesh)
    alone = torch.autograd.grad(surface.signed_distance(given).distance.sum(), given)[0]
    answer = surface.signed_distance(given)
    among = torch.autograd.grad((answer.distance + 0.0 * answer.points.sum(1)).sum(), given)[0]
    normals = outward_normals(mesh)[found.triangle_id]
    # Rounded to float32, a point next to an edge may lie over the next face.
    inner = found.barycentric.min(axis=1) > 1e-3
    for slope in (alone, among):
        np.testing.assert_allclose(slope[inner], normals[inner], atol=1e-6)


@pytest.mark.parametrize("by", [False, True])
def test_vertices_move_against_the_normals(by):
    mesh = placed("bracket", 3, inside_out=True)
    found = gk.mesh.sample_surface(mesh, 500, seed=4)
    rows = np.concatenate([found.points, mesh.vertices[:50]])
    held = tensor(mesh.vertices).requires_grad_()
    surface = gk.mesh.Surface((held, mesh.faces), device="cpu")
    answer = surface.signed_distance(tensor(rows))
    weights = np.linspace(1.0, 2.0, len(rows))
    (slope,) = torch.autograd.grad(answer.distance, held, tensor(weights), create_graph=by)
    expected = np.zeros_like(mesh.vertices)
    faces = mesh.faces[answer.triangle_id]
    shares = -weights[:, None, None] * answer.barycentric.detach().numpy()[..., None]
    np.add.at(expected, faces, shares * outward_normals(mesh)[answer.triangle_id][:, None])
    np.testing.assert_allclose(slope.detach(), expected, atol=1e-9)


def _box_slope(rows):
    """Of the signed distance to the box of half width 1/2, in closed form."""
    beyond = np.abs(rows) - 0.5
    out = np.maximum(beyond, 0.0)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    nearest = np.eye(3)[beyond.argmax(axis=1)]
    return np.sign(rows) * np.where(length > 0.0, out / np.where(length > 0.0, length, 1.0), nearest)


@pytest.mark.parametrize("sign", SIGNS)
@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-13, 1e-10, 1e-8, 1e-6, 1e-3, 0.1])
def test_both_sides_of_a_box(off, sign, slopes):
    random = np.random.default_rng(3)
    rows = random.uniform(-0.45, 0.45, (60, 3))
    axis, side = np.arange(60) % 3, np.where(random.random(60) < 0.5, -1.0, 1.0)
    inward = np.where(random.random(60) < 0.5, -1.0, 1.0)
    # Inside of the body the nearest face must stay the nearest.
    rows *= 0.5 if off > 1e-2 else 1.0
    rows[np.arange(60), axis] = side * (0.5 + off * inward)
    expected = np.zeros((60, 3))
    expected[np.arange(60), axis] = side
    np.testing.assert_allclose(slopes(gk.mesh.box(), rows, sign=sign), expected, atol=1e-9)
    if off:
        np.testing.assert_allclose(_box_slope(rows), expected, atol=1e-9)


@pytest.mark.parametrize("off", [1e-10, 1e-8, 1e-6, 1e-3, 2.0])
def test_away_from_edges_and_vertices_of_a_box(off, slopes):
    random = np.random.default_rng(5)
    corners = np.where(random.random((40, 3)) < 0.5, -0.5, 0.5)
    edges = corners.copy()
    edges[np.arange(40), np.arange(40) % 3] = random.uniform(-0.4, 0.4, 40)
    away = np.sign(corners) * random.uniform(0.1, 1.0, (40, 3)) * off
    along = away.copy()
    along[np.arange(40), np.arange(40) % 3] = 0.0
    rows = np.concatenate([corners + away, edges + along])
    np.testing.assert_allclose(slopes(gk.mesh.box(), rows), _box_slope(rows), atol=1e-4 if off < 1e-9 else 1e-6)


def test_differences_over_flipped_faces(slopes):
    """Winding numbers are right over a face that is wound the wrong way: the sign of the answer decides there."""
    ball = gk.mesh.sphere(segments=16)
    corners = ball.vertices[ball.faces]
    corners[::12] = corners[::12, ::-1]
    soup = gk.mesh.TriangleMesh(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))
    surface, middles = gk.mesh.Surface(soup, device="cpu"), corners.mean(axis=1)
    radial = middles / np.linalg.norm(middles, axis=1)[:, None]
    step = 1e-6
    for off in (-0.01, 1e-4, 0.3):
        rows = middles + off * radial
        found = slopes(soup, rows, sign="winding")
        for axis in range(3):
            ahead, behind = (
                surface.signed_distance(rows + side * step * np.eye(3)[axis], sign="winding").distance
                for side in (1.0, -1.0)
            )
            np.testing.assert_allclose(found[:, axis], (ahead - behind) / (2.0 * step), atol=1e-6)
        assert ((found * radial).sum(axis=1) > 0.9).all()


def test_a_distance_without_sign_has_a_kink(slopes):
    mesh = placed("profile", 0, inside_out=False)
    rows = np.concatenate([mesh.vertices, gk.mesh.sample_surface(mesh, 500, seed=1).points])
    distance = surface_of(mesh).closest_point(rows).distance
    found = slopes(mesh, rows, "closest_point")
    zero = distance == 0.0
    assert zero[len(mesh.vertices) :].any()
    assert not found[zero].any()
    np.testing.assert_allclose(slopes(mesh, rows + 5.0, "closest_point"), slopes(mesh, rows + 5.0), atol=1e-12)


def test_a_face_without_area_has_no_normal(slopes):
    """A cap on an edge of a box, whose normal would be that of a rounding."""
    box = turned(gk.mesh.box())
    one, other = box.faces[0, :2]
    middle = box.vertices[one] + (box.vertices[other] - box.vertices[one]) / 3.0
    faces = np.concatenate([[[one, other, len(box.vertices)]], box.faces])
    mesh = gk.mesh.TriangleMesh(np.concatenate([box.vertices, [middle]]), faces)
    share = np.linspace(0.05, 0.95, 20)[:, None]
    rows = (1.0 - share) * box.vertices[one] + share * box.vertices[other]
    face = surface_of(mesh).signed_distance(rows).triangle_id
    assert (face == 0).any()
    normals = np.concatenate([np.zeros((1, 3)), outward_normals(box)])
    np.testing.assert_allclose(slopes(mesh, rows), normals[face], atol=1e-9)


def _doubled(box, *, other_diagonals):
    """Each face twice, that with the inward winding first; or with the other diagonals of the squares."""
    back = box.faces[:, ::-1]
    if other_diagonals:
        # Faces n and n + 6 are a square: (a, b, c) and (a, c, d).
        (a, b, c), (first, third, d) = box.faces[:6].T, box.faces[6:].T
        assert (first == a).all()
        assert (third == c).all()
        back = np.concatenate([np.stack([b, a, d], axis=1), np.stack([b, d, c], axis=1)])
    return gk.mesh.TriangleMesh(box.vertices, np.concatenate([back, box.faces]))


@pytest.mark.parametrize("other_diagonals", [False, True])
def test_faces_that_lie_back_to_back(other_diagonals, slopes):
    box = gk.mesh.box()
    mesh = _doubled(turned(box), other_diagonals=other_diagonals)
    found = gk.mesh.sample_surface(turned(box), 400, seed=6)
    np.testing.assert_allclose(slopes(mesh, found.points), outward_normals(turned(box))[found.triangle_id], atol=1e-9)


@pytest.mark.parametrize("inside_out", [False, True])
def test_a_body_with_a_deck(inside_out, slopes):
    """A body keeps its outside, whichever way its faces and the deck are wound."""
    box = turned(gk.mesh.box())
    deck = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]) @ TURN.T * 0.9
    faces = np.concatenate([box.faces[:, ::-1] if inside_out else box.faces, [[8, 9, 10], [8, 10, 11]]])
    mesh = gk.mesh.TriangleMesh(np.concatenate([box.vertices, deck]), faces)
    found = gk.mesh.sample_surface(box, 400, seed=6)
    np.testing.assert_allclose(slopes(mesh, found.points), outward_normals(box)[found.triangle_id], atol=1e-9)
    # On both sides of the deck the distance grows inward.
    middle, up = deck.mean(axis=0), TURN[:, 2]
    rows = np.stack([middle + 0.1 * up, middle - 0.1 * up])
    np.testing.assert_allclose(slopes(mesh, rows), np.stack([-up, up]), atol=1e-9)


@pytest.mark.parametrize("inside_out", [False, True])
def test_a_body_cut_by_a_wall(inside_out, slopes):
    """The wall ends at edges, which have three faces then: they cut the body into two open halves."""
    box = turned(gk.mesh.box())
    faces = np.concatenate([box.faces[:, ::-1] if inside_out else box.faces, [[0, 1, 7], [0, 7, 6]]])
    mesh = gk.mesh.TriangleMesh(box.vertices, faces)
    found = gk.mesh.sample_surface(box, 400, seed=6)
    np.testing.assert_allclose(slopes(mesh, found.points), outward_normals(box)[found.triangle_id], atol=1e-9)
