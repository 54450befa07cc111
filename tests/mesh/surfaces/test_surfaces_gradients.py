"""Gradients of many surfaces in one call: finite differences, and those of single surfaces."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import geokit as gk  # noqa: E402
from tests.support.gradient_checks import check, tensor  # noqa: E402

BALL = gk.mesh.sphere(segments=6)
BOX = gk.mesh.box()
VERTICES = np.concatenate([BALL.vertices, 0.7 * BOX.vertices + 0.1])
FACES = np.concatenate([BALL.faces, BOX.faces + len(BALL.vertices), BOX.faces + len(BALL.vertices)])
# The ball, the box, and the box again: two meshes share its vertices.
OFFSETS = np.cumsum([0, len(BALL.faces), len(BOX.faces), len(BOX.faces)])
WHERE = [0, 5, 5, 11]


def _surfaces(vertices):
    return gk.mesh.Surfaces((vertices, FACES, OFFSETS), device="cpu")


@pytest.fixture(scope="module")
def points():
    return tensor(np.random.default_rng(0).uniform(-1.5, 1.5, (11, 3)))


def _distances(vertices, points):
    surfaces = _surfaces(vertices)
    near, signed = surfaces.closest_point(points, WHERE), surfaces.signed_distance(points, WHERE)
    return near.distance, near.points, signed.distance, signed.points


def _hits(vertices, origins, directions):
    found = _surfaces(vertices).raycast(origins, directions, WHERE)
    assert (found.triangle_id >= 0).all()
    return found.t, found.barycentric


@pytest.mark.slow
def test_by_points_and_packed_vertices(points):
    check(_distances, tensor(VERTICES), points)


@pytest.mark.slow
def test_by_rays_and_packed_vertices(points):
    check(_hits, tensor(VERTICES), 3.0 * points, 0.13 - 2.9 * points)


@pytest.mark.parametrize("part", ["distance", "points"])
def test_slopes_are_those_of_single_surfaces(points, part):
    given, held = points.clone().requires_grad_(), tensor(VERTICES).requires_grad_()
    found = getattr(_surfaces(held).closest_point(given, WHERE), part)
    slopes = torch.autograd.grad((found * found).sum(), (given, held))
    alone, total = points.clone().requires_grad_(), tensor(VERTICES).requires_grad_()
    loss = 0.0
    for mesh in (0, 2):
        rows, faces = slice(*WHERE[mesh : mesh + 2]), FACES[OFFSETS[mesh] : OFFSETS[mesh + 1]]
        single = gk.torch.Surface(total, torch.tensor(faces), device="cpu")
        loss = loss + getattr(single.closest_point(alone[rows]), part).square().sum()
    for one, other in zip(slopes, torch.autograd.grad(loss, (alone, total)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-13)


@pytest.mark.slow
def test_as_many_rows_for_each_mesh(points):
    plain = gk.mesh.Surfaces([BALL, BOX], device="cpu")
    rows = points[:10].reshape(2, 5, 3)
    check(lambda given: plain.signed_distance(given).distance, rows)
    check(lambda given: plain.signed_distance(given)[:2], rows)
    check(lambda given: plain.raycast(3.0 * given, -given).t, rows)
    missed = plain.closest_point(rows.clone().requires_grad_(), max_distance=1e-9)
    missed.points.nansum().backward()
    assert torch.isinf(missed.distance).all()


def test_what_has_no_gradient_is_refused(points):
    surfaces = _surfaces(tensor(VERTICES).requires_grad_())
    with pytest.raises(gk.InputError, match="offsets"):
        surfaces.closest_point(points, torch.tensor([0.0, 5, 5, 11], requires_grad=True))
    with pytest.raises(gk.InputError, match="points"):
        surfaces.contains(points.clone().requires_grad_(), WHERE)
    with pytest.raises(gk.InputError, match="require gradients"):
        gk.mesh.Surfaces([(tensor(BALL.vertices).requires_grad_(), BALL.faces)], device="cpu")


def test_what_was_prepared_is_kept(points):
    """Signs take long to prepare: the second call finds them."""
    surfaces = _surfaces(tensor(VERTICES).requires_grad_())
    surfaces.signed_distance(points, WHERE)
    assert surfaces._signs is surfaces._signs
    assert "signs" in surfaces._cache


@pytest.mark.slow
@pytest.mark.parametrize("kind", [list, torch.tensor])
def test_compiled_whole(points, kind):
    held = tensor(VERTICES).requires_grad_()
    surfaces, where = _surfaces(held), kind(WHERE)

    def loss(points):
        return surfaces.closest_point(points, where).points.square().sum()

    asked = points.clone().requires_grad_()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for one, other in zip(*(torch.autograd.grad(run(asked), (asked, held)) for run in (loss, compiled)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
