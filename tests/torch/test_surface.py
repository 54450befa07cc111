"""Meshes whose vertices are a tensor."""

from __future__ import annotations

import copy
import inspect
import subprocess
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import geokit as gk  # noqa: E402
from tests.support.gradient_checks import check, tensor  # noqa: E402

FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
CORNERS = tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


def test_queries_move_with_the_vertices():
    points = tensor([[2.0, 0.3, 0.2], [0.1, 0.1, -0.5], [0.1, 0.15, 0.2]])
    check(lambda vertices: gk.torch.Surface(vertices, FACES).signed_distance(points).distance, CORNERS)


def test_samples_move_with_the_vertices():
    vertices = CORNERS.clone().requires_grad_()
    samples = gk.torch.sample_surface(vertices, torch.tensor(FACES), 200, seed=3)
    plain = gk.mesh.sample_surface(gk.mesh.TriangleMesh(CORNERS.numpy(), FACES), 200, seed=3)
    assert np.allclose(samples.points.detach(), plain.points, atol=1e-15)
    assert np.array_equal(samples.triangle_id, plain.triangle_id)
    (slope,) = torch.autograd.grad(samples.points.sum(), vertices)
    # Each point moves as its weights say.
    expected = np.zeros(4)
    np.add.at(expected, np.array(FACES)[plain.triangle_id], plain.barycentric)
    assert np.allclose(slope, expected[:, None])


def test_a_mesh_is_fitted_to_points():
    random = np.random.default_rng(0)
    ball = random.standard_normal((400, 3))
    target = tensor(ball / np.linalg.norm(ball, axis=1)[:, None])
    vertices = (3.0 * (CORNERS - 0.25)).requires_grad_()
    optimizer = torch.optim.Adam([vertices], lr=0.05)
    surface, losses = gk.torch.Surface(vertices, FACES), []
    for _ in range(60):
        surface.update(vertices)
        loss = (surface.closest_point(target).distance ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


def test_copies_leave_the_graph():
    surface = gk.torch.Surface(CORNERS.clone().requires_grad_(), FACES)
    again = copy.deepcopy(surface)
    assert not again.closest_point(CORNERS + 1.0).distance.requires_grad


def test_other_arrays_are_refused():
    with pytest.raises(gk.InputError, match=r"vertices: .*Tensor"):
        gk.torch.Surface(CORNERS.numpy(), FACES)


def test_a_pair_of_tensors_is_a_surface_of_them():
    vertices = CORNERS.clone().requires_grad_()
    points = tensor([[2.0, 0.3, 0.2], [0.1, 0.1, -0.5]])
    slopes = []
    for surface in (gk.torch.Surface(vertices, FACES), gk.mesh.Surface((vertices, FACES), device="cpu")):
        slopes += torch.autograd.grad(surface.closest_point(points).distance.sum(), vertices)
    assert torch.equal(*slopes)


def _beside_a_box(vertices, faces):
    """A box, and faces of other corners beside it."""
    box = gk.mesh.box()
    faces = np.concatenate([np.add(faces, len(box.vertices)), box.faces])
    return gk.mesh.TriangleMesh(np.concatenate([box.vertices, vertices]), faces)


BOX = gk.mesh.box()
# Bodies whose signs are those of fewer faces.
DECIDED_BY_FEWER = {
    "deck": _beside_a_box([[-0.4, -0.3, 0], [0.4, -0.3, 0.1], [0.3, 0.4, 0]], [[0, 1, 2]]),
    "sheet outside": _beside_a_box([[2.0, 0, 0], [2.0, 1, 0], [2.0, 1, 1]], [[0, 1, 2]]),
    "no area": _beside_a_box([[2.0, 0, 0], [2.0, 0, 1], [2.0, 0, 3]], [[0, 1, 2]]),
    "doubled": gk.mesh.TriangleMesh(BOX.vertices, np.concatenate([BOX.faces[:, ::-1], BOX.faces])),
}


class Named(gk.mesh.Surface):
    """A class of a user, made of something else than a mesh."""

    def __init__(self, vertices, faces):
        super().__init__((vertices, faces), device="cpu")


@pytest.mark.filterwarnings("ignore:mesh. 1 of its pieces are too thin")
@pytest.mark.parametrize("body", DECIDED_BY_FEWER)
@pytest.mark.parametrize("kind", [gk.torch.Surface, Named], ids=["torch", "of a user"])
def test_signs_by_fewer_faces_than_there_are(body, kind):
    mesh = DECIDED_BY_FEWER[body]
    plain = gk.mesh.Surface(mesh, device="cpu")
    surface = kind(tensor(mesh.vertices).requires_grad_(), mesh.faces)
    assert surface.sign_method == plain.sign_method
    assert surface.sign_reason == plain.sign_reason
    rows = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    for query in ("signed_distance", "contains", "winding_number", "sign_confidence"):
        one, other = (getattr(asked, query)(rows) for asked in (surface, plain))
        one, other = (getattr(answer, "distance", answer) for answer in (one, other))
        assert torch.equal(torch.as_tensor(one).detach(), torch.as_tensor(other))
    made, expected = (gk.volume.from_mesh(one, 0.2, device="cpu") for one in (surface, plain))
    assert np.array_equal(made.nanovdb, expected.nanovdb)


def _torch_surface(vertices, faces, rows):
    return gk.torch.Surface(vertices, faces).signed_distance(rows)


def _pair(vertices, faces, rows):
    return gk.mesh.Surface((vertices, faces), device="cpu").signed_distance(rows)


def _packed(vertices, faces, rows):
    whole = vertices, np.concatenate([faces, faces]), [0, len(faces), 2 * len(faces)]
    return gk.mesh.Surfaces(whole, device="cpu").signed_distance(rows, [0, 0, len(rows)])


@pytest.mark.parametrize("ask", [_torch_surface, _pair, _packed])
@pytest.mark.parametrize("body", DECIDED_BY_FEWER)
def test_gradients_of_signs_by_fewer_faces(body, ask):
    mesh = DECIDED_BY_FEWER[body]
    held = tensor(mesh.vertices).requires_grad_()
    found = gk.mesh.sample_surface(BOX, 100, seed=2)
    a, b, c = np.moveaxis(BOX.vertices[BOX.faces[found.triangle_id]], 1, 0)
    outward = np.cross(b - a, c - a)
    rows = tensor(np.concatenate([found.points, 0.9 * found.points, 1.1 * found.points])).requires_grad_()
    by_points, by_vertices = torch.autograd.grad(ask(held, mesh.faces, rows).distance.sum(), (rows, held))
    assert np.allclose(by_points[:100], outward / np.linalg.norm(outward, axis=1)[:, None], atol=1e-12)
    assert torch.allclose(by_points.norm(dim=1), torch.ones(300, dtype=torch.float64))
    # A body that moves along with the points keeps its distances.
    assert torch.allclose(by_points.sum(0), -by_vertices.sum(0))


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_half_precision_is_answered_in_float64(kind, compiled):
    surface = gk.mesh.Surface(gk.mesh.box(), device="cpu")
    ask = torch.compile(surface.closest_point, backend="eager") if compiled else surface.closest_point
    rows = torch.tensor([[1.5, 0.25, 0.0], [0.0, -2.0, 0.125]], dtype=kind, requires_grad=True)
    found = ask(rows)
    assert (found.distance.dtype, found.distance.tolist()) == (torch.float64, [1.0, 1.5])
    found.distance.sum().backward()
    assert (rows.grad.dtype, rows.grad.tolist()) == (kind, [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def test_vertices_of_half_precision_are_refused():
    with pytest.raises(gk.InputError, match=r"vertices: torch.float16 has no gradients here"):
        gk.torch.Surface(CORNERS.half().requires_grad_(), FACES)


def test_a_graph_is_freed_once():
    surface = gk.torch.Surface(CORNERS.clone().requires_grad_(), FACES)
    loss = surface.closest_point(tensor([[2.0, 0.3, 0.2]])).distance.sum()
    loss.backward(retain_graph=True)
    loss.backward()
    with pytest.raises(gk.InputError, match="an earlier backward pass has freed"):
        loss.backward()


def test_a_mesh_of_tensors_with_gradients_is_refused_by_name():
    with pytest.raises(gk.InputError, match=r"vertices: requires gradients, which are not recorded here"):
        gk.mesh.TriangleMesh(CORNERS.clone().requires_grad_(), FACES)


def test_tensors_without_rows_in_memory_are_refused():
    surface = gk.mesh.Surface(gk.mesh.box(), device="cpu")
    for points in (CORNERS.to_sparse(), CORNERS.to_sparse().requires_grad_()):
        with pytest.raises(gk.InputError, match="points"):
            surface.closest_point(points)
    for vertices, faces in ((CORNERS.to("meta"), FACES), (CORNERS, torch.tensor(FACES).bfloat16())):
        with pytest.raises(gk.InputError, match="cannot be read"):
            gk.torch.Surface(vertices, faces)
    with pytest.raises(gk.InputError, match="holds no numbers"):
        gk.volume.from_mesh(gk.mesh.box(), 0.3, device="cpu").sample(CORNERS.to("meta").requires_grad_())
    with pytest.warns(UserWarning, match="prototype"):
        masked = torch.masked.masked_tensor(CORNERS, CORNERS >= 0.0)
    freed = CORNERS.clone()
    freed.untyped_storage().resize_(0)
    # Their numbers would be read at address 0.
    for bare in (masked, freed):
        for ask in (surface.closest_point, lambda rows: gk.points.NeighborGrid(rows, 0.3, device="cpu")):
            with pytest.raises(gk.InputError, match=r"points.*no memory of its own"):
                ask(bare)
        for make in (gk.mesh.TriangleMesh, gk.torch.Surface):
            with pytest.raises(gk.InputError, match=r"vertices.* cannot be read"):
                make(bare, FACES)


@pytest.mark.slow
def test_the_first_backward_pass_does_not_wait_for_the_compiler_of_torch():
    code = f"""
import sys, torch, geokit as gk
corners = torch.eye(4, 3, dtype=torch.float64).requires_grad_()
points = torch.full((5, 3), 0.3, dtype=torch.float64).requires_grad_()
gk.torch.Surface(corners, {FACES}, device="cpu").winding_number(points).sum().backward()
gk.points.NeighborGrid(corners, 2.0, device="cpu").knn(points, 2).distance.sum().backward()
assert points.grad.any() and "torch._dynamo" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_help_shows_the_arguments():
    assert list(inspect.signature(gk.torch.Surface).parameters) == ["vertices", "faces", "device"]
