// Candidates of a ray on CUDA: a float32 traversal that collects the few triangles that the ray may hit first.
//
// A triangle that the ray hits well inside ends the search behind it. One that it hits within the margin of an edge
// does not, and is decided in float64 together with the other candidates. With ANY_HIT a triangle that the ray hits
// well inside, and well within its length, ends the whole search; the widest triangles are tested before the tree.
#include "mesh/bvh/bvh2.inl"
#include "mesh/triangle/ray.inl"

struct alignas(16) Four {
    float x, y, z, w;
};

// The candidates' slots, with the bit IS_SLIVER, up to NO_CANDIDATE. found[0] is UNDECIDED where they do not fit or the
// ray starts too far away for float32, and SURE where the ray hits something.
static constexpr auto find_candidates = [](const SurfaceTree& tree, const point& start, const point& direction,
                                           double t_min, double t_max, int* found) {
#if !defined(__CUDA_ARCH__)
    // Warp's CPU compiler has these only as built-ins; tests run this search on a CPU.
    auto fminf = [](float a, float b) { return __builtin_fminf(a, b); };
    auto fmaxf = [](float a, float b) { return __builtin_fmaxf(a, b); };
    auto fabsf = [](float a) { return __builtin_fabsf(a); };
    auto sqrtf = [](float a) { return __builtin_sqrtf(a); };
    auto copysignf = [](float a, float b) { return __builtin_copysignf(a, b); };
    auto fmaf = [](float a, float b, float c) { return __builtin_fmaf(a, b, c); };
#endif
    found[0] = NO_CANDIDATE;
    float sx, sy, sz, tx, ty, tz, last;
    {
        const double largest = wp::max(wp::max(wp::abs(direction[0]), wp::abs(direction[1])), wp::abs(direction[2]));
        const double local = 1.0 / tree.scale, shrink = 1.0 / largest, unit = largest * local;
        const double fx = (start[0] - tree.origin[0]) * local, fy = (start[1] - tree.origin[1]) * local,
                     fz = (start[2] - tree.origin[2]) * local;
        const double ax = direction[0] * shrink, ay = direction[1] * shrink, az = direction[2] * shrink;
        tx = (float)ax;
        ty = (float)ay;
        tz = (float)az;
        double enter = t_min * unit;
        const float far = fmaxf(fmaxf(fabsf((float)fx), fabsf((float)fy)), fabsf((float)fz));
        if (!(far < 1e30f && largest < 1e300)) {
            found[0] = UNDECIDED;
            return;
        }
        if (far > (float)NEAR_START) {
            // Start near the cube, but safely before the ray enters it: there is nothing to hit farther out.
            const float length = sqrtf(tx * tx + ty * ty + tz * tz);
            const float middle = -((float)fx * tx + (float)fy * ty + (float)fz * tz) / (length * length);
            enter = wp::max(enter, (double)(middle - (1.75f + 1e-5f * far) / length));
        }
        sx = (float)(fx + enter * ax);
        sy = (float)(fy + enter * ay);
        sz = (float)(fz + enter * az);
        last = fminf((float)(t_max * unit - enter) * 1.000001f + PLANE_MARGIN, ENDLESS);
        if (last < 0.f) return;
        // The ray misses the ball around the cube, or is still so far from it that float32 has too few digits.
        const float beside = fmaxf(fmaxf(fabsf(sx), fabsf(sy)), fabsf(sz));
        if (beside > 4.f) {
            found[0] = far > 1e4f ? UNDECIDED : NO_CANDIDATE;
            return;
        }
    }
    auto reciprocal_of = [&](float component) {
        return 1.f / copysignf(fmaxf(fabsf(component), LEAST_COMPONENT), component);
    };
    const float ix = reciprocal_of(tx), iy = reciprocal_of(ty), iz = reciprocal_of(tz);
    const float ox = -sx * ix, oy = -sy * iy, oz = -sz * iz;
    // Fused explicitly: modules of the user's may not let the compiler do so.
    // Distance at which the ray enters a box, or infinity.
    auto entry_of = [&](float lx, float ly, float lz, float ux, float uy, float uz) {
        const float x0 = fmaf(lx, ix, ox), x1 = fmaf(ux, ix, ox), y0 = fmaf(ly, iy, oy), y1 = fmaf(uy, iy, oy);
        const float z0 = fmaf(lz, iz, oz), z1 = fmaf(uz, iz, oz);
        const float in = fmaxf(fmaxf(fminf(x0, x1), fminf(y0, y1)), fmaxf(fminf(z0, z1), 0.f));
        const float out = fminf(fminf(fmaxf(x0, x1), fmaxf(y0, y1)), fminf(fmaxf(z0, z1), last));
        return in <= out ? in : (float)INFINITY;
    };
    int slot_of[CANDIDATES];
    int count = 0;
    bool full = false;
    const float end = (last - PLANE_MARGIN) * 0.999998f - PLANE_MARGIN;
    bool sure = false;
    float nearest_of[CANDIDATES];
    auto prune = [&]() {
        int kept = 0;
        for (int i = 0; i < count; ++i)
            if (nearest_of[i] <= last) {
                slot_of[kept] = slot_of[i];
                nearest_of[kept++] = nearest_of[i];
            }
        count = kept;
    };
    auto dot = [&](float a, float b, float c, float x, float y, float z) { return fmaf(a, x, fmaf(b, y, c * z)); };
    // Multiplied by dz, with signs such that dz is positive: grazing rays lose no digits in a division.
    auto test = [&](int slot) {
        const Four* row = (const Four*)(tree.leaves.data + SLOT_WORDS * slot);
        const Four r0 = row[0], r1 = row[1], r2 = row[2], r3 = row[3];
        const float ax = sx - r0.x, ay = sy - r0.y, az = sz - r0.z;
        const float oz = dot(ax, ay, az, r2.y, r2.z, r2.w), dz = dot(tx, ty, tz, r2.y, r2.z, r2.w);
        const float depth = dz < 0.f ? oz : -oz, down = fabsf(dz);
        if (!(depth >= -PLANE_MARGIN && depth <= fmaf(last, down, PLANE_MARGIN))) return;
        const float ox = dot(ax, ay, az, r0.w, r1.x, r1.y), dx = dot(tx, ty, tz, r0.w, r1.x, r1.y);
        const float oy = dot(ax, ay, az, r1.z, r1.w, r2.x), dy = dot(tx, ty, tz, r1.z, r1.w, r2.x);
        const float x = fmaf(ox, down, dx * depth), y = fmaf(oy, down, dy * depth);
        const float longest = r3.x, cx = r3.y, cy = r3.z, margin = PLANE_MARGIN * longest;
        const float ca = fmaf(cy, x, -cx * y), bc = fmaf(cx - longest, y, -cy * fmaf(-longest, down, x));
        if (!(y >= -PLANE_MARGIN && ca >= -margin && bc >= -margin)) return;
        const bool inside = y > PLANE_MARGIN && ca > margin && bc > margin && depth > PLANE_MARGIN;
        if (ANY_HIT) {
            sure = inside && depth + PLANE_MARGIN < end * down;
            if (sure) return;
        } else {
            const float farthest = (depth + PLANE_MARGIN) / down * 1.000001f;
            if (inside && farthest < last) last = farthest;
            if (count == CANDIDATES) prune();
        }
        if (count == CANDIDATES) {
            full = true;
            return;
        }
        slot_of[count++] = cy < SLIVER * longest ? slot | IS_SLIVER : slot;
        if (!ANY_HIT) nearest_of[count - 1] = (depth - PLANE_MARGIN) / down * 0.999999f;
    };
    if (ANY_HIT) {
        for (int k = 0; k < tree.wide.shape[0] && !sure; ++k) test(tree.wide.data[k]);
        if (sure) {
            found[0] = SURE;
            return;
        }
        count = 0;  // the walk meets them again
        full = false;
    }
    int stack[64], height = 0, node = tree.children.data[0];
    while (true) {
        bool in_box = true;
        while (node >= 0 && in_box) {
            const Node n = load_node(tree.boxes.data, node);
            const float tl = entry_of(n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ);
            const float tr = entry_of(n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ);
            const bool left_first = tl <= tr;
            const float later = left_first ? tr : tl;
            if (later < INFINITY) stack[height++] = left_first ? n.right : n.left;
            node = left_first ? n.left : n.right;
            in_box = (left_first ? tl : tr) < INFINITY;
        }
        if (in_box) {
            for (int slot = first_slot(node); slot < end_slot(node) && !sure; ++slot) test(slot);
            if (sure) {
                found[0] = SURE;
                return;
            }
        }
        if (height == 0) break;
        node = stack[--height];
    }
    if (!ANY_HIT) prune();
    if (full) {
        found[0] = UNDECIDED;
        return;
    }
    for (int i = 0; i < count; ++i) found[i] = slot_of[i];
    if (count < CANDIDATES) found[count] = NO_CANDIDATE;
};

// The first hit: decides the nearest of a ray's candidates in float64.
static constexpr auto first_hit = [](int ray, const wp::array_t<wp::vec3d>& origins,
                                     const wp::array_t<wp::vec3d>& directions, const SurfaceTree& tree, double t_min,
                                     double max_distance, wp::array_t<double>& out_t, wp::array_t<int>& out_triangle_id,
                                     wp::array_t<wp::vec3d>& out_barycentric, wp::array_t<int>& out_bad) {
    point start, direction;
    double t_max;
    int found[CANDIDATES];
    found[0] = NO_CANDIDATE;
    if (fetch_ray(origins, directions, ray, max_distance, start, direction, t_max, out_bad))
        find_candidates(tree, start, direction, t_min, t_max, found);
    if (found[0] == UNDECIDED) {
        out_triangle_id.data[ray] = UNDECIDED;
        out_bad.data[1] = 1;
        return;
    }
    double best = t_max, weight_b = 0.0, weight_c = 0.0;
    int winner = -1;
    for (int i = 0; i < CANDIDATES; ++i) {
        if (found[i] < 0) break;
        const int slot = found[i] & ~IS_SLIVER;
        double t, v, w;
        if (!hit_at_all(tree, start, direction, slot, t, v, w)) continue;
        if (slot != found[i]) refine_sliver(tree, start, direction, slot, t, v, w);
        if (t < t_min || t > best) continue;
        // Ties go to the lowest triangle.
        if (t == best && winner >= 0 && tree.slot_triangle.data[slot] > tree.slot_triangle.data[winner]) continue;
        best = t;
        weight_b = v;
        weight_c = w;
        winner = slot;
    }
    const double none = (double)NAN;
    out_t.data[ray] = winner < 0 ? (double)INFINITY : best;
    out_triangle_id.data[ray] = winner < 0 ? -1 : tree.slot_triangle.data[winner];
    out_barycentric.data[ray] =
        winner < 0 ? point(none, none, none) : point(1.0 - weight_b - weight_c, weight_b, weight_c);
};

// Decides in float64 whether a ray hits one of its candidates.
static constexpr auto any_hit = [](int ray, const wp::array_t<wp::vec3d>& origins,
                                   const wp::array_t<wp::vec3d>& directions, const SurfaceTree& tree, double t_min,
                                   double max_distance, wp::array_t<bool>& out_occluded, wp::array_t<int>& out_bad) {
    point start, direction;
    double t_max;
    int found[CANDIDATES];
    found[0] = NO_CANDIDATE;
    if (fetch_ray(origins, directions, ray, max_distance, start, direction, t_max, out_bad))
        find_candidates(tree, start, direction, t_min, t_max, found);
    if (found[0] == UNDECIDED) {
        ((unsigned char*)out_occluded.data)[ray] = LEFT_OVER;
        out_bad.data[1] = 1;
        return;
    }
    bool is_hit = found[0] == SURE;
    for (int i = 0; i < CANDIDATES && !is_hit; ++i) {
        if (found[i] < 0) break;
        const int slot = found[i] & ~IS_SLIVER;
        double t, v, w;
        if (!hit_at_all(tree, start, direction, slot, t, v, w)) continue;
        if (slot != found[i]) refine_sliver(tree, start, direction, slot, t, v, w);
        is_hit = t >= t_min && t <= t_max;
    }
    out_occluded.data[ray] = is_hit;
};
