"""The team as a kernel sees it: the items of its share, and a barrier."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.

import warp as wp

from geokit.core.cpp import cpp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Share:
    """A thread's own part of a launch; the first parameter of a kernel that a :class:`Team` runs.

    Its items are ``gk.threads.item(share, k)`` for each of ``range(wp.tid(), share.count, share.step)``: on a CPU a
    loop over the blocks of rows that are this thread's, on a GPU one item.

    Attributes:
        thread: Number of the thread of a CPU, from 0 on; 0 on a GPU.
        threads: Threads of a CPU that share the launch; 1 on a GPU.
        count: End of the loop.
        step: Step of the loop.
        block: Rows that follow each other and are one thread's; 1 on a GPU.
        meeting: Of the barrier.
    """

    thread: int
    threads: int
    count: int
    step: int
    block: int
    meeting: wp.array(dtype=wp.int32)


@wp.func
def item(share: Share, k: int):
    """In a kernel: the item that is number k of this share."""
    return (k // share.block * share.threads + share.thread) * share.block + k % share.block


@wp.func_native(cpp("threads/barrier_cpu.inl"))
def barrier(share: Share):
    """In a kernel: wait until all threads of the team are here; all then see what any of them has written.

    Every thread has to pass it equally often. On a GPU it does nothing: work that has to wait needs a launch of its
    own.
    """
    ...
