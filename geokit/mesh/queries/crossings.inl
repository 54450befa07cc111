// All crossings of rays with a surface.
#include "mesh/bvh/ray_walk_cpu.inl"
#include "mesh/bvh/ray_walk_cuda.inl"

// Their number.
static constexpr auto count_crossings = [](int item, int group, const wp::array_t<wp::vec3d>& origins,
                                           const wp::array_t<wp::vec3d>& directions, const SurfaceTree& tree,
                                           double t_min, double max_distance, wp::array_t<int>& out_count,
                                           wp::array_t<int>& out_bad) {
    auto take_hit = [&](auto& r, int, double, double, double, const auto&) {
        ++r.count;
        return false;
    };
    auto finish = [&](const auto& r) { out_count.data[r.id] = r.count; };
    const int begin = item * group, end = wp::min(begin + group, origins.shape[0]);
    walk_rays(tree, origins, directions, begin, end, t_min, max_distance, out_bad, take_hit, finish);
};

// Their list in order, by t and then by triangle; by insertion, because rays have few. The limits of the ray were
// applied before t is refined, as in the count of the crossings.
static constexpr auto list_crossings =
    [](int item, int group, const wp::array_t<wp::vec3d>& origins, const wp::array_t<wp::vec3d>& directions,
       const wp::array_t<wp::int64>& offsets, const SurfaceTree& tree, double t_min, double max_distance,
       wp::array_t<double>& out_t, wp::array_t<int>& out_triangle_id, wp::array_t<wp::vec3d>& out_barycentric,
       wp::array_t<int>& out_bad) {
        auto take_hit = [&](auto& r, int slot, double t, double v, double w, const auto&) {
            refine(tree, origins.data[r.id], directions.data[r.id], slot, t, v, w);
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
        const int begin = item * group, end = wp::min(begin + group, origins.shape[0]);
        walk_rays(tree, origins, directions, begin, end, t_min, max_distance, out_bad, take_hit, finish);
    };
