// The winding number around a point, and whether it exceeds 1/2; `empty` is the half width of the cube, in local units,
// outside of which it is zero.
#include "core/simd.inl"

#if defined(__CUDA_ARCH__)
// By warp's own tree of solid angles.
static constexpr auto number_of = [](const SurfaceTree& tree, const WindingTree& winding, double empty,
                                     const wp::vec3d& p) -> float {
    const wp::vec3d q = (p - tree.origin) / tree.scale;
    const double size = wp::max(wp::max(wp::abs(q[0]), wp::abs(q[1])), wp::abs(q[2]));
    // A point at a great distance, or one that overflowed in the local frame, has winding number zero.
    if (!(size <= wp::min(empty, FAR))) return 0.f;
    return wp::mesh_query_winding_number(winding.mesh, wp::vec3(q[0], q[1], q[2]), ACCURACY);
};
static constexpr auto winding_number_at = [](const SurfaceTree& tree, const WindingTree& winding, double empty,
                                             const wp::vec3d& p) -> double {
    return number_of(tree, winding, empty, p);
};
static constexpr auto is_inside = [](const SurfaceTree& tree, const WindingTree& winding, double empty,
                                     const wp::vec3d& p) -> bool { return number_of(tree, winding, empty, p) > 0.5f; };
#else
// In the CPU tree: clusters far enough away contribute by their multipole moments, nearby triangles by their solid
// angles, eight at a time.

// Appends the selected lanes; writes up to eight entries beyond the end.
static constexpr auto append = [](int* to, i8 values, unsigned lanes) {
    #if defined(__AVX512VL__)
    typedef int x86 __attribute__((__vector_size__(32)));
    *(i8*)to = (i8)__builtin_ia32_compresssi256_mask((x86)values, (x86)values, lanes);
    return __builtin_popcount(lanes);
    #else
    int count = 0;
    for (; lanes; lanes &= lanes - 1) to[count++] = values[__builtin_ctz(lanes)];
    return count;
    #endif
};
static constexpr auto total = [](const v8& v) {
    return ((double)(v[0] + v[4]) + (v[1] + v[5])) + ((double)(v[2] + v[6]) + (v[3] + v[7]));
};
// A point to ask about, in the world and in the tree's local frame; on_surface is set once it is found on a triangle.
struct Query {
    const SurfaceTree& tree;
    const WindingTree& winding;
    const wp::vec3d& p;
    double q[3], size;
    bool on_surface;
};
static constexpr auto query_of = [](const SurfaceTree& tree, const WindingTree& winding, const wp::vec3d& p) -> Query {
    Query query = {tree,
                   winding,
                   p,
                   {(p[0] - tree.origin[0]) / tree.scale, (p[1] - tree.origin[1]) / tree.scale,
                    (p[2] - tree.origin[2]) / tree.scale},
                   0.0,
                   false};
    for (int k = 0; k < 3; ++k) query.size = wp::max(query.size, query.q[k] < 0.0 ? -query.q[k] : query.q[k]);
    return query;
};
// Half the solid angle of one triangle, in float64.
static constexpr auto half_angle = [](Query& query, int slot) {
    #pragma clang fp contract(fast)
    const SurfaceTree& tree = query.tree;
    const wp::vec3d& p = query.p;
    const wp::vec3d* corner = tree.corners.data + 3 * slot;
    const double inverse = 1.0 / tree.scale;
    const wp::vec3d a = (corner[0] - p) * inverse, b = (corner[1] - p) * inverse, c = (corner[2] - p) * inverse;
    const double la = wp::length(a), lb = wp::length(b), lc = wp::length(c);
    // The edges, not the corners: nearby, the edges are the longer vectors.
    const double volume = wp::dot(a, wp::cross(b - a, c - a));
    const double cosine = lc * (la * lb + wp::dot(a, b)) + wp::dot(b, c) * la + wp::dot(c, a) * lb;
    const float area = query.winding.areas.data[slot];
    if (area == 0.f) return 0.0;
    if (volume == 0.0) {
        // In the triangle's plane; on the triangle both sides are equally near.
        query.on_surface = query.on_surface || cosine <= ON_SURFACE * (la * lb * lc);
        return 0.0;
    }
    const double angle = wp::atan2(volume, cosine);
    return area > 0.f ? -angle : angle;
};
// The winding number, with clusters counted by moments from `opening` radii on. spread, if not null, gets the sum of
// the absolute terms of the last order.
static constexpr auto walk = [](Query& query, float opening, float* spread) -> double {
    // Fused products round less, and are faster: the sum is approximate in any case.
    #pragma clang fp contract(fast)
    const SurfaceTree& tree = query.tree;
    const WindingTree& winding = query.winding;
    const v8 zero = 0.f;
    const float X = (float)query.q[0], Y = (float)query.q[1], Z = (float)query.q[2];
    int queue[QUEUE + STACK + 8], head = 0, tail = 1;
    int list[LEAVES + 16], leaves = 0;
    v8 far_sum = 0.f, last = 0.f, angles = 0.f;
    double sum = 0.0, near_angles = 0.0;
    auto sum_leaves = [&]() {
        for (int i = 0; i < leaves; ++i) {
            const int block = -1 - list[i];
            const v8* row = (const v8*)(tree.leaves.data + (long long)block * 8 * PLANE_ROWS);
            const v8 dx = X - row[0], dy = Y - row[1], dz = Z - row[2];
            // In the triangle's frame its corners are (0, 0, 0), (length, 0, 0) and (cx, cy, 0).
            const v8 x = dx * row[3] + dy * row[4] + dz * row[5];
            const v8 y = dx * row[6] + dy * row[7] + dz * row[8];
            const v8 z = dx * row[9] + dy * row[10] + dz * row[11];
            const v8 length = row[12], cx = row[13], cy = row[14];
            const v8 bx = x - length, ex = x - cx, ey = y - cy, zz = z * z, yz = y * y + zz, yez = y * ey + zz;
            const v8 la = __builtin_elementwise_sqrt(x * x + yz), lb = __builtin_elementwise_sqrt(bx * bx + yz);
            const v8 lc = __builtin_elementwise_sqrt(ex * ex + ey * ey + zz);
            const v8 volume = z * *(const v8*)(winding.areas.data + 8 * block);
            const v8 lab = la * lb;
            const v8 cosine = lc * (lab + (x * bx + yz)) + (bx * ex + yez) * la + (x * ex + yez) * lb;
            // Eight arctangents of volume / cosine, by octants; the error of the polynomial is at most 4e-7.
            const v8 rise = __builtin_elementwise_abs(volume), run = __builtin_elementwise_abs(cosine);
            const v8 more = __builtin_elementwise_max(rise, run), less = __builtin_elementwise_min(rise, run);
            const v8 t = less / more, tt = t * t;
            v8 angle = 0.00737400978f * tt - 0.0355198959f;
            angle = angle * tt + 0.0821677802f;
            angle = angle * tt - 0.133988008f;
            angle = angle * tt + 0.198618561f;
            angle = angle * tt - 0.333253948f;
            angle = angle * tt * t + t;
            angle = rise > run ? 1.57079637f - angle : angle;
            angle = cosine < zero ? 3.14159274f - angle : angle;
            angle = volume < zero ? -angle : angle;
            angle = rise > zero ? angle : zero;
            const v8 away = __builtin_elementwise_max(
                __builtin_elementwise_max(__builtin_elementwise_abs(z), __builtin_elementwise_max(-x, bx)),
                __builtin_elementwise_max(-y, ey));
            const i8 near = (away < NEAR) | (more < SMALL * lab * lc);
            unsigned mask = mask_of(near);
            if (__builtin_expect(mask, 0)) {
                angle = near ? zero : angle;
                for (; mask; mask &= mask - 1) near_angles += half_angle(query, 8 * block + __builtin_ctz(mask));
            }
            angles += angle;
        }
        leaves = 0;
        // This many terms of one sign leave enough digits of float32; more of them might not.
        sum += total(far_sum + angles * 0.159154943f);
        far_sum = angles = zero;
    };
    queue[0] = 0;
    const float limit = opening * opening;
    while (head < tail) {
        const int node = __builtin_expect(tail < QUEUE, 1) ? queue[head++] : queue[--tail];
        const v8* m = (const v8*)(winding.moments.data + (long long)node * 8 * MOMENT_ROWS);
        const v8 x = X - m[0], y = Y - m[1], z = Z - m[2], xx = x * x, yy = y * y, zz = z * z, rr = xx + yy + zz;
        const i8 near = rr <= m[3] * limit;
        const v8 inverse = 1.f / rr, third = __builtin_elementwise_sqrt(inverse) * inverse;
        const v8 xz = xx - zz, yz = yy - zz, less = zz * 0.333333343f;
        const v8 first = x * m[4] + y * m[5] + z * m[6];
        const v8 second = xz * m[7] + yz * m[9] + y * (x * m[8] + z * m[11]) + x * z * m[10];
        const v8 thirds = x * ((xz - 2.f * zz) * m[12] + yz * m[14]) + y * ((yz - 2.f * zz) * m[15] + xz * m[13])
                          + z * ((xx - less) * m[16] + (yy - less) * m[18] + x * y * m[17]);
        const v8 highest = thirds * inverse * inverse;
        const v8 value = third * (first + second * inverse + highest);
        far_sum += near ? zero : value;
        if (spread) last += near ? zero : __builtin_elementwise_abs(third * highest);
        const i8 child = *(const i8*)(tree.children.data + 8 * node);
        tail += append(queue + tail, child, mask_of(near & (child > 0)));
        leaves += append(list + leaves, child, mask_of(near & (child < 0)));
        if (__builtin_expect(leaves > LEAVES, 0)) sum_leaves();
    }
    sum_leaves();
    if (spread) *spread = (float)total(last);
    return sum + near_angles * 0.15915494309189535;
};
static constexpr auto winding_number_at = [](const SurfaceTree& tree, const WindingTree& winding, double empty,
                                             const wp::vec3d& p) -> double {
    Query query = query_of(tree, winding, p);
    // A point at a great distance, or one that overflowed in the local frame, has winding number zero.
    if (!(query.size <= wp::min(empty, FAR))) return 0;
    return walk(query, OPENING, nullptr);
};
// A coarse sum first, then a fine one if the coarse sum is too close to 1/2. Nothing on the surface is inside.
static constexpr auto is_inside = [](const SurfaceTree& tree, const WindingTree& winding, double empty,
                                     const wp::vec3d& p) -> bool {
    Query query = query_of(tree, winding, p);
    if (!(query.size <= wp::min(empty, FAR))) return false;
    float spread;
    const double coarse = walk(query, OPENING_SIGN, &spread);
    if (query.on_surface) return false;
    const double doubt = coarse > 0.5 ? coarse - 0.5 : 0.5 - coarse;
    if (doubt > SIGN_MARGIN + SIGN_SPREAD * spread) return coarse > 0.5;
    return walk(query, OPENING, nullptr) > 0.5;
};
#endif
