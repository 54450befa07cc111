"""Steps that no interrupt divides, and processes that none leaves behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from geokit.core import download
from geokit.core.base import forks
from geokit.core.base.interrupts import child_process, signals_held
from tests.support.effort import of_all
from tests.support.interrupts import children, interrupts

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


def is_free(lock):
    """Whether another thread can take a lock."""
    found = []

    def take():
        found.append(lock.acquire(timeout=5))
        if found[0]:
            lock.release()

    thread = threading.Thread(target=take)
    thread.start()
    thread.join()
    return found[0]


def test_a_block_is_done_whole_or_not_begun():
    done = []

    def block():
        with signals_held():
            done.append(len("first"))
            done.append(len("second"))

    before, number = {one: signal.getsignal(one) for one in signal.valid_signals()}, 0
    for number in interrupts(block, step=of_all(7, 1)):
        assert done in ([], [5, 6]), number
        assert {one: signal.getsignal(one) for one in before} == before, number
        done.clear()
    assert number > 50


def test_an_interrupt_comes_after_the_block():
    done = []

    def block():
        with signals_held():
            signal.raise_signal(signal.SIGINT)
            done.append("rest")

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == ["rest"]


def test_other_threads_hold_no_signals():
    found = []

    def block():
        with signals_held():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=block)
    thread.start()
    thread.join()
    assert found == [signal.getsignal(signal.SIGINT)]


@pytest.mark.process
def test_no_process_is_left():
    def block():
        with child_process(["sleep", "60"], stdout=subprocess.PIPE) as process:
            assert process.poll() is None

    before, number = children(), 0
    for number in interrupts(block, step=of_all(23, 1)):
        assert children() == before, number
    assert number > 100


def test_a_process_that_has_ended_tells_its_status():
    with child_process([sys.executable, "-S", "-c", "raise SystemExit(3)"], stdout=subprocess.PIPE) as process:
        process.communicate()
    assert process.returncode == 3
    with child_process(["sleep", "60"]) as process:
        pass
    assert process.returncode == -signal.SIGKILL


def test_a_process_is_ended_where_the_system_has_no_waitid(monkeypatch):
    monkeypatch.delattr(os, "waitid")
    with child_process(["sleep", "60"], stdout=subprocess.PIPE) as process:
        pass
    assert process.returncode == -signal.SIGKILL
    assert process.stdout.closed


def test_no_lock_stays_taken():
    lock = forks.Lock()

    def block():
        with lock:
            len("held")

    number = 0
    for number in interrupts(block):
        assert is_free(lock._lock), number
    assert number


def test_a_lock_that_is_tried_does_not_stay_taken():
    lock = threading.Lock()

    def block():
        with download._if_free(lock) as free:
            assert free

    number = 0
    for number in interrupts(block):
        assert is_free(lock), number
    assert number > 5
