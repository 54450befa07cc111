"""Kernel functions of a team: a thread's share of the items, and a barrier."""

# mypy: ignore-errors

import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Share:
    """One thread's part of a launch; the first parameter of a kernel that a :class:`Team` runs.

    The thread's items are ``gk.threads.item(share, k)`` for ``k`` in ``range(wp.tid(), share.count, share.step)``. On a
    CPU this is a loop over the thread's blocks of items, on a GPU a single item.

    Attributes:
        thread: Index of the CPU thread, from 0; 0 on a GPU.
        threads: Number of CPU threads that share the launch; 1 on a GPU.
        count: End of the loop.
        step: Step of the loop.
        block: Number of consecutive items of one thread; 1 on a GPU.
        meeting: Memory of the barrier.
    """

    thread: int
    threads: int
    count: int
    step: int
    block: int
    meeting: wp.array(dtype=wp.int32)


@wp.func
def item(share: Share, k: int):
    """Index of item ``k`` of this share; call it in a kernel."""
    return (k // share.block * share.threads + share.thread) * share.block + k % share.block


@cpp.func_native("threads/team_cpu.inl")
def barrier(share: Share):
    """Wait until all threads of the team have arrived; afterwards each sees what the others wrote. Call it in a kernel.

    Every thread must call it equally often. On a GPU it does nothing: work that has to wait needs a separate launch.
    """
    ...
