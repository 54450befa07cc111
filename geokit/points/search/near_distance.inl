// Squared distances of sorted points from a query: float32 where it decides, float64 elsewhere.
//
// Expects grid, near, q, limit. Defines decides(j): whether point j is within the limit, in float64; and squared(j) in
// float32.

// The float64 formula, rounded term by term.
auto decides = [&](int j) -> bool {
    const double dx = grid.x.data[j] - q[0];
    const double dy = grid.y.data[j] - q[1];
    const double dz = grid.z.data[j] - q[2];
    return (dx * dx + dy * dy) + dz * dz <= limit;
};
// One 16-byte load for each point. The arithmetic may be contracted: the limits allow for its error.
auto squared = [&](int j) -> float {
#if defined(__CUDA_ARCH__)
    const float4 p = __ldg((const float4*)grid.packed.data + j);
    const float dx = p.x - near.x, dy = p.y - near.y, dz = p.z - near.z;
    return fmaf(dx, dx, fmaf(dy, dy, dz * dz));
#else
    const auto& p = grid.packed.data[j];
    const float dx = p[0] - near.x, dy = p[1] - near.y, dz = p[2] - near.z;
    return dx * dx + dy * dy + dz * dz;
#endif
};
