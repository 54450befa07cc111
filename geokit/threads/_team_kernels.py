"""What a kernel sees of its team: which items are its own, and how it waits for the other threads."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.

import warp as wp

wp.set_module_options({"enable_backward": False})

# Warp has no barrier between threads of a CPU, since it has no such threads. The last to arrive opens the next round,
# which the others wait for; counter and round lie in cache lines of their own. Who has waited in vain for long, since
# there are more threads than processors, lets others run. A kernel's text cannot include headers: sched_yield, which
# is POSIX, is declared by its name in the library.
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


@wp.func_native(snippet=BARRIER)
def barrier(share: Share):
    """In a kernel: wait until all threads of the team are here; what any of them has written, all see.

    Every thread has to pass it equally often. On a GPU it does nothing: there, what has to wait is a launch of its own.
    """
    ...
