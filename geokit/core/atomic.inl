// Atomic functions: see atomic_kernels. Numbers are int or int64_t; CUDA knows the latter by other names.
#pragma once

// Lowers a number to the minimum of itself and `value`, also while other threads do.
static constexpr auto lower_to = [](auto& values, auto at, auto value) {
    // Looked at first: most values are not lower, and threads that only read do not wait for each other.
    auto* const place = values.data + at;
    decltype(value) seen = *(volatile decltype(value)*)place;
#if defined(__CUDA_ARCH__)
    if (value >= seen) return;
    if constexpr (sizeof(value) == 4) atomicMin(place, value);
    else atomicMin((long long*)place, (long long)value);
#else
    while (value < seen
           && !__atomic_compare_exchange_n(place, &seen, value, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
#endif
};

// Adds to a number and returns its old value.
static constexpr auto add_at = [](auto* place, auto value) -> decltype(value) {
#if defined(__CUDA_ARCH__)
    if constexpr (sizeof(value) == 4) return atomicAdd(place, value);
    else return (int64_t)atomicAdd((unsigned long long*)place, (unsigned long long)value);
#else
    return __atomic_fetch_add(place, value, __ATOMIC_RELAXED);
#endif
};
static constexpr auto add_to = [](auto& values, int at, auto value) { return add_at(values.data + at, value); };
static constexpr auto add_to_cell = [](auto& values, int row, int column, auto value) {
    return add_at(values.data + (int64_t)row * values.shape[1] + column, value);
};

// Joins the sets of a and b in a union-find shared by several threads; the lower root becomes the root of both.
static constexpr auto unite = [](wp::array_t<int>& parent, int a, int b) {
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
};
