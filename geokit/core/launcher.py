"""The only place where kernels are launched: device, CPU threads, query order, blocks and the compile notice."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from geokit.core import launch_cache
from geokit.core.thread_placement import Pool, wait_for
from geokit.errors import InputError

if TYPE_CHECKING:
    import warp as wp

__all__ = [
    "cuda_devices",
    "identity",
    "in_order",
    "launch",
    "launch_queries",
    "load_module",
    "morton_order",
    "on_compile",
    "pool",
    "resolve_device",
    "thread_count",
]

# A launch costs about 30 us of Python: slices shorter than this would spend more on launching than on work.
MINIMUM_SLICE = 512
# More slices than threads, so that a slice of hard queries does not keep the others waiting.
SLICES_PER_THREAD = 8
# Fewest groups of queries worth a slice.
GROUP_GRAIN = 16
# Sorting fewer queries than this costs more than their order gives back.
MINIMUM_ORDERED = 2048
# Points that one thread orders as soon as two: to wake them takes as long as they save.
ORDER_SHARE = 1 << 18
# Buckets of points worth a slice.
BUCKET_GRAIN = 64
# Threads of a block on a GPU. A block keeps its place until its slowest thread is done: queries are 5% quicker than in
# blocks of 256, and no quicker in smaller ones (measured on an H100).
BLOCK_DIM = 128
# Queries per launch: bounds the memory of keys and order (16 bytes each, twice, or 24 on a CPU) to 128 MiB.
BLOCK = 1 << 22
# A load from the kernel cache takes well under this; a build takes seconds.
COMPILE_NOTICE_SECONDS = 0.7

# Share of a GPU's memory that its pool keeps of arrays that are no longer used. By default it gives all back to the
# driver, and to get the arrays of four million answers again takes a third of a millisecond, of a query that takes one.
POOL_SHARE = 0.25

_loaded: set[tuple[str, str]] = set()
_load_lock = threading.Lock()
_compile_listener: Callable[[str], None] | None = None


@functools.lru_cache(maxsize=1)
def _warp() -> Any:
    import warp

    with _quiet(warp), _silenced_stderr():
        warp.init()
    return warp


@contextlib.contextmanager
def _quiet(wp: Any) -> Iterator[None]:
    """Holds back warp's banner and load messages; the level that the user's own warp code runs under is put back."""
    level = wp.config.log_level
    wp.config.log_level = max(level, logging.WARNING)
    try:
        yield
    finally:
        wp.config.log_level = level


@contextlib.contextmanager
def _silenced_stderr() -> Iterator[None]:
    """Sends descriptor 2 to nowhere: warp's native start-up reports a missing CUDA driver there, past sys.stderr."""
    try:
        saved = os.dup(2)
    except OSError:  # a process without a stderr has nothing to silence
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def cuda_devices() -> list[str]:
    """Aliases of the CUDA devices that can be used."""
    return [device.alias for device in _warp().get_cuda_devices()]


def resolve_device(device: Any = None) -> "wp.Device":
    """The warp device for an alias ("cpu", "cuda:0"), for a warp device, or for None: the first GPU, else the CPU.

    Raises:
        InputError: There is no such device; the message lists those there are.
    """
    wp = _warp()
    if device is None:
        gpus = wp.get_cuda_devices()
        device = gpus[0] if gpus else "cpu"
    try:
        found = wp.get_device(device)
    except (ValueError, RuntimeError, TypeError) as error:
        names = ", ".join(["cpu", *cuda_devices()])
        raise InputError(f"device: {device!r} is not on this machine; use one of {names}") from error
    if found.is_cuda:
        _keep_pool(found.alias)
    return found


@functools.lru_cache(maxsize=16)
def _keep_pool(device: str) -> None:
    """Let the device's pool keep what it has given out; more, if the user has said so."""
    wp = _warp()
    kept = int(POOL_SHARE * wp.get_device(device).total_memory)
    if wp.is_mempool_enabled(device) and wp.get_mempool_release_threshold(device) < kept:
        wp.set_mempool_release_threshold(device, kept)


def thread_count() -> int:
    """CPU threads that kernels use: GEOKIT_THREADS, else the processors that this process may run on.

    Raises:
        InputError: GEOKIT_THREADS is set to something that is not a positive whole number.
    """
    wanted = os.environ.get("GEOKIT_THREADS", "")
    if wanted:
        if not wanted.isdecimal() or int(wanted) < 1:
            raise InputError(f"GEOKIT_THREADS: {wanted!r} is not a positive whole number; set it to 1 or more")
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.lru_cache(maxsize=4)
def _pool(threads: int) -> Pool:
    return Pool(threads, "geokit")


def pool() -> Pool:
    """The threads that take slices of launches."""
    return _pool(thread_count())


def on_compile(listener: Callable[[str], None] | None) -> None:
    """Have ``listener(module_name)`` called when a kernel module is being compiled rather than read from the cache."""
    global _compile_listener
    _compile_listener = listener


def load_module(module: Any, device: "wp.Device") -> None:
    """Build or load a kernel module before its first launch: slices of a launch must not each try to."""
    key = (module.name, device.alias)
    if key in _loaded:
        return
    with _load_lock:
        if key in _loaded:
            return
        listener = _compile_listener
        notice = threading.Timer(COMPILE_NOTICE_SECONDS, listener, [module.name]) if listener else None
        if notice:
            notice.daemon = True
            notice.start()
        try:
            with _quiet(_warp()):
                # Launches on the CPU run with blocks of one; another block size would be another build.
                module.load(device, block_dim=1 if device.is_cpu else BLOCK_DIM)
        finally:
            if notice:
                notice.cancel()
        _loaded.add(key)


def launch(
    kernel: Any, count: int, inputs: Sequence[Any], outputs: Sequence[Any], device: "wp.Device", *, grain: int = 0
) -> None:
    """Run ``kernel`` for the items ``0 .. count - 1``; its first parameter is the first item of the slice.

    Args:
        kernel: A warp kernel ``(first: int, *inputs, *outputs)`` whose item is ``first + wp.tid()``.
        count: Number of items, below 2^31.
        inputs: Arguments after ``first``.
        outputs: Arguments after the inputs.
        device: Where the arrays are.
        grain: Fewest items worth a slice of their own, for kernels whose items are large; 0 for the usual.
    """
    if count == 0:
        return
    load_module(kernel.module, device)
    if device.is_cuda:
        _launch_slice(kernel, 0, count, inputs, outputs, device)
        return
    # Warp runs a CPU launch on one thread and lets go of the GIL meanwhile.
    threads = thread_count()
    size = max(grain or MINIMUM_SLICE, -(-count // (threads * SLICES_PER_THREAD)))
    if threads == 1 or count <= size:
        _launch_slice(kernel, 0, count, inputs, outputs, device)
        return
    firsts = iter(range(0, count, size))

    def work() -> None:
        for first in firsts:
            _launch_slice(kernel, first, min(size, count - first), inputs, outputs, device)

    workers = _pool(threads)
    wait_for([workers.submit(work) for _ in range(min(threads, -(-count // size)))], workers.ids)


def _launch_slice(
    kernel: Any, first: int, count: int, inputs: Sequence[Any], outputs: Sequence[Any], device: "wp.Device"
) -> None:
    launch_cache.run(kernel, count, [first, *inputs, *outputs], device, 1 if device.is_cpu else BLOCK_DIM)


def launch_queries(
    kernel: Any,
    points: "wp.array",
    inputs: Sequence[Any],
    outputs: Sequence["wp.array"],
    device: "wp.Device",
    *,
    lower: Any,
    extent: float,
    streams: Sequence["wp.array"] = (),
    group: int = 0,
    flags: Sequence[Any] = (),
) -> None:
    """Run a query kernel over ``points`` in blocks, each in Morton order where that pays.

    Answers do not depend on the order: it only decides which queries share the caches.

    Args:
        kernel: ``(first: int, order, points, *streams, *inputs, *outputs)``; its query is ``order[first + wp.tid()]``.
            Where ``group`` is not 0 it is ``(first: int, group: int, order, points, *streams, *inputs, *outputs)``; its
            queries are ``order[k]`` for ``k`` from ``group * (first + wp.tid())`` on.
        points: Positions (N,) of vec3d that decide the order [world].
        inputs: Arguments that every query shares.
        outputs: Arrays with N rows.
        device: Where the arrays are.
        lower: Lower corner [world] of the box that the order resolves, three numbers; points outside are clamped to it.
        extent: Edge length [world] of that box.
        streams: Further arrays with N rows that go with the points.
        group: Queries of a thread, one after the other; neighbours then start from each other's answers.
        flags: Further outputs, after the others, that all queries share.
    """

    def answer(order: "wp.array", block: "wp.array", rows: list["wp.array"]) -> None:
        inner, outer = rows[: len(streams)], rows[len(streams) :]
        if group:
            groups = -(-len(block) // group)
            launch(kernel, groups, [group, order, block, *inner, *inputs], [*outer, *flags], device, grain=GROUP_GRAIN)
        else:
            launch(kernel, len(block), [order, block, *inner, *inputs], [*outer, *flags], device)

    in_order(answer, points, [*streams, *outputs], device, lower, extent)


def in_order(
    answer: Callable[["wp.array", "wp.array", list["wp.array"]], None],
    points: "wp.array",
    arrays: Sequence["wp.array"],
    device: "wp.Device",
    lower: Any,
    extent: float,
) -> None:
    """``answer(order, points, arrays)`` for blocks of the points and of the arrays that have a row for each."""
    total = len(points)
    for start in range(0, total, BLOCK):
        stop = min(total, start + BLOCK)
        whole = stop - start == total
        block = points if whole else points[start:stop]
        rows = [a if whole else a[start:stop] for a in arrays]
        answer(morton_order(block, lower, extent, device), block, rows)


def morton_order(points: "wp.array", lower: Any, extent: float, device: "wp.Device") -> "wp.array":
    wp = _warp()
    from geokit.core.morton_order_kernels import morton_kernel

    count = len(points)
    if count < MINIMUM_ORDERED:
        return identity(device)
    inverse = 1.0 / extent if extent > 0.0 else 0.0
    frame = [wp.vec3d(*map(float, lower)), wp.float64(inverse)]
    if device.is_cpu:
        return _host_order(points, frame, device)
    # radix_sort_pairs uses the second half of both arrays as scratch space.
    keys = wp.empty(2 * count, dtype=wp.int32, device=device)
    order = wp.empty(2 * count, dtype=wp.int32, device=device)
    launch(morton_kernel, count, [points, *frame], [keys, order], device)
    wp.utils.radix_sort_pairs(keys, order, count, end_bit=30)
    return order


def _host_order(points: "wp.array", frame: list[Any], device: "wp.Device") -> "wp.array":
    """In half the time of one sort of all keys; of a million points, by two threads, in a third."""
    import numpy as np

    from geokit.core import host_pool
    from geokit.core import morton_order_cpu_kernels as kernels
    from geokit.core.counting_sort_cpu_kernels import sum_kernel
    from geokit.core.host_array import HostArray

    count = len(points)
    rows = min(thread_count(), -(-count // ORDER_SHARE))
    share = -(-count // rows)
    counts = HostArray(np.zeros(rows * kernels.BUCKETS, np.int32))
    start = HostArray(np.empty(kernels.BUCKETS + 1, np.int32))
    keys = HostArray(host_pool.empty((count,), np.uint32))
    pairs, spare = (HostArray(host_pool.empty((count,), np.uint64)) for _ in range(2))
    order = host_pool.room(count, _warp().int32, device)
    launch(kernels.count_kernel, rows, [share, points, *frame], [keys, counts], device, grain=1)
    launch(sum_kernel, 1, [rows, kernels.BUCKETS], [counts, start], device)
    launch(kernels.place_kernel, rows, [share, keys, counts], [pairs], device, grain=1)
    grain = BUCKET_GRAIN if rows > 1 else kernels.BUCKETS
    launch(kernels.sort_kernel, kernels.BUCKETS, [start, pairs, spare], [order], device, grain=grain)
    return order


def identity(device: "wp.Device") -> "wp.array":
    """The order of fewer than MINIMUM_ORDERED queries: as they come."""
    return _identity(device.alias)


@functools.lru_cache(maxsize=16)
def _identity(alias: str) -> "wp.array":
    wp = _warp()
    from geokit.core.morton_order_kernels import identity_kernel

    device = wp.get_device(alias)
    order = wp.empty(MINIMUM_ORDERED, dtype=wp.int32, device=device)
    launch(identity_kernel, MINIMUM_ORDERED, [], [order], device)
    return order
