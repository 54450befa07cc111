// Occlusion: the first hit in traversal order ends the ray.
//
// Expects out_occluded. Defines take_hit and finish as raycast_bvh8_cpu.inl describes.
auto take_hit = [&](auto& r, int slot, double, double, double, const auto&) {
    r.winner = slot;
    return true;
};
auto finish = [&](const auto& r) { out_occluded.data[r.id] = r.winner >= 0; };
