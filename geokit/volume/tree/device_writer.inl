// Nodes and leaves of a grid, written in place: see device_writer_kernels.

// 64 slots of a node: offsets of the children, tiles in between, and a word of the child mask.
static constexpr auto link_word = [](int item, const auto& level, const wp::array_t<int64_t>& parent_keys,
                                     const wp::array_t<int>& first_child, const wp::array_t<int64_t>& child_keys,
                                     const wp::array_t<uint8_t>& state, unsigned long long outside,
                                     unsigned long long inside, wp::array_t<uint8_t>& out_buffer) {
    const int words = 1 << (level.bits - 6);
    const int node = item / words, word = item % words;
    const long long key = parent_keys.data[node] << level.bits | (long long)word << 6;
    int low = first_child.data[node], high = first_child.data[node + 1];
    const int end = high;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (child_keys.data[middle] < key) low = middle + 1;
        else high = middle;
    }
    const long long at = level.begin + node * level.size;
    unsigned char* out = out_buffer.data + at;
    unsigned long long mask = 0;
    for (int slot = 0; slot < 64; ++slot) {
        unsigned long long value = 0;
        if (low < end && child_keys.data[low] == key + slot) {
            mask |= 1ull << slot;
            value = (unsigned long long)(level.child_begin + low * level.child_size - at);
            ++low;
        } else {
            value = state.data && state.data[((long long)item << 6) + slot] == 2 ? inside : outside;
        }
        *(unsigned long long*)(out + level.table + 8ll * (64 * word + slot)) = value;
    }
    *(unsigned long long*)(out + 32 + 8ll * words + 8ll * word) = mask;
};

// Copies a row of 64 values of 32 bits of any type, and their mask.
static constexpr auto copy_plane = [](int plane, long long begin, const wp::array_t<int>& order,
                                      const wp::array_t<int>& values, const wp::array_t<uint64_t>& masks,
                                      wp::array_t<uint8_t>& out_buffer) {
    const int leaf = plane >> 3, x = plane & 7;
    unsigned char* out = out_buffer.data + begin + 2144ll * leaf;
    const unsigned* from = (const unsigned*)values.data + 512ll * order.data[leaf] + 64 * x;
    unsigned* to = (unsigned*)(out + 96) + 64 * x;
    for (int b = 0; b < 64; ++b) to[b] = from[b];
    ((unsigned long long*)(out + 16))[x] = masks.data[8ll * order.data[leaf] + x];
};
