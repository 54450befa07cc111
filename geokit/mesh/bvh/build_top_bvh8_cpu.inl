// Builds the top of the tree: nodes are opened in the order of their numbers until their children hold at most `limit`
// references. Those children are left to build_subtree_bvh8_cpu.inl, as child number -1 - subtree.
//
// Expects build_bvh8_cpu.inl; count, limit, capacity, scratch, children, out_subtree, out_size; WIDTH, HALVING_DEPTH,
// NO_CHILD.
#if !defined(__CUDA_ARCH__)
Range root;
empty(root);
for (int i = 0; i < count; ++i) add(root, i);
root.begin = 0;
root.end = count;
Range* waiting = (Range*)scratch.data;
int* depth = (int*)(waiting + capacity);
int nodes = 1, subtrees = 0;
waiting[0] = root;
depth[0] = 0;
for (int node = 0; node < nodes; ++node) {
    Range child[WIDTH];
    const int found = open(waiting[node], depth[node] >= HALVING_DEPTH, child);
    write(node, child, found);
    for (int c = 0; c < WIDTH; ++c) {
        int number = NO_CHILD;
        if (c < found && child[c].end - child[c].begin > limit && nodes < capacity) {
            waiting[nodes] = child[c];
            depth[nodes] = depth[node] + 1;
            number = nodes++;
        } else if (c < found) {
            out_subtree.data[3 * subtrees] = child[c].begin;
            out_subtree.data[3 * subtrees + 1] = child[c].end;
            out_subtree.data[3 * subtrees + 2] = depth[node] + 1;
            number = -1 - subtrees++;
        }
        children.data[node * WIDTH + c] = number;
    }
}
out_size.data[0] = nodes;
out_size.data[1] = subtrees;
#endif
