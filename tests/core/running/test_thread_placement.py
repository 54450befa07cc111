"""Waiting for threads: all of them, with their errors, and each on a processor of its own where there is one."""

from __future__ import annotations

import gc
import hashlib
import os
import signal
import threading
import time

import numpy as np
import pytest
import warp as wp

from geokit.core import launcher
from geokit.core.running import thread_placement
from geokit.core.running.thread_placement import Pool
from tests.support.effort import of_all
from tests.support.interrupts import interrupts

wp.set_module_options({"enable_backward": False})
processors = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()

pytestmark = pytest.mark.process


@wp.kernel
def busy_kernel(first: int, turns: int, out: wp.array(dtype=float)):
    i = first + wp.tid()
    x = float(i)
    for _k in range(turns):
        x = wp.sin(x) + 1.0
    out[i] = x


def test_all_are_waited_for():
    done = []
    Pool(3, "test").run(lambda seconds: (time.sleep(seconds), done.append(seconds)), [0.0, 0.002, 0.02, 0.0], 3)
    assert sorted(done) == [0.0, 0.0, 0.002, 0.02]


def test_the_error_of_the_first_item_is_raised():
    def fail(at):
        if at in (3, 5):
            time.sleep(0.002 * (5 - at))
            raise KeyError(f"slice {at}")

    pool = Pool(2, "test")
    for _ in range(5):
        with pytest.raises(KeyError, match="slice 3"):
            pool.run(fail, range(8), 2)
    assert pool.map(str, range(3)) == ["0", "1", "2"]


def test_a_pool_knows_its_threads():
    pool = Pool(3, "test")
    together = threading.Barrier(3)

    def meet(_):
        together.wait()
        return threading.get_native_id()

    assert sorted(pool.map(meet, range(3))) == sorted(pool.ids)


def test_a_call_may_give_more_to_its_own_pool():
    pool = Pool(2, "test")
    assert pool.map(lambda at: sum(pool.map(int, range(at))), range(6)) == [0, 0, 1, 3, 6, 10]


def test_without_memory_for_threads_the_caller_does_the_work(monkeypatch):
    monkeypatch.setattr(thread_placement, "available_host", lambda: 0)
    pool = Pool(2, "test")
    assert set(pool.map(lambda _: threading.get_ident(), range(4))) == {threading.get_ident()}
    assert not pool.ids


def test_the_threads_of_a_pool_end_with_it():
    pool = Pool(2, "test")
    pool.map(time.sleep, [0.001, 0.001])
    threads = list(pool._threads)
    del pool
    gc.collect()
    assert not any(thread.is_alive() for thread in threads)


def test_after_an_interrupt_nothing_runs_any_more():
    begun, ended = [], []

    def call(at):
        begun.append(at)
        if at == 2:
            os.kill(os.getpid(), signal.SIGINT)  # of a process: its main thread takes it
        time.sleep(0.02)
        ended.append(at)

    with pytest.raises(KeyboardInterrupt):
        Pool(2, "test").run(call, range(100), 2)
    assert sorted(ended) == sorted(begun)
    assert len(begun) < 10


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_at_any_call_leaves_the_pool_usable():
    begun, ended = [], []

    def call(at):
        begun.append(at)
        ended.append(at)

    def block():
        nonlocal pool
        pool = Pool(2, "test")
        pool.run(call, range(4), 2)
        pool.run(call, range(4), 2)

    def ask():
        found.append(pool.map(str, range(4)))

    pool, number = Pool(2, "test"), 0
    for number in interrupts(block, step=of_all(7, 1)):
        assert len(begun) == len(ended), number
        found = []
        asking = threading.Thread(target=ask, daemon=True)
        asking.start()
        asking.join(30)
        assert found == [["0", "1", "2", "3"]], number
    assert number > 100


@pytest.mark.skipif(len(processors) < 2, reason="needs two processors")
def test_threads_on_one_processor_are_moved_apart(monkeypatch):
    together, ids, stop = min(processors), [], threading.Event()

    def work():
        os.sched_setaffinity(0, {together})
        ids.append(threading.get_native_id())
        while not stop.is_set():
            hashlib.pbkdf2_hmac("sha256", b"", b"", 1000)  # without Python's lock

    def arrives(thread, processor):
        for _ in range(1000):
            if thread_placement._processor_of(thread) == processor:
                return True
            time.sleep(0.01)
        return False

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    moved, masks = [], {}
    move = os.sched_setaffinity

    def noted(thread, mask):
        move(thread, mask)
        masks[thread] = set(mask)
        if len(mask) == 1:
            # The system may move a thread again once it may run anywhere.
            moved.append((thread, arrives(thread, *mask), *mask))

    try:
        while len(ids) < 2:
            time.sleep(0.001)
        assert all(arrives(thread, together) for thread in ids)
        # They are held together until they are looked at, and may run on all.
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(processors))
        monkeypatch.setattr(os, "sched_setaffinity", noted)
        thread_placement._separate(ids)
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    assert moved == [(ids[1], True, min(processors - {together}))]
    assert masks == {ids[1]: processors}


def test_a_thread_that_has_ended_is_no_error():
    thread = threading.Thread(target=lambda: None)
    thread.start()
    thread.join()
    thread_placement._separate([thread.native_id, threading.get_native_id()])
    assert thread_placement._can_move == hasattr(os, "sched_setaffinity")


def test_where_it_is_forbidden_nothing_is_tried_again(monkeypatch):
    def forbidden(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(thread_placement, "_can_move", True)
    monkeypatch.setattr(thread_placement, "_processor_of", forbidden)
    thread_placement._separate([threading.get_native_id()])
    assert not thread_placement._can_move


def test_slices_are_run_once_each_and_errors_leave_the_pool_usable(monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "3")
    device = wp.get_device("cpu")
    out = wp.zeros(100_000, dtype=float, device=device)
    for _ in range(20):
        launcher.launch(busy_kernel, len(out), [0], [out], device)
    np.testing.assert_array_equal(out.numpy(), np.arange(100_000, dtype=np.float32))
    with pytest.raises(RuntimeError):
        launcher.launch(busy_kernel, 100_000, [0, 1], [out], device)
    launcher.launch(busy_kernel, len(out), [30], [out], device)
    assert out.numpy().min() >= 0.0
