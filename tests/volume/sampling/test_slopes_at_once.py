"""Samples and their gradients from one pass, which a GPU takes: the same bits as from one pass for each."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from geokit import InputError, volume  # noqa: E402
from geokit.core.launches.late_checks import AtEnd  # noqa: E402
from geokit.volume.nanovdb.nodes import grid_nodes  # noqa: E402
from geokit.volume.sampling import gradients, trilinear_table  # noqa: E402
from geokit.volume.tree.leaves import assemble, leaves_of  # noqa: E402
from tests.support.gradient_checks import tensor  # noqa: E402


@pytest.fixture(scope="module")
def ball():
    """A float grid with its table."""
    made = volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.25)
    turn = np.eye(4)
    turn[:3, :3] = 0.25 * np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.1], [0.0, 0.0, 1.2]])
    values = grid_nodes(made.nanovdb).leaf.values.astype(np.float32)
    field = assemble(leaves_of(made), values, made, background=1.5, grid_class="level set", transform=turn)
    assert field.info.grid_type == "float"
    volume.sample(field, np.zeros((1_000_000, 3)), order=1, device="cpu")
    return field


@pytest.fixture
def places():
    """Inside, on voxel centers, and far beyond the table."""
    random = np.random.default_rng(7)
    near, far = random.uniform(-2.5, 2.5, (300, 3)), 1e6 * random.standard_normal((20, 3))
    return tensor(np.concatenate([near, np.round(4.0 * near[:50]) / 4.0, far]))


@pytest.fixture
def at_once(monkeypatch):
    """Take the one pass on a CPU too, and count its calls."""
    calls = []
    real = trilinear_table.sample_and_slopes

    def counted(*given):
        calls.append(given)
        return real(*given)

    monkeypatch.setattr(gradients, "_is_quick_alone", lambda points: False)
    monkeypatch.setattr(gradients, "sample_and_slopes", counted)
    return calls


def both(field, points, **options):
    """The samples and their slopes, weighted."""
    asked = points.clone().requires_grad_()
    found = volume.sample(field, asked, order=1, device="cpu", **options)
    weights = torch.linspace(1.0, 2.0, len(points), dtype=points.dtype)
    return found.detach(), torch.autograd.grad(found, asked, weights)[0]


@pytest.mark.parametrize("space", ["world", "index"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_bits(ball, places, dtype, space, at_once, monkeypatch):
    points = places.to(dtype)
    found, slopes = both(ball, points, space=space)
    assert len(at_once) == 1
    assert torch.equal(found, volume.sample(ball, points, order=1, space=space, device="cpu"))
    monkeypatch.undo()
    expected = both(ball, points, space=space)
    assert found.dtype == slopes.dtype == dtype
    assert torch.equal(found, expected[0])
    assert torch.equal(slopes, expected[1])


def test_voxels_that_are_not_finite(ball, places, at_once, monkeypatch):
    leaves = leaves_of(ball)
    values = grid_nodes(ball.nanovdb).leaf.values.astype(np.float32)
    values[:, ::50], values[:, 1::70] = np.nan, np.inf
    field = assemble(leaves, values, ball, background=1.5, grid_class="level set", transform=ball.info.transform)
    volume.sample(field, np.zeros((1_000_000, 3)), order=1, device="cpu")
    found = both(field, places)
    assert len(at_once) == 1
    monkeypatch.undo()
    for one, other in zip(found, both(field, places), strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())
    assert found[0].isnan().any()


def test_second_derivatives_go_the_other_way(ball, places, at_once, monkeypatch):
    def twice():
        asked = places[:50].clone().requires_grad_()
        value = volume.sample(ball, asked, order=1, device="cpu")
        (first,) = torch.autograd.grad(value.sum(), asked, create_graph=True)
        return torch.autograd.grad((first**2).sum(), asked)[0]

    found = twice()
    assert at_once
    monkeypatch.undo()
    assert torch.equal(found, twice())


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_points_that_are_not_finite_are_refused(ball, places, at_once, bad):
    points = places.clone()
    points[17, 1] = bad
    with pytest.raises(InputError, match="points: row 17 is not finite"):
        both(ball, points)
    assert at_once


def test_the_check_waits_for_the_end_of_the_call(ball, places, monkeypatch):
    device = trilinear_table.launcher.resolve_device("cpu")
    points = places.clone()
    points[3] = np.nan
    monkeypatch.setattr(trilinear_table, "later", lambda check, device: checks.append(check))
    checks: list = []
    with AtEnd():
        value, slopes = trilinear_table.sample_and_slopes(ball, points, "world", device)
    assert value.shape == (len(points),)
    assert slopes.shape == (len(points), 3)
    with pytest.raises(InputError, match="row 3 is not finite"):
        checks[0]()


def test_where_another_way_is_taken(ball, places, at_once):
    asked = places.clone().requires_grad_()
    fresh = volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.25)
    volume.sample(fresh, asked[:1], order=1, device="cpu")
    assert [call[0] for call in at_once] == [fresh]  # which has no table yet
    del at_once[:]
    volume.sample(ball, asked, order=2, device="cpu")
    volume.sample(ball, asked[:0], order=1, device="cpu")
    held = tensor(volume.active_voxels(ball).values).requires_grad_()
    volume.sample(volume.with_values(ball, held), asked, order=1, device="cpu")
    with torch.no_grad():
        volume.sample(ball, asked, order=1, device="cpu")
    with pytest.raises(InputError, match=r"points: .* is not \(N, 3\)"):
        volume.sample(ball, asked[:, :2], order=1, device="cpu")
    with pytest.raises(InputError, match="space: 'voxel' is not known"):
        volume.sample(ball, asked, order=1, space="voxel", device="cpu")
    assert not at_once


def test_too_little_memory_for_both(ball, places, at_once, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("CUDA out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(torch.Tensor, "new_empty", fail)
        asked = places.clone().requires_grad_()
        found = volume.sample(ball, asked, order=1, device="cpu")
    assert len(at_once) == 1
    assert torch.equal(found.detach(), volume.sample(ball, places, order=1, device="cpu"))


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("space", ["world", "index"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_backward_passes_without_checks_have_the_same_bits(places, order, space, dtype, monkeypatch):
    field = volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.25)
    asked = places.to(dtype).requires_grad_()
    found = volume.sample(field, asked, order=order, space=space, device="cpu")
    weights = torch.linspace(1.0, 2.0, len(places), dtype=dtype)
    (expected,) = torch.autograd.grad(found, asked, weights, retain_graph=True)
    kernels = []
    real = gradients.query_kernel
    monkeypatch.setattr(gradients, "query_kernel", lambda *given: kernels.append(given) or real(*given))
    monkeypatch.setattr(gradients, "_is_quick_alone", lambda points: False)
    (slopes,) = torch.autograd.grad(found, asked, weights)
    assert kernels == [("gradient", order, 1, False)]
    assert slopes.dtype == dtype
    assert torch.equal(slopes, expected)


def test_vectors_go_the_other_way(places, monkeypatch):
    ball = volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.25)
    field, asked = volume.gradient_field(ball, device="cpu"), places[:40].clone().requires_grad_()
    (expected,) = torch.autograd.grad(volume.sample(field, asked, order=2, device="cpu").sum(), asked)
    monkeypatch.setattr(gradients, "_is_quick_alone", lambda points: False)
    assert torch.equal(
        torch.autograd.grad(volume.sample(field, asked, order=2, device="cpu").sum(), asked)[0], expected
    )


def test_checkpoints(ball, places, at_once):
    # They compare what a graph keeps in the first pass and in the second, between which a table may be made.
    asked = places.clone().requires_grad_()

    def loss(points):
        return (volume.sample(ball, points, order=1, device="cpu") ** 2).sum()

    torch.utils.checkpoint.checkpoint(loss, asked, use_reentrant=False).backward()
    assert not at_once
    found = asked.grad.clone()
    asked.grad = None
    loss(asked).backward()
    assert len(at_once) == 1
    assert torch.equal(found, asked.grad)


def test_twice_through_one_graph(ball, places, at_once):
    asked = places.clone().requires_grad_()
    value = volume.sample(ball, asked, order=1, device="cpu").sum()
    first, second = (torch.autograd.grad(value, asked, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second)
