// Bit mask of the `count` sorted points from `begin` on, 64 at most, that are within the radius of a query.
//
// Expects x, y, z, begin, count, qx, qy, qz, radius_squared; on a CPU also core/simd.inl. Returns the mask.
//
// In C++, because warp has no vectors of eight doubles and no conversion of their comparison to a bit mask. Both
// branches round alike, lane by lane.

uint64_t mask = 0;
#if defined(__CUDA_ARCH__)
for (int k = 0; k < count; ++k) {
    const double dx = x.data[begin + k] - qx;
    const double dy = y.data[begin + k] - qy;
    const double dz = z.data[begin + k] - qz;
    const double d = (dx * dx + dy * dy) + dz * dz;
    mask |= uint64_t(d <= radius_squared) << k;
}
#else
const d8 limit = (d8)(radius_squared);
for (int k = 0; k < count; k += 8) {
    const d8 dx = *(const d8*)(x.data + begin + k) - (d8)(qx);
    const d8 dy = *(const d8*)(y.data + begin + k) - (d8)(qy);
    const d8 dz = *(const d8*)(z.data + begin + k) - (d8)(qz);
    const d8 d = (dx * dx + dy * dy) + dz * dz;
    mask |= uint64_t(mask_of(d <= limit)) << k;
}
if (count < 64) mask &= (uint64_t(1) << count) - 1;
#endif
return mask;
