"""Teams of threads: every item once, barriers that hold, and refusals."""

from __future__ import annotations

import gc
import threading
import weakref

import numpy as np
import pytest
import warp as wp

import geokit as gk
from tests.support.devices import DEVICES
from tests.support.effort import of_all

wp.set_module_options({"enable_backward": False})


@wp.kernel
def visit_kernel(share: gk.threads.Share, out_visits: wp.array(dtype=int)):
    for k in range(wp.tid(), share.count, share.step):
        out_visits[gk.threads.item(share, k)] += 1


@wp.kernel
def diffuse_kernel(share: gk.threads.Share, steps: int, values: wp.array2d(dtype=wp.int64)):
    # Each step reads what other threads have written in the one before, from the items on both sides.
    count = values.shape[1]
    for s in range(steps):
        for k in range(wp.tid(), share.count, share.step):
            i = gk.threads.item(share, k)
            left, right = values[s % 2, (i + count - 1) % count], values[s % 2, (i + 1) % count]
            values[1 - s % 2, i] = (left * wp.int64(3) + right * wp.int64(5)) % wp.int64(1000003)
        gk.threads.barrier(share)


@wp.kernel
def shareless_kernel(first: int, out_visits: wp.array(dtype=int)):
    out_visits[first + wp.tid()] += 1


def diffused(start, steps):
    for _ in range(steps):
        start = (np.roll(start, 1) * 3 + np.roll(start, -1) * 5) % 1000003
    return start


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("threads", [1, 2, 3, 16])
@pytest.mark.parametrize(("count", "block"), [(0, 32), (1, 32), (5, 1), (96, 32), (1000, 32), (1000, 7), (1001, 1000)])
def test_every_item_is_one_thread_s(device, threads, count, block):
    team = gk.threads.Team(threads, device=device)
    visits = wp.zeros(max(count, 1), dtype=int, device=device)
    again = team.record(visit_kernel, count, [visits], block=block)
    for _ in range(3):
        again()
    np.testing.assert_array_equal(visits.numpy()[:count], 3)


# More threads than processors, too.
@pytest.mark.slow
@pytest.mark.parametrize("threads", of_all([2, 24], [1, 2, 3, 8, 24]))
def test_no_thread_passes_a_barrier_early(threads):
    start = np.random.default_rng(7).integers(0, 1000003, 96)
    values = wp.array(np.stack([start, np.zeros(96, np.int64)]), dtype=wp.int64, device="cpu")
    team = gk.threads.Team(threads, device="cpu")
    team.run(diffuse_kernel, 96, [400, values], block=3)
    team.run(diffuse_kernel, 96, [400, values], block=3)
    np.testing.assert_array_equal(values.numpy()[0], diffused(start, 800))


@pytest.mark.parametrize("device", [d for d in DEVICES if d != "cpu"])
def test_a_launch_is_the_barrier_of_a_gpu(device):
    start = np.random.default_rng(8).integers(0, 1000003, 5000)
    values = wp.array(np.stack([start, np.zeros(5000, np.int64)]), dtype=wp.int64, device=device)
    gk.threads.Team(device=device).run(diffuse_kernel, 5000, [1, values])
    np.testing.assert_array_equal(values.numpy()[1], diffused(start, 1))


@pytest.mark.slow
def test_launches_of_one_team_from_several_threads_take_turns():
    start = np.random.default_rng(9).integers(0, 1000003, 96)
    team = gk.threads.Team(2, device="cpu")
    grids = [wp.array(np.stack([start, start]), dtype=wp.int64, device="cpu") for _ in range(6)]
    calls = [team.record(diffuse_kernel, 96, [100, grid], block=8) for grid in grids]
    callers = [threading.Thread(target=call) for call in calls]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    for grid in grids:
        np.testing.assert_array_equal(grid.numpy()[0], diffused(start, 100))


@pytest.mark.parametrize("device", DEVICES)
def test_sequences_make_their_calls_in_turn(device):
    start = np.random.default_rng(10).integers(0, 1000003, 500)
    values = wp.array(np.stack([start, start]), dtype=wp.int64, device=device)
    new, team = wp.zeros((2, 500), dtype=wp.int64, device=device), gk.threads.Team(2, device=device)
    step = team.record(diffuse_kernel, 500, [1, values])
    # One step, and its result is put where the next one reads.
    again = team.sequence([step, lambda: wp.copy(new[0], values[1]), lambda: wp.copy(values, new)])
    for _ in range(5):
        again()
    np.testing.assert_array_equal(values.numpy()[0], diffused(start, 5))


def test_threads_are_those_of_the_environment(monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "3")
    assert gk.threads.Team(device="cpu").threads == 3
    assert gk.threads.Team(5, device="cpu").threads == 5


@pytest.mark.slow
def test_recorded_arrays_stay_alive():
    team, visits = gk.threads.Team(2, device="cpu"), wp.zeros(1000, dtype=int, device="cpu")
    alive = weakref.ref(visits)
    again = team.record(visit_kernel, 1000, [visits])
    del visits
    gc.collect()
    again()
    np.testing.assert_array_equal(alive().numpy(), 1)


@pytest.mark.parametrize("threads", [0, -1, 1.5, True, "2"])
def test_number_of_threads_is_checked(threads):
    with pytest.raises(gk.InputError, match=r"threads: .* is not a whole number from 1 up"):
        gk.threads.Team(threads, device="cpu")


def test_kernels_without_a_share_and_negative_counts_are_refused():
    team = gk.threads.Team(2, device="cpu")
    with pytest.raises(gk.InputError, match=r"the first parameter of shareless_kernel is no gk.threads.Share"):
        team.record(shareless_kernel, 5, [wp.zeros(5, dtype=int, device="cpu")])
    with pytest.raises(gk.InputError, match="count: -1 is not a whole number"):
        team.run(visit_kernel, -1, [wp.zeros(1, dtype=int, device="cpu")])
    with pytest.raises(gk.InputError, match="block: 0 is not a whole number"):
        team.run(visit_kernel, 1, [wp.zeros(1, dtype=int, device="cpu")], block=0)
