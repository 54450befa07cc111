// The k nearest points on a GPU: one thread's traversal of the tree.
//
// Expects nearest_query_cuda.inl, a list (nearest_short_list_cuda.inl or nearest_heap_cuda.inl), tree, LEAF, WIDTH,
// STACK.

auto scan = [&](int leaf) {
    const double* at = tree.positions.data + (size_t)leaf * 3 * LEAF;
    const int* index = tree.index.data + (size_t)leaf * LEAF;
    for (int i = 0; i < LEAF; ++i) {
        const double dx = at[i] - x, dy = at[LEAF + i] - y, dz = at[2 * LEAF + i] - z;
        const double given = (dx * dx + dy * dy) + dz * dz;
        // The rest of the last leaf is NaN: every comparison with it is false.
        if (given <= bound && index[i] != self && before(given, index[i], bound, bound_index)) offer(given, index[i]);
    }
};
auto outside = [](double lower, double upper, double value) {
    const double below = lower - value, above = value - upper;
    const double most = below > above ? below : above;
    return most > 0.0 ? most : 0.0;
};
if (seed >= 0) scan(seed);
int stack[STACK], height = 1;
signed char level[STACK];
double entry[STACK];
stack[0] = 0;
level[0] = (signed char)tree.top;
entry[0] = 0.0;
const bool part = queries.leaves.shape[0] > 0;
int first_leaf = 0, leaf_end = 0;
if (part) {
    // The lowest node above all leaves of the group.
    first_leaf = queries.leaves.data[block][0];
    leaf_end = queries.leaves.data[block][1];
    int l = 1;
    while (first_leaf < leaf_end && first_leaf >> 3 * l != (leaf_end - 1) >> 3 * l) ++l;
    stack[0] = first_leaf >> 3 * l;
    level[0] = (signed char)l;
    if (first_leaf == leaf_end) height = 0;
}
while (height > 0) {
    --height;
    if (entry[height] > bound) continue;
    const int n = stack[height], l = level[height];
    if (l == 0) {
        if (n != seed && before(entry[height], tree.least.data[n], bound, bound_index)) scan(n);
        continue;
    }
    const int node = tree.level_first.data[l] + n;
    const double* side = tree.boxes.data + (size_t)node * 6 * WIDTH;
    const int* least = tree.least.data + (size_t)node * WIDTH;
    const int base = height;
    int from = 0, to = WIDTH - 1;
    if (part) {
        from = (first_leaf >> 3 * (l - 1)) - WIDTH * n;
        to = ((leaf_end - 1) >> 3 * (l - 1)) - WIDTH * n;
        from = from > 0 ? from : 0;
        to = to < WIDTH - 1 ? to : WIDTH - 1;
    }
    for (int j = from; j <= to; ++j) {
        const double dx = outside(side[j], side[24 + j], x), dy = outside(side[8 + j], side[32 + j], y),
                     dz = outside(side[16 + j], side[40 + j], z);
        const double d = (dx * dx + dy * dy) + dz * dz;
        if (!before(d, least[j], bound, bound_index)) continue;
        // The nearest child is pushed last; among equals, the first.
        int at = height++;
        for (; at > base && entry[at - 1] <= d; --at) {
            entry[at] = entry[at - 1];
            stack[at] = stack[at - 1];
            level[at] = level[at - 1];
        }
        entry[at] = d;
        stack[at] = WIDTH * n + j;
        level[at] = (signed char)(l - 1);
    }
}
finish();
