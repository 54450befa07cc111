// Decides in float64 whether a ray hits one of its candidates.
//
// Expects ray_candidates_bvh2_cuda.inl with ANY_HIT, ray_triangle.inl and refine_sliver.inl; tree, start, direction,
// t_min, t_max, ray, out_occluded, out_bad; CANDIDATES, IS_SLIVER, UNDECIDED, SURE, LEFT_OVER.
if (found[0] == UNDECIDED) {
    ((unsigned char*)out_occluded.data)[ray] = LEFT_OVER;
    out_bad.data[1] = 1;
    return;
}
bool is_hit = found[0] == SURE;
for (int i = 0; i < CANDIDATES && !is_hit; ++i) {
    if (found[i] < 0) break;
    const int slot = found[i] & ~IS_SLIVER;
    double t, v, w;
    if (!hit_at_all(start, direction, slot, t, v, w)) continue;
    if (slot != found[i]) refine_sliver(start, direction, slot, t, v, w);
    is_hit = t >= t_min && t <= t_max;
}
out_occluded.data[ray] = is_hit;
