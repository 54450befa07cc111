// Which of the sorted points are within the radius of a query. In C++, because warp has no vectors of eight doubles and
// no conversion of their comparison to a bit mask.
#include "core/simd.inl"

// Bit mask of the sorted points from `begin` on, 64 at most and below `end`, that are within the radius of a query.
//
// Both branches round alike, lane by lane.
static constexpr auto within_mask = [](const CellGrid& grid, int begin, int end, const wp::vec3d& q,
                                       double radius_squared) -> uint64_t {
    const int count = end - begin < 64 ? end - begin : 64;
    uint64_t mask = 0;
#if defined(__CUDA_ARCH__)
    for (int k = 0; k < count; ++k) {
        const double dx = grid.x.data[begin + k] - q[0];
        const double dy = grid.y.data[begin + k] - q[1];
        const double dz = grid.z.data[begin + k] - q[2];
        const double d = (dx * dx + dy * dy) + dz * dz;
        mask |= uint64_t(d <= radius_squared) << k;
    }
#else
    const d8 limit = (d8)(radius_squared);
    for (int k = 0; k < count; k += 8) {
        const d8 dx = *(const d8*)(grid.x.data + begin + k) - (d8)(q[0]);
        const d8 dy = *(const d8*)(grid.y.data + begin + k) - (d8)(q[1]);
        const d8 dz = *(const d8*)(grid.z.data + begin + k) - (d8)(q[2]);
        const d8 d = (dx * dx + dy * dy) + dz * dz;
        mask |= uint64_t(mask_of(d <= limit)) << k;
    }
    if (count < 64) mask &= (uint64_t(1) << count) - 1;
#endif
    return mask;
};

// Whether sorted point j is within the limit: the float64 formula, rounded term by term.
static constexpr auto decides = [](const CellGrid& grid, int j, const wp::vec3d& q, double limit) -> bool {
    const double dx = grid.x.data[j] - q[0];
    const double dy = grid.y.data[j] - q[1];
    const double dz = grid.z.data[j] - q[2];
    return (dx * dx + dy * dy) + dz * dz <= limit;
};

// Squared distance in float32, from one 16-byte load for each point. The arithmetic may be contracted: the limits of
// Nearness allow for its error.
static constexpr auto squared = [](const CellGrid& grid, int j, const auto& near) -> float {
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

// Number of the sorted points `begin` to `end` - 1 within the radius: float32 where it decides, else float64.
static constexpr auto near_count = [](const CellGrid& grid, int begin, int end, const auto& near, const wp::vec3d& q,
                                      double limit) -> int {
    int inside = 0, outside = 0;
    #pragma unroll 4
    for (int j = begin; j < end; ++j) {
        const float d = squared(grid, j, near);
        inside += d <= near.surely;
        outside += d > near.possibly;
    }
    if (inside + outside != end - begin) {
        inside = 0;
        for (int j = begin; j < end; ++j) inside += decides(grid, j, q, limit);
    }
    return inside;
};

// The bit mask of within_mask: float32 where it decides, else float64.
static constexpr auto near_mask = [](const CellGrid& grid, int begin, int end, const auto& near, const wp::vec3d& q,
                                     double limit) -> uint64_t {
    uint64_t inside = 0, doubt = 0;
    const int count = end - begin < 64 ? end - begin : 64;
    for (int k = 0; k < count; ++k) {
        const float d = squared(grid, begin + k, near);
        inside |= uint64_t(d <= near.surely) << k;
        doubt |= uint64_t(!(d <= near.surely || d > near.possibly)) << k;
    }
    for (int k = 0; doubt; ++k, doubt >>= 1)
        if (doubt & 1) inside |= uint64_t(decides(grid, begin + k, q, limit)) << k;
    return inside;
};

// The same on either device, as fast as it has them.
static constexpr auto neighbor_mask = [](const CellGrid& grid, int begin, int end, const auto& near, const wp::vec3d& q,
                                         double limit) -> uint64_t {
#if defined(__CUDA_ARCH__)
    return near_mask(grid, begin, end, near, q, limit);
#else
    return within_mask(grid, begin, end, q, limit);
#endif
};
