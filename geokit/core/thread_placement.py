"""Moves worker threads off shared processors.

Linux often wakes two threads on one processor while another is idle, and takes some milliseconds to notice. Of calls
of 8 ms on two processors, a third took 14 ms. So the waiting thread checks the placement and moves one of the two.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

from geokit.core.memory.available_memory import available_host

__all__ = ["Pool", "wait_for"]

# When to check [s]: once all threads are awake, and again in case the system has moved one back.
CHECK_SECONDS = (3e-4, 1e-3)
# Field of /proc/PID/task/TID/stat, counted after the name: the processor that the thread last ran on.
PROCESSOR_FIELD = 36

# A thread's stack (8 MiB, unless the system says otherwise), and as much again.
THREAD_BYTES = 1 << 24
# A check takes 15 us a thread. With more threads than these, two on one processor matter less.
MOST_THREADS = 16

_can_move = hasattr(os, "sched_setaffinity")


class Pool(ThreadPoolExecutor):
    """A thread pool that knows the native ids of its threads, even of those that have not run a job yet.

    Where there is no memory for a thread, the others do its work, or else the thread that submits it.
    """

    def __init__(self, count: int, name: str) -> None:
        ids: list[int] = []
        super().__init__(count, thread_name_prefix=name, initializer=lambda: ids.append(threading.get_native_id()))
        self.ids = ids

    def submit(self, job: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if not self._threads and available_host() < THREAD_BYTES:
            done: Future[Any] = Future()
            try:
                done.set_result(job(*args, **kwargs))
            except BaseException as error:
                done.set_exception(error)
            return done
        return super().submit(job, *args, **kwargs)

    def _adjust_thread_count(self) -> None:
        # Python waits for ever for a thread that has started and has no memory for its first objects.
        count = len(self._threads)
        if count in (0, self._max_workers) or available_host() >= THREAD_BYTES:
            with contextlib.suppress(RuntimeError) if count else contextlib.nullcontext():
                super()._adjust_thread_count()


def wait_for(jobs: Sequence[Future[Any]], threads: Sequence[int]) -> None:
    """Wait for all jobs, which run on threads with these native ids, and raise their exceptions."""
    if _can_move and len(threads) <= MOST_THREADS:
        for seconds in CHECK_SECONDS:
            if not wait(jobs, timeout=seconds).not_done:
                break
            _separate(threads)
    for job in jobs:
        job.result()


def _separate(threads: Sequence[int]) -> None:
    """Move threads that share a processor to processors that none of them uses; affinity masks are restored."""
    global _can_move
    try:
        taken: set[int] = set()
        sharing = []
        for thread in threads:
            processor = _processor_of(thread)
            if processor in taken:
                sharing.append(thread)
            taken.add(processor)
        for thread in sharing:
            allowed = os.sched_getaffinity(thread)
            free = allowed - taken
            if free:
                # A thread moves at once when its affinity mask excludes the processor it is on.
                target = min(free)
                taken.add(target)
                os.sched_setaffinity(thread, {target})
                os.sched_setaffinity(thread, allowed)
    except (ProcessLookupError, FileNotFoundError):
        return  # a thread has ended
    except (OSError, ValueError, IndexError):
        _can_move = False  # the system forbids it, or reports placement in another format


def _processor_of(thread: int) -> int:
    with open(f"/proc/self/task/{thread}/stat", encoding="ascii", errors="replace") as file:
        return int(file.read().rpartition(")")[2].split()[PROCESSOR_FIELD])
