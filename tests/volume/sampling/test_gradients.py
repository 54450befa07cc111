"""Gradients of samples, gradients and hits by points, rays and active values."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from geokit import InputError, volume  # noqa: E402
from geokit.volume.nanovdb.nodes import grid_nodes  # noqa: E402
from geokit.volume.tree.leaves import assemble, leaves_of  # noqa: E402
from tests.support.gradient_checks import check, tensor  # noqa: E402


@pytest.fixture(scope="module")
def ball():
    """A distance field in float64, so that differences of values are not rounded to float32."""
    field = volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.5)
    values = grid_nodes(field.nanovdb).leaf.values.astype(np.float64)
    turn = np.eye(4)
    turn[:3, :3] = 0.5 * np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.1], [0.0, 0.0, 1.2]])
    return assemble(leaves_of(field), values, field, background=1.5, grid_class="level set", transform=turn)


@pytest.fixture
def places(ball):
    random = np.random.default_rng(7)
    way = random.standard_normal((12, 3))
    return tensor(way / np.linalg.norm(way, axis=1)[:, None] * random.uniform(0.7, 1.4, (12, 1)))


@pytest.fixture
def values(ball):
    found = volume.active_voxels(ball).values
    return tensor(found + 0.01 * np.random.default_rng(8).standard_normal(len(found)))


@pytest.mark.slow
@pytest.mark.parametrize("space", ["world", "index"])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_samples_and_gradients(ball, places, values, order, space):
    def answer(points, values):
        field = volume.with_values(ball, values)
        options = {"order": order, "space": space, "device": "cpu"}
        return volume.sample(field, points, **options), volume.gradient(field, points, **options)

    given = tuple(part.clone().requires_grad_() for part in (places, values))
    assert torch.autograd.gradcheck(answer, given, eps=1e-6, atol=1e-5, fast_mode=True, nondet_tol=0.0)
    # Second derivatives by points, and by points and values together.
    check(lambda points: answer(points, values)[0], places)
    sample = torch.autograd.gradgradcheck
    assert sample(lambda *both: answer(*both)[0], given, eps=1e-6, atol=1e-4, fast_mode=True)


def test_vectors(ball, places):
    field = volume.gradient_field(ball, device="cpu")
    check(lambda points: volume.sample(field, points, order=2, device="cpu"), places, second=False)


def test_hits(ball, places, values):
    random = np.random.default_rng(9)
    origins = 3.0 * random.standard_normal((20, 3))
    rays = tensor(origins), tensor(0.3 * random.standard_normal((20, 3)) - origins)
    hit = torch.isfinite(volume.raycast(volume.with_values(ball, values), *rays, device="cpu").t)
    assert hit.sum() > 10

    def answer(origins, directions, values):
        found = volume.raycast(volume.with_values(ball, values), origins, directions, device="cpu")
        return found.t[hit], found.points[hit]

    given = tuple(part.clone().requires_grad_() for part in (*rays, values))
    assert torch.autograd.gradcheck(answer, given, eps=1e-6, atol=1e-5, fast_mode=True)
    (slope,) = torch.autograd.grad(answer(*given)[0].sum(), given[0], create_graph=True)
    with pytest.raises(InputError, match="second derivatives of hits of a volume are not known"):
        slope.sum().backward()


def test_eikonal_loss_reaches_the_values(ball, places, values):
    # A field that is optimized through its gradients.
    given = values.clone().requires_grad_()
    for _ in range(20):
        slope = volume.gradient(volume.with_values(ball, given), places, order=2, device="cpu")
        loss = ((slope.norm(dim=1) - 1.0) ** 2).sum()
        (by_values,) = torch.autograd.grad(loss, given)
        given = (given - 0.05 * by_values).detach().requires_grad_()
    after = volume.gradient(volume.with_values(ball, given), places, order=2, device="cpu")
    before = volume.gradient(volume.with_values(ball, values), places, order=2, device="cpu")
    assert (after.norm(dim=1) - 1.0).abs().mean() < 0.5 * (before.norm(dim=1) - 1.0).abs().mean()


def test_third_derivatives_and_order_0_are_refused(ball, places):
    asked = places.clone().requires_grad_()
    (first,) = torch.autograd.grad(volume.sample(ball, asked, order=3, device="cpu").sum(), asked, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), asked, create_graph=True)
    with pytest.raises(InputError, match="third derivatives"):
        torch.autograd.grad(second.sum(), asked)
    with pytest.raises(InputError, match="order: samples of order 0 are constant"):
        volume.sample(ball, asked, order=0, device="cpu").sum().backward()


@pytest.mark.slow
def test_adaptive_fields():
    from geokit import mesh

    body = mesh.load("data/samples/bracket.obj")
    field = volume.adaptive_from_mesh(body, tolerance=1.0, order=2, codec="float")
    low, high = body.bounds
    points = tensor(low + (high - low) * np.random.default_rng(1).random((20, 3)))
    check(lambda points: field.sample(points, device="cpu"), points, second=False)
