"""Waiting for threads: all of them, with their errors, and each on a processor of its own where there is one."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

from geokit.core import launcher, thread_placement
from geokit.core.thread_placement import Pool, wait_for

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
    with ThreadPoolExecutor(3) as pool:
        jobs = [pool.submit(time.sleep, seconds) for seconds in (0.0, 0.002, 0.02)]
        wait_for(jobs, [])
        assert all(job.done() for job in jobs)


def test_errors_are_raised():
    def fail():
        raise KeyError("slice")

    with ThreadPoolExecutor(2) as pool, pytest.raises(KeyError, match="slice"):
        wait_for([pool.submit(time.sleep, 0.005), pool.submit(fail)], [])


def test_a_pool_knows_its_threads():
    pool = Pool(3, "test")
    together = threading.Barrier(3)

    def meet():
        together.wait()
        return threading.get_native_id()

    jobs = [pool.submit(meet) for _ in range(3)]
    wait_for(jobs, pool.ids)
    assert sorted(job.result() for job in jobs) == sorted(pool.ids)


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
