"""Runs a kernel of the user on all threads of a CPU at once, or on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from geokit.core import launcher
from geokit.core.base.forks import renew_after_fork
from geokit.core.base.late_warp import wp
from geokit.core.interop.types import Device
from geokit.core.launches import warp_private
from geokit.core.require import require_callable, require_count, require_instance, require_items
from geokit.core.running.thread_placement import Pool
from geokit.errors import InputError

# Size of the barrier's memory in int32: counter and round, each in a cache line that nothing else shares.
MEETING_SIZE = 64
# Default items of a block: two cache lines of floats.
BLOCK = 32


class Team:
    """CPU threads that run a kernel together and can wait for each other inside it; on a GPU, plain launches.

    The kernel's first parameter is its :class:`Share` of the items::

        @wp.kernel
        def scale_kernel(share: gk.threads.Share, factor: float, values: wp.array(dtype=float)):
            for k in range(wp.tid(), share.count, share.step):
                i = gk.threads.item(share, k)
                values[i] *= factor

    All threads of a launch run at the same time, so the kernel may call ``gk.threads.barrier(share)``, and a loop over
    many steps can be one launch. At most one thread runs per block of items. Blocks are dealt to the threads in turn,
    so that expensive items that lie together are spread over all threads. The items of a thread depend only on the
    numbers of items and threads and on the block size.

    Attributes:
        device: The device that kernels run on.
        threads: Number of CPU threads that run a kernel; 1 on a GPU, whose own threads are not counted here.
    """

    def __init__(self, threads: int | None = None, *, device: Device = None) -> None:
        """Create a team; on a CPU its threads start with the first launch.

        Args:
            threads: Number of CPU threads; None for GEOKIT_THREADS, or else the number of processors that this process
                may run on. More threads than processors work, but slowly. Ignored on a GPU.
            device: The device; None for the first GPU if there is one, else the CPU.
        Raises:
            InputError: threads is not a positive whole number, or there is no such device.
        """
        self.device = launcher.resolve_device(device)
        if threads is not None:
            threads = require_count(threads, "threads", 1)
        self.threads = 1 if self.device.is_cuda else threads or launcher.thread_count()
        self._meeting = wp.zeros(MEETING_SIZE, dtype=wp.int32, device=self.device)
        self._after_fork()
        renew_after_fork(self)

    def _after_fork(self) -> None:
        self._meeting.zero_()  # a launch of the parent may have been under way
        # One thread makes the launches, one after the other. The caller's thread must not: if it were interrupted after
        # starting some of the threads only, these would wait at their barrier forever.
        self._first = Pool(1, "geokit-team")
        self._others = ThreadPoolExecutor(max(1, self.threads - 1), thread_name_prefix="geokit-team")

    def record(self, kernel: Any, count: int, inputs: Sequence[object], *, block: int = BLOCK) -> Callable[[], None]:
        """Prepare a launch that is made many times.

        Args:
            kernel: A warp kernel ``(share: gk.threads.Share, *inputs)``.
            count: Number of items. On a GPU each has a thread of its own.
            inputs: Arguments after the share; the returned function keeps them. Arrays are read when the launch is
                made; numbers and structs keep the values that they have now.
            block: Number of consecutive items of one thread. Smaller blocks share cache lines with other threads;
                larger blocks balance the load less evenly.
        Returns:
            A function that makes the launch; on a CPU it returns when all threads are done. Inside a
            ``wp.ScopedCapture`` the launch becomes part of the graph.
        Raises:
            InputError: kernel's first parameter is no Share, count is negative, or block is not positive.
        """
        from geokit.threads._team_kernels import Share

        require_instance(kernel, "kernel", wp.Kernel, "decorate a function with @wp.kernel")
        inputs = require_items(inputs, "inputs")
        parameters = warp_private.parameters(kernel)
        if parameters is not None and (not parameters or parameters[0][1] is not Share):
            raise InputError(f"kernel: the first parameter of {kernel.key} is no gk.threads.Share; put one there")
        count, block = require_count(count, "count", 0, 2**31 - 1), require_count(block, "block", 1, 2**31 - 1)
        if self.device.is_cuda and count == 0:
            return lambda: None  # warp records no launch of nothing
        threads = max(1, min(self.threads, -(-count // block)))
        shares = [Share() for _ in range(threads)]
        for k, share in enumerate(shares):
            share.thread, share.threads, share.meeting = k, threads, self._meeting
            share.count, share.step, share.block = count, count, 1
            if self.device.is_cpu:
                share.count, share.step, share.block = _items_of(k, threads, count, block), 1, block
        items = count if self.device.is_cuda else 1
        try:
            calls = [
                wp.launch(kernel, items, [share, *inputs], device=self.device, record_cmd=True).launch
                for share in shares
            ]
        except Exception as error:  # of warp, which does not know the type of an input
            raise InputError(f"inputs: {kernel.key} cannot take them ({error}); give what follows its share") from error

        def run() -> None:
            if threads == 1:
                calls[0]()
            else:
                self._first.start(self._run_all, [calls], 1).wait(hold=True)

        return run

    def run(self, kernel: Any, count: int, inputs: Sequence[object], *, block: int = BLOCK) -> None:
        """Launch a kernel once. The arguments are those of :meth:`record`.

        Args:
            kernel: A warp kernel ``(share: gk.threads.Share, *inputs)``.
            count: Number of items.
            inputs: Arguments after the share.
            block: Number of consecutive items of one thread.
        Raises:
            InputError: kernel's first parameter is no Share, count is negative, or block is not positive.
        """
        self.record(kernel, count, inputs, block=block)()

    def sequence(self, calls: Sequence[Callable[[], object]]) -> Callable[[], None]:
        """Combine several calls into one function; on a GPU they become a CUDA graph, launched by one driver call.

        The first run makes the calls directly, so that modules are loaded and memory is allocated. On a GPU the second
        run captures them into a graph, and later runs launch the graph.

        Args:
            calls: Recorded launches, and other functions without arguments whose device work can be captured, such as
                copies and ``wp.HashGrid.build``. They run in sequence.
        Returns:
            A function that runs all calls.
        """
        items: list[Any] = require_items(calls, "calls")
        calls = [require_callable(call, "calls") for call in items]
        has_run, graph = False, None

        def run() -> None:
            nonlocal has_run, graph
            if self.device.is_cuda and has_run and graph is None:
                with wp.ScopedCapture(self.device) as capture:
                    _call_all(calls)
                graph = capture.graph
            if graph is not None:
                wp.capture_launch(graph)
            else:
                _call_all(calls)
            has_run = True

        return run

    def _run_all(self, calls: Sequence[Callable[[], None]]) -> None:
        jobs = [self._others.submit(call) for call in calls[1:]]
        calls[0]()
        for job in jobs:
            job.result()


def _call_all(calls: Sequence[Callable[[], object]]) -> None:
    for call in calls:
        call()


def _items_of(thread: int, threads: int, count: int, block: int) -> int:
    """Number of items in the blocks thread, thread + threads, ... of ``count`` items."""
    whole, rest = divmod(count, block)
    turns, left = divmod(whole, threads)
    return turns * block + (block if thread < left else rest if thread == left else 0)
