"""Memory of calls: bounded over many of them, given back on request, and no needless waits on a GPU."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.core.memory import host_pool
from tests.support.devices import DEVICES
from tests.support.effort import of_all

GPUS = [device for device in DEVICES if device != "cpu"]


def _resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.fixture(params=["new pages", "a free piece of the heap"])
def memory(request: pytest.FixtureRequest) -> Iterator[None]:
    """Memory that the pool is given for its next array, since it has none itself."""
    gk.release_memory()
    if request.param == "new pages":
        yield
        return
    # An array that is freed has the heap serve others of its size; what lies behind them keeps them from the end.
    np.empty(31 << 20, np.uint8)
    pieces = [np.ones(30 << 20, np.uint8) for _ in range(4)]
    behind = np.ones(30 << 20, np.uint8)
    pieces.clear()
    yield
    del behind


@pytest.mark.usefixtures("memory")
def test_idle_memory_is_given_back():
    array = host_pool.empty((1 << 23,), np.float64)
    array[:] = 1.0
    assert gk.release_memory() >= 0
    array[:] = 2.0  # what is in use stays
    size = array.nbytes
    del array
    before = _resident()
    assert gk.release_memory() >= size
    assert _resident() < before - size // 2
    assert gk.release_memory() == 0
    assert host_pool.empty((1 << 23,), np.float64).size == 1 << 23


def test_meshes_and_results_stay():
    surface = gk.mesh.Surface(gk.mesh.sphere(segments=24), device=DEVICES[-1])
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    before = surface.signed_distance(points)
    kept = [output.copy() for output in before]
    gk.release_memory()
    for output, other, again in zip(before, kept, surface.signed_distance(points), strict=True):
        assert np.array_equal(output, other)
        assert np.array_equal(again, other)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_a_training_loop_with_changing_batches_keeps_its_memory(device):
    torch = pytest.importorskip("torch")
    random = np.random.default_rng(1)
    ball = gk.mesh.sphere(segments=12)
    vertices = torch.tensor(ball.vertices, device=device, requires_grad=True)
    field = gk.volume.from_mesh(ball, voxel_size=0.2, device=device)
    surface = gk.torch.Surface(vertices, ball.faces)
    optimizer = torch.optim.SGD([vertices], lr=1e-4)

    def steps(count: int) -> None:
        for _ in range(count):
            size = int(random.integers(1, 600))
            points = torch.tensor(random.uniform(-1, 1, (size, 3)), device=device, requires_grad=True)
            surface.update(vertices)
            found = surface.signed_distance(points)
            hits = surface.raycast(points, points + 2.0)
            loss = found.distance.square().sum() + gk.volume.sample(field, points, device=device).sum()
            loss = loss + torch.where(hits.triangle_id >= 0, hits.t, 0.0).sum()
            loss = loss + gk.points.chamfer(points, vertices, device=device).distance
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    steps(75)
    gc.collect()
    before = _resident()
    count = of_all(120, 500)
    steps(count)
    gc.collect()
    # One array of the points a step would be about as much.
    assert _resident() - before < min(count << 14, 4 << 20)


@contextlib.contextmanager
def _counted(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    import torch
    import warp as wp

    calls: list[str] = []
    for module, name in ((wp, "synchronize_device"), (wp, "synchronize"), (torch.cuda, "synchronize")):
        real = getattr(module, name)
        with_note = lambda *given, real=real, name=name, **more: (calls.append(name), real(*given, **more))[1]  # noqa: E731
        monkeypatch.setattr(module, name, with_note)
    yield calls


@pytest.mark.parametrize("device", GPUS)
def test_calls_through_torch_wait_for_no_device_and_answer_in_its_memory(device, monkeypatch):
    torch = pytest.importorskip("torch")
    surface = gk.mesh.Surface(gk.mesh.sphere(segments=24), device=device)
    field = gk.volume.from_mesh(gk.mesh.sphere(segments=24), voxel_size=0.1, device=device)
    points = torch.rand(20000, 3, device=device, dtype=torch.float64, requires_grad=True)

    def step() -> tuple[object, ...]:
        found = surface.closest_point(points)
        (found.distance.sum() + gk.volume.sample(field, points, device=device).sum()).backward()
        return tuple(found)

    step()
    with _counted(monkeypatch) as calls:
        outputs = step()
    assert calls == []
    for output in outputs:
        assert isinstance(output, torch.Tensor)
        assert str(output.device) == device
    # What torch takes for its tensors is torch's: its allocator sees gradients of this size.
    points.grad = None
    before = torch.cuda.memory_allocated(device)
    step()
    assert torch.cuda.memory_allocated(device) - before >= points.nbytes
