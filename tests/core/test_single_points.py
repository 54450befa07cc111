"""One point (3,) is answered as one point, by every query, in every container."""

from __future__ import annotations

import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

import geokit as gk

POINT = np.array([0.3, 0.4, 0.9])
WAY = np.array([0.1, 0.2, -1.0])


def _cube() -> Any:
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    return corners, [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


@pytest.fixture(scope="module")
def things() -> dict[str, Any]:
    dense = np.random.default_rng(1).random((12, 12, 12)).astype(np.float32)
    fog = gk.volume.from_dense(dense, voxel_size=0.1)
    return {
        "surface": gk.mesh.Surface(_cube(), device="cpu"),
        "fog": fog,
        "vectors": gk.volume.from_dense(np.random.default_rng(2).random((12, 12, 12, 3)), voxel_size=0.1),
        "level": gk.volume.from_mesh(_cube(), 0.1, device="cpu"),
        "adaptive": gk.volume.adaptive_from_mesh(_cube(), 0.05, device="cpu"),
        "grid": gk.points.NeighborGrid(np.random.default_rng(3).random((90, 3)), 0.3, device="cpu"),
    }


CPU = {"device": "cpu"}
POINT_QUERIES: dict[str, Callable[..., Any]] = {
    "closest_point": lambda t, p: t["surface"].closest_point(p),
    "furthest_point": lambda t, p: t["surface"].furthest_point(p),
    "signed_distance": lambda t, p: t["surface"].signed_distance(p),
    "contains": lambda t, p: t["surface"].contains(p),
    "winding_number": lambda t, p: t["surface"].winding_number(p),
    "sign_confidence": lambda t, p: t["surface"].sign_confidence(p),
    "sample": lambda t, p: t["fog"].sample(p, **CPU),
    "sample of order 3": lambda t, p: t["fog"].sample(p, order=3, **CPU),
    "sample of vectors": lambda t, p: t["vectors"].sample(p, **CPU),
    "gradient": lambda t, p: t["fog"].gradient(p, **CPU),
    "gradient of vectors": lambda t, p: t["vectors"].gradient(p, **CPU),
    "hessian": lambda t, p: t["fog"].hessian(p, **CPU),
    "curvature": lambda t, p: t["fog"].curvature(p, **CPU),
    "active_at": lambda t, p: t["fog"].active_at(p, **CPU),
    "adaptive sample": lambda t, p: t["adaptive"].sample(p, **CPU),
    "adaptive gradient": lambda t, p: t["adaptive"].gradient(p, **CPU),
    "count": lambda t, p: t["grid"].count(p),
    "knn": lambda t, p: t["grid"].knn(p, 3),
    "hybrid": lambda t, p: t["grid"].hybrid(p, 3),
}
WITH_GRADIENTS = {
    "closest_point", "signed_distance", "winding_number", "sample", "sample of order 3", "sample of vectors",
    "gradient", "adaptive sample", "knn", "hybrid",
}  # fmt: skip
RAY_QUERIES: dict[str, Callable[..., Any]] = {
    "raycast": lambda t, o, d: t["surface"].raycast(o, d),
    "crossing_count": lambda t, o, d: t["surface"].crossing_count(o, d),
    "occluded": lambda t, o, d: t["surface"].occluded(o, d),
    "volume raycast": lambda t, o, d: t["level"].raycast(o, d, **CPU),
    "integrate": lambda t, o, d: t["fog"].integrate(o, d, **CPU),
}


def _parts(answer: Any) -> list[np.ndarray]:
    return [np.asarray(part) for part in (answer if isinstance(answer, tuple) else (answer,))]


@pytest.mark.parametrize("name", POINT_QUERIES)
def test_points(things: dict[str, Any], name: str) -> None:
    ask = POINT_QUERIES[name]
    row, alone = _parts(ask(things, POINT[None])), _parts(ask(things, POINT.tolist()))
    for many, one in zip(row, alone, strict=True):
        assert one.shape == many.shape[1:]
        np.testing.assert_array_equal(one, many[0])


@pytest.mark.parametrize("name", RAY_QUERIES)
def test_rays(things: dict[str, Any], name: str) -> None:
    ask = RAY_QUERIES[name]
    row, alone = _parts(ask(things, POINT[None], WAY[None])), _parts(ask(things, POINT, WAY))
    for many, one in zip(row, alone, strict=True):
        assert one.shape == many.shape[1:]
        np.testing.assert_array_equal(one, many[0])


@pytest.mark.parametrize(
    "ask",
    [
        lambda t, p: t["surface"].raycast_all(p, np.broadcast_to(WAY, np.shape(p))),
        lambda t, p: t["surface"].overlapping(np.asarray(p) - 0.2, np.asarray(p) + 0.2),
        lambda t, p: t["grid"].radius_search(p),
    ],
)
def test_lists_of_one_point_keep_their_shape(things: dict[str, Any], ask: Callable[..., Any]) -> None:
    for many, one in zip(_parts(ask(things, POINT[None])), _parts(ask(things, POINT)), strict=True):
        np.testing.assert_array_equal(one, many)


def test_other_containers(things: dict[str, Any]) -> None:
    expected = things["surface"].closest_point(POINT)
    for value in (tuple(POINT), wp.vec3d(*POINT)):
        found = things["surface"].closest_point(value)
        assert found.distance == expected.distance
    found = things["surface"].closest_point(wp.array(POINT, dtype=wp.float64, device="cpu"))
    assert isinstance(found.points, wp.array)
    assert found.points.shape == (3,)
    np.testing.assert_array_equal(found.points.numpy(), expected.points)
    assert found.distance == expected.distance
    torch = pytest.importorskip("torch")
    found = things["surface"].closest_point(torch.tensor(POINT))
    assert (found.points.shape, found.distance.shape) == ((3,), ())
    assert float(found.distance) == expected.distance


def test_float32(things: dict[str, Any]) -> None:
    assert things["surface"].closest_point(POINT.astype(np.float32)).points.dtype == np.float32
    assert things["fog"].sample(POINT.astype(np.float32), **CPU).dtype == np.float32


def test_clouds_are_tables(things: dict[str, Any]) -> None:
    with pytest.raises(gk.InputError, match=r"shape \(3,\) is not \(N, 3\)"):
        gk.points.normals(POINT, k=3)
    with pytest.raises(gk.InputError, match=r"shape \(4,\) is not \(N, 3\)"):
        things["surface"].closest_point(np.zeros(4))


class TestGradients:
    """A tape gets gradients or is refused, and is not answered with zeros. torch has rules of its own."""

    def test_of_warp(self, things: dict[str, Any]) -> None:
        points = wp.array(POINT[None], dtype=wp.vec3d, device="cpu", requires_grad=True)
        assert things["fog"].sample(points, **CPU).shape == (1,)
        for name, ask in POINT_QUERIES.items():
            with wp.Tape() as tape:
                if name in WITH_GRADIENTS:
                    ask(things, points)
                else:
                    with pytest.raises(gk.InputError, match=r"(points|queries): (a wp.Tape|second derivatives)"):
                        ask(things, points)
            assert len(tape.launches) == (name in WITH_GRADIENTS)

    def test_without_gradients_a_tape_is_none_of_their_business(self, things: dict[str, Any]) -> None:
        points = wp.array(POINT[None], dtype=wp.vec3d, device="cpu")
        with wp.Tape():
            assert things["fog"].sample(points, **CPU).shape == (1,)

    def test_of_torch(self, things: dict[str, Any]) -> None:
        torch = pytest.importorskip("torch")
        point = torch.tensor(POINT, requires_grad=True)
        with pytest.raises(gk.InputError, match="the Tensor requires gradients, which are not recorded; detach"):
            things["surface"].furthest_point(point)
        for ask in (POINT_QUERIES["closest_point"], POINT_QUERIES["sample"], POINT_QUERIES["adaptive sample"]):
            row = torch.tensor(POINT[None], requires_grad=True)
            many, one = ask(things, row), ask(things, point)
            many, one = getattr(many, "distance", many), getattr(one, "distance", one)
            assert (many.shape, one.shape) == ((1,), ())
            expected, found = torch.autograd.grad(many.sum(), row)[0], torch.autograd.grad(one, point)[0]
            assert expected.any()
            assert torch.equal(found, expected[0])
        way = torch.tensor(WAY, requires_grad=True)
        hit = things["surface"].raycast(point, way)
        slopes = torch.autograd.grad(hit.t, (point, way))
        # The upper side is at z = 1, which the ray leaves.
        np.testing.assert_allclose(slopes[1], [0.0, 0.0, -hit.t.item() / WAY[2]], atol=1e-12)

    def test_of_clouds(self, things: dict[str, Any]) -> None:
        torch = pytest.importorskip("torch")
        cloud = types.SimpleNamespace(points=torch.tensor(POINT[None], requires_grad=True))
        mesh = things["surface"].mesh
        surface = gk.torch.Surface(torch.tensor(mesh.vertices, requires_grad=True), mesh.faces, device="cpu")
        assert surface.closest_point(gk.points.PointCloud(POINT[None])).distance.requires_grad
        assert surface.closest_point(POINT).distance.shape == ()
        assert surface.closest_point(POINT.tolist()).distance.requires_grad
        with pytest.raises(gk.InputError, match="requires gradients"):
            things["surface"].closest_point(cloud)
