// Loads a node of the tree that bvh2_packed_cuda_kernels writes.
//
// Expects tree; NODE_FLOATS, LEAF_BITS, MANY, SLOT_WORDS. Defines Node, load_node(nodes, node), first_slot(child) and
// end_slot(child) of a child that is a leaf. The CPU branch is for tests, which run a CUDA search there.
struct alignas(16) Node {
    float lx, ly, lz, lX, lY, lZ, rx, ry, rz, rX, rY, rZ;
    int left, right, none[2];
};
auto load_node = [](const float* nodes, int node) {
    Node n;
    #if defined(__CUDA_ARCH__)
    const float4* from = (const float4*)(nodes + NODE_FLOATS * node);
    float4* to = (float4*)&n;
    to[0] = __ldg(from);
    to[1] = __ldg(from + 1);
    to[2] = __ldg(from + 2);
    to[3] = __ldg(from + 3);
    #else
    n = *(const Node*)(nodes + NODE_FLOATS * node);
    #endif
    return n;
};
auto first_slot = [](int leaf) { return (-1 - leaf) >> LEAF_BITS; };
auto end_slot = [&](int leaf) {
    const int first = (-1 - leaf) >> LEAF_BITS, count = ((-1 - leaf) & MANY - 1) + 1;
    return first + (count < MANY ? count : ((const int*)tree.leaves.data)[SLOT_WORDS * (first + 1) - 1]);
};
