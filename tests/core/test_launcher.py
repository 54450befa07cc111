"""Launching: devices, threads, slices, order and blocks."""

from __future__ import annotations

import os
import threading

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.core import launcher
from geokit.core.blocks.several_devices import devices_of
from geokit.core.launches import prepared

COUNT = 5000


@wp.kernel
def mark_kernel(first: int, step: int, out_visits: wp.array(dtype=int), out_value: wp.array(dtype=int)):
    i = first + wp.tid()
    out_visits[i] = out_visits[i] + 1
    out_value[i] = i * step


@wp.kernel
def ask_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    shared: wp.float64,
    out_value: wp.array(dtype=wp.float64),
    out_rank: wp.array(dtype=int),
):
    i = order[first + wp.tid()]
    out_value[i] = points[i][0] + wp.float64(10.0) * points[i][1] + shared
    out_rank[i] = first + wp.tid()


@wp.kernel
def ask_group_kernel(
    first: int,
    group: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    shared: wp.float64,
    out_value: wp.array(dtype=wp.float64),
    out_rank: wp.array(dtype=int),
):
    begin = (first + wp.tid()) * group
    for k in range(begin, wp.min(begin + group, points.shape[0])):
        i = order[k]
        out_value[i] = points[i][0] + wp.float64(10.0) * points[i][1] + shared
        out_rank[i] = k


@pytest.fixture(scope="module")
def cpu():
    return launcher.resolve_device("cpu")


def ask(points, cpu, *, lower=(0.0, 0.0, 0.0), extent=1.0, group=0):
    count = len(points)
    value = wp.full(count, -1.0, dtype=wp.float64, device=cpu)
    rank = wp.full(count, -1, dtype=int, device=cpu)
    launcher.launch_queries(
        ask_group_kernel if group else ask_kernel,
        wp.array(points, dtype=wp.vec3d, device=cpu),
        [wp.float64(0.25)],
        [value, rank],
        cpu,
        lower=lower,
        extent=extent,
        group=group,
    )
    np.testing.assert_array_equal(value.numpy(), points[:, 0] + 10.0 * points[:, 1] + 0.25)
    return rank.numpy()


def test_thread_count_is_what_the_process_may_use(monkeypatch):
    monkeypatch.delenv("GEOKIT_THREADS", raising=False)
    assert launcher.thread_count() == len(os.sched_getaffinity(0))
    monkeypatch.setenv("GEOKIT_THREADS", "")
    assert launcher.thread_count() == len(os.sched_getaffinity(0))
    monkeypatch.setenv("GEOKIT_THREADS", "7")
    assert launcher.thread_count() == 7


@pytest.mark.parametrize("value", ["0", "-2", "two", "1.5", " ", "²"])
def test_thread_count_refuses_what_is_no_number_of_threads(value, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", value)
    with pytest.raises(gk.InputError, match="GEOKIT_THREADS"):
        launcher.thread_count()


def test_resolve_device():
    cpu = launcher.resolve_device("cpu")
    assert cpu.is_cpu
    assert launcher.resolve_device(cpu) is cpu
    gpus = launcher.cuda_devices()
    assert launcher.resolve_device().alias == (gpus[0] if gpus else "cpu")


def test_devices_of_other_libraries():
    torch = pytest.importorskip("torch")
    for device in (torch.device("cpu"), torch.device("cpu", 0)):
        assert launcher.resolve_device(device).is_cpu
        assert [one.alias for one in devices_of([device]) or []] == ["cpu"]
    with pytest.raises(gk.InputError, match=r"device: device\(type='cuda', index=98\) is not on this"):
        launcher.resolve_device(torch.device("cuda", 98))
    for module, said, alias in (
        ("torch", {"type": "cuda", "index": None}, "cuda"),
        ("jaxlib._jax", {"platform": "gpu", "local_hardware_id": 1}, "cuda:1"),
        ("jax", {"platform": "cpu", "local_hardware_id": 3}, "cpu"),
        ("cupy.cuda.device", {"id": 2}, "cuda:2"),
    ):
        # Devices of GPUs cannot be made here; these have the fields that are read.
        device = type("Device", (), {"__module__": module, **said})()
        assert launcher._alias_of(device) == alias


@pytest.mark.parametrize("device", ["cuda:99", "gpu", "", 3.5, object()])
def test_resolve_device_names_those_there_are(device):
    with pytest.raises(gk.InputError, match=r"device: .* is not on this machine; use one of cpu"):
        launcher.resolve_device(device)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 511, 512, 513, 1025, COUNT])
def test_every_item_is_visited_once(threads, count, cpu, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", str(threads))
    visits, value = (wp.zeros(COUNT, dtype=int, device=cpu) for _ in range(2))
    launcher.launch(mark_kernel, count, [3], [visits, value], cpu)
    np.testing.assert_array_equal(visits.numpy(), np.arange(COUNT) < count)
    np.testing.assert_array_equal(value.numpy()[:count], np.arange(count) * 3)


@pytest.fixture
def slices(monkeypatch):
    """The (first, count, thread) of each slice that is launched."""
    seen = []
    run = prepared.bound

    def spy(kernel, count, arguments, *rest):
        seen.append((arguments[0], count, threading.current_thread().name))
        return run(kernel, count, arguments, *rest)

    monkeypatch.setattr(prepared, "bound", spy)
    return seen


def test_one_thread_takes_one_slice(slices, cpu, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "1")
    launcher.launch(mark_kernel, COUNT, [1], [wp.zeros(COUNT, dtype=int, device=cpu) for _ in range(2)], cpu)
    assert [(first, count) for first, count, _ in slices] == [(0, COUNT)]


def test_slices_cover_the_items_on_pool_threads(slices, cpu, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "2")
    launcher.launch(mark_kernel, COUNT, [1], [wp.zeros(COUNT, dtype=int, device=cpu) for _ in range(2)], cpu)
    covered = sorted((first, first + count) for first, count, _ in slices)
    assert covered == [(a, min(a + 512, COUNT)) for a in range(0, COUNT, 512)]
    assert all(name.startswith("geokit") for _, _, name in slices)


def test_grain_sets_the_shortest_slice(slices, cpu, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "2")
    launcher.launch(mark_kernel, 64, [1], [wp.zeros(64, dtype=int, device=cpu) for _ in range(2)], cpu, grain=4)
    assert {count for _, count, _ in slices} == {4}
    assert len(slices) == 16


def test_an_error_in_a_slice_comes_out(cpu, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "2")
    wrong = wp.zeros(COUNT, dtype=wp.float64, device=cpu)
    with pytest.raises(RuntimeError, match="out_visits"):
        launcher.launch(mark_kernel, COUNT, [1], [wrong, wrong], cpu)


@pytest.mark.parametrize("count", [0, 1, 100, 2047, 2048, COUNT])
def test_each_query_gets_its_own_rows(count, cpu):
    rank = ask(np.random.default_rng(0).random((count, 3)), cpu)
    assert sorted(rank.tolist()) == list(range(count))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_answers_do_not_depend_on_threads(threads, cpu, monkeypatch):
    points = np.random.default_rng(1).random((COUNT, 3))
    monkeypatch.setenv("GEOKIT_THREADS", str(threads))
    rank = ask(points, cpu)
    monkeypatch.setenv("GEOKIT_THREADS", "1")
    np.testing.assert_array_equal(rank, ask(points, cpu))


def test_few_queries_keep_their_order(cpu):
    rank = ask(np.random.default_rng(0).random((2047, 3)), cpu)
    np.testing.assert_array_equal(rank, np.arange(2047))


def test_many_queries_are_answered_in_morton_order(cpu):
    # The eight octants of the box come one after the other, x fastest.
    points = np.random.default_rng(0).random((4096, 3))
    rank = ask(points, cpu)
    octant = (points >= 0.5) @ [1, 2, 4]
    # 1023 cells: one boundary lies half a cell off the middle.
    clear = (np.abs(points - 0.5) > 2e-3).all(axis=1)
    by_rank = np.empty(4096, int)
    by_rank[rank] = np.where(clear, octant, -1)
    by_rank = by_rank[by_rank >= 0]
    assert (np.diff(by_rank) >= 0).all()
    assert set(by_rank) == set(range(8))


@pytest.mark.parametrize(
    ("lower", "extent"),
    [((0.0, 0.0, 0.0), 0.0), ((5.0, 5.0, 5.0), 1.0), ((-1e300, 0.0, 0.0), 1e300), ((0.4,) * 3, 1e-9)],
)
def test_any_box_orders_every_query_once(lower, extent, cpu):
    rank = ask(np.random.default_rng(0).random((3000, 3)) * 1e6, cpu, lower=lower, extent=extent)
    assert sorted(rank.tolist()) == list(range(3000))


def test_blocks(cpu, monkeypatch):
    monkeypatch.setattr(launcher, "BLOCK", 2100)
    rank = ask(np.random.default_rng(0).random((COUNT, 3)), cpu)
    for start in range(0, COUNT, 2100):
        block = rank[start : start + 2100]
        assert sorted(block.tolist()) == list(range(len(block)))


class Named:
    def __init__(self, name: str) -> None:
        self.name = name


@pytest.fixture
def compiles(monkeypatch):
    """Modules named "new" are compiled, others are found in the cache."""

    def load(module, device, block_dim, announce):
        assert block_dim == 1
        if module.name.startswith("new"):
            announce(module.name)

    monkeypatch.setattr(launcher.kernel_cache, "load", load)
    monkeypatch.setattr(launcher, "_loaded", set())
    monkeypatch.setattr(launcher, "_compile_listener", None)
    launcher._log_compiling.cache_clear()
    yield
    launcher._log_compiling.cache_clear()


def test_on_compile_is_told_of_what_is_compiled(cpu, compiles, caplog):
    told = []
    launcher.on_compile(told.append)
    for name in ("new", "found", "new"):  # loaded by the third time: nothing to tell
        launcher.load_module(Named(name), cpu)
    assert told == ["new"]
    assert caplog.text == ""


def test_the_log_says_once_that_kernels_are_compiled(cpu, compiles, caplog):
    launcher.load_module(Named("found"), cpu)
    assert caplog.text == ""
    for name in ("new", "new one"):
        launcher.load_module(Named(name), cpu)
    assert [record.getMessage() for record in caplog.records] == [f"geokit: {launcher.compile_notice()}"]
    assert str(wp.config.kernel_cache_dir) in launcher.compile_notice()


def test_warp_speaks_as_before_afterwards(cpu):
    before = wp.config.log_level
    launcher.launch(mark_kernel, 1, [1], [wp.zeros(1, dtype=int, device=cpu) for _ in range(2)], cpu)
    assert wp.config.log_level == before


@pytest.mark.parametrize("group", [1, 7, 32])
@pytest.mark.parametrize("count", [1, 31, 5000])
def test_groups_answer_every_query_once(cpu, count, group):
    points = np.random.default_rng(3).random((count, 3))
    assert sorted(ask(points, cpu, group=group)) == list(range(count))
    np.testing.assert_array_equal(ask(points, cpu, group=group), ask(points, cpu))


@pytest.mark.skipif(bool(launcher.cuda_devices()), reason="there is a GPU")
def test_the_current_gpu_where_there_is_none_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(gk.InputError, match="'cuda' is not on this machine"):
        launcher.resolve_device("cuda")
    assert capfd.readouterr() == ("", "")
