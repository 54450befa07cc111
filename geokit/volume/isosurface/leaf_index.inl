// The number of a leaf, from its byte offset.
//
// Expects cells, tree. Defines leaf_index(offset), with the offset from the grid's start.

auto leaf_index = [&](unsigned long long offset) -> int {
    if (tree.leaf_size) return (int)((unsigned)((offset - tree.leaf_begin) >> 5) / (unsigned)(tree.leaf_size >> 5));
    int low = 0, high = cells.leaf_count - 1;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (cells.leaf_offset.data[middle] < offset) low = middle + 1;
        else high = middle;
    }
    return low;
};
