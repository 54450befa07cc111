// 64 slots of a node: offsets of the children, tiles in between, and a word of the child mask.
//
// Expects item, level, parent_keys, first_child, child_keys, state, outside, inside, out_buffer.

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
