"""One kernel of the user's on all threads of a CPU at once, or on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from geokit.core import launcher
from geokit.errors import InputError

__all__ = ["Team"]

# Counter and round of the barrier, each in a cache line of its own, and no line of anyone else's.
MEETING_SIZE = 64
# Of floats, two cache lines.
BLOCK = 32


class Team:
    """Threads of a CPU that run a kernel together and can wait for each other in it; on a GPU, plain launches.

    The kernel's first parameter is its :class:`Share` of the items::

        @wp.kernel
        def scale_kernel(share: gk.threads.Share, factor: float, values: wp.array(dtype=float)):
            for k in range(wp.tid(), share.count, share.step):
                i = gk.threads.item(share, k)
                values[i] *= factor

    All threads of a launch run at the same time, so that ``gk.threads.barrier(share)`` may stand in the kernel: a loop
    over many steps is then one launch. No more threads run than there are blocks of items. Which items a thread has
    depends on nothing but their number and that of the threads: every so many blocks of rows, so that dear items that
    lie together are shared by all.

    Attributes:
        device: Where the kernels run.
        threads: How many run a kernel on a CPU; 1 on a GPU, whose own threads are not counted here.
    """

    def __init__(self, threads: int | None = None, *, device: Any = None) -> None:
        """Make a team; on a CPU its threads start with its first launch.

        Args:
            threads: How many; None for GEOKIT_THREADS, or the processors that this process may run on. More than
                there are processors work, slowly. A GPU pays no heed to it.
            device: None for the first GPU if there is one, else the CPU.
        Raises:
            InputError: threads is not a positive whole number, or there is no such device.
        """
        import warp as wp

        self.device = launcher.resolve_device(device)
        if threads is not None and (isinstance(threads, bool) or not isinstance(threads, int) or threads < 1):
            raise InputError(f"threads: {threads!r} is not a positive whole number; leave it out for all processors")
        self.threads = 1 if self.device.is_cuda else threads or launcher.thread_count()
        self._meeting = wp.zeros(MEETING_SIZE, dtype=wp.int32, device=self.device)
        # The first has one launch after the other. It is not the user's thread: were that interrupted between the
        # starts of two threads, those that had begun would wait at their barrier for ever.
        self._first = ThreadPoolExecutor(1, thread_name_prefix="geokit-team")
        self._others = ThreadPoolExecutor(max(1, self.threads - 1), thread_name_prefix="geokit-team")

    def record(self, kernel: Any, count: int, inputs: Sequence[Any], *, block: int = BLOCK) -> Callable[[], None]:
        """Prepare a launch that will be made again and again.

        Args:
            kernel: A warp kernel ``(share: gk.threads.Share, *inputs)``.
            count: Number of items. On a GPU there is a thread for each.
            inputs: Arguments after the share, kept with the function. What arrays hold counts when the launch is made;
                numbers and structs must stay as they are now.
            block: Items in a row that are one thread's. Fewer share their cache lines with other threads' items, more
                are shared out less evenly.
        Returns:
            A function that makes the launch; on a CPU it returns when all threads are done. In a
            ``wp.ScopedCapture`` it becomes part of the graph.
        Raises:
            InputError: kernel's first parameter is no Share, count is negative, or block is not positive.
        """
        import warp as wp

        from geokit.threads._team_kernels import Share

        arguments = kernel.adj.args
        if not arguments or arguments[0].type is not Share:
            raise InputError(f"kernel: the first parameter of {kernel.key} is no gk.threads.Share; put one there")
        if count < 0 or block < 1:
            raise InputError(f"count, block: {count} and {block}; give 0 items or more, in blocks of 1 or more")
        threads = max(1, min(self.threads, -(-count // block)))
        shares = [Share() for _ in range(threads)]
        for k, share in enumerate(shares):
            share.thread, share.threads, share.meeting = k, threads, self._meeting
            share.count, share.step, share.block = count, count, 1
            if self.device.is_cpu:
                share.count, share.step, share.block = _items_of(k, threads, count, block), 1, block
        items = count if self.device.is_cuda else 1
        calls = [
            wp.launch(kernel, items, [share, *inputs], device=self.device, record_cmd=True).launch for share in shares
        ]

        def run() -> None:
            if threads == 1:
                calls[0]()
            else:
                self._first.submit(self._run_all, calls).result()

        return run

    def run(self, kernel: Any, count: int, inputs: Sequence[Any], *, block: int = BLOCK) -> None:
        """Launch once: :meth:`record`, which says what to give, and what that returns.

        Raises:
            InputError: kernel's first parameter is no Share, count is negative, or block is not positive.
        """
        self.record(kernel, count, inputs, block=block)()

    def sequence(self, calls: Sequence[Callable[[], Any]]) -> Callable[[], None]:
        """Make one function of several; on a GPU it becomes a CUDA graph, which starts with one call of the driver.

        The first run makes the calls as they are, so that modules are loaded and memory is reserved; on a GPU the
        second captures them, and later ones launch the graph.

        Args:
            calls: Recorded launches, and other functions without arguments whose work on the device may be captured:
                copies, ``wp.HashGrid.build``. They run one after the other.
        Returns:
            A function that makes all calls.
        """
        import warp as wp

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


def _call_all(calls: Sequence[Callable[[], Any]]) -> None:
    for call in calls:
        call()


def _items_of(thread: int, threads: int, count: int, block: int) -> int:
    """How many items are in the blocks thread, thread + threads, ... of so many items in all."""
    whole, rest = divmod(count, block)
    turns, left = divmod(whole, threads)
    return turns * block + (block if thread < left else rest if thread == left else 0)
