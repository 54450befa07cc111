// Links and edges of orientation_kernels.

// Points the link of a point to its root, safely while other threads shorten links. Every link read is that of some
// ancestor with its parity, before or after another thread has shortened it.
static constexpr auto flatten = [](int i, wp::array_t<int64_t>& link) {
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
};

// Sorts `count` values from `begin` on, in place: Shell sort, gaps of Tokuda 1992.
static constexpr auto sort_row = [](int begin, int count, wp::array_t<int64_t>& values) {
    int64_t* const row = values.data + begin;
    int gap = count;
    while (gap > 1) {
        gap = gap <= 32 ? 1 : gap / 9 * 4;
        for (int i = gap; i < count; ++i) {
            const int64_t moving = row[i];
            int j = i;
            for (; j >= gap && row[j - gap] > moving; j -= gap) row[j] = row[j - gap];
            row[j] = moving;
        }
    }
};

// Whether point i, which has the neighbor j, lists their edge. In C++, where the loop over a row is vectorized.
static constexpr auto is_mine = [](const wp::array_t<int>& neighbor, int i, int j) -> bool {
    const int width = neighbor.shape[1];
    if (j < 0 || j == i) return false;
    if (i < j) return true;
    const int* const row = neighbor.data + (int64_t)j * width;
    bool mutual = false;
    for (int k = 0; k < width; ++k) mutual |= row[k] == i;
    return !mutual;
};
