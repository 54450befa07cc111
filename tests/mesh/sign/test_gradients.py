"""Gradients of winding numbers against differences of exact solid angles."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

torch = pytest.importorskip("torch")

from benchmarks.catalog import mesh_catalog  # noqa: E402
from geokit import mesh  # noqa: E402
from geokit.mesh.sign import gradients  # noqa: E402
from tests.support.gradient_checks import tensor  # noqa: E402

FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3]])
STEP = 1e-6
NEAR = np.random.default_rng(5).standard_normal((40, 3))


def exact(points, vertices):
    """Sum of the triangles' solid angles by Van Oosterom and Strackee, over 4 pi."""
    a, b, c = (vertices[FACES[:, corner]][None] - points[:, None] for corner in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    volume = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
    below = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return 2.0 * np.arctan2(volume, below).sum(1) / (4.0 * np.pi)


@pytest.mark.parametrize("as_given", [False, True])
def test_by_points_and_vertices(as_given):
    random = np.random.default_rng(0)
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0], [1, 1, 1]]) + 0.1 * random.standard_normal(
        (5, 3)
    )
    points = random.standard_normal((30, 3)) + 0.3
    surface = mesh.Surface(mesh.TriangleMesh(vertices, FACES), device="cpu")
    side = 1.0 if as_given else float(surface.orientation)
    moved, asked = tensor(vertices).requires_grad_(), tensor(points).requires_grad_()
    surface.update(moved)
    winding = surface.winding_number(asked, as_given=as_given)
    assert np.allclose(winding.detach(), side * exact(points, vertices), atol=0.005)
    by_points, by_vertices = torch.autograd.grad(winding.sum(), (asked, moved))
    for axis in range(3):
        step = STEP * np.eye(3)[axis]
        slope = side * (exact(points + step, vertices) - exact(points - step, vertices)) / (2.0 * STEP)
        assert np.allclose(by_points[:, axis], slope, atol=1e-7)
        for row in range(5):
            step = np.zeros((5, 3))
            step[row, axis] = STEP
            slope = side * (exact(points, vertices + step) - exact(points, vertices - step)).sum() / (2.0 * STEP)
            assert by_vertices[row, axis] == pytest.approx(slope, abs=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("parts", [1, 7, 1024])
def test_kernels_agree_with_what_is_differentiated_further(parts, dtype, monkeypatch):
    """Also on the lines of edges, a rounding beside them, and far away; in any number of parts of the points."""
    monkeypatch.setattr(gradients, "MOST_PARTS", parts)
    body = mesh_catalog.icosphere()
    faces, ends = body.faces[: body.face_count // 2], body.vertices[:2]
    beside = ends.mean(axis=0) + np.array([[0.0, 0.0, 1e-9], [0.0, 0.0, 1e6]])
    rows = np.concatenate([NEAR, 3.0 * NEAR, body.vertices, 2.0 * ends - ends[::-1], beside])
    points, vertices = tensor(rows).to(dtype).requires_grad_(), tensor(body.vertices).requires_grad_()
    winding = mesh.Surface((vertices, faces), device="cpu").winding_number(points)
    weights = torch.linspace(-1.0, 1.0, len(points), dtype=dtype)
    by_kernel, by_rule = (
        torch.autograd.grad(winding, (points, vertices), weights, create_graph=further, retain_graph=True)
        for further in (False, True)
    )
    for found, expected in zip(by_kernel, by_rule, strict=True):
        torch.testing.assert_close(found, expected.detach(), rtol=1e-12 if dtype == torch.float64 else 1e-6, atol=1e-12)


def test_second_derivatives():
    body = mesh_catalog.icosphere()

    def slopes(points, vertices):
        winding = mesh.Surface((vertices, body.faces[:7]), device="cpu").winding_number(points)
        weights = torch.linspace(-1.0, 1.0, len(points), dtype=points.dtype)
        return torch.autograd.grad(winding, (points, vertices), weights, create_graph=True)

    given = tensor(NEAR[:5]).requires_grad_(), tensor(body.vertices).requires_grad_()
    assert torch.autograd.gradcheck(slopes, given, atol=1e-6, nondet_tol=0.0, fast_mode=True)


def test_closed_meshes_have_none():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    surface = mesh.Surface(mesh.TriangleMesh(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]), device="cpu")
    points = tensor([[0.1, 0.1, 0.1], [3.0, 0.0, 0.0]]).requires_grad_()
    (slope,) = torch.autograd.grad(surface.winding_number(points).sum(), points)
    assert (slope == 0.0).all()


def test_on_the_border():
    """Vertices and middles of edges: what an edge with the point on it contributes is left out."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3]]
    # The border runs along the edges between vertices 0, 2 and 3; 1 is off it.
    points = np.concatenate([corners, 0.5 * (corners[[0, 0, 2]] + corners[[2, 3, 3]])])
    vertices, asked = tensor(corners).requires_grad_(), tensor(points).requires_grad_()
    winding = mesh.Surface((vertices, faces), device="cpu").winding_number(asked)
    first = torch.autograd.grad(winding.sum(), (asked, vertices), create_graph=True)
    loss = sum(
        (part * torch.linspace(1.0, 2.0, part.numel(), dtype=part.dtype).reshape(part.shape)).sum() for part in first
    )
    for part in (*first, *torch.autograd.grad(loss, (asked, vertices))):
        assert torch.isfinite(part).all()
    given = wp.array(points, dtype=wp.vec3d, device="cpu", requires_grad=True)
    with wp.Tape() as tape:
        answer = mesh.Surface(mesh.TriangleMesh(corners, faces), device="cpu").winding_number(given)
    answer.grad.fill_(1.0)
    tape.backward()
    np.testing.assert_allclose(given.grad.numpy(), first[0].detach(), atol=1e-12)
