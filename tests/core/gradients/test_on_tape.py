"""Gradients on warp's tape: against torch's and finite differences, between kernels, and what is refused."""

from __future__ import annotations

import functools
import importlib.util
import re
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core.launches import warp_private
from geokit.volume.nanovdb.nodes import grid_nodes
from geokit.volume.tree.leaves import assemble, leaves_of
from tests.support.devices import DEVICES

ROOT = Path(__file__).resolve().parents[3]
BODY = mesh_catalog.icosphere()
OPEN = gk.mesh.TriangleMesh(BODY.vertices, BODY.faces[: BODY.face_count // 2])
GROUPS = [0, 10, 11, 30], [0, 5, 12, 20]
# Meshes, rays and values of Surfaces, packed.
PACKED = np.concatenate([BODY.vertices, BODY.vertices + 0.5])
TWICE = np.concatenate([BODY.faces, BODY.faces + BODY.vertex_count])
BEGIN = [0, BODY.face_count, 2 * BODY.face_count]
HALVES = [0, 15, 40]


@functools.cache
def field(background: float, kind: str) -> gk.volume.SparseVolume:
    """A sphere in float64 under a sheared transform."""
    ball = gk.volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.5)
    values = grid_nodes(ball.nanovdb).leaf.values.astype(np.float64)
    turn = np.eye(4)
    turn[:3, :3] = 0.5 * np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.1], [0.0, 0.0, 1.2]])
    return assemble(leaves_of(ball), values, ball, background=background, grid_class=kind, transform=turn)


def ball() -> gk.volume.SparseVolume:
    return field(1.5, "level set")


def fog() -> gk.volume.SparseVolume:
    return field(0.0, "fog volume")


def values() -> np.ndarray:
    found = gk.volume.active_voxels(ball()).values
    return found + 0.01 * np.random.default_rng(4).standard_normal(len(found))


RANDOM = np.random.default_rng(1)
AROUND = 1.5 * RANDOM.standard_normal((40, 3))
NEAR = RANDOM.standard_normal((40, 3))
NEAR *= RANDOM.uniform(0.7, 1.4, (40, 1)) / np.linalg.norm(NEAR, axis=1)[:, None]
ORIGINS = 3.0 * RANDOM.standard_normal((40, 3))
WAYS = 0.5 * RANDOM.standard_normal((40, 3)) - ORIGINS
A, B = RANDOM.random((30, 3)), RANDOM.random((20, 3))


def surface(vertices: Any, mesh: gk.mesh.TriangleMesh = BODY) -> gk.mesh.Surface:
    return gk.mesh.Surface((vertices, mesh.faces), device="cpu")


def packed(vertices: Any) -> gk.mesh.Surfaces:
    return gk.mesh.Surfaces((vertices, TWICE, BEGIN), device="cpu")


def valued(values: Any, volume: gk.volume.SparseVolume | None = None) -> gk.volume.SparseVolume:
    return gk.volume.with_values(volume or ball(), values)


def cloud(points: Any) -> gk.points.NeighborGrid:
    return gk.points.NeighborGrid(points, device="cpu")


def periodic(points: Any) -> gk.points.NeighborGrid:
    cell = [[1.0, 0.0, 0.0], [0.2, 0.9, 0.0], [0.1, -0.2, 1.1]]
    return gk.points.NeighborGrid(points, 0.5, periodic=cell, device="cpu")


# Queries of arrays with gradients, for each library alike; arrays that take time to make are functions.
QUERIES: dict[str, tuple[Callable[..., Any], tuple[np.ndarray | Callable[[], np.ndarray], ...]]] = {
    "closest_point": (lambda v, p: surface(v).closest_point(p), (BODY.vertices, AROUND)),
    # By points alone there are kernels.
    "closest_point by points": (lambda p: surface(BODY.vertices).closest_point(p), (AROUND,)),
    "closest_point by points, within": (
        lambda p: surface(BODY.vertices).closest_point(p, max_distance=0.7),
        (AROUND,),
    ),
    "signed_distance by points": (lambda p: surface(BODY.vertices).signed_distance(p), (AROUND,)),
    "closest_point within": (lambda v, p: surface(v).closest_point(p, max_distance=0.7), (BODY.vertices, AROUND)),
    "signed_distance": (lambda v, p: surface(v).signed_distance(p), (BODY.vertices, AROUND)),
    "raycast": (lambda v, o, d: surface(v).raycast(o, d), (BODY.vertices, ORIGINS, WAYS)),
    "winding_number": (lambda v, p: surface(v, OPEN).winding_number(p), (BODY.vertices, AROUND)),
    "winding_number, closed": (lambda v, p: surface(v).winding_number(p), (BODY.vertices, AROUND)),
    "closest_point of many": (lambda v, p: packed(v).closest_point(p, offsets=HALVES), (PACKED, AROUND)),
    "signed_distance of many": (lambda v, p: packed(v).signed_distance(p, offsets=HALVES), (PACKED, AROUND)),
    "raycast of many": (lambda v, o, d: packed(v).raycast(o, d, offsets=HALVES), (PACKED, ORIGINS, WAYS)),
    "volume.raycast": (lambda o, d, a: valued(a).raycast(o, d, device="cpu"), (ORIGINS, WAYS, values)),
    "vector field": (
        lambda p: gk.volume.gradient_field(ball(), device="cpu").sample(p, order=2, device="cpu"),
        (NEAR,),
    ),
    "integrate": (
        lambda o, d, a, e: valued(a, fog()).integrate(o, d, emission=valued(e, fog()), device="cpu"),
        (ORIGINS, WAYS, lambda: abs(values()), values),
    ),
    "knn": (lambda a, b: cloud(a).knn(b, k=3), (A, B)),
    "knn of the points": (lambda a: cloud(a).knn(k=3, exclude_self=True), (A,)),
    "hybrid": (lambda a, b: cloud(a).hybrid(b, k=3, radius=0.2), (A, B)),
    "radius_search": (lambda a, b: cloud(a).radius_search(b, radius=0.4), (A, B)),
    "radius_search of the points": (lambda a: cloud(a).radius_search(radius=0.4, order="any"), (A,)),
    "radius_search by queries": (lambda b: cloud(A).radius_search(b, radius=0.3, order="distance"), (B,)),
    "neighbor_list": (lambda a, b: periodic(a).neighbor_list(b, radius=0.7), (A, B)),
    "neighbor_list of the points": (lambda a: periodic(a).neighbor_list(exclude_self=True), (A,)),
    "density": (lambda a, b: gk.points.density(a, radius=0.4, kernel="poly6", queries=b, device="cpu"), (A, B)),
    "density of the points": (lambda a: gk.points.density(a, radius=0.4, kernel="wendland_c2", device="cpu"), (A,)),
    "chamfer": (lambda a, b: gk.points.chamfer(a, b, device="cpu"), (A, B)),
    "chamfer of groups": (lambda a, b: gk.points.chamfer(a, b, groups=GROUPS, device="cpu"), (A, B)),
    "hausdorff": (lambda a, b: gk.points.hausdorff(a, b, device="cpu"), (A, B)),
}
for order in (1, 2, 3):
    for space in ("world", "index"):
        options = {"order": order, "space": space, "device": "cpu"}
        QUERIES[f"sample, order {order}, {space}"] = (
            lambda p, a, options=options: valued(a).sample(p, **options),
            (NEAR, values),
        )
        QUERIES[f"sample by points, order {order}, {space}"] = (
            lambda p, options=options: ball().sample(p, **options),
            (NEAR,),
        )
        QUERIES[f"gradient, order {order}, {space}"] = (
            lambda p, a, options=options: valued(a).gradient(p, **options),
            (NEAR, values),
        )


def asked(name: str) -> tuple[Callable[..., Any], list[np.ndarray]]:
    ask, given = QUERIES[name]
    return ask, [part() if callable(part) else part for part in given]


def on_tape(values: Any, dtype: Any = wp.float64, device: str = "cpu") -> wp.array:
    return wp.array(values, dtype=dtype, device=device, requires_grad=True)


def leaves(answer: Any) -> list[Any]:
    return [leaf for one in answer for leaf in leaves(one)] if isinstance(answer, tuple) else [answer]


def weights_of(arrays: list[Any]) -> list[Any]:
    """Random weights of what is finite in each output that carries gradients; None for the others."""
    random = np.random.default_rng(2)
    return [
        np.where(np.isfinite(one.numpy()), random.standard_normal(one.numpy().shape), 0.0)
        if one.requires_grad
        else None
        for one in arrays
    ]


def pulled(tape: wp.Tape, arrays: list[Any], weights: list[Any]) -> None:
    tape.backward(
        grads={
            one: wp.array(weight, dtype=one.dtype, device=one.device)
            for one, weight in zip(arrays, weights, strict=True)
            if weight is not None
        }
    )


@pytest.mark.parametrize("name", QUERIES)
def test_gradients_are_those_of_torch(name: str) -> None:
    torch = pytest.importorskip("torch")
    ask, given = asked(name)
    tensors = [torch.tensor(part, requires_grad=True) for part in given]
    arrays = [on_tape(part) for part in given]
    with wp.Tape() as tape:
        found = leaves(ask(*arrays))
    weights = weights_of(found)
    loss = 0.0
    for out, weight, one in zip(leaves(ask(*tensors)), weights, found, strict=True):
        assert out.requires_grad == (weight is not None)
        np.testing.assert_allclose(one.numpy().reshape(out.shape), out.detach().numpy(), rtol=1e-14)
        if weight is not None:
            finite = torch.where(torch.isfinite(out), out, 0.0)
            loss = loss + (finite * torch.tensor(weight.reshape(out.shape))).sum()
    loss.backward()
    pulled(tape, found, weights)
    for array, tensor in zip(arrays, tensors, strict=True):
        expected = tensor.grad.numpy()
        np.testing.assert_allclose(array.grad.numpy(), expected, rtol=0.0, atol=1e-12 * max(1.0, abs(expected).max()))
        assert tape.gradients[array] is array.grad
    assert name == "winding_number, closed" or all(array.grad.numpy().any() for array in arrays)


# Winding numbers are approximate to 0.005, which differences show; their gradients are those of the exact ones.
@pytest.mark.parametrize("name", [name for name in QUERIES if "winding" not in name])
def test_gradients_are_finite_differences(name: str) -> None:
    # Along a random direction of all arguments together.
    ask, given = asked(name)
    random, step = np.random.default_rng(3), 1e-6
    ways = [random.standard_normal(part.shape) for part in given]
    arrays = [on_tape(part) for part in given]
    with wp.Tape() as tape:
        found = leaves(ask(*arrays))
    weights = weights_of(found)
    sides = []
    for sign in (1.0, -1.0):
        moved = [on_tape(part + sign * step * way) for part, way in zip(given, ways, strict=True)]
        with wp.Tape():
            sides.append([out.numpy() for out in leaves(ask(*moved))])
    change = 0.0
    for out, weight, ahead, behind in zip(found, weights, *sides, strict=True):
        if weight is not None:
            # On an edge, the weights are those of either of its faces.
            with np.errstate(invalid="ignore"):
                smooth = np.maximum(abs(ahead - out.numpy()), abs(behind - out.numpy())) < 1e3 * step
                slope = np.where(smooth, (ahead - behind) / (2.0 * step), 0.0)
            assert smooth[weight != 0.0].mean() > 0.8
            weight[~smooth] = 0.0
            change += float((slope * weight).sum())
    pulled(tape, found, weights)
    along = sum(float((array.grad.numpy() * way).sum()) for array, way in zip(arrays, ways, strict=True))
    assert along == pytest.approx(change, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("name", QUERIES)
def test_a_second_pass_adds_the_same_bits(name: str) -> None:
    ask, given = asked(name)
    runs = []
    for _ in range(2):
        arrays = [on_tape(part) for part in given]
        with wp.Tape() as tape:
            found = leaves(ask(*arrays))
        weights = weights_of(found)
        pulled(tape, found, weights)
        first = [array.grad.numpy().copy() for array in arrays]
        pulled(tape, found, weights)
        for array, once in zip(arrays, first, strict=True):
            np.testing.assert_array_equal(array.grad.numpy(), 2.0 * once)
        tape.zero()
        assert not any(array.grad.numpy().any() for array in arrays)
        pulled(tape, found, weights)
        runs.append([array.grad.numpy() for array in arrays])
        for again, once in zip(runs[-1], first, strict=True):
            np.testing.assert_array_equal(again, once)
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, other)


@wp.kernel
def turned_kernel(points: wp.array(dtype=wp.vec3d), angle: wp.array(dtype=wp.float64), out: wp.array(dtype=wp.vec3d)):
    i = wp.tid()
    p, c, s = points[i], wp.cos(angle[0]), wp.sin(angle[0])
    out[i] = wp.vec3d(c * p[0] - s * p[1], s * p[0] + c * p[1], p[2])


@wp.kernel
def loss_kernel(distance: wp.array(dtype=wp.float64), feet: wp.array(dtype=wp.vec3d), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    wp.atomic_add(out, 0, distance[i] * distance[i] + wp.float64(0.1) * feet[i][0])


@pytest.mark.parametrize("device", DEVICES)
def test_kernels_before_and_after(device: str) -> None:
    body = mesh_catalog.box()
    surface, points = gk.mesh.Surface(body, device=device), wp.array(AROUND, dtype=wp.vec3d, device=device)

    def loss(angle: wp.array) -> wp.array:
        turned = wp.empty_like(points, requires_grad=True)
        total = wp.zeros(1, dtype=wp.float64, device=device, requires_grad=True)
        wp.launch(turned_kernel, len(points), [points, angle], [turned], device=device)
        found = surface.signed_distance(turned)
        wp.launch(loss_kernel, len(points), [found.distance, found.points], [total], device=device)
        return total

    angle = on_tape([0.3], device=device)
    with wp.Tape() as tape:
        total = loss(angle)
    tape.backward(total)
    step = 1e-6
    ahead, behind = (loss(wp.array([0.3 + way], dtype=wp.float64, device=device)).numpy()[0] for way in (step, -step))
    once = angle.grad.numpy()[0]
    assert once == pytest.approx((ahead - behind) / (2.0 * step), rel=1e-6)
    tape.backward(total)
    assert angle.grad.numpy()[0] == pytest.approx(2.0 * once, rel=1e-12)
    tape.zero()
    tape.backward(total)
    assert angle.grad.numpy()[0] == pytest.approx(once, rel=1e-12)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [wp.float32, wp.float64, wp.vec3f, wp.vec3d])
@pytest.mark.parametrize(
    "name", ["closest_point", "signed_distance", "sample", "winding_number", "density", "vertices", "values"]
)
def test_types_of_arrays(name: str, dtype: Any, device: str) -> None:
    """Each array type has the gradients of float64 rows, in its own type."""
    rows, corners, numbers = (part.astype(np.float32).astype(np.float64) for part in (AROUND, BODY.vertices, values()))
    number = wp.float32 if dtype in (wp.float32, wp.vec3f) else wp.float64

    def gradients(kind: Any, number: Any) -> list[np.ndarray]:
        given = [on_tape(rows, kind, device)]
        if name == "vertices":
            given.append(on_tape(corners, kind, device))
        if name == "values":
            given.append(on_tape(numbers, number, device))
        with wp.Tape() as tape:
            if name == "sample":
                answer = ball().sample(given[0], device=device)
            elif name == "values":
                answer = valued(given[1]).sample(given[0], device=device)
            elif name == "winding_number":
                answer = gk.mesh.Surface((corners, OPEN.faces), device=device).winding_number(given[0])
            elif name == "density":
                answer = gk.points.density(given[0], radius=0.5, kernel="cubic_spline", device=device)
            else:
                body = gk.mesh.Surface((given[-1] if name == "vertices" else corners, BODY.faces), device=device)
                answer = getattr(body, name if name != "vertices" else "signed_distance")(given[0]).distance
        assert answer.device == given[0].device
        assert answer.dtype == number
        tape.backward(grads={answer: wp.ones_like(answer, requires_grad=False)})
        assert [array.grad.dtype for array in given] == [array.dtype for array in given]
        return [array.grad.numpy() for array in given]

    for expected, found in zip(gradients(wp.float64, wp.float64), gradients(dtype, number), strict=True):
        assert expected.any()
        if number is wp.float64:
            np.testing.assert_array_equal(found, expected)
        else:
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("single", [0, 1])
@pytest.mark.parametrize("name", ["raycast", "chamfer", "density"])
def test_two_precisions_parts_of_arrays_and_another_device(name: str, single: int, device: str) -> None:
    """Arguments of float32 and float64, with gaps and on the CPU, have the gradients of arrays without all that."""
    pair = [part.astype(np.float32).astype(np.float64) for part in ((ORIGINS, WAYS) if name == "raycast" else (A, B))]

    def ask(first: Any, second: Any) -> Any:
        if name == "raycast":
            return gk.mesh.Surface(BODY, device=device).raycast(first, second).t
        if name == "chamfer":
            return gk.points.chamfer(first, second, device=device).distance
        return gk.points.density(first, radius=0.4, kernel="wendland_c2", queries=second, device=device)

    kinds = [wp.vec3f if number == single else wp.vec3d for number in range(2)]
    wholes = [on_tape(np.repeat(part, 2, axis=0), kind) for part, kind in zip(pair, kinds, strict=True)]
    slopes = []
    for given in (pair, wholes):
        arrays = [on_tape(one) if given is pair else one[::2] for one in given]
        with wp.Tape() as tape:
            answer = ask(*arrays)
        tape.backward(grads={answer: wp.ones_like(answer, requires_grad=False)})
        slopes.append([array.grad.numpy() for array in arrays])
    for expected, found in zip(*slopes, strict=True):
        assert expected.any()
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_more_rows_than_a_sum_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    from geokit.points.gradients import distances

    monkeypatch.setattr(distances, "MOST_SUMMED", 10)
    points = on_tape(A)
    with wp.Tape() as tape:
        found = cloud(points).knn(k=3)
    with pytest.raises(gk.InputError, match="points: too many rows for one sum of derivatives; ask in parts"):
        tape.backward(grads={found.distance: wp.ones_like(found.distance, requires_grad=False)})


@pytest.mark.parametrize("dtype", [wp.vec3f, wp.vec3d])
@pytest.mark.parametrize("device", DEVICES)
def test_what_has_a_kernel_stays_on_its_device(device: str, dtype: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from geokit.core.gradients import with_numpy as module

    def fail(*_: Any) -> None:
        raise AssertionError("on the host")

    monkeypatch.setattr(module, "_on_host", fail)
    rows = (BODY.vertices, AROUND, -AROUND, PACKED, BODY.vertices)
    vertices, points, ways, both, some = (on_tape(part, dtype, device) for part in rows)
    body = gk.mesh.Surface((vertices, BODY.faces), device=device)
    many = gk.mesh.Surfaces((both, TWICE, BEGIN), device=device)
    with wp.Tape() as tape:
        answers = [body.closest_point(points).distance, body.signed_distance(points).points]
        answers += [body.raycast(points, ways).t, many.closest_point(points, HALVES).barycentric]
        answers.append(ball().sample(points, device=device))
        answers.append(gk.mesh.Surface((some, OPEN.faces), device=device).winding_number(points))
        answers.append(gk.points.density(points, radius=0.5, kernel="poly6", queries=ways, device=device))
    pulled(tape, answers, weights_of(answers))
    # Only the vertices of the border move winding numbers.
    assert 3 < some.grad.numpy().any(axis=1).sum() < len(some)
    for array in (vertices, points, ways, both):
        assert array.grad.numpy().any(axis=1).sum() > 0.8 * min(len(array), len(points))


@pytest.mark.parametrize("query", ["closest_point", "signed_distance"])
@pytest.mark.parametrize("outputs", [["distance"], ["distance", "points", "barycentric"]])
def test_kernels_agree_with_the_rule_at_kinks(query: str, outputs: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Far and near, on faces, edges and vertices, at distance 0, and beside a triangle without area."""
    torch = pytest.importorskip("torch")
    from geokit.core.gradients import with_torch as module

    flat = np.concatenate([BODY.faces, [[0, 1, 1], [2, 2, 2]]])
    body = gk.mesh.Surface((BODY.vertices, flat), device="cpu")
    found = body.closest_point(AROUND)
    away = (AROUND - found.points) / found.distance[:, None]
    centers = BODY.vertices[BODY.faces].mean(axis=1)
    rows = np.concatenate([AROUND, found.points + 1e-9 * away, centers, BODY.vertices, 1.5 * BODY.vertices])

    def slopes() -> list[np.ndarray]:
        points, vertices = (torch.tensor(part, requires_grad=True) for part in (rows, BODY.vertices))
        answer = getattr(gk.mesh.Surface((vertices, flat), device="cpu"), query)(points)
        random = np.random.default_rng(2)
        some = [getattr(answer, name) for name in outputs]
        sum((one * torch.tensor(random.standard_normal(one.shape))).sum() for one in some).backward()
        return [points.grad.numpy(), vertices.grad.numpy()]

    by_kernel = slopes()
    monkeypatch.setattr(module, "by_kernel", lambda *_: None)
    for found_slopes, expected in zip(by_kernel, slopes(), strict=True):
        assert np.isfinite(found_slopes).all()
        # Directions between points that are 1e-9 apart are known to 1e-6.
        np.testing.assert_allclose(found_slopes, expected, rtol=0.0, atol=1e-5)


def test_parts_of_arrays_and_arrays_that_are_given_twice() -> None:
    body = gk.mesh.Surface(BODY, device="cpu")
    whole = on_tape(np.repeat(AROUND, 2, axis=0), wp.vec3d)
    with wp.Tape() as tape:
        found = body.closest_point(whole[::2])
    tape.backward(grads={found.distance: wp.ones_like(found.distance, requires_grad=False)})
    slopes = whole.grad.numpy()
    assert not slopes[1::2].any()
    np.testing.assert_allclose(np.linalg.norm(slopes[::2], axis=1), 1.0)
    points = on_tape(A)
    with wp.Tape() as tape:
        found = gk.points.chamfer(points, points, device="cpu")
    tape.backward(found.squared)
    assert not points.grad.numpy().any()


def test_gradients_are_added_to_what_is_there() -> None:
    body, points = gk.mesh.Surface(BODY, device="cpu"), on_tape(AROUND)
    with wp.Tape() as tape:
        found = body.closest_point(points), body.closest_point(points)
    one = wp.ones_like(found[0].distance, requires_grad=False)
    points.grad.fill_(5.0)
    tape.backward(grads={found[0].distance: one, found[1].distance: one})
    expected = 2.0 * (AROUND - found[0].points.numpy()) / found[0].distance.numpy()[:, None]
    np.testing.assert_allclose(points.grad.numpy(), 5.0 + expected, rtol=1e-12)


def test_an_object_that_is_updated_between_the_query_and_the_pass() -> None:
    # As in steps of time, which are one tape.
    body, points = surface(BODY.vertices), on_tape(AROUND)
    shift = np.array([0.3, -0.2, 0.1])
    vertices = [on_tape(BODY.vertices), on_tape(BODY.vertices + shift)]
    found = []
    with wp.Tape() as tape:
        for place in vertices:
            body.update(place)
            found.append(body.closest_point(points).distance)
    for number, place in enumerate(vertices):
        tape.zero()
        tape.backward(grads={found[number]: wp.ones_like(found[number], requires_grad=False)})
        assert place.grad.numpy().any()
        assert not vertices[1 - number].grad.numpy().any()
        fresh = on_tape(AROUND)
        with wp.Tape() as other:
            distance = surface(place.numpy()).closest_point(fresh).distance
        other.backward(grads={distance: wp.ones_like(distance, requires_grad=False)})
        np.testing.assert_allclose(points.grad.numpy(), fresh.grad.numpy(), rtol=0.0, atol=1e-14)


def test_vertices_alone() -> None:
    # Points of NumPy: only an array of warp can carry the gradient.
    vertices = on_tape(BODY.vertices, wp.vec3d)
    body = surface(vertices)
    assert isinstance(body.closest_point(AROUND).distance, np.ndarray)
    with wp.Tape() as tape:
        found = body.closest_point(AROUND)
    assert isinstance(found.distance, wp.array)
    tape.backward(grads={found.distance: wp.ones_like(found.distance, requires_grad=False)})
    # A rigid shift of the mesh is one of the points, the other way.
    away = (AROUND - found.points.numpy()) / found.distance.numpy()[:, None]
    np.testing.assert_allclose(vertices.grad.numpy().sum(axis=0), -away.sum(axis=0), atol=1e-12)


@pytest.mark.slow
def test_adaptive_fields() -> None:
    body = gk.mesh.load(ROOT / "data" / "samples" / "bracket.obj")
    field = gk.volume.adaptive_from_mesh(body, tolerance=1.0)
    low, high = body.bounds
    points = on_tape(low + (high - low) * np.random.default_rng(1).random((20, 3)))
    with wp.Tape() as tape:
        answer = field.sample(points, device="cpu")
    tape.backward(grads={answer: wp.ones_like(answer, requires_grad=False)})
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        ahead, behind = (field.sample(points.numpy() + way, device="cpu") for way in (step, -step))
        np.testing.assert_allclose(points.grad.numpy()[:, axis], (ahead - behind) / 2e-6, atol=1e-5)


def test_misses_and_nothing() -> None:
    body, points = gk.mesh.Surface(BODY, device="cpu"), on_tape(5.0 * AROUND)
    with wp.Tape() as tape:
        found = body.closest_point(points, max_distance=1e-3)
        nothing = body.closest_point(on_tape(np.zeros((0, 3))))
    assert (found.triangle_id.numpy() == -1).all()
    assert nothing.distance.shape == (0,)
    tape.backward(grads={found.distance: wp.ones_like(found.distance, requires_grad=False)})
    assert not points.grad.numpy().any()


class TestOutsideATape:
    def test_nothing_is_recorded(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from geokit.core.gradients import differentiable
        from geokit.core.gradients import on_tape as module

        def fail(*_: Any) -> None:
            raise AssertionError("recorded")

        monkeypatch.setattr(module, "attach", fail)
        monkeypatch.setattr(differentiable, "_attach", fail)
        body, points = surface(on_tape(BODY.vertices)), on_tape(AROUND)
        found = [*body.signed_distance(points), ball().sample(points, device="cpu")]
        assert not any(out.requires_grad for out in found)
        for out, expected in zip(body.signed_distance(AROUND), found, strict=False):
            np.testing.assert_array_equal(out, expected.numpy())
        gk.points.chamfer(points, points, device="cpu")
        gk.points.NeighborGrid(points, 0.5, device="cpu").radius_search()

    def test_nor_are_arrays_without_gradients(self) -> None:
        points = wp.array(AROUND, dtype=wp.vec3d, device="cpu")
        body = gk.mesh.Surface(BODY, device="cpu")
        with wp.Tape() as tape:
            found = body.signed_distance(points)
            assert isinstance(body.signed_distance(AROUND).distance, np.ndarray)
            gk.points.NeighborGrid(points, 0.5, device="cpu").radius_search(points)
        assert not tape.launches
        assert not found.distance.requires_grad

    def test_objects_that_were_made_of_arrays_with_gradients(self) -> None:
        assert gk.mesh.audit((on_tape(BODY.vertices), BODY.faces)).watertight
        np.testing.assert_array_equal(gk.points.PointCloud(on_tape(AROUND)).points, AROUND)
        made = valued(on_tape(values()))
        np.testing.assert_array_equal(made.sample(NEAR, device="cpu"), valued(values()).sample(NEAR, device="cpu"))


class TestRefusals:
    @pytest.mark.parametrize(
        ("message", "ask"),
        [
            ("queries: a wp.Tape is recording", lambda p: cloud(A).count(p, radius=0.2)),
            ("radius_search: distances to images .*; use neighbor_list", lambda p: periodic(p).radius_search()),
            ("points: a wp.Tape is recording", lambda p: surface(BODY.vertices).furthest_point(p)),
            ("points: a wp.Tape is recording", lambda p: surface(BODY.vertices).contains(p)),
            (
                "points: a wp.Tape is recording, and radius_search_blocks has no",
                lambda p: cloud(p).radius_search_blocks(radius=0.2),
            ),
            ("points: a wp.Tape is recording, and pairs has no", lambda p: cloud(p).pairs(radius=0.2)),
            ("vertices: a wp.Tape is recording, and sign_confidence", lambda p: surface(p, OPEN).sign_confidence(A)),
            ("vertices: a wp.Tape is recording, and raycast_all", lambda p: surface(p, OPEN).raycast_all(A, A)),
            ("vertices: a wp.Tape is recording, and distance", lambda p: surface(p).distance(surface(BODY.vertices))),
            ("vertices: a wp.Tape is recording", lambda p: gk.mesh.TriangleMesh(p, OPEN.faces)),
            ("vertices: a wp.Tape is recording", lambda p: gk.mesh.audit((p, OPEN.faces))),
            ("points: a wp.Tape is recording", lambda p: ball().hessian(p, device="cpu")),
            ("order: samples of order 0", lambda p: ball().sample(p, order=0, device="cpu")),
            ("points: second derivatives", lambda p: gk.volume.gradient_field(ball()).gradient(p, device="cpu")),
            ("kernel: 'count' has no derivative", lambda p: gk.points.density(p, radius=0.4, device="cpu")),
            ("points: a tensor with gradients beside transform", lambda p: ball().sample(p, transform=np.eye(4))),
            ("values: a wp.Tape is", lambda p: gk.volume.from_dense(on_tape(np.zeros((4, 4, 4))))),
            ("points: a wp.Tape is recording", lambda p: gk.points.PointCloud(p)),
            ("mass: a wp.Tape", lambda p: gk.points.density(A, radius=0.4, kernel="poly6", mass=p.flatten())),
            ("max_distance: a wp.Tape is", lambda p: surface(BODY.vertices).closest_point(A, max_distance=p.flatten())),
        ],
    )
    def test_what_has_no_gradient(self, message: str, ask: Callable[[Any], Any]) -> None:
        points = on_tape(BODY.vertices if "vertices" in message else A)
        with wp.Tape() as tape, pytest.raises(gk.InputError, match=message):
            ask(points)
        assert not tape.launches

    def test_values_of_a_volume(self) -> None:
        with wp.Tape(), pytest.raises(gk.InputError, match=r"values: a wp.Tape is recording, and hessian has no"):
            valued(on_tape(values())).hessian(NEAR, device="cpu")
        with wp.Tape(), pytest.raises(gk.InputError, match=r"values: a wp.Tape is recording, and curvature has no"):
            gk.volume.curvature(volume=valued(on_tape(values())), points=NEAR, device="cpu")

    def test_one_point(self) -> None:
        body = gk.mesh.Surface(BODY, device="cpu")
        with wp.Tape():
            with pytest.raises(gk.InputError, match=r"points: a single row has no gradient on a wp.Tape.*\(1, 3\)"):
                body.closest_point(on_tape(AROUND[0]))
            with pytest.raises(gk.InputError, match="points: a single row has no gradient"):
                surface(on_tape(BODY.vertices)).closest_point(AROUND[0])
            # Three vectors are three rows.
            assert body.closest_point(on_tape(AROUND[:3], wp.vec3d)).distance.shape == (3,)

    @pytest.mark.parametrize("device", DEVICES)
    def test_graphs(self, device: str) -> None:
        body, points = gk.mesh.Surface(BODY, device=device), on_tape(AROUND, wp.vec3d, device)
        with wp.Tape() as tape:
            found = body.closest_point(points)
            found.distance.grad.fill_(1.0)
            with wp.ScopedCapture(device), pytest.raises(gk.InputError, match="points: a graph is being captured"):
                body.closest_point(points)
        with wp.ScopedCapture(device), pytest.raises(gk.InputError, match="points: a graph is being captured"):
            tape.backward()
        assert not points.grad.numpy().any()

    def test_other_numbers(self) -> None:
        body = gk.mesh.Surface(BODY, device="cpu")
        with wp.Tape(), pytest.raises(gk.InputError, match="points: float16 has no gradients; give float32 or float64"):
            body.closest_point(on_tape(AROUND, wp.float16))

    def test_beside_torch(self) -> None:
        torch = pytest.importorskip("torch")
        body = surface(on_tape(BODY.vertices))
        with wp.Tape(), pytest.raises(gk.InputError, match="points: a tensor with gradients beside arrays on"):
            body.closest_point(torch.tensor(AROUND, requires_grad=True))
        with wp.Tape():
            assert isinstance(body.closest_point(torch.tensor(AROUND)).distance, wp.array)

    def test_a_warp_that_does_not_tell_its_tape(self, monkeypatch: pytest.MonkeyPatch) -> None:
        body, points = gk.mesh.Surface(BODY, device="cpu"), on_tape(AROUND)
        monkeypatch.setattr(warp_private, "_missing", lambda: frozenset(["tape"]))
        assert not body.closest_point(points).distance.requires_grad
        with wp.Tape(), pytest.raises(gk.InputError, match=r"points: a wp.Tape is recording, and warp .* does not say"):
            body.closest_point(points)


def test_overwritten_arguments_are_named_by_warp(monkeypatch: pytest.MonkeyPatch) -> None:
    points, others = on_tape(AROUND, wp.vec3d), on_tape(AROUND, wp.vec3d)
    body = gk.mesh.Surface(BODY, device="cpu")
    body.closest_point(points)  # the option compiles modules anew
    monkeypatch.setattr(wp.config, "verify_autograd_array_access", True)
    with wp.Tape():
        body.closest_point(points)
        # Warnings are errors in tests.
        with pytest.raises(UserWarning, match="is being written to"):
            wp.copy(points, others)


def test_the_block_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (ROOT / "docs" / "gradients.md").read_text(encoding="utf-8")
    (block,) = (code for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "wp.Tape" in code)
    path = tmp_path / "block.py"  # warp reads the source of kernels from their file
    path.write_text(block, encoding="utf-8")
    monkeypatch.chdir(ROOT)
    spec: Any = importlib.util.spec_from_file_location("block_of_gradients", path)
    module: types.ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.losses[-1] < 0.01 * module.losses[0]
