// Points the link of `i` to its root, safely while other threads shorten links.
//
// Expects link, i. Every link read is that of some ancestor with its parity, before or after another thread has
// shortened it.

#if defined(__CUDA_ARCH__)
auto load = [](int64_t* at) { return (int64_t)*(volatile long long*)at; };
auto store = [](int64_t* at, int64_t value) { *(volatile long long*)at = value; };
#else
auto load = [](int64_t* at) { return __atomic_load_n(at, __ATOMIC_RELAXED); };
auto store = [](int64_t* at, int64_t value) { __atomic_store_n(at, value, __ATOMIC_RELAXED); };
#endif
int64_t own = load(link.data + i);
for (;;) {
    const int64_t above = load(link.data + (own >> 1));
    if ((above >> 1) == (own >> 1)) return;
    own = above ^ (own & 1);
    store(link.data + i, own);
}
