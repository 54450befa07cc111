// Lists a ray's crossings in order, by t and then by triangle; by insertion, because rays have few.
//
// The limits of the ray were applied before t is refined, as in the count of the crossings. Expects refine_hit.inl;
// origins, directions, offsets, tree, out_t, out_triangle_id, out_barycentric. Defines take_hit and finish as
// raycast_bvh8_cpu.inl describes.
auto take_hit = [&](auto& r, int slot, double t, double v, double w, const auto&) {
    refine(origins.data[r.id], directions.data[r.id], slot, t, v, w);
    const int triangle = tree.slot_triangle.data[slot];
    const wp::int64 from = offsets.data[r.id];
    wp::int64 place = from + r.count++;
    for (; place > from; --place) {
        const double before = out_t.data[place - 1];
        if (before < t || (before == t && out_triangle_id.data[place - 1] < triangle)) break;
        out_t.data[place] = before;
        out_triangle_id.data[place] = out_triangle_id.data[place - 1];
        out_barycentric.data[place] = out_barycentric.data[place - 1];
    }
    out_t.data[place] = t;
    out_triangle_id.data[place] = triangle;
    out_barycentric.data[place] = point(1.0 - v - w, v, w);
    return false;
};
auto finish = [](const auto&) {};
