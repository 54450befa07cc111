"""Queries on several devices: the same bits as on one, in the same order, and errors that count the caller's rows."""

from __future__ import annotations

import itertools
import pickle
from typing import Any

import numpy as np
import pytest

import geokit as gk
from geokit.core import launcher
from geokit.core.blocks import several_devices, shared_rows
from geokit.errors import InputError
from tests.support.devices import DEVICES

# The same device twice is two devices for all that is tested here.
SHARED = [*DEVICES[-2:], DEVICES[-1]] if len(DEVICES) > 2 else [DEVICES[-1]] * 3
ONE = SHARED[0]
COUNT = 1000
RNG = np.random.default_rng(11)
POINTS = RNG.uniform(-1.5, 1.5, (COUNT, 3))
DIRECTIONS = RNG.normal(size=(COUNT, 3))
TURN = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture(autouse=True)
def few_rows_are_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(several_devices, "LEAST_ROWS", 100)
    monkeypatch.setattr(shared_rows, "LEAST_ROWS_OF_A_BLOCK", 100)
    monkeypatch.setattr(several_devices, "_is_on_gpu", lambda rows: False)


@pytest.fixture
def parts_asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of parts of the calls so far: a part for each device, of rows on the host blocks of 100."""
    asked: list[int] = []

    class Noted(shared_rows._Whole):
        count = 0

        def put(self, first: int, answer: Any, stream: Any = None) -> None:
            self.count += 1
            super().put(first, answer, stream)

        def answer(self, to_caller: Any = None) -> Any:
            asked.append(self.count)
            return super().answer(to_caller)

    monkeypatch.setattr(shared_rows, "_Whole", Noted)
    return asked


def fields_of(answer: Any) -> list[np.ndarray]:
    return [np.asarray(one) for one in (answer if isinstance(answer, tuple) else (answer,))]


def require_same(found: Any, expected: Any) -> None:
    assert type(found) is type(expected)
    for a, b in zip(fields_of(found), fields_of(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


SURFACE = {
    "closest_point": (1, {}),
    "furthest_point": (1, {}),
    "signed_distance": (1, {}),
    "contains": (1, {}),
    "winding_number": (1, {}),
    "sign_confidence": (1, {}),
    "raycast": (2, {"max_distance": 2.0}),
    "raycast_all": (2, {}),
    "crossing_count": (2, {}),
    "occluded": (2, {"max_distance": 1.0}),
}


@pytest.mark.parametrize("name", SURFACE)
@pytest.mark.parametrize("moved", [False, True])
def test_surfaces(name: str, moved: bool, parts_asked: list[int]) -> None:
    rows, options = SURFACE[name]
    options = {**options, "transform": TURN} if moved else options
    one, several = gk.mesh.Surface(gk.mesh.torus(), device=ONE), gk.mesh.Surface(gk.mesh.torus(), device=SHARED)
    given = [POINTS, DIRECTIONS][:rows]
    require_same(getattr(several, name)(*given, **options), getattr(one, name)(*given, **options))
    assert parts_asked == [10]
    few = [array[:150] for array in given]
    require_same(getattr(several, name)(*few, **options), getattr(one, name)(*few, **options))
    assert parts_asked == [10]


GRID = {
    "count": {},
    "radius_search": {"radius": 0.4, "order": "distance"},
    "knn": {"k": 7},
    "hybrid": {"k": 5, "radius": 0.5},
}


@pytest.mark.parametrize("name", GRID)
def test_neighbors(name: str, parts_asked: list[int]) -> None:
    cloud = RNG.uniform(-1.0, 1.0, (3000, 3))
    one, several = (gk.points.NeighborGrid(cloud, 0.3, device=device) for device in (ONE, SHARED))
    require_same(getattr(several, name)(POINTS, **GRID[name]), getattr(one, name)(POINTS, **GRID[name]))
    require_same(getattr(several, name)(queries=POINTS, **GRID[name]), getattr(one, name)(POINTS, **GRID[name]))
    assert parts_asked == [10, 10]
    # About the points themselves the first device answers.
    require_same(getattr(several, name)(**GRID[name]), getattr(one, name)(**GRID[name]))
    assert len(parts_asked) == 2
    assert len(several) == len(one)


def test_a_radius_for_each_query(parts_asked: list[int]) -> None:
    cloud, radii = RNG.uniform(-1.0, 1.0, (3000, 3)), RNG.uniform(0.1, 0.5, COUNT)
    one, several = (gk.points.NeighborGrid(cloud, 0.3, device=device) for device in (ONE, SHARED))
    require_same(several.count(POINTS, radius=radii), one.count(POINTS, radius=radii))
    require_same(several.radius_search(POINTS, radius=radii), one.radius_search(POINTS, radius=radii))
    assert parts_asked == [10, 10]


def test_a_periodic_grid(parts_asked: list[int]) -> None:
    cloud = RNG.uniform(0.0, 1.0, (500, 3))
    one, several = (
        gk.points.NeighborGrid(cloud, 0.2, periodic=[1.0, 1.0, 1.0], device=device) for device in (ONE, SHARED)
    )
    require_same(several.neighbor_list(POINTS), one.neighbor_list(POINTS))
    assert parts_asked == [10]


VOLUME = {
    "hessian": (1, {"space": "index"}),
    "curvature": (1, {}),
    "raycast": (2, {}),
    "integrate": (2, {"max_distance": 3.0}),
}


@pytest.mark.parametrize("name", VOLUME)
def test_volumes(name: str, parts_asked: list[int]) -> None:
    rows, options = VOLUME[name]
    volume = gk.volume.from_mesh(gk.mesh.torus(), voxel_size=0.05, device=ONE)
    if name == "integrate":
        volume = gk.volume.from_dense(RNG.uniform(0.1, 1.0, (20, 20, 20)), voxel_size=0.1)
    given = [POINTS, DIRECTIONS][:rows]
    query = getattr(volume, name)
    require_same(query(*given, **options, device=SHARED), query(*given, **options, device=ONE))
    require_same(query(*given, **options, device=tuple(SHARED)), query(*given, **options, device=ONE))
    assert parts_asked == [10, 10]


@pytest.mark.parametrize(
    ("name", "options"),
    [("sample", {}), ("sample", {"order": 3}), ("gradient", {"order": 2}), ("active_at", {"space": "index"})],
)
def test_what_takes_less_time_than_copies_is_asked_of_the_first(
    name: str, options: dict[str, Any], parts_asked: list[int]
) -> None:
    volume = gk.volume.from_mesh(gk.mesh.torus(), voxel_size=0.05, device=ONE)
    query = getattr(volume, name)
    require_same(query(POINTS, **options, device=SHARED), query(POINTS, **options, device=ONE))
    assert parts_asked == []


@pytest.mark.slow
def test_rows_on_a_gpu_are_shared_if_there_are_very_many(
    parts_asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copies between GPUs take longer than answers to a few thousand rows."""
    monkeypatch.setattr(several_devices, "_is_on_gpu", lambda rows: True)
    surface, grid = gk.mesh.Surface(gk.mesh.torus(), device=SHARED), gk.points.NeighborGrid(POINTS, 0.3, device=SHARED)
    volume = gk.volume.from_mesh(gk.mesh.torus(), voxel_size=0.05, device=ONE)
    surface.closest_point(POINTS)
    surface.raycast(POINTS, DIRECTIONS)
    grid.count(POINTS)
    volume.hessian(POINTS, device=SHARED)
    assert parts_asked == []
    # So far away that each row is answered at once.
    many = np.full((2 * several_devices.LEAST_ON_GPUS, 3), 9.0)
    surface.contains(many)
    surface.raycast(many, many + 1.0)
    grid.count(many)
    assert parts_asked == [8]


@pytest.fixture
def three_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with three GPUs, each of which is the device of these tests."""
    there = launcher.resolve_device(ONE)
    resolve = launcher.resolve_device
    monkeypatch.setattr(launcher, "cuda_devices", lambda: ["cuda:0", "cuda:1", "cuda:2"])
    monkeypatch.setattr(
        launcher, "resolve_device", lambda one=None: there if str(one).startswith("cuda:") else resolve(one)
    )


@pytest.mark.usefixtures("three_gpus")
def test_all_gpus(parts_asked: list[int]) -> None:
    mesh, cloud = gk.mesh.torus(), RNG.uniform(-1.0, 1.0, (3000, 3))
    one, several = gk.mesh.Surface(mesh, device=ONE), gk.mesh.Surface(mesh, device="cuda:*")
    require_same(several.closest_point(POINTS), one.closest_point(POINTS))
    ours, other = (gk.points.NeighborGrid(cloud, 0.3, device=device) for device in ("cuda:*", ONE))
    require_same(ours.count(POINTS), other.count(POINTS))
    volume = gk.volume.from_mesh(mesh, voxel_size=0.05, device=ONE)
    require_same(volume.hessian(POINTS, device="cuda:*"), volume.hessian(POINTS, device=ONE))
    require_same(volume.hessian(POINTS, device=["cuda:*"]), volume.hessian(POINTS, device=ONE))
    require_same(volume.hessian(POINTS, device=[ONE, "cuda:*"]), volume.hessian(POINTS, device=ONE))
    assert parts_asked == [10] * 5


def test_all_gpus_of_a_machine_without_one_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launcher, "cuda_devices", list)
    for given in ("cuda:*", [ONE, "cuda:*"]):
        with pytest.raises(InputError, match=r"device: 'cuda:\*' is all GPUs, and this machine has none; use 'cpu'"):
            gk.mesh.Surface(gk.mesh.torus(), device=given)


class StackedContext:
    """A device's guard that notes how deep it is entered."""

    def __init__(self, device: Any) -> None:
        self.device, self.depth, self.entered = device, 0, 0

    is_cuda = True
    context_guard = property(lambda self: self)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.device, name)

    def __enter__(self) -> None:
        self.depth += 1
        self.entered += 1

    def __exit__(self, *_: object) -> None:
        self.depth -= 1


def test_the_current_device_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also after an error; on machines with two GPUs the device itself is asked."""
    guard = StackedContext(launcher.resolve_device(ONE))
    monkeypatch.setattr(several_devices, "devices_of", lambda _: [guard, guard])
    volume = gk.volume.from_mesh(gk.mesh.torus(), voxel_size=0.05, device=ONE)
    depths: list[int] = []

    def note(*_: Any) -> int:
        depths.append(guard.depth)
        return 0

    monkeypatch.setattr(several_devices, "_rows_of", note)
    with pytest.raises(Exception, match="device"):
        # The guard is no device for the query itself.
        volume.hessian(POINTS, device=SHARED)
    assert depths == [1]
    assert (guard.depth, guard.entered) == (0, 1)


@pytest.mark.skipif(len(DEVICES) < 3, reason="needs two GPUs")
def test_the_current_device_of_torch_is_kept() -> None:
    torch = pytest.importorskip("torch")
    mesh, points = gk.mesh.torus(), torch.from_numpy(POINTS).to("cuda:1")
    volume = gk.volume.from_mesh(mesh, voxel_size=0.05)
    for current in (0, 1):
        torch.cuda.set_device(current)
        surface = gk.mesh.Surface(mesh, device="cuda:*")
        assert torch.cuda.current_device() == current
        surface.closest_point(points)
        volume.hessian(points, device="cuda:*")
        volume.sample(POINTS, order=1, device=["cuda:1", "cuda:0"])
        surface.update(mesh.vertices * 2.0)
        assert torch.cuda.current_device() == current
        # One device, which is not the current one.
        other = f"cuda:{1 - current}"
        gk.mesh.Surface(mesh, device=other).signed_distance(POINTS)
        gk.points.NeighborGrid(POINTS, 0.1, device=other).count()
        gk.volume.from_mesh(mesh, voxel_size=0.05, device=other).sample(POINTS, device=other)
        assert torch.cuda.current_device() == current
        for device in ("cuda:0", "cuda:1"):
            asked = torch.from_numpy(POINTS).to(device)
            assert gk.mesh.Surface(mesh, device=device).closest_point(asked).points.device == asked.device
        assert torch.cuda.current_device() == current


@pytest.mark.parametrize("container", ["torch", "warp", "float32"])
def test_containers(container: str, parts_asked: list[int]) -> None:
    import warp as wp

    cloud = RNG.uniform(-1.0, 1.0, (3000, 3))
    if container == "torch":
        points: Any = pytest.importorskip("torch").from_numpy(POINTS).to(ONE)
    else:
        points = wp.array(POINTS, dtype=wp.vec3d, device=ONE) if container == "warp" else POINTS.astype(np.float32)
    one, several = gk.mesh.Surface(gk.mesh.torus(), device=ONE), gk.mesh.Surface(gk.mesh.torus(), device=SHARED)
    require_equal_containers(several.closest_point(points), one.closest_point(points))
    ours, other = (gk.points.NeighborGrid(cloud, 0.3, device=device) for device in (SHARED, ONE))
    require_equal_containers(ours.radius_search(points), other.radius_search(points))
    # Two-dimensional arrays of warp have one dimension. Rows of quick queries go to other devices in pieces.
    pieces = sum(1 if device == ONE else shared_rows.PIECES for device in SHARED)
    parts = [10, 10] if container == "float32" else [len(SHARED), pieces]
    assert parts_asked == ([] if container == "warp" and points.ndim != 2 else parts)


def require_equal_containers(found: Any, expected: Any) -> None:
    for a, b in zip(found, expected, strict=True):
        assert type(a) is type(b)
        assert a.device == b.device if hasattr(b, "device") else True
        host = [one.numpy() if not isinstance(one, np.ndarray) and not hasattr(one, "cpu") else one for one in (a, b)]
        host = [one.cpu().numpy() if hasattr(one, "cpu") else one for one in host]
        assert host[0].dtype == host[1].dtype
        np.testing.assert_array_equal(*host)


@pytest.mark.parametrize("is_quick", [False, True])
def test_the_device_that_has_the_rows_of_a_quick_query_answers_more_of_them(is_quick: bool) -> None:
    home: Any = object()
    away: Any = object()
    asked = shared_rows.Question([len, len], [away, home], [POINTS], [], {}, is_quick=is_quick)
    few, own = (list(part) for part in asked._parts(home, COUNT))
    assert len(few) == (shared_rows.PIECES if is_quick else 1)
    assert len(own) == 1
    pieces = [*few, *own]
    assert pieces[0][0] == 0
    assert pieces[-1][1] == COUNT
    assert all(one[1] == other[0] for one, other in itertools.pairwise(pieces))
    assert own[0][0] == (444 if is_quick else 500)


def test_errors_count_the_rows_of_the_caller() -> None:
    surface = gk.mesh.Surface(gk.mesh.torus(), device=SHARED)
    bad = POINTS.copy()
    bad[900, 1] = np.nan
    with pytest.raises(InputError, match="row 900"):
        surface.closest_point(bad)
    with pytest.raises(InputError, match=r"points: .*\(N, 3\)"):
        surface.closest_point(POINTS[:, :2])
    with pytest.raises(InputError, match="directions"):
        surface.raycast(POINTS, DIRECTIONS[:10])
    with pytest.raises(InputError, match="device: the list is empty"):
        gk.mesh.Surface(gk.mesh.torus(), device=[])
    with pytest.raises(InputError, match="device: entry 1 is None"):
        gk.mesh.Surface(gk.mesh.torus(), device=[ONE, None])
    with pytest.raises(InputError, match=r"device: .*nowhere"):
        gk.points.NeighborGrid(POINTS, 0.1, device=[ONE, "nowhere"])
    for several, what in ((SHARED, "a list"), ("cuda:*", r"'cuda:\*'")):
        with pytest.raises(InputError, match=f"device: {what} is for"):
            gk.volume.from_mesh(gk.mesh.torus(), voxel_size=0.1, device=several)


def test_progress_adds_up() -> None:
    told: list[tuple[int, int]] = []
    gk.mesh.Surface(gk.mesh.torus(), device=SHARED).closest_point(POINTS, progress=lambda *now: told.append(now))
    assert told[-1] == (COUNT, COUNT)
    assert [done for done, _ in told] == sorted(done for done, _ in told)


def test_updates_and_copies() -> None:
    mesh, cloud = gk.mesh.torus(), RNG.uniform(-1.0, 1.0, (3000, 3))
    surface, grid = gk.mesh.Surface(mesh, device=SHARED), gk.points.NeighborGrid(cloud, 0.3, device=SHARED)
    assert surface.audit.watertight
    surface.update(mesh.vertices * 2.0)
    grid.update(cloud * 0.5)
    moved = gk.mesh.Surface(gk.mesh.TriangleMesh(mesh.vertices * 2.0, mesh.faces), device=ONE)
    closer = gk.points.NeighborGrid(cloud * 0.5, 0.3, device=ONE)
    for one, other in ((surface, grid), pickle.loads(pickle.dumps((surface, grid)))):
        require_same(one.closest_point(POINTS), moved.closest_point(POINTS))
        require_same(other.count(POINTS), closer.count(POINTS))
        assert isinstance(one, gk.mesh.Surface)
        assert isinstance(other, gk.points.NeighborGrid)
        assert repr(SHARED) in repr(one)
        assert repr(SHARED) in repr(other)
        np.testing.assert_array_equal(one.bounds, moved.bounds)


def test_gradients_stay_on_the_first_device(parts_asked: list[int]) -> None:
    torch = pytest.importorskip("torch")
    points = torch.from_numpy(POINTS).requires_grad_()
    surface = gk.mesh.Surface(gk.mesh.torus(), device=SHARED)
    surface.closest_point(points).distance.sum().backward()
    plain = torch.from_numpy(POINTS).requires_grad_()
    gk.mesh.Surface(gk.mesh.torus(), device=ONE).closest_point(plain).distance.sum().backward()
    np.testing.assert_array_equal(points.grad.numpy(), plain.grad.numpy())
    assert parts_asked == []


def test_an_error_or_an_interrupt_ends_the_other_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks that nobody has begun are not asked any more."""
    asked: list[int] = []
    surface = gk.mesh.Surface(gk.mesh.torus(), device=SHARED)
    put = shared_rows._Whole.put

    def stopped(whole: Any, first: int, answer: Any, stream: Any = None) -> None:
        asked.append(first)
        if first == 0:
            raise KeyboardInterrupt
        put(whole, first, answer, stream)

    monkeypatch.setattr(shared_rows._Whole, "put", stopped)
    many = np.tile(POINTS, (100, 1))
    monkeypatch.setattr(shared_rows, "MOST_ROWS_OF_A_BLOCK", 500)
    with pytest.raises(KeyboardInterrupt):
        surface.closest_point(many)
    assert len(asked) < 200
    monkeypatch.undo()
    require_same(surface.closest_point(POINTS), gk.mesh.Surface(gk.mesh.torus(), device=ONE).closest_point(POINTS))
