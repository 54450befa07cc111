"""Arrays from a GPU as NumPy arrays: in pinned memory, or through it, with several threads that copy on.

The driver takes what goes to pageable memory through a small pinned buffer of its own and copies from there on one
thread, to pages that it often touches for the first time: 1.5 to 10 GB/s, where the bus gives 50. Of 11 MB, ms on an
H100's host: as warp does it 1.1 to 8, with threads 1.0, into pinned memory 0.22.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import Future, wait
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.host_array import row_of
from geokit.core.memory_pool import Loans

if TYPE_CHECKING:
    import warp as wp

__all__ = ["download", "download_into"]

# What is copied at a time, twice: the bus fills one half while threads empty the other. 32 MiB of pinned memory in all,
# kept from the first large download on.
HALF_BYTES = 1 << 24
# Threads that empty a half, and the least that is worth one: to wake it takes as long as it copies a fifth of that.
THREADS = 6
LEAST_PER_THREAD = 1 << 20
# Less than this is quicker without other threads, and without lent memory.
LEAST_STAGED = 1 << 21
LEAST_LENT = 1 << 15

# Of all results in pinned memory, those in use and those that wait for others, and of one: four million closest points
# with all that is said of them, or the mesh of a level set of 1024^3, and what a desktop's host can do without.
LENT_BYTES = 1 << 28
LARGEST_LENT = 1 << 27
# To pin memory takes as long as five to ten copies lose that go through the halves (0.3 ms a MB, once; 48 MB take 3.9
# ms instead of 1, 150 MB 7 instead of 3). So a large one is pinned for who has lost about that much: who reads a few
# loses nothing, who reads many loses no more than twice what he must.
PINNED_AT_ONCE = 1 << 24
PATIENCE = 5


def _host_bytes(size: int, *, pinned: bool = True) -> tuple["wp.array", int]:
    import warp as wp

    memory = wp.empty(size, dtype=wp.uint8, device="cpu", pinned=pinned)
    return memory, int(memory.ptr or 0)


_loans = Loans(
    _host_bytes,
    most_bytes=LENT_BYTES,
    largest_bytes=LARGEST_LENT,
    ready_bytes=PINNED_AT_ONCE,
    patience=PATIENCE,
)
_stages: dict[str, _Stage] = {}


def download(*arrays: "wp.array") -> list[np.ndarray]:
    """Arrays of one device on the host; those that are there already are not copied."""
    device = arrays[0].device
    total = sum(array.capacity for array in arrays)
    if device.is_cpu or total < LEAST_LENT or not all(array.is_contiguous for array in arrays):
        return [array.numpy() for array in arrays]
    return _lent(arrays, _loans) or _staged(arrays, total)


def download_into(target: np.ndarray, array: "wp.array") -> None:
    """The bytes of a contiguous array, to contiguous memory of the host that is as long."""
    import warp as wp

    if array.device.is_cuda and target.nbytes >= LEAST_STAGED and _through_stage((array,), [target]):
        return
    there: Any = wp.array(target.reshape(-1).view(np.uint8), dtype=wp.uint8, device="cpu", copy=False)
    wp.copy(there, _bytes_of(array, 0, target.nbytes))
    wp.synchronize_device(array.device)  # the copy may still be under way


def _lent(arrays: tuple["wp.array", ...], loans: Loans) -> list[np.ndarray] | None:
    """Straight into pinned memory that is lent, as long as there is some."""
    import warp as wp

    rows = [row_of(array.dtype) for array in arrays]
    lent = [loans.empty((*array.shape, *row.shape[1:]), row.dtype) for array, row in zip(arrays, rows, strict=True)]
    found = [loan for loan in lent if loan is not None]
    if len(found) < len(arrays):
        return None
    for array, (result, memory) in zip(arrays, found, strict=True):
        wp.copy(memory, _bytes_of(array, 0, result.nbytes), count=result.nbytes)
    if arrays[0].device.is_cuda:
        wp.synchronize_stream(arrays[0].device.stream)
    return [result for result, _ in found]


def _staged(arrays: tuple["wp.array", ...], total: int) -> list[np.ndarray]:
    if total >= LEAST_STAGED:
        results = [_empty_like(array) for array in arrays]
        if _through_stage(arrays, results):
            return results
    return [array.numpy() for array in arrays]


def _through_stage(arrays: tuple["wp.array", ...], results: list[np.ndarray]) -> bool:
    """Fills in the results, unless another thread is at it."""
    device = arrays[0].device
    stage = _stages.setdefault(device.alias, _Stage(device))
    if not stage.lock.acquire(blocking=False):
        return False
    try:
        stage.copy(arrays, results)
    finally:
        stage.lock.release()
    return True


class _Stage:
    """Pinned memory for one device, as two halves that are used in turn."""

    def __init__(self, device: "wp.Device") -> None:
        self.lock = threading.Lock()
        self._device = device
        self._halves: list[_Half] = []

    def copy(self, arrays: tuple["wp.array", ...], results: list[np.ndarray]) -> None:
        self._halves = self._halves or [_Half(self._device) for _ in range(2)]
        first, second = self._halves
        try:
            for pieces in _pieces([result.nbytes for result in results]):
                # The bus is at this half while threads are at the other.
                first.fill(arrays, results, pieces)
                second.empty()
                first, second = second, first
            second.empty()
        finally:
            # Nothing may be under way when the halves go to the next download, also after an error.
            for half in self._halves:
                half.forget()


class _Half:
    """A part of the pinned memory, what is copied there, and the threads that take it out again."""

    def __init__(self, device: "wp.Device") -> None:
        import warp as wp

        self._memory = wp.empty(HALF_BYTES, dtype=wp.uint8, device="cpu", pinned=device.is_cuda)
        self._values = self._memory.numpy()
        self._filled: Any = wp.Event(device) if device.is_cuda else None
        self._stream: Any = None
        self._parts: list[tuple[np.ndarray, int]] = []
        self._jobs: list[Future[None]] = []

    def fill(self, arrays: Any, results: list[np.ndarray], pieces: list[tuple[int, int, int]]) -> None:
        """Have pieces (array, first byte, bytes) copied here, one after the other."""
        import warp as wp

        at = 0
        for number, start, size in pieces:
            wp.copy(self._memory, _bytes_of(arrays[number], start, size), at, 0, size)
            self._parts.append((results[number].reshape(-1).view(np.uint8)[start : start + size], at))
            at += size
        if self._filled is not None:
            arrays[0].device.stream.record_event(self._filled)

    def empty(self) -> None:
        """Once it is filled, copy what is here to where it belongs: this thread takes a share, others take the rest."""
        import warp as wp

        if not self._parts:
            return
        if self._filled is not None:
            wp.synchronize_event(self._filled)
        total = sum(len(target) for target, _ in self._parts)
        share = max(LEAST_PER_THREAD, -(-total // THREADS))
        shares = [
            (target[k : k + share], self._values[at + k : at + min(k + share, len(target))])
            for target, at in self._parts
            for k in range(0, len(target), share)
        ]
        self._parts = []
        self._jobs = [launcher.pool().submit(np.copyto, *one) for one in shares[1:]]
        np.copyto(*shares[0])
        self.wait()

    def wait(self) -> None:
        jobs, self._jobs = self._jobs, []
        wait(jobs)
        for job in jobs:
            job.result()

    def forget(self) -> None:
        wait(self._jobs)
        self._jobs, self._parts = [], []


def _pieces(sizes: list[int]) -> Iterator[list[tuple[int, int, int]]]:
    """What goes into one half after the other: pieces (array, first byte, bytes)."""
    pieces, room = [], HALF_BYTES
    for number, size in enumerate(sizes):
        start = 0
        while start < size:
            taken = min(room, size - start)
            pieces.append((number, start, taken))
            start, room = start + taken, room - taken
            if not room:
                yield pieces
                pieces, room = [], HALF_BYTES
    if pieces:
        yield pieces


def _bytes_of(array: "wp.array", start: int, size: int) -> "wp.array":
    """A part of a contiguous array: warp counts no more than 2^31 elements."""
    import warp as wp

    return wp.array(ptr=array.ptr + start, dtype=wp.uint8, shape=(size,), device=array.device)


def _empty_like(array: "wp.array") -> np.ndarray:
    row = row_of(array.dtype)
    return np.empty((*array.shape, *row.shape[1:]), row.dtype)
