// Visits the triangles of a surface whose boxes overlap a box.
//
// Expects core/simd.inl and load_node_bvh2.inl; tree; low and high (three floats each, local); visit(first), which is
// called with the first slot of each leaf of eight slots on a CPU, and with each slot of a leaf on CUDA; STACK.
{
    int stack[STACK], height = 1;
#if defined(__CUDA_ARCH__)
    auto reaches = [&](float lx, float ly, float lz, float ux, float uy, float uz) {
        return lx <= high[0] && ly <= high[1] && lz <= high[2] && ux >= low[0] && uy >= low[1] && uz >= low[2];
    };
    stack[0] = tree.children.data[0];
    while (height > 0) {
        const int node = stack[--height];
        if (node < 0) {
            for (int first = first_slot(node); first < end_slot(node); ++first) visit(first);
            continue;
        }
        const Node n = load_node(tree.boxes.data, node);
        if (reaches(n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ)) stack[height++] = n.right;
        if (reaches(n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ)) stack[height++] = n.left;
    }
#else
    stack[0] = 0;
    while (height > 0) {
        const int node = stack[--height];
        if (node < 0) {
            visit(8 * (-1 - node));
            continue;
        }
        const v8* side = (const v8*)(tree.boxes.data + 48 * node);
        const auto meets = (side[0] <= high[0]) & (side[1] <= high[1]) & (side[2] <= high[2]) & (side[3] >= low[0])
                           & (side[4] >= low[1]) & (side[5] >= low[2]);
        const int* child = tree.children.data + 8 * node;
        for (unsigned mask = mask_of(meets); mask; mask &= mask - 1) stack[height++] = child[__builtin_ctz(mask)];
    }
#endif
}
