"""Launches kernels: devices, CPU threads, query order, chunks, and notice of compilation.

All kernels of the package are launched here, except those of :mod:`geokit.threads`.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from geokit.core import kernel_cache
from geokit.core.base.forks import register_at_fork
from geokit.core.base.late_warp import wp
from geokit.core.launches import prepared, warp_private
from geokit.core.memory import needs
from geokit.core.memory.unchecked import sort_pairs
from geokit.core.require import described
from geokit.core.running.thread_placement import Pool
from geokit.errors import InputError

# As a device: all CUDA devices.
ALL_GPUS = "cuda:*"

# A launch costs about 30 us of Python; shorter slices would spend more time on launching than on work.
MINIMUM_SLICE = 512
# More slices than threads, so that a slice of expensive queries does not delay the whole launch.
SLICES_PER_THREAD = 8
# Fewest groups of queries that are worth a slice.
GROUP_GRAIN = 16
# Sorting fewer queries than this costs more than their order saves.
MINIMUM_ORDERED = 2048
# Points that one thread sorts as fast as two, because waking a thread takes as long as it saves.
ORDER_SHARE = 1 << 18
# Fewest buckets of points that are worth a slice.
BUCKET_GRAIN = 64
# Threads of a block on a GPU. A block is resident until its slowest thread is done: queries are 5% faster than with
# blocks of 256, and no faster with smaller ones (measured on an H100).
BLOCK_DIM = 128
# Queries per launch. This bounds the memory of keys and order (16 bytes each, twice, or 24 on a CPU) to 128 MiB.
BLOCK = 1 << 22
# What is said before the first compilation of a process. The command line adds a line for each module.
COMPILE_NOTICE = "compiling kernels: some seconds at the first call of each kind, once; they are kept in %s"

# Share of a GPU's memory that warp's pool keeps after arrays are freed. By default it returns all to the driver, and
# allocating the arrays of four million answers again takes a third of a millisecond, of a query that takes one.
POOL_SHARE = 0.25

_loaded: set[tuple[str, str]] = set()
# A fork waits until no module is being loaded: the compiler's own locks cannot be made anew in the child.
_load_lock = threading.RLock()
# True in a forked child of a process that had initialized CUDA: the driver refuses to work there.
_has_lost_cuda = False
_compile_listener: Callable[[str], None] | None = None
_log = logging.getLogger("geokit")


@functools.lru_cache(maxsize=1)
def _warp() -> Any:
    import warp

    def init() -> None:
        with _quiet(warp), _silenced_stderr():
            warp.init()
        gpus = warp.get_cuda_devices()
        if gpus:
            needs.be_a_guest(warp_private.native_library(), gpus)

    kernel_cache.initialize(warp, init)
    return warp


@contextlib.contextmanager
def _quiet(wp: Any) -> Iterator[None]:
    """Suppress warp's banner and load messages, then restore the user's log level."""
    level = wp.config.log_level
    wp.config.log_level = max(level, logging.WARNING)
    try:
        yield
    finally:
        wp.config.log_level = level


@contextlib.contextmanager
def _silenced_stderr() -> Iterator[None]:
    """Redirect descriptor 2 to os.devnull: warp's native code reports a missing CUDA driver there, past sys.stderr."""
    try:
        saved = os.dup(2)
    except OSError:  # the process has no stderr
        yield
        return
    try:
        with open(os.devnull, "wb") as null:
            os.dup2(null.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def cuda_devices() -> list[str]:
    """Aliases of the usable CUDA devices."""
    return [device.alias for device in _warp().get_cuda_devices()]


needs.loaders.append(cuda_devices)


def is_several(device: Any) -> bool:
    """Whether a device is a list of them, or all GPUs."""
    return isinstance(device, (list, tuple)) or (isinstance(device, str) and device == ALL_GPUS)


def resolve_device(device: Any = None) -> "wp.Device":
    """The warp device for an alias ("cpu", "cuda:0"), a device of warp, torch, jax or CuPy, or None.

    None is the first GPU, else the CPU.

    Raises:
        InputError: There is no such device; the message lists the existing ones.
    """
    wp = _warp()
    if is_several(device):
        what = repr(ALL_GPUS) if isinstance(device, str) else "a list"
        raise InputError(f"device: {what} is for Surface, NeighborGrid and queries of volumes; give one device here")
    if device is None:
        gpus = wp.get_cuda_devices()
        device = gpus[0] if gpus else "cpu"
    try:
        # Asked for the current GPU where there is none, warp's native code prints what the driver says.
        if isinstance(device, str) and device == "cuda" and not wp.get_cuda_devices():
            raise LookupError("no GPU")
        found = wp.get_device(_alias_of(device))
    except Exception as error:  # of warp, or of the caller's own type
        names = ", ".join(["cpu", *cuda_devices()])
        raise InputError(f"device: {described(device)} is not on this machine; use one of {names}") from error
    if found.is_cuda:
        _require_cuda()
        _keep_pool(found.alias)
    return found


def _alias_of(device: Any) -> Any:
    """Warp's alias for a device of torch, jax or CuPy; anything else as it is."""
    library = type(device).__module__.partition(".")[0]
    if library == "torch":
        kind, number = device.type, device.index
    elif library in ("jax", "jaxlib"):
        kind, number = device.platform, device.local_hardware_id
    elif library == "cupy":
        kind, number = "cuda", device.id
    else:
        return device
    kind = "cuda" if kind == "gpu" else kind
    return kind if kind == "cpu" or number is None else f"{kind}:{number}"


def device_or_default(alias: str) -> str:
    """The alias itself if there is such a device here, else that of the default device; for what was pickled."""
    return alias if alias in ("cpu", *cuda_devices()) else str(resolve_device().alias)


@functools.lru_cache(maxsize=16)
def _keep_pool(device: str) -> None:
    """Make warp's pool of the device keep freed memory; a larger threshold set by the user stays."""
    wp = _warp()
    kept = int(POOL_SHARE * wp.get_device(device).total_memory)
    if wp.is_mempool_enabled(device) and wp.get_mempool_release_threshold(device) < kept:
        wp.set_mempool_release_threshold(device, kept)


def _require_cuda() -> None:
    if _has_lost_cuda:
        raise InputError(
            "device: CUDA does not work in a process forked from one that has used it; "
            "start workers by 'spawn' (multiprocessing.get_context), or pass device='cpu'"
        )


def _after_fork() -> None:
    """In a forked child: forget the thread pools, whose threads were not copied, and CUDA."""
    global _has_lost_cuda
    _pool.cache_clear()
    _has_lost_cuda = bool(_warp.cache_info().currsize and _warp().get_cuda_device_count())


def thread_count() -> int:
    """Number of CPU threads for kernels: GEOKIT_THREADS, else the processors that this process may run on.

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


# The lock's own methods: an interrupt between two of Python would leave it taken.
register_at_fork(before=_load_lock.acquire, after_in_parent=_load_lock.release, after_in_child=_load_lock.release)
register_at_fork(after_in_child=_after_fork)


def pool() -> Pool:
    """The thread pool that runs the slices of CPU launches."""
    return _pool(thread_count())


def on_compile(listener: Callable[[str], None] | None) -> Callable[[str], None] | None:
    """Set ``listener(module_name)``, called before a kernel module is compiled rather than read from the cache.

    Without a listener the log says once that kernels are being compiled; Python prints that to stderr unless logging is
    configured.

    Returns:
        The listener before, for those who set theirs for a while.
    """
    global _compile_listener
    before, _compile_listener = _compile_listener, listener
    return before


def compile_notice() -> str:
    """What to tell people before the first kernels are compiled."""
    return COMPILE_NOTICE % _warp().config.kernel_cache_dir


@functools.cache
def _log_compiling() -> None:
    _log.warning("geokit: %s", compile_notice())


def load_module(module: Any, device: "wp.Device") -> None:
    """Compile or load a kernel module before its first launch, so that the slices of a launch do not each try to."""
    key = (module.name, device.alias)
    if key in _loaded:
        return
    with _load_lock:
        if key in _loaded:
            return
        # Wheels bring no objects of these for GPUs.
        assert device.is_cpu or "_cpu_kernels" not in module.name, f"{module.name} on {device}"
        with _quiet(_warp()):
            # CPU launches have blocks of one thread. Another block size would compile the module again.
            announce = _compile_listener or (lambda _: _log_compiling())
            kernel_cache.load(module, device, 1 if device.is_cpu else BLOCK_DIM, announce)
        _loaded.add(key)


def launch(
    kernel: Any, count: int, inputs: Sequence[Any], outputs: Sequence[Any], device: "wp.Device", *, grain: int = 0
) -> None:
    """Run ``kernel`` for the items ``0 .. count - 1``; on a CPU in slices, which the threads of a pool take in turn.

    Args:
        kernel: A warp kernel ``(first: int, *inputs, *outputs)``. ``first`` is the first item of the slice; a thread's
            item is ``first + wp.tid()``.
        count: Number of items, below 2^31.
        inputs: Arguments after ``first``.
        outputs: Arguments after the inputs.
        device: The device of the arrays.
        grain: Fewest items of a slice, for kernels with expensive items; 0 for the default.
    """
    if count == 0:
        return
    load_module(kernel.module, device)
    if device.is_cuda:
        _require_cuda()
        prepared.refuse()
        prepared.bound(kernel, count, [0, *inputs, *outputs], device, BLOCK_DIM)()
        return
    # Warp runs a CPU launch on one thread and releases the GIL, so slices can run side by side.
    threads = thread_count()
    size = max(grain or MINIMUM_SLICE, -(-count // (threads * SLICES_PER_THREAD)))
    if threads == 1 or count <= size:
        arguments = [0, *inputs, *outputs]
        call = prepared.bound(kernel, count, arguments, device, 1)
        if recording := prepared.current():
            recording.launch(call, arguments, outputs, device)
        call()
        return
    prepared.refuse()

    def run_slice(first: int) -> None:
        prepared.bound(kernel, min(size, count - first), [first, *inputs, *outputs], device, 1)()

    _pool(threads).run(run_slice, range(0, count, size), min(threads, -(-count // size)))


def launch_queries(
    kernel: Any,
    points: "wp.array",
    inputs: Sequence[Any],
    outputs: Sequence["wp.array"],
    device: "wp.Device",
    *,
    lower: Any,
    extent: float,
    group: int = 0,
    flags: Sequence[Any] = (),
) -> None:
    """Run a query kernel over ``points`` in chunks; a large chunk is answered in Morton order.

    Answers do not depend on the order; it only decides which queries share the caches.

    Args:
        kernel: ``(first: int, order, points, *inputs, *outputs)``; its query is ``order[first + wp.tid()]``.
            Where ``group`` is not 0 it is ``(first: int, group: int, order, points, *inputs, *outputs)``; its
            queries are ``order[k]`` for the ``group`` values of ``k`` from ``group * (first + wp.tid())`` on.
        points: Positions (N,) of vec3d that decide the order [world].
        inputs: Arguments that all queries share.
        outputs: Arrays with N rows.
        device: The device of the arrays.
        lower: Lower corner [world] of the box that the Morton keys resolve, three numbers; points outside are clamped.
        extent: Edge length [world] of that box.
        group: Queries that one thread answers in sequence, each starting from its neighbor's answer; 0 for one each.
        flags: Further outputs, after the others, that all queries share.
    """
    total = len(points)
    for start in range(0, total, BLOCK):
        stop = min(total, start + BLOCK)
        block, *rows = (a if stop - start == total else a[start:stop] for a in (points, *outputs))
        order = morton_order(block, lower, extent, device)
        arguments, results = [order, block, *inputs], [*rows, *flags]
        if group:
            groups = -(-len(block) // group)
            launch(kernel, groups, [group, *arguments], results, device, grain=GROUP_GRAIN)
        else:
            launch(kernel, len(block), arguments, results, device)


def morton_order(points: "wp.array", lower: Any, extent: float, device: "wp.Device") -> "wp.array":
    """Indices that put ``points`` in Morton order; the identity for fewer than MINIMUM_ORDERED points."""
    wp = _warp()
    from geokit.core.morton_order_kernels import morton_kernel

    count = len(points)
    if count < MINIMUM_ORDERED:
        return identity(device)
    inverse = 1.0 / extent if extent > 0.0 else 0.0
    frame = [wp.vec3d(*map(float, lower)), wp.float64(inverse)]
    if device.is_cpu:
        return _morton_order_cpu(points, frame, device)
    # radix_sort_pairs uses the second half of both arrays as scratch memory.
    keys = wp.empty(2 * count, dtype=wp.int32, device=device)
    order = wp.empty(2 * count, dtype=wp.int32, device=device)
    launch(morton_kernel, count, [points, *frame], [keys, order], device)
    sort_pairs(keys, order, count, end_bit=30)
    return order


def _morton_order_cpu(points: "wp.array", frame: list[Any], device: "wp.Device") -> "wp.array":
    """Morton order by a counting sort into buckets, then a sort of each bucket.

    It takes half the time of one sort of all keys; for a million points and two threads, a third.
    """
    from geokit.core import morton_order_cpu_kernels as kernels
    from geokit.core.memory import host_pool
    from geokit.core.memory.host_array import HostArray
    from geokit.core.sorting.counting_sort_cpu_kernels import sum_kernel

    count = len(points)
    rows = min(thread_count(), -(-count // ORDER_SHARE))
    share = -(-count // rows)
    counts = HostArray(np.zeros(rows * kernels.BUCKETS, np.int32))
    start = HostArray(np.empty(kernels.BUCKETS + 1, np.int32))
    keys = HostArray(host_pool.empty((count,), np.uint32))
    pairs, spare = (HostArray(host_pool.empty((count,), np.uint64)) for _ in range(2))
    order = host_pool.empty_warp(count, _warp().int32, device)
    launch(kernels.count_kernel, rows, [share, points, *frame], [keys, counts], device, grain=1)
    launch(sum_kernel, 1, [rows, kernels.BUCKETS], [counts, start], device)
    launch(kernels.place_kernel, rows, [share, keys, counts], [pairs], device, grain=1)
    grain = BUCKET_GRAIN if rows > 1 else kernels.BUCKETS
    launch(kernels.sort_kernel, kernels.BUCKETS, [start, pairs, spare], [order], device, grain=grain)
    return order


def identity(device: "wp.Device") -> "wp.array":
    """The identity order, used for fewer than MINIMUM_ORDERED queries."""
    return _identity(device.alias)


@functools.lru_cache(maxsize=16)
def _identity(alias: str) -> "wp.array":
    wp = _warp()
    from geokit.core.morton_order_kernels import identity_kernel

    device = wp.get_device(alias)
    order = wp.empty(MINIMUM_ORDERED, dtype=wp.int32, device=device)
    launch(identity_kernel, MINIMUM_ORDERED, [], [order], device)
    return order
