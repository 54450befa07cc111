// Tests a ray against a triangle, from t_min on.
//
// Expects ray_triangle.inl and refine_hit.inl; t_min; optionally the macros REFINE_ON_CPU and REFINE_ON_CUDA. With them
// t is refined before it is compared with anything; without, a sliver's t may have lost digits. Defines hit(start,
// direction, slot, t, v, w): false if the ray misses the triangle in a slot, or hits it before t_min.
auto hit = [&](const point& start, const point& direction, int slot, double& t, double& v, double& w) {
    if (!hit_at_all(start, direction, slot, t, v, w)) return false;
    #if (defined(__CUDA_ARCH__) && defined(REFINE_ON_CUDA)) || (!defined(__CUDA_ARCH__) && defined(REFINE_ON_CPU))
    refine(start, direction, slot, t, v, w);
    #endif
    return t >= t_min;
};
