// Squared distances of sorted points from a query: in float32 where that decides, in float64 where it does not.
//
// Expects grid, near, q, limit. Defines decides(j): whether point j is within the limit, in float64; and squared(j) in
// float32.

// The formula in float64, its roundings term by term.
auto decides = [&](int j) -> bool {
    const double dx = grid.x.data[j] - q[0];
    const double dy = grid.y.data[j] - q[1];
    const double dz = grid.z.data[j] - q[2];
    return (dx * dx + dy * dy) + dz * dz <= limit;
};
// One load of 16 bytes for each point, and arithmetic that may be contracted: its error is allowed for.
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
