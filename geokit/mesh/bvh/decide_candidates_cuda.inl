// Decides the nearest of a ray's candidates in float64.
//
// Expects ray_candidates_bvh2_cuda.inl, ray_triangle.inl and refine_sliver.inl; tree, start, direction, t_min, t_max,
// ray, out_t, out_triangle_id, out_barycentric, out_bad; CANDIDATES, IS_SLIVER, UNDECIDED.
if (found[0] == UNDECIDED) {
    out_triangle_id.data[ray] = UNDECIDED;
    out_bad.data[1] = 1;
    return;
}
double best = t_max, weight_b = 0.0, weight_c = 0.0;
int winner = -1;
for (int i = 0; i < CANDIDATES; ++i) {
    if (found[i] < 0) break;
    const int slot = found[i] & ~IS_SLIVER;
    double t, v, w;
    if (!hit_at_all(start, direction, slot, t, v, w)) continue;
    if (slot != found[i]) refine_sliver(start, direction, slot, t, v, w);
    if (t < t_min || t > best) continue;
    // Ties go to the lowest triangle.
    if (t == best && winner >= 0 && tree.slot_triangle.data[slot] > tree.slot_triangle.data[winner]) continue;
    best = t;
    weight_b = v;
    weight_c = w;
    winner = slot;
}
const double none = (double)NAN;
out_t.data[ray] = winner < 0 ? (double)INFINITY : best;
out_triangle_id.data[ray] = winner < 0 ? -1 : tree.slot_triangle.data[winner];
out_barycentric.data[ray] = winner < 0 ? point(none, none, none) : point(1.0 - weight_b - weight_c, weight_b, weight_c);
