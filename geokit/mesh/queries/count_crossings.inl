// Counts a ray's crossings.
//
// Expects out_count. Defines take_hit and finish as raycast_bvh8_cpu.inl describes.
auto take_hit = [&](auto& r, int, double, double, double, const auto&) {
    ++r.count;
    return false;
};
auto finish = [&](const auto& r) { out_count.data[r.id] = r.count; };
