// First hits: take_hit keeps the nearest hit of a ray, finish writes it.
//
// Expects tree, out_t, out_triangle_id, out_barycentric. Defines take_hit and finish as raycast_bvh8_cpu.inl describes.
auto take_hit = [&](auto& r, int slot, double t, double v, double w, const auto& shorten) {
    // Ties go to the lowest triangle: the answer must not depend on the traversal order.
    if (t == r.best && r.winner >= 0 && tree.slot_triangle.data[slot] > tree.slot_triangle.data[r.winner]) return false;
    r.best = t;
    r.weight_b = v;
    r.weight_c = w;
    r.winner = slot;
    shorten(r);
    return false;
};
auto finish = [&](const auto& r) {
    const double none = (double)NAN;
    const bool missed = r.winner < 0;
    out_t.data[r.id] = missed ? (double)INFINITY : r.best;
    out_triangle_id.data[r.id] = missed ? -1 : tree.slot_triangle.data[r.winner];
    out_barycentric.data[r.id] =
        missed ? point(none, none, none) : point(1.0 - r.weight_b - r.weight_c, r.weight_b, r.weight_c);
};
