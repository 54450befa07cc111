// Writes a pair of triangles; within one surface, the lower one first.
//
// Expects at (the position), itself, surface, tree, out_pairs. Defines append_pair(slot, other).
auto append_pair = [&](int slot, int other) {
    const int one = surface.slot_triangle.data[slot], another = tree.slot_triangle.data[other];
    const bool turned = itself && one > another;
    out_pairs.data[2 * at] = turned ? another : one;
    out_pairs.data[2 * at++ + 1] = turned ? one : another;
};
