// Builds one subtree. Its nodes get numbers from node_base on, parents before children. Its leaves are written from
// position `begin` on, which has room for one leaf per reference.
//
// Expects build_bvh8_cpu.inl; subtree, begin, end, start_depth, node_base, children, leaf_begin, leaf_end, out_size;
// WIDTH, STACK, HALVING_DEPTH, NO_CHILD.
#if !defined(__CUDA_ARCH__)
Range root;
root.begin = begin;
root.end = end;
bound(root);
int nodes = 0, leaves = 0;
auto leaf = [&](const Range& r) {
    leaf_begin.data[begin + leaves] = r.begin;
    leaf_end.data[begin + leaves] = r.end;
    return -1 - leaves++;
};
if (end - begin <= WIDTH) leaf(root);
else {
    Range waiting[STACK];
    int number[STACK], depth[STACK], height = 1;
    waiting[0] = root;
    number[0] = nodes++;
    depth[0] = start_depth;
    while (height > 0) {
        --height;
        const int node = number[height], level = depth[height];
        const Range range = waiting[height];
        Range child[WIDTH];
        const int found = open(range, level >= HALVING_DEPTH, child);
        write(node_base + node, child, found);
        for (int c = 0; c < WIDTH; ++c) {
            int value = NO_CHILD;
            if (c < found && child[c].end - child[c].begin <= WIDTH) value = leaf(child[c]);
            else if (c < found) {
                waiting[height] = child[c];
                depth[height] = level + 1;
                number[height++] = value = nodes++;
            }
            children.data[(node_base + node) * WIDTH + c] = value;
        }
    }
}
out_size.data[2 * subtree] = nodes;
out_size.data[2 * subtree + 1] = leaves;
#endif
