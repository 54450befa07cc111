"""Kernel functions of a team: a thread's share of the items, and a barrier."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.

import warp as wp

wp.set_module_options({"enable_backward": False})

# Warp runs a CPU launch on one thread and so has no barrier between CPU threads. Here the last thread to arrive opens
# the next round, and the others wait for it. Counter and round are in separate cache lines. A thread that has polled 50
# times yields its processor, because there may be more threads than processors. The snippet cannot include headers, so
# it declares POSIX's sched_yield by its symbol name.
BARRIER = """
#if !defined(__CUDA_ARCH__)
    if (share.threads > 1) {
        extern int geokit_yield() __asm__("sched_yield");
        int* const arrived = share.meeting.data;
        int* const round = share.meeting.data + 32;
        const int now = __atomic_load_n(round, __ATOMIC_RELAXED);
        if (__atomic_add_fetch(arrived, 1, __ATOMIC_ACQ_REL) == share.threads) {
            __atomic_store_n(arrived, 0, __ATOMIC_RELAXED);
            __atomic_store_n(round, now + 1, __ATOMIC_RELEASE);
        } else {
            for (int looks = 0; __atomic_load_n(round, __ATOMIC_ACQUIRE) == now; ++looks) {
                if (looks >= 50) {
                    geokit_yield();
                } else {
#if defined(__x86_64__)
                    __builtin_ia32_pause();
#elif defined(__aarch64__)
                    __asm__ __volatile__("yield");
#endif
                }
            }
        }
    }
#endif
"""


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


@wp.func_native(snippet=BARRIER)
def barrier(share: Share):
    """Wait until all threads of the team have arrived; afterwards each sees what the others wrote. Call it in a kernel.

    Every thread must call it equally often. On a GPU it does nothing: work that has to wait needs a separate launch.
    """
    ...
