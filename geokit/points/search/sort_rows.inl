// Rows of neighbors are sorted in place: Shell sort, gaps of Tokuda 1992.
//
// In C++, because warp accesses arrays through their strides: the same loop takes 1.7 times as long on a CPU.
#pragma once

// before(d, i, e, j): whether an entry with value d and key i comes before one with e and j.
static constexpr auto sort_by = [](int* key, auto* value, int count, auto before) {
    int gap = count;
    while (gap > 1) {
        gap = gap <= 32 ? 1 : gap / 9 * 4;
        for (int i = gap; i < count; ++i) {
            // Rows by index are nearly in order.
            if (!before(value[i], key[i], value[i - gap], key[i - gap])) continue;
            const int moving = key[i];
            const double moving_value = value[i];
            int j = i;
            do {
                key[j] = key[j - gap];
                value[j] = value[j - gap];
                j -= gap;
            } while (j >= gap && before(moving_value, moving, value[j - gap], key[j - gap]));
            key[j] = moving;
            value[j] = moving_value;
        }
    }
};

// By ascending index.
static constexpr auto sort_row = [](int* key, auto* value, int count) {
    sort_by(key, value, count, [](double, int i, double, int j) { return i < j; });
};

// The `count` neighbors from `begin` on by ascending (distance, index).
static constexpr auto by_distance = [](int begin, int count, wp::array_t<int>& index, wp::array_t<double>& distance) {
    sort_by(index.data + begin, distance.data + begin, count,
            [](double d, int i, double e, int j) { return d < e || (d == e && i < j); });
};

// By ascending index, with the 32 threads of a CUDA warp: each counts the smaller entries for every entry it holds. On
// a CPU there is one thread: the first of the 32 items sorts the row.
static constexpr auto sort_together = [](int begin, int count, int lane, wp::array_t<int>& index,
                                         wp::array_t<double>& distance) {
    int* const keys = index.data + begin;
    double* const values = distance.data + begin;
#if defined(__CUDA_ARCH__)
    constexpr int held = 4;
    int mine[held], rank[held];
    double far[held];
    if (count > 32 * held) {
        if (lane == 0) sort_row(keys, values, count);
        return;
    }
    for (int h = 0; h < held; ++h) {
        const int at = lane + 32 * h;
        rank[h] = 0;
        mine[h] = at < count ? keys[at] : 0x7fffffff;
        far[h] = at < count ? values[at] : 0.0;
    }
    for (int h = 0; 32 * h < count; ++h)
        for (int source = 0; source < 32; ++source) {
            const int other = __shfl_sync(0xffffffffu, mine[h], source);
            for (int own = 0; own < held; ++own) rank[own] += other < mine[own];
        }
    // Every entry has been read before any is written.
    __syncwarp();
    for (int h = 0; h < held; ++h)
        if (lane + 32 * h < count) {
            keys[rank[h]] = mine[h];
            values[rank[h]] = far[h];
        }
#else
    if (lane == 0) sort_row(keys, values, count);
#endif
};
