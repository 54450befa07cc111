"""Threads that work side by side, each on a processor of its own.

Linux often wakes two threads on one processor while another is idle, and takes some milliseconds to notice: of calls of
8 ms on two processors a third took 14. Whoever waits for the threads looks where they are, and moves one.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

__all__ = ["Pool", "wait_for"]

# When to look [s]: once all have been woken, and once more when a thread that was moved has been moved back.
LOOKS = (3e-4, 1e-3)
# Of /proc/PID/task/TID/stat, counted from behind the name: the processor that the thread was on last.
PROCESSOR_FIELD = 36

# To look takes 15 us a thread. Of so many two on one processor matter less.
MOST_THREADS = 16

_can_move = hasattr(os, "sched_setaffinity")


class Pool(ThreadPoolExecutor):
    """Threads whose native ids are known, also of those that have been woken and have not run yet."""

    def __init__(self, count: int, name: str) -> None:
        ids: list[int] = []
        super().__init__(count, thread_name_prefix=name, initializer=lambda: ids.append(threading.get_native_id()))
        self.ids = ids


def wait_for(jobs: Sequence[Future[Any]], threads: Sequence[int]) -> None:
    """Wait until all jobs are done, which the threads of these native ids work at; their exceptions are raised."""
    if _can_move and len(threads) <= MOST_THREADS:
        for seconds in LOOKS:
            if not wait(jobs, timeout=seconds).not_done:
                break
            _spread(threads)
    for job in jobs:
        job.result()


def _spread(threads: Sequence[int]) -> None:
    """Moves threads that share a processor to those that none of them has. Where they may run stays as it is."""
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
                # A thread that may no longer run where it is moves at once.
                target = min(free)
                taken.add(target)
                os.sched_setaffinity(thread, {target})
                os.sched_setaffinity(thread, allowed)
    except (ProcessLookupError, FileNotFoundError):
        return  # a thread has ended
    except (OSError, ValueError, IndexError):
        _can_move = False  # a system that forbids it, or tells it otherwise


def _processor_of(thread: int) -> int:
    with open(f"/proc/self/task/{thread}/stat", encoding="ascii", errors="replace") as file:
        return int(file.read().rpartition(")")[2].split()[PROCESSOR_FIELD])
