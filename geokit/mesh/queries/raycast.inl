// First hits and occlusion of rays.
#include "mesh/bvh/ray_walk_cpu.inl"
#include "mesh/bvh/ray_walk_cuda.inl"

// First hits: the nearest hit of each ray.
static constexpr auto cast_rays = [](int begin, int end, const wp::array_t<wp::vec3d>& origins,
                                     const wp::array_t<wp::vec3d>& directions, const SurfaceTree& tree, double t_min,
                                     double max_distance, wp::array_t<double>& out_t, wp::array_t<int>& out_triangle_id,
                                     wp::array_t<wp::vec3d>& out_barycentric, wp::array_t<int>& out_bad) {
    auto take_hit = [&](auto& r, int slot, double t, double v, double w, const auto& shorten) {
        // Ties go to the lowest triangle: the answer must not depend on the traversal order.
        if (t == r.best && r.winner >= 0 && tree.slot_triangle.data[slot] > tree.slot_triangle.data[r.winner])
            return false;
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
    walk_rays(tree, origins, directions, begin, end, t_min, max_distance, out_bad, take_hit, finish);
};
static constexpr auto cast_group =
    [](int item, int group, const wp::array_t<wp::vec3d>& origins, const wp::array_t<wp::vec3d>& directions,
       const SurfaceTree& tree, double t_min, double max_distance, wp::array_t<double>& out_t,
       wp::array_t<int>& out_triangle_id, wp::array_t<wp::vec3d>& out_barycentric, wp::array_t<int>& out_bad) {
        const int begin = item * group, end = wp::min(begin + group, origins.shape[0]);
        cast_rays(begin, end, origins, directions, tree, t_min, max_distance, out_t, out_triangle_id, out_barycentric,
                  out_bad);
    };
// Of a ray that the search for candidates has left undecided.
static constexpr auto cast_undecided =
    [](int ray, const wp::array_t<wp::vec3d>& origins, const wp::array_t<wp::vec3d>& directions,
       const SurfaceTree& tree, double t_min, double max_distance, wp::array_t<double>& out_t,
       wp::array_t<int>& out_triangle_id, wp::array_t<wp::vec3d>& out_barycentric, wp::array_t<int>& out_bad) {
        if (out_triangle_id.data[ray] == UNDECIDED)
            cast_rays(ray, ray + 1, origins, directions, tree, t_min, max_distance, out_t, out_triangle_id,
                      out_barycentric, out_bad);
    };

// Occlusion: the first hit in traversal order ends the ray.
static constexpr auto test_group = [](int item, int group, const wp::array_t<wp::vec3d>& origins,
                                      const wp::array_t<wp::vec3d>& directions, const SurfaceTree& tree, double t_min,
                                      double max_distance, wp::array_t<bool>& out_occluded, wp::array_t<int>& out_bad) {
    auto take_hit = [&](auto& r, int slot, double, double, double, const auto&) {
        r.winner = slot;
        return true;
    };
    auto finish = [&](const auto& r) { out_occluded.data[r.id] = r.winner >= 0; };
    const int begin = item * group, end = wp::min(begin + group, origins.shape[0]);
    walk_rays(tree, origins, directions, begin, end, t_min, max_distance, out_bad, take_hit, finish);
};
static constexpr auto test_left_over = [](int ray, const wp::array_t<wp::vec3d>& origins,
                                          const wp::array_t<wp::vec3d>& directions, const SurfaceTree& tree,
                                          double t_min, double max_distance, wp::array_t<bool>& out_occluded,
                                          wp::array_t<int>& out_bad) {
    if (((const unsigned char*)out_occluded.data)[ray] == LEFT_OVER)
        test_group(ray, 1, origins, directions, tree, t_min, max_distance, out_occluded, out_bad);
};
