// The nodes of bvh2_cuda_kernels as searches on CUDA read them. CPU branches are for tests, which run a CUDA search there.
#pragma once

struct alignas(16) Node {
    float lx, ly, lz, lX, lY, lZ, rx, ry, rz, rX, rY, rZ;
    int left, right, none[2];
};
static constexpr auto load_node = [](const float* nodes, int node) {
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
static constexpr auto first_slot = [](int leaf) { return (-1 - leaf) >> LEAF_BITS; };
static constexpr auto end_slot = [](int leaf) {
    return ((-1 - leaf) >> LEAF_BITS) + ((-1 - leaf) & ((1 << LEAF_BITS) - 1)) + 1;
};
