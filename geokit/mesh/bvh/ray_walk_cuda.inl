// Rays in the tree of bvh2_cuda_kernels: float32 tests with margins, decided in float64. One ray per thread.
//
// Warp's own ray query tests unpadded boxes and leaks thousands of rays per million that aim at edges and vertices.
#include "mesh/bvh/bvh2.inl"
#include "mesh/triangle/ray.inl"

#if defined(__CUDA_ARCH__)
// The ray with number `begin`; the other arguments are those of walk_rays in ray_walk_cpu.inl.
static constexpr auto walk_rays = [](const SurfaceTree& tree, const wp::array_t<wp::vec3d>& origins,
                                     const wp::array_t<wp::vec3d>& directions, int begin, int, double t_min,
                                     double max_distance, wp::array_t<int>& out_bad, auto&& take_hit, auto&& finish) {
    struct Ray {
        point start, direction;
        double best, enter, unit, weight_b, weight_c;
        float last;
        int id, winner, height, count;
    };
    Ray r;
    r.winner = -1;
    r.count = 0;
    r.weight_b = 0.0;
    r.weight_c = 0.0;
    r.height = 0;
    r.id = begin;
    bool reached = fetch_ray(origins, directions, begin, max_distance, r.start, r.direction, r.best, out_bad);
    if (!reached) {  // a miss
        r.start = tree.origin;
        r.direction = point(1.0, 0.0, 0.0);
        r.best = max_distance;
    }
    // The ray as from + s * along in local units with the largest component of along being 1: s = unit * t.
    const double largest = wp::max(wp::max(wp::abs(r.direction[0]), wp::abs(r.direction[1])), wp::abs(r.direction[2]));
    const double local = 1.0 / tree.scale, shrink = 1.0 / largest;
    const point from = (r.start - tree.origin) * local, along = r.direction * shrink;
    r.unit = largest * local;
    r.enter = t_min * r.unit;
    // Finite, so that its product with a zero is zero.
    auto shorten = [](Ray& r) {
        r.last = fminf((float)(r.best * r.unit - r.enter) * 1.000001f + PLANE_MARGIN, ENDLESS);
    };
    auto reciprocal_of = [](double component) {
        return 1.f / copysignf(fmaxf(fabsf((float)component), LEAST_COMPONENT), (float)component);
    };
    const float ix = reciprocal_of(along[0]), iy = reciprocal_of(along[1]), iz = reciprocal_of(along[2]);
    const double far = wp::max(wp::max(wp::abs(from[0]), wp::abs(from[1])), wp::abs(from[2]));
    if (far > NEAR_START) {
        // Slightly early and late: these reciprocals have the precision of float32, and the cube has a margin.
        const double edge = 1.0 + 1e-5 + 1e-6 * far;
        double leave = INFINITY;
        const double rate[3] = {ix, iy, iz};
        for (int k = 0; k < 3; ++k) {
            const double t0 = (-edge - from[k]) * rate[k], t1 = (edge - from[k]) * rate[k];
            r.enter = wp::max(r.enter, wp::min(t0, t1));
            leave = wp::min(leave, wp::max(t0, t1));
        }
        reached = r.enter <= leave;
    }
    shorten(r);
    const float sx = (float)(from[0] + r.enter * along[0]), sy = (float)(from[1] + r.enter * along[1]),
                sz = (float)(from[2] + r.enter * along[2]);
    const float tx = (float)along[0], ty = (float)along[1], tz = (float)along[2];
    const float ox = -sx * ix, oy = -sy * iy, oz = -sz * iz;
    // Fused explicitly: modules of the user's may not let the compiler do so.
    // Distance at which the ray enters a box, or infinity.
    auto entry_of = [&](float lx, float ly, float lz, float ux, float uy, float uz) {
        const float x0 = fmaf(lx, ix, ox), x1 = fmaf(ux, ix, ox), y0 = fmaf(ly, iy, oy), y1 = fmaf(uy, iy, oy);
        const float z0 = fmaf(lz, iz, oz), z1 = fmaf(uz, iz, oz);
        const float in = fmaxf(fmaxf(fminf(x0, x1), fminf(y0, y1)), fmaxf(fminf(z0, z1), 0.f));
        const float out = fminf(fminf(fmaxf(x0, x1), fmaxf(y0, y1)), fminf(fmaxf(z0, z1), r.last));
        return in <= out ? in : (float)INFINITY;
    };
    auto dot = [](float a, float b, float c, float x, float y, float z) { return fmaf(a, x, fmaf(b, y, c * z)); };
    // Multiplied by dz, with signs such that dz is positive: grazing rays lose no digits in a division.
    auto may_hit = [&](int slot) {
        const float4* row = (const float4*)(tree.leaves.data + SLOT_WORDS * slot);
        const float4 r0 = row[0], r1 = row[1], r2 = row[2], r3 = row[3];
        const float ax = sx - r0.x, ay = sy - r0.y, az = sz - r0.z;
        const float oz = dot(ax, ay, az, r2.y, r2.z, r2.w), dz = dot(tx, ty, tz, r2.y, r2.z, r2.w);
        const float depth = dz < 0.f ? oz : -oz, down = fabsf(dz);
        if (!(depth >= -PLANE_MARGIN && depth <= fmaf(r.last, down, PLANE_MARGIN))) return false;
        const float ox = dot(ax, ay, az, r0.w, r1.x, r1.y), dx = dot(tx, ty, tz, r0.w, r1.x, r1.y);
        const float oy = dot(ax, ay, az, r1.z, r1.w, r2.x), dy = dot(tx, ty, tz, r1.z, r1.w, r2.x);
        const float x = fmaf(ox, down, dx * depth), y = fmaf(oy, down, dy * depth);
        const float longest = r3.x, cx = r3.y, cy = r3.z, margin = -PLANE_MARGIN * longest;
        return y >= -PLANE_MARGIN && fmaf(cy, x, -cx * y) >= margin
               && fmaf(cx - longest, y, -cy * fmaf(-longest, down, x)) >= margin;
    };
    int stack[64], node = tree.children.data[0];
    float entry[64];
    // Negative once the traversal is over.
    r.height = reached ? 0 : -1;
    while (r.height >= 0) {
        bool in_box = true;
        while (node >= 0 && in_box) {
            const Node n = load_node(tree.boxes.data, node);
            const float tl = entry_of(n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ);
            const float tr = entry_of(n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ);
            const bool left_first = tl <= tr;
            const float later = left_first ? tr : tl;
            if (later < INFINITY) {
                stack[r.height] = left_first ? n.right : n.left;
                entry[r.height++] = later;
            }
            node = left_first ? n.left : n.right;
            in_box = (left_first ? tl : tr) < INFINITY;
        }
        if (in_box) {
            for (int slot = first_slot(node); slot < end_slot(node) && r.height >= 0; ++slot) {
                double t, v, w;
                if (!may_hit(slot) || !hit(tree, t_min, r.start, r.direction, slot, t, v, w) || t > r.best) continue;
                if (take_hit(r, slot, t, v, w, shorten)) {
                    r.height = -1;  // the walk is over
                    break;
                }
            }
        }
        do --r.height;
        while (r.height >= 0 && entry[r.height] > r.last);
        if (r.height >= 0) node = stack[r.height];
    }
    finish(r);
};
#endif
