"""Rows of shape (..., 3), one direction for all rays, and numbers and devices as other libraries have them.

Those of jax are in tests/core/gradients/test_jax.py.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.core import launcher
from geokit.errors import InputError

LEAD = (2, 5)
ROWS = np.random.default_rng(3).uniform(-1.0, 1.0, (*LEAD, 3))
UP = [0.0, 0.0, 1.0]


@functools.cache
def _things() -> tuple[gk.mesh.Surface, gk.volume.SparseVolume, gk.volume.SparseVolume, gk.points.NeighborGrid]:
    ball = gk.mesh.sphere(segments=12)
    fog = gk.volume.from_dense(np.full((4, 4, 4), 0.5, np.float32))
    grid = gk.points.NeighborGrid(ROWS.reshape(-1, 3), radius=0.7, device="cpu")
    return gk.mesh.Surface(ball, device="cpu"), gk.volume.from_mesh(ball, voxel_size=0.2, device="cpu"), fog, grid


# Each query of a row of points, and its answer to them.
QUERIES: dict[str, Callable[[Any], Any]] = {
    "closest_point": lambda x: _things()[0].closest_point(x),
    "closest_point, moved": lambda x: _things()[0].closest_point(x, transform=np.eye(4)),
    "furthest_point": lambda x: _things()[0].furthest_point(x),
    "signed_distance": lambda x: _things()[0].signed_distance(x),
    "contains": lambda x: _things()[0].contains(x),
    "winding_number": lambda x: _things()[0].winding_number(x),
    "sign_confidence": lambda x: _things()[0].sign_confidence(x),
    "raycast": lambda x: _things()[0].raycast(x, UP),
    "occluded": lambda x: _things()[0].occluded(x, UP),
    "crossing_count": lambda x: _things()[0].crossing_count(x, UP),
    "sample": lambda x: _things()[1].sample(x, device="cpu"),
    "gradient": lambda x: _things()[1].gradient(x, device="cpu"),
    "hessian": lambda x: _things()[1].hessian(x, device="cpu"),
    "curvature": lambda x: _things()[1].curvature(x, device="cpu"),
    "active_at": lambda x: _things()[1].active_at(x, device="cpu"),
    "raycast of a volume": lambda x: _things()[1].raycast(x, UP, device="cpu"),
    "integrate": lambda x: _things()[2].integrate(x, UP, device="cpu"),
    "count": lambda x: _things()[3].count(x),
    "knn": lambda x: _things()[3].knn(x, 3),
    "hybrid": lambda x: _things()[3].hybrid(x, k=3, radius=0.5),
}
LISTS: dict[str, Callable[[Any], Any]] = {
    "raycast_all": lambda x: _things()[0].raycast_all(x, UP),
    "overlapping": lambda x: _things()[0].overlapping(x, x + 0.1),
    "radius_search": lambda x: _things()[3].radius_search(x),
}


def _arrays(answer: Any) -> list[np.ndarray]:
    parts = answer if isinstance(answer, tuple) else (answer,)
    return [part.numpy() if isinstance(part, wp.array) else np.asarray(part) for part in parts]


def _torch(x: np.ndarray) -> Any:
    return pytest.importorskip("torch").tensor(x)


def _turned(x: np.ndarray) -> Any:  # not contiguous
    return pytest.importorskip("torch").tensor(np.swapaxes(x, 0, 1).copy()).transpose(0, 1)


def _warp(x: np.ndarray) -> Any:
    return wp.array(x, dtype=wp.float64, device="cpu")


def _vectors(x: np.ndarray) -> Any:
    return wp.array(x, dtype=wp.vec3d, device="cpu")


@pytest.mark.parametrize("kind", [np.asarray, np.ndarray.tolist, _torch, _turned, _warp, _vectors])
@pytest.mark.parametrize("name", QUERIES)
def test_answers_have_the_leading_axes(name: str, kind: Callable[[np.ndarray], Any]) -> None:
    rows = kind(ROWS)
    expected = _arrays(QUERIES[name](ROWS.reshape(-1, 3)))
    for _ in range(4):  # the third call of one shape is replayed
        answer = QUERIES[name](rows)
        parts = answer if isinstance(answer, tuple) else (answer,)
        if not isinstance(rows, list):
            assert all(isinstance(part, type(rows)) for part in parts)
        for part, whole in zip(_arrays(answer), expected, strict=True):
            assert part.shape == (*LEAD, *whole.shape[1:])
            np.testing.assert_array_equal(part.reshape(whole.shape), whole)


@pytest.mark.parametrize("shape", [(1, 1, 1, 10, 3), (0, 4, 3), (4, 0, 3)])
@pytest.mark.parametrize("kind", [np.asarray, _torch])
def test_any_number_of_axes(shape: tuple[int, ...], kind: Callable[[np.ndarray], Any]) -> None:
    rows = np.resize(ROWS, shape)
    assert _things()[0].closest_point(kind(rows)).points.shape == shape
    assert _things()[1].sample(kind(rows), device="cpu").shape == shape[:-1]


@pytest.mark.parametrize("name", LISTS)
def test_lists_are_those_of_the_rows_in_order(name: str) -> None:
    for left, right in zip(_arrays(LISTS[name](ROWS)), _arrays(LISTS[name](ROWS.reshape(-1, 3))), strict=True):
        np.testing.assert_array_equal(left, right)


def test_many_rows_go_in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    from geokit.core.blocks import chunked_queries

    done = []
    monkeypatch.setattr(chunked_queries, "MOST_ROWS", 3)
    _things()[0].closest_point(ROWS.reshape(-1, 3), progress=lambda *count: done.append(count))
    assert done == [(3, 10), (6, 10), (9, 10), (10, 10)]


@pytest.mark.parametrize("name", ["signed_distance", "closest_point", "winding_number", "raycast", "sample", "knn"])
def test_gradients_by_torch(name: str) -> None:
    torch = pytest.importorskip("torch")
    slopes = []
    for rows in (torch.tensor(ROWS, requires_grad=True), torch.tensor(ROWS.reshape(-1, 3), requires_grad=True)):
        answer = QUERIES[name](rows)
        first = answer[0] if isinstance(answer, tuple) else answer
        torch.where(torch.isfinite(first), first, 0.0).sum().backward()
        slopes.append(rows.grad)
    assert slopes[0].shape == ROWS.shape
    torch.testing.assert_close(slopes[0].reshape(-1, 3), slopes[1], rtol=0.0, atol=0.0)


def test_gradients_on_a_tape() -> None:
    rows: Any = wp.array(ROWS, dtype=wp.float64, device="cpu", requires_grad=True)
    with wp.Tape() as tape:
        answer = _things()[0].signed_distance(rows)
    assert answer.points.shape == ROWS.shape
    answer.distance.grad.fill_(1.0)
    tape.backward()
    torch = pytest.importorskip("torch")
    tensor = torch.tensor(ROWS, requires_grad=True)
    _things()[0].signed_distance(tensor).distance.sum().backward()
    np.testing.assert_allclose(rows.grad.numpy(), tensor.grad.numpy(), atol=1e-14)


def _many(x: Any, d: Any) -> Any:
    ball = gk.mesh.sphere(segments=12)
    return gk.mesh.Surfaces([ball, ball], device="cpu").raycast(x, d)


@pytest.mark.parametrize(
    "cast",
    [
        lambda x, d: _things()[0].raycast(x, d),
        lambda x, d: _things()[0].raycast(x, d, transform=np.eye(4)),
        lambda x, d: _things()[0].raycast_all(x, d),
        lambda x, d: _things()[0].occluded(x, d),
        lambda x, d: _things()[0].crossing_count(x, d),
        lambda x, d: _things()[1].raycast(x, d, device="cpu"),
        lambda x, d: _things()[2].integrate(x, d, device="cpu"),
        _many,
    ],
)
def test_one_direction_is_that_of_all_rays(cast: Callable[[Any, Any], Any]) -> None:
    each = np.broadcast_to(UP, ROWS.shape)
    for kind in (np.asarray, _torch, _warp):
        for one in (UP, kind(np.array(UP))):
            for left, right in zip(_arrays(cast(kind(ROWS), one)), _arrays(cast(ROWS, each)), strict=True):
                np.testing.assert_array_equal(left, right)


def test_one_origin_is_that_of_all_rays() -> None:
    start = np.array([0.0, 0.0, -5.0])
    for left, right in zip(
        _things()[0].raycast(_torch(start), ROWS - start),
        _things()[0].raycast(np.broadcast_to(start, ROWS.shape), ROWS - start),
        strict=True,
    ):
        np.testing.assert_array_equal(left.numpy(), right)


@pytest.mark.parametrize("cast", [lambda x, d: _things()[0].raycast(x, d), _many])
def test_the_gradient_of_one_direction_is_the_sum_of_all(cast: Callable[[Any, Any], Any]) -> None:
    torch = pytest.importorskip("torch")
    one = torch.tensor(UP, dtype=torch.float64, requires_grad=True)
    each = torch.tensor(np.broadcast_to(UP, ROWS.shape).copy(), requires_grad=True)
    for direction in (one, each):
        t = cast(torch.tensor(ROWS), direction).t
        t[torch.isfinite(t)].sum().backward()
    torch.testing.assert_close(one.grad, each.grad.sum((0, 1)))


@pytest.mark.parametrize("kind", ["float16", "bfloat16", "int16", "int64", "uint8"])
def test_numbers_are_widened(kind: str) -> None:
    torch = pytest.importorskip("torch")
    rows = (torch.tensor(ROWS.reshape(-1, 3)) * 3.0 + 4.0).to(getattr(torch, kind))
    answer, expected = _things()[0].closest_point(rows), _things()[0].closest_point(rows.to(torch.float64).numpy())
    assert answer.points.dtype == torch.float64
    for left, right in zip(answer, expected, strict=True):
        np.testing.assert_array_equal(left.numpy(), right)


def test_half_precision_has_gradients() -> None:
    torch = pytest.importorskip("torch")
    rows = torch.tensor(ROWS).half().requires_grad_()
    _things()[0].signed_distance(rows).distance.sum().backward()
    wide = rows.detach().double().requires_grad_()
    _things()[0].signed_distance(wide).distance.sum().backward()
    torch.testing.assert_close(rows.grad, wide.grad.half(), rtol=0.0, atol=0.0)


@pytest.mark.parametrize("kind", [np.asarray, np.ndarray.tolist, _torch, _warp])
def test_columns_are_named(kind: Callable[[np.ndarray], Any]) -> None:
    with pytest.raises(InputError, match=r"points: .*shape \(3, 10\) is not \(N, 3\).*; transpose it"):
        _things()[0].closest_point(kind(ROWS.reshape(-1, 3).T))


def test_other_numbers_of_rows_are_refused() -> None:
    with pytest.raises(InputError, match="directions: 3 rows for 10 origins; give one for each, or one of shape"):
        _things()[0].raycast(ROWS.reshape(-1, 3), np.ones((3, 3)))
    with pytest.raises(InputError, match=r"directions: \(10,\) rows for \(2, 5\) origins"):
        _things()[1].raycast(ROWS, np.ones((10, 3)), device="cpu")
    with pytest.raises(InputError, match=r"points: shape \(2, 5, 3\) is not \(N, 3\)"):
        gk.points.NeighborGrid(ROWS, radius=0.5, device="cpu")


@pytest.mark.parametrize("none", [(), np.zeros((0, 3)), np.zeros((2, 0, 3))])
def test_no_direction_is_none_for_all(none: Any) -> None:
    surface, volume = _things()[0], _things()[2]
    rows = ROWS.reshape(-1, 3)
    for cast in (
        surface.raycast,
        surface.raycast_all,
        surface.occluded,
        lambda *rays: gk.volume.raycast(volume, *rays),
    ):
        with pytest.raises(InputError, match=r"directions: .*0.* rows for .*10.* origins; give one for each"):
            cast(rows, none)
    with pytest.raises(InputError, match=r"directions: .*0.* rows for .*10.* origins; give one for each"):
        gk.volume.integrate(volume, rows, none, extinction=1.0)


def test_devices_of_other_libraries() -> None:
    torch = pytest.importorskip("torch")
    ball = gk.mesh.sphere(segments=8)
    for device in (torch.device("cpu"), torch.tensor(0.0).device):
        assert gk.mesh.Surface(ball, device=device).device == "cpu"
        assert gk.volume.from_mesh(ball, voxel_size=0.3, device=device).sample(UP, device=device) == pytest.approx(
            0.0, abs=0.1
        )
        assert gk.points.NeighborGrid(ball.vertices, radius=0.1, device=device).device == "cpu"
    with pytest.raises(InputError, match="is not on this machine; use one of cpu"):
        launcher.resolve_device(torch.device("mps"))


def test_gpus_of_other_libraries_are_told_by_number() -> None:
    class Platform:
        platform, local_hardware_id, id = "gpu", 1, 3

    for module, expected in (("jaxlib._jax", "cuda:1"), ("cupy.cuda.device", "cuda:3"), ("mine", None)):
        device = type("Device", (Platform,), {"__module__": module})()
        assert launcher._alias_of(device) == (device if expected is None else expected)
    torch = pytest.importorskip("torch")
    assert launcher._alias_of(torch.device("cuda:1")) == "cuda:1"


@pytest.mark.slow
def test_torch_compile_keeps_leading_axes_and_one_direction() -> None:
    torch = pytest.importorskip("torch")
    surface = _things()[0]

    def asked(x: Any, up: Any) -> tuple[Any, Any]:
        return surface.signed_distance(x).distance, surface.raycast(x, up).t

    slopes = []
    for ask in (asked, torch.compile(asked, backend="eager", fullgraph=True)):
        rows, up = (torch.tensor(values, dtype=torch.float64, requires_grad=True) for values in (ROWS, UP))
        distance, t = ask(rows, up)
        assert distance.shape == t.shape == LEAD
        (distance.sum() + t[torch.isfinite(t)].sum()).backward()
        slopes.append((rows.grad, up.grad))
    for left, right in zip(*slopes, strict=True):
        torch.testing.assert_close(left, right)
