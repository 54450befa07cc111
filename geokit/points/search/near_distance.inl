// Squared distances of sorted points from a query: in float32 where that decides, in float64 where it does not.
//
// Expects packed (float32 points in the grid's frame), exact_x, exact_y, exact_z, qx, qy, qz (the query in that frame),
// ex, ey, ez (the query in float64), radius_squared. Defines decides and squared.

// The formula in float64, its roundings term by term.
auto decides = [&](int j) -> bool {
    const double dx = exact_x.data[j] - ex;
    const double dy = exact_y.data[j] - ey;
    const double dz = exact_z.data[j] - ez;
    return (dx * dx + dy * dy) + dz * dz <= radius_squared;
};
// One load of 16 bytes for each point, and arithmetic that may be contracted: its error is allowed for.
auto squared = [&](int j) -> float {
#if defined(__CUDA_ARCH__)
    const float4 p = __ldg((const float4*)packed.data + j);
    const float dx = p.x - qx, dy = p.y - qy, dz = p.z - qz;
    return fmaf(dx, dx, fmaf(dy, dy, dz * dz));
#else
    const auto& p = packed.data[j];
    const float dx = p[0] - qx, dy = p[1] - qy, dz = p[2] - qz;
    return dx * dx + dy * dy + dz * dz;
#endif
};
