"""Gradients of closest points, signed distances and hits: across faces, edges and vertices, and by vertices."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from geokit import InputError, mesh  # noqa: E402
from geokit.core.launches import prepared  # noqa: E402
from tests.support.gradient_checks import check, tensor  # noqa: E402

FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]


@pytest.fixture
def tetrahedron():
    random = np.random.default_rng(3)
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + 0.1 * random.standard_normal((4, 3))
    return mesh.Surface(mesh.TriangleMesh(vertices, FACES), device="cpu")


@pytest.fixture
def points():
    """Closest to faces, edges and vertices, inside and outside."""
    return tensor(np.random.default_rng(4).standard_normal((40, 3)) + 0.3)


def test_all_features_are_there(tetrahedron, points):
    weights = tetrahedron.closest_point(points.numpy()).barycentric
    assert set((weights > 0.0).sum(axis=1)) == {1, 2, 3}


@pytest.mark.parametrize("query", ["closest_point", "signed_distance"])
@pytest.mark.parametrize("output", ["distance", "points"])
def test_by_points_and_vertices(tetrahedron, points, query, output):
    def answer(vertices, points):
        tetrahedron.update(vertices)
        return getattr(getattr(tetrahedron, query)(points), output)

    check(answer, tensor(tetrahedron.mesh.vertices), points)


def test_barycentric_over_faces(tetrahedron, points):
    inner = (tetrahedron.closest_point(points.numpy()).barycentric > 0.0).all(axis=1)
    check(lambda points: tetrahedron.closest_point(points).barycentric, points[inner])


@pytest.mark.slow
def test_first_hits(tetrahedron):
    random = np.random.default_rng(5)
    origins, targets = 3.0 * random.standard_normal((60, 3)), 0.2 + 0.2 * random.standard_normal((60, 3))
    rays = tensor(origins), tensor(targets - origins)
    hit = torch.isfinite(tetrahedron.raycast(*rays).t)
    assert 10 < hit.sum() < 60

    def answer(vertices, origins, directions):
        tetrahedron.update(vertices)
        found = tetrahedron.raycast(origins, directions)
        return found.t[hit], found.barycentric[hit]

    check(answer, tensor(tetrahedron.mesh.vertices), *rays)


def test_misses_have_no_slope(tetrahedron, points):
    asked = points.clone().requires_grad_()
    found = tetrahedron.closest_point(asked, max_distance=0.3)
    missed = found.triangle_id < 0
    assert missed.any()
    assert not missed.all()
    (slope,) = torch.autograd.grad(torch.where(missed, 0.0, found.distance).sum(), asked)
    assert (slope[missed] == 0.0).all()
    assert torch.isfinite(slope).all()
    assert torch.allclose(slope[~missed].norm(dim=1), torch.ones((~missed).sum(), dtype=torch.float64))


def test_on_the_surface(tetrahedron):
    # The unsigned distance has a kink there, with slope 0; the signed one goes on with the outward normal.
    corners = tensor(tetrahedron.mesh.vertices)[torch.tensor(FACES[2])]
    center = corners.mean(dim=0, keepdim=True).requires_grad_()
    assert tetrahedron.closest_point(center).distance.item() < 1e-15
    (slope,) = torch.autograd.grad(tetrahedron.signed_distance(center).distance, center)
    normal = torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0])
    assert torch.allclose(slope[0], normal / normal.norm(), atol=1e-9)


@pytest.mark.parametrize("query", ["closest_point", "signed_distance"])
def test_close_to_the_surface_among_others(tetrahedron, points, query):
    # First derivatives alone take a shorter way, which these points leave.
    found = tetrahedron.closest_point(points.numpy())
    feet, over_face = tensor(found.points), (found.barycentric > 0.0).all(axis=1)
    away = (points - feet) / (points - feet).norm(dim=1, keepdim=True)
    # On an edge itself the direction is that of a rounding error.
    rows = torch.cat([points, feet + 1e-9 * away, feet + 1e-11 * away, feet[over_face]]).requires_grad_()
    vertices = tensor(tetrahedron.mesh.vertices).requires_grad_()
    tetrahedron.update(vertices)
    distance = getattr(tetrahedron, query)(rows).distance
    scale = tensor(np.linspace(1.0, 2.0, len(rows)))
    short = torch.autograd.grad(distance, (rows, vertices), scale, retain_graph=True)
    whole = torch.autograd.grad(distance, (rows, vertices), scale, create_graph=True)
    for one, other in zip(short, whole, strict=True):
        assert torch.isfinite(one).all()
        # Directions between points that are 1e-11 apart are known to 1e-5.
        assert torch.allclose(one, other.detach(), rtol=0.0, atol=1e-4)


def test_answers_are_those_without_gradients(tetrahedron, points):
    plain = tetrahedron.signed_distance(points)
    found = tetrahedron.signed_distance(points.clone().requires_grad_())
    assert type(found) is type(plain)
    for with_slope, without in zip(found, plain, strict=True):
        assert torch.equal(with_slope.detach(), without)
        assert with_slope.dtype == without.dtype
    assert not found.triangle_id.requires_grad


def test_float32_and_numpy(tetrahedron, points):
    single = points.float().requires_grad_()
    found = tetrahedron.closest_point(single)
    assert found.distance.dtype == torch.float32
    (slope,) = torch.autograd.grad(found.distance.sum(), single)
    assert slope.dtype == torch.float32
    tetrahedron.update(tensor(tetrahedron.mesh.vertices).requires_grad_())
    # Only a tensor can carry the gradient.
    assert tetrahedron.closest_point(points.numpy()).distance.requires_grad
    tetrahedron.update(tetrahedron.mesh.vertices)
    assert isinstance(tetrahedron.closest_point(points.numpy()).distance, np.ndarray)


def test_vmap_and_grad(tetrahedron, points):
    each = torch.func.vmap(torch.func.grad(lambda p: tetrahedron.closest_point(p[None]).distance[0]))(points)
    asked = points.clone().requires_grad_()
    (slope,) = torch.autograd.grad(tetrahedron.closest_point(asked).distance.sum(), asked)
    assert torch.allclose(each, slope, rtol=1e-12)


@pytest.mark.slow
def test_compiled_whole(tetrahedron, points):
    vertices = tensor(tetrahedron.mesh.vertices).requires_grad_()

    def loss(points):
        return (tetrahedron.signed_distance(points, sign="winding").distance ** 2).sum()

    tetrahedron.update(vertices)
    asked = points.clone().requires_grad_()
    expected = torch.autograd.grad(loss(asked), (asked, vertices))
    found = torch.autograd.grad(torch.compile(loss, fullgraph=True, backend="aot_eager")(asked), (asked, vertices))
    assert all(map(torch.allclose, expected, found))


def test_no_gradient_of_an_option(tetrahedron, points):
    with pytest.raises(InputError, match=r"max_distance: a tensor that requires gradients"):
        tetrahedron.closest_point(points, max_distance=torch.tensor(1.0, requires_grad=True))


def test_two_devices(tetrahedron, points):
    tetrahedron.update(tensor(tetrahedron.mesh.vertices).requires_grad_())
    with pytest.raises(InputError, match="cpu, meta; move them to one device"):
        tetrahedron.closest_point(points.to("meta"))


OUTPUTS = [("distance",), ("points",), ("barycentric",), ("distance", "points"), ("distance", "points", "barycentric")]


def slope_of(answer, outputs, by, *, create_graph=False):
    """The derivative of a weighted sum of some outputs, those of misses left out."""
    total = 0.0
    for place, name in enumerate(outputs):
        out = torch.nan_to_num(getattr(answer, name), posinf=0.0, neginf=0.0)
        weights = torch.linspace(1.0 + place, 2.0, out.numel(), dtype=out.dtype).reshape(out.shape)
        total = total + (out * weights).sum()
    return torch.autograd.grad(total, by, create_graph=create_graph)


@pytest.mark.parametrize("wanted", [(0,), (1,), (0, 1)], ids=["points", "vertices", "both"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("outputs", OUTPUTS, ids="-".join)
@pytest.mark.parametrize("query", ["closest_point", "signed_distance"])
def test_kernels_give_the_slopes_of_the_closed_form(tetrahedron, points, query, outputs, dtype, wanted):
    inner = (tetrahedron.closest_point(points.numpy()).barycentric > 0.0).all(axis=1)
    given = (points[inner] if "barycentric" in outputs else points), tensor(tetrahedron.mesh.vertices)
    asked = [rows.to(dtype).requires_grad_(place in wanted) for place, rows in enumerate(given)]
    by = [asked[place] for place in wanted]
    tetrahedron.update(asked[1])
    answer = getattr(tetrahedron, query)(asked[0], max_distance=0.9)
    slopes = slope_of(answer, outputs, by)
    expected = slope_of(getattr(tetrahedron, query)(asked[0], max_distance=0.9), outputs, by, create_graph=True)
    for found, one in zip(slopes, expected, strict=True):
        assert found.dtype == dtype
        assert not found.requires_grad
        assert torch.allclose(found, one, rtol=1e-5 if dtype == torch.float32 else 1e-11, atol=2e-6)
    assert 0 in wanted or (answer.triangle_id < 0).any() or "barycentric" in outputs
    if 0 in wanted:
        assert (slopes[0][answer.triangle_id < 0] == 0.0).all()


@pytest.mark.parametrize("query", ["closest_point", "signed_distance"])
def test_kernels_close_to_the_surface(tetrahedron, points, query):
    found = tetrahedron.closest_point(points.numpy())
    feet, over_face = tensor(found.points), (found.barycentric > 0.0).all(axis=1)
    away = (points - feet) / (points - feet).norm(dim=1, keepdim=True)
    rows = torch.cat([feet + 1e-9 * away, feet[over_face]]).requires_grad_()
    vertices = tensor(tetrahedron.mesh.vertices).requires_grad_()
    tetrahedron.update(vertices)
    weights = tensor(np.linspace(1.0, 2.0, len(rows)))

    def slopes(create_graph):
        distance = getattr(tetrahedron, query)(rows).distance
        return torch.autograd.grad(distance, (rows, vertices), weights, create_graph=create_graph)

    for one, other in zip(slopes(False), slopes(True), strict=True):
        assert torch.allclose(one, other, rtol=1e-6, atol=1e-6)


@pytest.fixture
def rays():
    random = np.random.default_rng(5)
    origins, targets = 3.0 * random.standard_normal((60, 3)), 0.2 + 0.2 * random.standard_normal((60, 3))
    return tensor(origins), tensor(targets - origins)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("outputs", [("t",), ("barycentric",), ("t", "barycentric")], ids="-".join)
@pytest.mark.parametrize("wanted", [(0,), (1,), (2,), (0, 1, 2)])
def test_slopes_of_hits(tetrahedron, rays, wanted, outputs, dtype):
    given = *rays, tensor(tetrahedron.mesh.vertices)
    asked = [part.to(dtype).requires_grad_(place in wanted) for place, part in enumerate(given)]
    by = [asked[place] for place in wanted]
    tetrahedron.update(asked[2])
    found = slope_of(tetrahedron.raycast(*asked[:2]), outputs, by)
    expected = slope_of(tetrahedron.raycast(*asked[:2]), outputs, by, create_graph=True)
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == dtype
        assert torch.allclose(one, other, rtol=2e-5 if dtype == torch.float32 else 1e-10, atol=1e-9)


def test_rays_of_two_precisions(tetrahedron, rays):
    asked = rays[0].requires_grad_(), rays[1].float().requires_grad_()
    found = slope_of(tetrahedron.raycast(*asked), ("t",), asked)
    expected = slope_of(tetrahedron.raycast(asked[0], asked[1].double()), ("t",), asked)
    assert [part.dtype for part in found] == [torch.float64, torch.float32]
    assert torch.allclose(found[0], expected[0])
    assert torch.allclose(found[1], expected[1])


def test_a_backward_pass_is_that_of_the_surface_of_its_query(tetrahedron, rays):
    asked = rays[0].requires_grad_(), rays[1]
    (expected,) = slope_of(tetrahedron.raycast(*asked), ("t",), asked[0])
    answer = tetrahedron.raycast(*asked)
    tetrahedron.update(tetrahedron.mesh.vertices[::-1] * [1.0, 2.0, 3.0])
    assert torch.equal(slope_of(answer, ("t",), asked[0])[0], expected)


def test_batches_of_slopes(tetrahedron, points):
    # Under vmap there is no memory for a kernel.
    asked = points.float().requires_grad_()
    distance = tetrahedron.closest_point(asked).distance
    some = torch.eye(len(points), dtype=torch.float32)[:3]
    (batch,) = torch.autograd.grad(distance, asked, some, is_grads_batched=True, retain_graph=True)
    for one, weights in zip(batch, some, strict=True):
        assert torch.allclose(one, torch.autograd.grad(distance, asked, weights, retain_graph=True)[0])


def test_small_calls_on_a_cpu_are_replayed(tetrahedron, points):
    asked = points.clone().requires_grad_()
    answers = [tetrahedron.closest_point(asked) for _ in range(4)]
    assert any(kept for kept in tetrahedron._cache.find(prepared.KEPT, dict).values())
    for answer in answers[1:]:
        for part, first in zip(answer, answers[0], strict=True):
            assert torch.equal(part, first)
            assert part.requires_grad == first.requires_grad
            assert part.data_ptr() != first.data_ptr()


def test_no_graph_under_no_grad(tetrahedron, points):
    with torch.no_grad():
        found = tetrahedron.closest_point(points.clone().requires_grad_())
    assert type(found).__name__ == "ClosestPoints"
    assert not any(part.requires_grad for part in found)
