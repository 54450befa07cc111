"""Downloads GPU arrays to NumPy, into pinned memory or staged through it by several threads.

A copy to pageable memory goes through a small pinned buffer of the driver. One thread empties that buffer, often into
pages that are touched for the first time, at 1.5 to 10 GB/s; the bus delivers 50. Copying 11 MB on an H100's host takes
1.1 to 8 ms with warp's copy, 1.0 ms with staging threads, and 0.22 ms into pinned memory.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.forks import renew_after_fork
from geokit.core.base.late_warp import wp
from geokit.core.launches import captured
from geokit.core.memory.host_array import row_of
from geokit.core.memory.memory_pool import MemoryPool
from geokit.core.running.thread_placement import Calls

# Size of each of the two halves of the staging memory: the bus fills one half while threads empty the other. The
# 32 MiB of pinned memory are kept from the first large download on.
HALF_BYTES = 1 << 24
# Threads that empty a half, and the smallest share worth a thread: waking it takes as long as copying a fifth of that.
THREADS = 6
LEAST_PER_THREAD = 1 << 20
# Smaller downloads are faster without staging, and without the memory pool.
SMALLEST_STAGED = 1 << 21
SMALLEST_POOLED = 1 << 15
# Bytes of a copy without staging: an array of warp has fewer than 2^31.
LARGEST_COPY = 1 << 30

# Bounds of the pool of pinned memory, for all arrays together (in use and idle) and for one array. They hold the full
# results of four million closest points, or the mesh of a level set of 1024^3; a desktop can spare that much.
POOL_BYTES = 1 << 28
LARGEST_POOLED = 1 << 27
# The ski-rental rule: pinning memory takes as long as five to ten staged copies lose against a pinned one (0.3 ms a MB,
# once; staged, 48 MB take 3.9 ms instead of 1, 150 MB 7 instead of 3). So memory for an array above 16 MiB is pinned
# once five times its size was copied without. A program that reads few results never pays for pinning; one that reads
# many pays at most about twice the optimum.
PINNED_AT_ONCE = 1 << 24
PATIENCE = 5


def _host_bytes(size: int, *, pinned: bool = True) -> tuple["wp.array", int]:
    memory = wp.empty(size, dtype=wp.uint8, device="cpu", pinned=pinned)
    return memory, int(memory.ptr or 0)


_pool = MemoryPool(
    _host_bytes, most_bytes=POOL_BYTES, largest_bytes=LARGEST_POOLED, ready_bytes=PINNED_AT_ONCE, patience=PATIENCE
)
_stages: dict[str, _Stage] = {}


def download(*arrays: "wp.array") -> list[np.ndarray]:
    """Copy arrays of one device to NumPy; arrays in host memory are not copied."""
    device = arrays[0].device
    captured.refuse(device, "answers are copied to the host")
    total = sum(array.capacity for array in arrays)
    if device.is_cpu or total < SMALLEST_POOLED or not all(array.is_contiguous for array in arrays):
        return [array.numpy() for array in arrays]
    return _download_pooled(arrays, _pool) or _download_staged(arrays, total)


def download_into(target: np.ndarray, array: "wp.array") -> None:
    """Copy a contiguous array into a contiguous NumPy array of the same number of bytes."""
    if array.device.is_cuda and target.nbytes >= SMALLEST_STAGED and _through_stage((array,), [target]):
        return
    memory = target.reshape(-1).view(np.uint8)
    for start in range(0, len(memory), LARGEST_COPY):
        part = memory[start : start + LARGEST_COPY]
        wp.copy(wp.array(part, dtype=wp.uint8, device="cpu", copy=False), bytes_of(array, start, len(part)))
    wp.synchronize_device(array.device)  # the copy is asynchronous


def release() -> int:
    """Free idle pinned memory, and staging memory that no thread uses; return the bytes of the former."""
    for alias, stage in list(_stages.items()):
        with _if_free(stage.lock) as free:
            if free:
                _stages.pop(alias, None)
    return _pool.release()


@contextlib.contextmanager
def _if_free(lock: threading.Lock) -> Iterator[bool]:
    """Take a lock unless another thread has it; whether it was taken."""
    taken: list[bool] = []
    try:
        # Taken and noted in one step: no interrupt comes between.
        taken.extend(map(lock.acquire, (False,)))
        yield taken[0]
    finally:
        if taken and taken[0]:
            lock.release()


def _download_pooled(arrays: tuple["wp.array", ...], pool: MemoryPool) -> list[np.ndarray] | None:
    """Copy straight into the pool's pinned memory; None if the pool has no room."""
    rows = [row_of(array.dtype) for array in arrays]
    pooled = [pool.empty((*array.shape, *row.shape[1:]), row.dtype) for array, row in zip(arrays, rows, strict=True)]
    results = [pair for pair in pooled if pair is not None]
    if len(results) < len(arrays):
        return None
    for array, (result, memory) in zip(arrays, results, strict=True):
        wp.copy(memory, bytes_of(array, 0, result.nbytes), count=result.nbytes)
    if arrays[0].device.is_cuda:
        wp.synchronize_stream(arrays[0].device.stream)
    return [result for result, _ in results]


def _download_staged(arrays: tuple["wp.array", ...], total: int) -> list[np.ndarray]:
    if total >= SMALLEST_STAGED:
        results = [_empty_like(array) for array in arrays]
        if _through_stage(arrays, results):
            return results
    return [array.numpy() for array in arrays]


def _through_stage(arrays: tuple["wp.array", ...], results: list[np.ndarray]) -> bool:
    """Copy the arrays into ``results``; False if another thread is using the staging memory."""
    device = arrays[0].device
    stage = _stages.setdefault(device.alias, _Stage(device))
    with _if_free(stage.lock) as free:
        if free:
            stage.copy(arrays, results)
        return free


class _Stage:
    """Staging memory for one device: two pinned halves, used in turn."""

    def __init__(self, device: "wp.Device") -> None:
        self._device = device
        self._halves: list[_Half] = []
        self._after_fork()
        renew_after_fork(self)

    def _after_fork(self) -> None:
        self.lock = threading.Lock()

    def copy(self, arrays: tuple["wp.array", ...], results: list[np.ndarray]) -> None:
        self._halves = self._halves or [_Half(self._device) for _ in range(2)]
        first, second = self._halves
        try:
            for pieces in _pieces([result.nbytes for result in results]):
                # The bus fills this half while threads empty the other.
                first.fill(arrays, results, pieces)
                second.empty()
                first, second = second, first
            second.empty()
        finally:
            # No copy may be running when the next download uses the halves, even after an error.
            for half in self._halves:
                half.forget()


class _Half:
    """One half of the staging memory, the pieces it holds, and the jobs that empty it."""

    def __init__(self, device: "wp.Device") -> None:
        self._memory = wp.empty(HALF_BYTES, dtype=wp.uint8, device="cpu", pinned=device.is_cuda)
        self._values = self._memory.numpy()
        self._filled: Any = wp.Event(device) if device.is_cuda else None
        self._stream: Any = None
        self._parts: list[tuple[np.ndarray, int]] = []
        self._copies: Calls | None = None

    def fill(self, arrays: Any, results: list[np.ndarray], pieces: list[tuple[int, int, int]]) -> None:
        """Start copying the pieces (array, first byte, bytes) into this half."""
        at = 0
        for number, start, size in pieces:
            wp.copy(self._memory, bytes_of(arrays[number], start, size), at, 0, size)
            self._parts.append((results[number].reshape(-1).view(np.uint8)[start : start + size], at))
            at += size
        if self._filled is not None:
            arrays[0].device.stream.record_event(self._filled)

    def empty(self) -> None:
        """Wait until the half is filled, then copy its pieces to the results; the calling thread takes a share."""
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
        self._copies = launcher.pool().start(_copy, shares[1:], len(shares) - 1) if shares[1:] else None
        _copy(shares[0])
        if self._copies is not None:
            self._copies.wait()

    def forget(self) -> None:
        if self._copies is not None:
            self._copies.drop()
        self._copies, self._parts = None, []


def _copy(pair: tuple[np.ndarray, np.ndarray]) -> None:
    np.copyto(*pair)


def _pieces(sizes: list[int]) -> Iterator[list[tuple[int, int, int]]]:
    """Cut arrays of these sizes into pieces (array, first byte, bytes); yields the pieces of one half at a time."""
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


def bytes_of(array: "wp.array", start: int, size: int) -> "wp.array":
    """View ``size`` bytes of a contiguous array; the whole may exceed warp's limit of 2^31 elements."""
    return wp.array(ptr=int(array.ptr or 0) + start, dtype=wp.uint8, shape=(size,), device=array.device)


def _empty_like(array: "wp.array") -> np.ndarray:
    row = row_of(array.dtype)
    return np.empty((*array.shape, *row.shape[1:]), row.dtype)
