// Joins the components of two nodes in a forest of parents that other threads change at the same time.
//
// Expects label, a, b. Warp's atomic functions are plain reads and writes on a CPU, where slices of a launch run on
// several threads.
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
// Halves the path on the way; a thread that loses a race leaves a parent that is still valid.
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
    if (a < b) {
        const int t = a;
        a = b;
        b = t;
    }
    // If another thread was faster, a is no longer a root, and the search goes on from there.
    if (swap(a, a, b) == a) return;
}
