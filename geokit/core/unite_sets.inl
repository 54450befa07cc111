// Joins the sets of a and b in a union-find shared by several threads; the lower root becomes the root of both.
//
// Expects parent, a, b. warp's atomics are plain reads and writes on a CPU, where geokit splits a launch over several
// threads.

#if defined(__CUDA_ARCH__)
auto load = [](int* at) { return *(volatile int*)at; };
auto store = [](int* at, int value) { *(volatile int*)at = value; };
auto swapped = [](int* at, int old, int value) { return atomicCAS(at, old, value) == old; };
#else
auto load = [](int* at) { return __atomic_load_n(at, __ATOMIC_RELAXED); };
auto store = [](int* at, int value) { __atomic_store_n(at, value, __ATOMIC_RELAXED); };
auto swapped = [](int* at, int old, int value) {
    return __atomic_compare_exchange_n(at, &old, value, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED);
};
#endif
int* const up = parent.data;
auto root = [&](int x) {
    for (;;) {
        const int above = load(up + x);
        if (above == x) return x;
        const int next = load(up + above);
        if (next != above) store(up + x, next);
        x = next;
    }
};
for (;;) {
    a = root(a);
    b = root(b);
    if (a == b) return;
    if (a < b) {
        const int c = a;
        a = b;
        b = c;
    }
    if (swapped(up + a, a, b)) return;
}
