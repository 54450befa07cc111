"""Many surfaces in every order: no answer depends on which meshes stand before or after one in its batch."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations
from typing import Any

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, Surfaces, TriangleMesh
from tests.support.devices import DEVICES

BOX, BALL = gk.mesh.box(), mesh_catalog.icosphere(2)


def _crossing_itself() -> TriangleMesh:
    """A box one of whose corners is pulled through the opposite side."""
    vertices = BOX.vertices * [2.0, 3.0, 1.0] + [0.0, 9.0, 0.0]
    vertices[0] = np.add(vertices.max(axis=0), [1.0, 0.4, 0.3])
    return TriangleMesh(vertices, BOX.faces)


# Each in a place and of a size of its own, so that the frame or the tree of another mesh shows at once; and each of
# another kind: sound, inside out, open, crossing itself (winding numbers), and of so many faces that some threads
# build its tree.
MESHES = {
    "box": BOX,
    "far": mesh_catalog.moved(mesh_catalog.scaled(mesh_catalog.inside_out(BALL), 30.0), (1e3, -50.0, 7.0)),
    "open": mesh_catalog.moved(mesh_catalog.scaled(mesh_catalog.holed_sphere(), 1e-3), (0.2, 5.0, 0.0)),
    "crossed": _crossing_itself(),
    "fine": mesh_catalog.moved(mesh_catalog.icosphere(5), (-4.0, 0.0, 2.0)),
}
ORDERS = [*permutations(["box", "far", "open", "crossed"]), ("fine", "box"), ("box", "fine"), ("far", "fine", "open")]
QUERY_COUNT = 60


def _points(name: str, seed: int = 0) -> np.ndarray:
    mesh = MESHES[name]
    shares = np.random.default_rng([seed, list(MESHES).index(name)]).uniform(-0.7, 0.7, (QUERY_COUNT, 3))
    return np.asarray(mesh.bounds.mean(axis=0) + shares * mesh.diagonal)


def _directions(name: str) -> np.ndarray:
    return np.asarray(_points(name, 1) - _points(name))


ASKED: dict[str, Callable[[Any, Any, Any], Any]] = {
    "closest_point": lambda s, points, _: s.closest_point(points),
    "closest_point within": lambda s, points, _: s.closest_point(points, max_distance=0.4),
    "signed_distance": lambda s, points, _: s.signed_distance(points),
    "by winding": lambda s, points, _: s.signed_distance(points, sign="winding"),
    "by pseudonormal": lambda s, points, _: s.signed_distance(points, sign="pseudonormal"),
    "by parity": lambda s, points, _: s.signed_distance(points, sign="parity"),
    "signed within": lambda s, points, _: s.signed_distance(points, sign="winding", max_distance=0.4),
    "contains": lambda s, points, _: s.contains(points),
    "raycast": lambda s, points, directions: s.raycast(points, directions),
}


def _outputs(found: Any) -> list[np.ndarray]:
    return [np.asarray(output) for output in (found if isinstance(found, tuple) else (found,))]


@pytest.fixture(scope="module", params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def alone(device: str) -> dict[tuple[str, str], list[np.ndarray]]:
    """What a surface of each mesh answers by itself."""
    surfaces = {name: Surface(mesh, device=device) for name, mesh in MESHES.items()}
    return {
        (name, kind): _outputs(ask(surface, _points(name), _directions(name)))
        for name, surface in surfaces.items()
        for kind, ask in ASKED.items()
    }


def _assert_same(found: list[np.ndarray], expected: list[np.ndarray], what: str) -> None:
    for output, other in zip(found, expected, strict=True):
        assert np.array_equal(output, other, equal_nan=other.dtype.kind == "f"), what


@pytest.mark.parametrize("order", ORDERS, ids="-".join)
def test_each_answers_as_alone(order: tuple[str, ...], device: str, alone: Any) -> None:
    many = Surfaces([MESHES[name] for name in order], device=device)
    points, directions = (np.stack([of(name) for name in order]) for of in (_points, _directions))
    for kind, ask in ASKED.items():
        found = _outputs(ask(many, points, directions))
        for row, name in enumerate(order):
            what = f"{kind} of {name}, {row + 1} of {order}"
            _assert_same([output[row] for output in found], alone[name, kind], what)
    last = many.surface(len(order) - 1)
    for kind, ask in ASKED.items():
        found = _outputs(ask(last, _points(order[-1]), _directions(order[-1])))
        _assert_same(found, alone[order[-1], kind], f"{kind} of the last surface of {order}")


@pytest.mark.parametrize("order", [("box", "far"), ("far", "box"), ("box", "box", "far"), ("open", "far", "box")])
def test_the_last_rows_may_be_missing_or_many(order: tuple[str, ...], device: str, alone: Any) -> None:
    many = Surfaces([MESHES[name] for name in order], device=device)
    for asked in range(len(order)):
        counts = [QUERY_COUNT if row == asked else 0 for row in range(len(order))]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        name = order[asked]
        _assert_same(_outputs(many.signed_distance(_points(name), offsets)), alone[name, "signed_distance"], name)
        found = _outputs(many.raycast(_points(name), _directions(name), offsets))
        _assert_same(found, alone[name, "raycast"], name)


def test_poses_are_those_of_their_own_meshes(device: str) -> None:
    shifts = np.array([[1.0, 2.0, 3.0], [-40.0, 0.5, 0.0], [7.0, 7.0, 7.0]])
    transform = np.repeat(np.eye(4)[None], 3, axis=0)
    transform[:, :3, 3] = shifts
    names = ["box", "open", "far"]
    points = np.stack([_points(name) for name in names])
    for order in permutations(range(3)):
        rows = list(order)
        many = Surfaces([MESHES[names[row]] for row in rows], device=device)
        moved = many.signed_distance(points[rows] + shifts[rows][:, None], transform=transform[rows])
        single = [
            Surface(MESHES[names[row]], device=device).signed_distance(
                points[row] + shifts[row], transform=transform[row]
            )
            for row in rows
        ]
        for at, found in enumerate(single):
            _assert_same([output[at] for output in _outputs(moved)], _outputs(found), names[rows[at]])


def test_methods_of_signs_are_those_of_their_own_meshes(device: str) -> None:
    methods = {name: Surface(mesh, device=device).sign_method for name, mesh in MESHES.items()}
    assert set(methods.values()) == {"pseudonormal", "winding"}
    for order in ORDERS:
        many = Surfaces([MESHES[name] for name in order], device=device)
        assert [methods[name] == "pseudonormal" for name in order] == list(many._signs.by_pseudonormal), order


def test_what_is_known_without_geokit() -> None:
    near, far = gk.mesh.box(), gk.mesh.box(center=(3, 0, 0))
    many = Surfaces([near, far], device="cpu")
    assert list(many.raycast([[0.1, 0, 2], [3.1, 0, 2]], [[0, 0, -1]] * 2, [0, 1, 2]).t) == [1.5, 1.5]
    np.testing.assert_allclose(many.closest_point([[0, 0.1, 0.7], [3, 0.1, 0.7]], [0, 1, 2]).distance, 0.2, atol=1e-15)
    balls = [mesh_catalog.moved(BALL, (3.0 * i, 0.0, 0.0)) for i in range(4)]
    points = np.array([[3.0 * i, 0.1, 0.3] for i in range(4)])
    distance = Surfaces(balls, device="cpu").signed_distance(points, range(5)).distance
    np.testing.assert_allclose(distance, distance[0], atol=1e-14)
    assert -0.7 < distance[0] < -0.6


def test_gradients_follow_their_own_meshes() -> None:
    torch = pytest.importorskip("torch")
    from tests.support.gradient_checks import tensor

    names = ["box", "far", "open"]
    for order in permutations(names):
        meshes = [MESHES[name] for name in order]
        shift = np.cumsum([0, *[mesh.vertex_count for mesh in meshes]])
        faces = np.concatenate([mesh.faces + first for mesh, first in zip(meshes, shift, strict=False)])
        offsets = np.cumsum([0, *[mesh.face_count for mesh in meshes]])
        vertices = tensor(np.concatenate([mesh.vertices for mesh in meshes])).requires_grad_()
        points = tensor(np.stack([_points(name) for name in order])).requires_grad_()
        towards = tensor(np.stack([_directions(name) for name in order])).requires_grad_()
        many = Surfaces((vertices, faces, offsets), device="cpu")
        t = many.raycast(points, towards).t
        loss = many.signed_distance(points).distance.sum() + t[torch.isfinite(t)].sum()
        of_vertices, of_points, of_towards = torch.autograd.grad(loss, (vertices, points, towards))
        for row, mesh in enumerate(meshes):
            held = tensor(mesh.vertices).requires_grad_()
            own, aim = points[row].detach().requires_grad_(), towards[row].detach().requires_grad_()
            single = gk.torch.Surface(held, torch.tensor(mesh.faces), device="cpu")
            t = single.raycast(own, aim).t
            loss = single.signed_distance(own).distance.sum() + t[torch.isfinite(t)].sum()
            slopes = torch.autograd.grad(loss, (held, own, aim))
            rows = slice(int(shift[row]), int(shift[row + 1]))
            for one, other in zip(slopes, (of_vertices[rows], of_points[row], of_towards[row]), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12, err_msg=f"{order[row]} of {order}")
