// Builds the top of a tree: nodes are opened in the order of their numbers until their children hold at most `limit`
// references. Those children are left to build_subtree_bvh8_cpu.inl, as child number -1 - subtree.
//
// Expects build_bvh8_cpu.inl; tree, begin, end (its references), base (its first place for nodes), limit, capacity,
// scratch, children, out_subtree, out_size; WIDTH, HALVING_DEPTH, NO_CHILD, WAITING_WORDS.
#if !defined(__CUDA_ARCH__)
Range root;
root.begin = begin;
root.end = end;
bound(root);
Range* waiting = (Range*)(scratch.data + (long long)WAITING_WORDS * base);
int* depth = (int*)(waiting + capacity);
int nodes = 1, subtrees = 0;
waiting[0] = root;
depth[0] = 0;
for (int node = 0; node < nodes; ++node) {
    Range child[WIDTH];
    const int found = open(waiting[node], depth[node] >= HALVING_DEPTH, child);
    write(base + node, child, found);
    for (int c = 0; c < WIDTH; ++c) {
        int number = NO_CHILD;
        if (c < found && child[c].end - child[c].begin > limit && nodes < capacity) {
            waiting[nodes] = child[c];
            depth[nodes] = depth[node] + 1;
            number = nodes++;
        } else if (c < found) {
            int* row = out_subtree.data + 3 * (WIDTH * base + subtrees);
            row[0] = child[c].begin;
            row[1] = child[c].end;
            row[2] = depth[node] + 1;
            number = -1 - subtrees++;
        }
        children.data[(base + node) * WIDTH + c] = number;
    }
}
out_size.data[2 * tree] = nodes;
out_size.data[2 * tree + 1] = subtrees;
#endif
