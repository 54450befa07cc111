// A hit whose distance is refined, if the triangle is a sliver, before the distance is compared with anything.
//
// The leaf's own numbers tell which triangles are slivers, by the ratio of height to longest edge. On a CPU they are
// already a bit of the leaf that the traversal has just read.
//
// Expects refine_sliver.inl; tree; SLIVER, SLOT_WORDS, LEAF_WORDS, HEAD. Defines is_sliver(slot) and refine(start,
// direction, slot, t, v, w).
auto is_sliver = [&](int slot) {
    #if defined(__CUDA_ARCH__)
    const float* const number = tree.leaves.data + SLOT_WORDS * slot;
    return number[14] < SLIVER * number[12];
    #else
    const float* const head = tree.ray_leaves.data + LEAF_WORDS * (wp::int64)(slot >> 3) + HEAD;
    return (((const unsigned*)head)[6] >> 8 >> (slot & 7) & 1u) != 0;
    #endif
};
auto refine = [&](const point& start, const point& direction, int slot, double& t, double& v, double& w) {
    if (is_sliver(slot)) refine_sliver(start, direction, slot, t, v, w);
};
