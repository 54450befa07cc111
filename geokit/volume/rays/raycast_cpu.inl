// The first crossings of a packet of rays on a CPU. Vector arithmetic takes the steps that all rays share: into the
// box, the jumps to the first block that may hold a crossing, the root iteration in a cell, and the world point and
// normal. The walk in between is scalar. All operations are those of raycast.inl and write_hit, so answers agree to
// the last bit.
//
// Expects the names of ray_packet_cpu.inl and ray_roots_cpu.inl; isovalue, below, above; out_t, out_points,
// out_normals.
// Returns 0, or 1 if a ray is not usable; then nothing is written.
#if defined(__CUDA_ARCH__)
return 0;
#else
#include "volume/rays/ray_packet_cpu.inl"
// A separate function, so that the walk has all registers.
auto walk = [](const auto& field, const Rays& rays, Brackets& found, int q, double isovalue, double below, double above)
                __attribute__((noinline)) -> wp::vec_t<4, double> {
#include "volume/rays/ray_field.inl"
#include "volume/nanovdb/cached_accessor.inl"
#include "volume/rays/ray_steps.inl"
#define LOAD(name) const double name = rays.name[q];
    RAY_REALS(LOAD)
#undef LOAD
    double ta = rays.ta[q];
#define LOAD(name) const int name = rays.name[q];
    RAY_FLAGS(LOAD)
#undef LOAD
#define LOAD(name) int name = rays.name[q];
    RAY_STATE(LOAD)
#undef LOAD
    const int clear_there = rays.clear[q];
    const int sx = fx ? 1 : -1, sy = fy ? 1 : -1, sz = fz ? 1 : -1;
    const double step_x = sx, step_y = sy, step_z = sz;
    double tb = 0.0;
    int known = clear_there;
#include "volume/rays/raycast_start.inl"
#define ON_UNSEEN side = 0;
    if (unseen >= 0) { ON_UNSEEN }
#include "volume/rays/traverse_blocks.inl"
#undef ON_UNSEEN
#include "volume/rays/raycast_end.inl"
};
double hit[G], sx[G], sy[G], sz[G];
    #pragma clang loop vectorize(disable)
for (int q = 0; q < G; ++q) {
    hit[q] = sx[q] = sy[q] = sz[q] = 0.0;
    if (q >= count) continue;
    const auto met = walk(field, rays, found, q, isovalue, below, above);
    hit[q] = met[0];
    sx[q] = met[1];
    sy[q] = met[2];
    sz[q] = met[3];
}
#include "volume/rays/ray_roots_cpu.inl"
// The operations of write_hit.
for (int q = 0; q < G; ++q) {
    const bool none = hit[q] == (double)INFINITY;
    const double t = hit[q] / rays.scale[q], nan = (double)NAN;
    const double x = m00 * sx[q] + m10 * sy[q] + m20 * sz[q], y = m01 * sx[q] + m11 * sy[q] + m21 * sz[q];
    const double z = m02 * sx[q] + m12 * sy[q] + m22 * sz[q];
    const double size = __builtin_elementwise_sqrt(x * x + y * y + z * z);
    hit[q] = none ? hit[q] : t;
    ox[q] = none ? nan : ox[q] + rx[q] * t;
    oy[q] = none ? nan : oy[q] + ry[q] * t;
    oz[q] = none ? nan : oz[q] + rz[q] * t;
    sx[q] = none ? nan : size > 0.0 ? x / size : 0.0;
    sy[q] = none ? nan : size > 0.0 ? y / size : 0.0;
    sz[q] = none ? nan : size > 0.0 ? z / size : 0.0;
}
double* const points = (double*)out_points.data + 3ll * start;
double* const normals = (double*)out_normals.data + 3ll * start;
    #pragma clang loop vectorize(disable)
for (int q = 0; q < count; ++q) {
    out_t.data[start + q] = hit[q];
    points[3 * q] = ox[q];
    points[3 * q + 1] = oy[q];
    points[3 * q + 2] = oz[q];
    normals[3 * q] = sx[q];
    normals[3 * q + 1] = sy[q];
    normals[3 * q + 2] = sz[q];
}
return 0;
#undef RAY_REALS
#undef RAY_FLAGS
#undef RAY_STATE
#undef BRACKET
#endif
