"""Connected components by union and find, all links at once.

``label`` holds a forest: each node's parent, which is never above it, and itself for a root. A root only ever gets a
lower root as its parent, so that what is left in the end is the lowest node of each component, in whatever order the
links were taken.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})


# Warp's atomic functions are plain reads and writes on a CPU, where slices of a launch run on several threads.
@wp.func_native(
    """
    int* const parent = label.data;
#if defined(__CUDA_ARCH__)
    auto read = [parent](int i) { return atomicAdd(parent + i, 0); };
    auto swap = [parent](int i, int from, int to) { return atomicCAS(parent + i, from, to); };
#else
    auto read = [parent](int i) { return __atomic_load_n(parent + i, __ATOMIC_RELAXED); };
    auto swap = [parent](int i, int from, int to) {
        __atomic_compare_exchange_n(parent + i, &from, to, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED);
        return from;
    };
#endif
    // Halves the path on the way: whoever loses a race leaves a parent that is still one.
    auto root = [&read, &swap](int i) {
        int above = read(i);
        while (above != i) {
            const int beyond = read(above);
            if (beyond != above) swap(i, above, beyond);
            i = above;
            above = beyond;
        }
        return i;
    };
    while (true) {
        a = root(a);
        b = root(b);
        if (a == b) return;
        if (a < b) { const int t = a; a = b; b = t; }
        // Where another thread was quicker a is no root any more, and the search goes on from there.
        if (swap(a, a, b) == a) return;
    }
    """
)
def join(label: wp.array(dtype=wp.int32), a: wp.int32, b: wp.int32): ...


@wp.kernel
def join_kernel(
    first: int,
    one: wp.array(dtype=wp.int32),
    other: wp.array(dtype=wp.int32),
    out_label: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    join(out_label, one[i], other[i])


@wp.kernel
def lowest_kernel(first: int, label: wp.array(dtype=wp.int32), out_label: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    node = label[i]
    while label[node] != node:
        node = label[node]
    out_label[i] = node
