// Rays that a kernel of the user's casts one by one, by the walks of the queries.
#include "mesh/queries/raycast.inl"
#if defined(__CUDA_ARCH__)
#include "mesh/bvh/ray_candidates_cuda.inl"
#endif

// t, the weights of the second and third corner, and the triangle of the first hit: -1 for a miss, which also a ray is
// that has no direction or is not finite, or whose limits are negative or NaN.
static constexpr auto cast_ray = [](const SurfaceTree& tree, point origin, point direction, double t_min,
                                    double max_distance) -> wp::vec4d {
    double t = (double)INFINITY;
    point weights((double)NAN, (double)NAN, (double)NAN);
    int triangle = UNDECIDED, flags[2];
    if (!(t_min >= 0.0 && max_distance >= 0.0)) return wp::vec4d(t, weights[1], weights[2], -1.0);
    const wp::array_t<wp::vec3d> origins(&origin, 1), directions(&direction, 1);
    wp::array_t<double> out_t(&t, 1);
    wp::array_t<int> out_triangle(&triangle, 1), out_bad(flags, 2);
    wp::array_t<wp::vec3d> out_weights(&weights, 1);
#if defined(__CUDA_ARCH__)
    first_hit(0, origins, directions, tree, t_min, max_distance, out_t, out_triangle, out_weights, out_bad);
#endif
    cast_undecided(0, origins, directions, tree, t_min, max_distance, out_t, out_triangle, out_weights, out_bad);
    return wp::vec4d(t, weights[1], weights[2], (double)triangle);
};

// Whether a ray hits anything.
static constexpr auto test_ray = [](const SurfaceTree& tree, point origin, point direction, double t_min,
                                    double max_distance) -> bool {
    unsigned char found = LEFT_OVER;
    int flags[2] = {0, 0};
    if (!(t_min >= 0.0 && max_distance >= 0.0)) return false;
    const wp::array_t<wp::vec3d> origins(&origin, 1), directions(&direction, 1);
    wp::array_t<bool> out_occluded((bool*)&found, 1);
    wp::array_t<int> out_bad(flags, 2);
#if defined(__CUDA_ARCH__)
    any_hit(0, origins, directions, tree, t_min, max_distance, out_occluded, out_bad);
#endif
    test_left_over(0, origins, directions, tree, t_min, max_distance, out_occluded, out_bad);
    return found == 1 && flags[0] == 0;
};
