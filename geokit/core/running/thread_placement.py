"""Worker threads, which are moved off shared processors.

Linux often wakes two threads on one processor while another is idle, and takes some milliseconds to notice. Of calls
of 8 ms on two processors, a third took 14 ms. So the waiting thread checks the placement and moves one of the two.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from geokit.core.base.interrupts import signals_held
from geokit.core.memory.available_memory import available_host

# When to check [s]: once all threads are awake, and again in case the system has moved one back.
CHECK_SECONDS = (3e-4, 1e-3)
# Field of /proc/PID/task/TID/stat, counted after the name: the processor that the thread last ran on.
PROCESSOR_FIELD = 36

# A thread's stack (8 MiB, unless the system says otherwise), and as much again.
THREAD_BYTES = 1 << 24
# A check takes 10 us a thread. With more threads than these, two on one processor matter less.
MOST_THREADS = 16
# How often to look, after an interrupt, whether calls that have begun have ended [s].
POLL_SECONDS = 1e-3

_Result = TypeVar("_Result")

_can_move = hasattr(os, "sched_setaffinity")


class Pool:
    """Threads for calls that do not wait for each other.

    It knows the native ids of its threads, even of those that have not run anything yet. Where there is no memory for
    a thread, the others do its work, or else the thread that asks.

    An interrupt in ``concurrent.futures`` leaves a lock taken at some calls, and the next call waits for ever: nothing
    here takes one that is released by another call.

    Args:
        count: Most threads.
        name: What their names begin with.
    """

    def __init__(self, count: int, name: str) -> None:
        self.ids: list[int] = []
        self._count, self._name = count, name
        self._waiting: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        weakref.finalize(self, _end, self._waiting, self._threads)

    def start(self, call: Callable[[Any], object], items: Iterable[Any], threads: int) -> Calls:
        """Start ``call(item)`` for all items, in up to so many threads, each of which takes the next item in turn."""
        calls = Calls(call, items)
        count = 0 if threading.current_thread() in self._threads else self._grown(min(threads, self._count))
        if count:
            calls._give(self._waiting, min(threads, count))
        else:
            calls._make_here()
        return calls

    def run(self, call: Callable[[Any], object], items: Iterable[Any], threads: int) -> None:
        """``call(item)`` for all items; of several errors, that of the first item is raised."""
        self.start(call, items, threads).wait(self.ids)

    def map(self, call: Callable[[Any], _Result], items: Iterable[Any]) -> list[_Result]:
        """``call(item)`` of all items, by all threads, in the order of the items."""
        listed = list(items)
        results: list[Any] = [None] * len(listed)

        def one(at: int) -> None:
            results[at] = call(listed[at])

        self.run(one, range(len(listed)), min(self._count, len(listed)))
        return results

    def _grown(self, wanted: int) -> int:
        """Start threads until there are so many, as far as there is memory; how many there are."""
        if len(self._threads) < wanted:
            with self._lock:
                # Python waits for ever for a thread that has started and has no memory for its first objects.
                while len(self._threads) < wanted and available_host() >= THREAD_BYTES:
                    if not self._started():
                        break
        return len(self._threads)

    def _started(self) -> bool:
        thread = threading.Thread(
            target=_work, args=(self._waiting, self.ids), name=f"{self._name}_{len(self._threads)}", daemon=True
        )
        with signals_held():
            try:
                thread.start()
            except RuntimeError:  # the system has no room for it
                return False
            self._threads.append(thread)
        return True


class Calls:
    """Calls that threads of a pool make.

    Args:
        call: What is called.
        items: With which; an iterator in C, from which threads may take at the same time.
    """

    def __init__(self, call: Callable[[Any], object], items: Iterable[Any]) -> None:
        self._call, self._rest = call, enumerate(items)
        self._shares, self._begun, self._ended = 0, list[None](), list[None]()
        self._errors: dict[int, BaseException] = {}
        self._woken: SimpleQueue[None] = SimpleQueue()

    def wait(self, threads: Sequence[int] = (), *, hold: bool = False) -> None:
        """Wait until all calls are made, and raise the error of the first item that has one.

        Args:
            threads: Native ids of the threads that make them, to be moved off shared processors.
            hold: Calls hold all that they use: after an interrupt they are left to themselves.
        """
        try:
            self._wait(threads)
        except BaseException:
            if not hold:
                self.drop()
            raise
        errors, self._errors = self._errors, {}
        if errors:
            try:
                raise errors[min(errors)]
            finally:
                errors.clear()  # their tracebacks hold this frame

    def drop(self) -> None:
        """Begin no more calls, and wait for those that have begun: they use memory that the caller may free."""
        deque(self._rest, maxlen=0)
        while len(self._ended) < len(self._begun):
            time.sleep(POLL_SECONDS)

    def _give(self, waiting: SimpleQueue[Any], shares: int) -> None:
        self._shares = shares
        try:
            for _ in range(shares):
                waiting.put(self._make)
        except BaseException:
            self.drop()
            raise

    def _make(self) -> None:
        """Make calls until none is left, in a thread of the pool."""
        self._begun.append(None)
        for at, item in self._rest:
            try:
                self._call(item)
            except BaseException as error:
                self._errors[at] = error
        self._ended.append(None)
        if len(self._ended) == self._shares:
            self._woken.put(None)

    def _make_here(self) -> None:
        for at, item in self._rest:
            try:
                self._call(item)
            except Exception as error:
                self._errors[at] = error

    def _wait(self, threads: Sequence[int]) -> None:
        if _can_move and len(threads) <= MOST_THREADS:
            for seconds in CHECK_SECONDS:
                if self._done(seconds):
                    return
                _separate(threads)
        while not self._done(None):
            pass

    def _done(self, seconds: float | None) -> bool:
        """Whether all calls are made within a time."""
        if len(self._ended) < self._shares:
            with contextlib.suppress(Empty):
                self._woken.get(timeout=seconds)
        return len(self._ended) >= self._shares


def _work(waiting: SimpleQueue[Callable[[], None] | None], ids: list[int]) -> None:
    ids.append(threading.get_native_id())
    while (job := waiting.get()) is not None:
        job()
        del job  # with what it holds


def _end(waiting: SimpleQueue[Any], threads: list[threading.Thread]) -> None:
    """End the threads of a pool that nobody has any more, or at the end of the process."""
    for _ in threads:
        waiting.put(None)
    for thread in threads:
        if thread is not threading.current_thread():
            thread.join()


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
    # Neither buffered nor decoded: that takes twice as long.
    with open(f"/proc/self/task/{thread}/stat", "rb", buffering=0) as file:
        return int(file.read(1 << 10).rpartition(b")")[2].split()[PROCESSOR_FIELD])
