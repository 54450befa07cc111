// Rays that a kernel of the user's casts one by one, by the walks of the queries. Callers check them.
#include "mesh/queries/raycast.inl"
#if defined(__CUDA_ARCH__)
constexpr bool ANY_HIT = UNORDERED;
#include "mesh/bvh/ray_candidates_cuda.inl"
#endif

// t, the weights of the second and third corner, and the triangle of the first hit: -1 for a miss.
static constexpr auto cast_ray = [](const SurfaceTree& tree, point origin, point direction, double t_min, double t_max,
                                    double max_distance) -> wp::vec4d {
    double t = 0.0;
    int triangle = UNDECIDED, flag[2];
    point weights;
    wp::array_t<double> out_t(&t, 1);
    wp::array_t<int> out_triangle(&triangle, 1), out_bad(flag, 2);
    wp::array_t<wp::vec3d> out_weights(&weights, 1);
#if defined(__CUDA_ARCH__)
    first_hit(tree, origin, direction, t_min, t_max, 0, out_t, out_triangle, out_weights, out_bad);
    if (triangle == UNDECIDED)
#endif
        cast_rays(0, 1, wp::array_t<wp::vec3d>(&origin, 1), wp::array_t<wp::vec3d>(&direction, 1), tree, t_min,
                  max_distance, out_t, out_triangle, out_weights, out_bad);
    return wp::vec4d(t, weights[1], weights[2], (double)triangle);
};

// Whether it hits anything.
static constexpr auto test_ray = [](const SurfaceTree& tree, point origin, point direction, double t_min, double t_max,
                                    double max_distance) -> bool {
    int flag[2];
    unsigned char found = LEFT_OVER;
    wp::array_t<bool> out_occluded((bool*)&found, 1);
    wp::array_t<int> out_bad(flag, 2);
#if defined(__CUDA_ARCH__)
    any_hit(tree, origin, direction, t_min, t_max, 0, out_occluded, out_bad);
    if (found == LEFT_OVER)
#endif
        test_group(0, 1, wp::array_t<wp::vec3d>(&origin, 1), wp::array_t<wp::vec3d>(&direction, 1), tree, t_min,
                   max_distance, out_occluded, out_bad);
    return found != 0;
};
