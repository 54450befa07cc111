"""Calls that a CUDA graph captures: the bits of the calls, for rows that change, without a look by the host.

On a CPU the same code answers as if a graph were captured; the graphs themselves are made where there is a GPU.
"""

from __future__ import annotations

import contextlib
import functools
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.core.base.query import QUERIES
from geokit.core.launches import captured
from geokit.core.memory.host_array import HostArray
from geokit.errors import InputError
from tests.support.devices import DEVICES

# Rays of more than 16,384 take two passes on a GPU, and rows of more than 2,048 are sorted.
COUNTS = (300, 20_000)
BAD = ([np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [1e151, 0.0, 0.0])


class Scene:
    def __init__(self, device: str, count: int, adaptive: Any = None) -> None:
        ball = gk.mesh.sphere(segments=24)
        points = np.random.default_rng(4).uniform(-1.0, 1.0, (500, 3))
        self.device, self.count = device, count
        self.closed = gk.mesh.Surface(ball, device=device)
        self.open = gk.mesh.Surface(gk.mesh.TriangleMesh(ball.vertices, ball.faces[:-20]), device=device)
        self.field = gk.volume.from_mesh(ball, voxel_size=0.1, device=device)
        self.adaptive = adaptive or gk.volume.adaptive_from_mesh(ball, 0.05, device=device)
        self.home = gk.points.NeighborGrid(points, 0.3, device=device)
        held: Any = wp.array(points, dtype=wp.vec3d, device=device)
        self.grid = gk.points.NeighborGrid(held, 0.3, device=device)

    @functools.cached_property
    def rows(self) -> Any:
        return self.fresh(0)

    @functools.cached_property
    def ahead(self) -> Any:
        return self.fresh(1)

    def fresh(self, seed: int) -> Any:
        values = np.random.default_rng(seed).uniform(-1.2, 1.2, (self.count, 3))
        return wp.array(values, dtype=wp.vec3d, device=self.device)

    @contextlib.contextmanager
    def other_rows(self, values: np.ndarray) -> Iterator[None]:
        """Put other values where the rows are, for a while."""
        before = wp.clone(self.rows)
        wp.copy(self.rows, wp.array(values.copy(), dtype=wp.vec3d, device=self.device))
        try:
            yield
        finally:
            wp.copy(self.rows, before)


# Every query that is replayed, by the part of its name after the last room.
CASES: dict[str, Callable[[Scene], Any]] = {
    "closest_point": lambda s: s.closed.closest_point(s.rows),
    "closest_point, moved": lambda s: s.closed.closest_point(s.rows, transform=np.eye(4)),
    "furthest_point": lambda s: s.closed.furthest_point(s.rows),
    "signed_distance": lambda s: s.closed.signed_distance(s.rows),
    "signed_distance, open": lambda s: s.open.signed_distance(s.rows),
    "signed_distance, near": lambda s: s.closed.signed_distance(s.rows, max_distance=0.2),
    "signed_distance, parity": lambda s: s.closed.signed_distance(s.rows, sign="parity"),
    "contains": lambda s: s.closed.contains(s.rows),
    "contains, open": lambda s: s.open.contains(s.rows),
    "winding_number": lambda s: s.open.winding_number(s.rows),
    "sign_confidence": lambda s: s.open.sign_confidence(s.rows),
    "raycast": lambda s: s.closed.raycast(s.rows, s.ahead),
    "occluded": lambda s: s.closed.occluded(s.rows, s.ahead),
    "crossing_count": lambda s: s.closed.crossing_count(s.rows, s.ahead),
    "sample": lambda s: s.field.sample(s.rows, device=s.device),
    "sample, cubic": lambda s: s.field.sample(s.rows, order=3, device=s.device),
    "gradient": lambda s: s.field.gradient(s.rows, device=s.device),
    "hessian": lambda s: s.field.hessian(s.rows, device=s.device),
    "curvature": lambda s: s.field.curvature(s.rows, device=s.device),
    "active_at": lambda s: s.field.active_at(s.rows, device=s.device),
    "raycast, of a volume": lambda s: s.field.raycast(s.rows, s.ahead, device=s.device),
    "sample, adaptive": lambda s: s.adaptive.sample(s.rows, device=s.device),
    "gradient, adaptive": lambda s: s.adaptive.gradient(s.rows, device=s.device),
    "count": lambda s: s.grid.count(s.rows),
    "count, of the points": lambda s: s.grid.count(exclude_self=True),
    "knn": lambda s: s.grid.knn(s.rows, 5),
    "knn, of the points": lambda s: s.grid.knn(k=20),
    "hybrid": lambda s: s.grid.hybrid(queries=s.rows, k=3, radius=0.2),
}


SCENES = [(device, count) for device in DEVICES for count in (COUNTS if device != "cpu" else COUNTS[:1])]


@pytest.fixture(params=SCENES, ids=str)
def scene(request: pytest.FixtureRequest) -> Scene:
    return _scene(*request.param)


@functools.cache
def _scene(device: str, count: int) -> Scene:
    return Scene(device, count)


@pytest.fixture
def capture(monkeypatch: pytest.MonkeyPatch) -> Callable[[Scene, Callable[[], Any]], Any]:
    """Captures what a function asks, makes its launches, and returns the answer; a function does so again."""

    def run(scene: Scene, ask: Callable[[], Any]) -> tuple[Any, Callable[[], Any]]:
        if scene.device == "cpu":
            with monkeypatch.context() as patched:
                patched.setattr(captured, "is_captured", lambda device: True)
                found = ask()

            def again() -> Any:
                with monkeypatch.context() as patched:
                    patched.setattr(captured, "is_captured", lambda device: True)
                    return ask()

            return found, again
        with wp.ScopedCapture(scene.device) as made:
            found = ask()

        def replay() -> Any:
            wp.capture_launch(made.graph)
            return found

        return replay(), replay

    return run


def arrays_of(answer: Any) -> Iterator[np.ndarray]:
    for part in answer if isinstance(answer, tuple) else (answer,):
        yield np.array(part.numpy() if hasattr(part, "numpy") else part)


def same(found: Any, expected: list[np.ndarray]) -> None:
    for one, other in zip(arrays_of(found), expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_each_query_that_can_be_captured_is_tried(scene: Scene) -> None:
    for ask in CASES.values():
        ask(scene)
    replayed = {query.name for key, query in QUERIES.items() if query.is_replayed and key.startswith("geokit.")}
    assert replayed == {name.partition(",")[0] for name in CASES}


@pytest.mark.parametrize("name", CASES)
def test_a_graph_has_the_bits_of_the_call(scene: Scene, capture: Any, name: str) -> None:
    ask = functools.partial(CASES[name], scene)
    expected = list(arrays_of(ask()))
    found, again = capture(scene, ask)
    same(found, expected)
    # The graph reads the rows anew.
    with scene.other_rows(scene.fresh(2).numpy()):
        expected = list(arrays_of(ask()))
        same(again(), expected)


@pytest.mark.parametrize("name", CASES)
def test_what_was_not_asked_before_is_not_captured(scene: Scene, capture: Any, name: str) -> None:
    # A copy of what takes long to make: it has been asked nothing.
    fresh = Scene(scene.device, scene.count, pickle.loads(pickle.dumps(scene.adaptive)))
    _ = fresh.rows, fresh.ahead  # made before the capture
    with pytest.raises(InputError, match=r"captures calls that were made before.*make it once before the capture"):
        capture(fresh, lambda: CASES[name](fresh))


def test_bad_rows_are_misses_in_a_graph(scene: Scene, capture: Any) -> None:
    surface, rows, ahead = scene.closed, scene.rows, scene.ahead

    def ask() -> Any:
        return *surface.closest_point(rows), *surface.raycast(rows, ahead), scene.grid.count(rows)

    ask()
    _, again = capture(scene, ask)
    with scene.other_rows(np.concatenate([np.array(BAD), rows.numpy()[len(BAD) :]])):
        found = list(arrays_of(again()))
        with pytest.raises(InputError, match="row 0 is not finite"):
            surface.closest_point(rows)
    points, distance, triangle_id, barycentric, t, hit, at, count = (part[: len(BAD)] for part in found)
    assert np.isnan(points).all()
    assert np.isnan(barycentric).all()
    assert np.isinf(distance).all()
    assert (triangle_id == -1).all()
    assert (hit[:2] == -1).all()
    assert np.isinf(t[:2]).all()
    assert np.isnan(at[:2]).all()
    assert (count == 0).all()


@pytest.mark.parametrize("name", CASES)
def test_bad_rows_do_no_harm(scene: Scene, capture: Any, name: str) -> None:
    """Whatever a bad row gets, the others have their bits."""
    if (scene.device, name) == ("cpu", "raycast, of a volume"):
        pytest.skip("a CPU answers packets of rays, which no graph has")
    ask = functools.partial(CASES[name], scene)
    expected = list(arrays_of(ask()))
    _, again = capture(scene, ask)
    with scene.other_rows(np.concatenate([np.array(BAD), scene.rows.numpy()[len(BAD) :]])):
        for one, other in zip(arrays_of(again()), expected, strict=True):
            at = slice(None) if "of the points" in name else slice(len(BAD), None)
            np.testing.assert_array_equal(one[at], other[at])


REFUSED: dict[str, tuple[Callable[[Scene], Any], str]] = {
    "rows in host memory": (lambda s: s.closed.closest_point(np.zeros((s.count, 3))), "points: rows in host memory"),
    "answers in host memory": (lambda s: s.home.count(), "answers are copied to the host"),
    "lists": (lambda s: s.closed.closest_point([[0.0, 0.0, 0.0]]), "points: rows in host memory"),
    "many poses": (
        lambda s: s.closed.closest_point(s.rows, transform=np.tile(np.eye(4), (2, 1, 1))),
        "transform: many poses",
    ),
    "a radius for each": (
        lambda s: s.grid.count(s.rows, radius=np.full(s.count, 0.1)),
        "radius: one for each query",
    ),
    "lists of hits": (lambda s: s.closed.raycast_all(s.rows, s.ahead), "raycast_all: its answer is read on the host"),
    "lists of neighbors": (lambda s: s.grid.radius_search(s.rows), "radius_search: its answer is read on the host"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_the_host_has_a_part_in_is_refused(scene: Scene, capture: Any, name: str) -> None:
    ask, words = REFUSED[name]
    ask(scene)
    with pytest.raises(InputError, match=words):
        capture(scene, lambda: ask(scene))


def test_a_changed_surface_is_asked_anew(scene: Scene, capture: Any) -> None:
    surface = gk.mesh.Surface(gk.mesh.sphere(segments=8), device=scene.device)
    ask = functools.partial(surface.closest_point, scene.rows)
    ask()
    surface.update(surface.mesh.vertices * 1.5)
    with pytest.raises(InputError, match="make it once before the capture"):
        capture(scene, ask)
    expected = list(arrays_of(ask()))
    same(capture(scene, ask)[0], expected)


def test_the_host_waits_for_nothing(scene: Scene, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    CASES["signed_distance"](scene)

    def wait(flags: HostArray) -> np.ndarray:
        raise AssertionError("a flag was read")

    monkeypatch.setattr(HostArray, "numpy", wait)
    capture(scene, lambda: CASES["signed_distance"](scene))


@pytest.mark.parametrize("device", [device for device in DEVICES if device != "cpu"])
@pytest.mark.parametrize("count", COUNTS)
def test_a_graph_of_torch_has_the_bits_of_the_call(device: str, count: int) -> None:
    torch = pytest.importorskip("torch")
    scene = _scene(device, count)

    def tensor(seed: int) -> Any:
        return torch.as_tensor(scene.fresh(seed).numpy(), device=device)

    rows, ahead = tensor(0), tensor(1)
    own = gk.points.NeighborGrid(tensor(4), 0.3, device=device)

    def ask() -> list[Any]:
        held, where = scene.closed, {"device": device}
        found = [*held.closest_point(rows), *held.signed_distance(rows), *held.raycast(rows, ahead)]
        found += [scene.field.sample(rows, **where), scene.field.gradient(rows.float(), **where)]
        # Tensors by name, and points of the grid alone.
        found += [scene.grid.count(queries=rows), *scene.grid.knn(rows, 4), own.count(), held.contains(points=rows)]
        return found

    for _ in range(2):
        ask()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = ask()
    for seed in (2, 3):
        rows.copy_(tensor(seed))
        graph.replay()
        for one, other in zip(found, ask(), strict=True):
            np.testing.assert_array_equal(one.cpu().numpy(), other.cpu().numpy())
