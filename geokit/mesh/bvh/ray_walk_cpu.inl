// Rays in the CPU tree: eight boxes or triangles at a time.
//
// Boxes and triangles are tested in float32 with margins that cover its rounding. What passes is decided in float64 by
// edge functions that are exact opposites on the two sides of an edge, so that no ray leaks.
//
// A thread has many rays in flight. Rays that are at a node, at a leaf, or at triangles to be decided wait in one queue
// each, and one queue is processed at a time. So the data of a ray is prefetched while others are processed, and no
// branch depends on what a ray meets. Such branches are unpredictable: mispredicted, they took as long as the tests.
// Children wait on the stack, the nearest on top. With UNORDERED they wait in the builder's order, leaves on
// top: for rays that any hit ends, and for rays that visit everything. Rays that any hit ends are tested with the widest
// triangles while they are set up; what these surely stop needs no walk.
//
// Leaves are packed by bvh8_leaves_cpu.inl. The test projects corners along the ray (its largest component is z,
// x and y are sheared) and tests whether the ray's point is within the triangle, of either winding. Let a ray hit the
// true triangle at weights u, v, w. Its distance from the point with those weights in the rounded triangle is at most
// d, by which rounding moved the corners and the ray. Then each edge function, seen from the ray, is on the wrong side
// by at most d times the length of that edge. That is the margin: no hit is missed, also for slivers and triangles
// without area.
//
// The hit lies between the depths of the nearest and the farthest corner, and near that of the plane above the ray's
// point. Times the sum of the edge functions (`whole`, twice the projected area), a plane rises by at most the
// triangle's range of depths times its edges over a distance of d, and the margin is at least d times an edge: two
// edges and the errors of the three functions are within four margins. For slivers that says little, and the corners
// decide.
#include "core/simd.inl"
#include "mesh/triangle/ray.inl"

#if !defined(__CUDA_ARCH__)
// One instruction each; the built-in functions take more, because they must prefer a number to NaN.
static constexpr auto larger = [](auto a, auto b) { return a > b ? a : b; };
static constexpr auto smaller = [](auto a, auto b) { return a < b ? a : b; };
static constexpr auto greatest = [](v8 a) {
    a = larger(a, __builtin_shufflevector(a, a, 4, 5, 6, 7, 0, 1, 2, 3));
    a = larger(a, __builtin_shufflevector(a, a, 2, 3, 0, 1, 6, 7, 4, 5));
    a = larger(a, __builtin_shufflevector(a, a, 1, 0, 3, 2, 5, 4, 7, 6));
    return a[0];
};
static constexpr auto least = [](v8 a) { return -greatest(-a); };
static constexpr bool ONE_HIT = UNORDERED && !CROSSINGS;
// The result of a ray so far.
struct Found {
    double best, weight_b, weight_c;
    int id, winner, count;
};
// Numbers of a ray in local units: reciprocals of its direction; those times its start, moved by BOX_MARGIN against
// near planes and far ones; its start and its slopes, along the axes of leaves; 1 or -1 along their z; its length. Then
// row numbers: the near and far rows of a node's boxes; the axis that is the z of leaves.
enum { RATE = 0, TO_NEAR = 3, TO_FAR = 6, AT = 9, SHEAR = 12, FORWARD = 14, LAST = 15 };
enum { NEAR_ROW = 0, FAR_ROW = 3, AXIS = 6 };
struct Group {
    alignas(64) double best[8], enter[8], unit[8];
    alignas(32) float field[8][16];
    alignas(32) int row[8][8];
    int first;
    unsigned waiting;  // lanes of rays that may hit something and are not done
    unsigned sure;     // lanes of rays that surely hit something: any hit ends them
};
// What rays meet first: the box of the mesh, widened by twice the rounding error of a ray.
struct Hull {
    float lower[3], upper[3];
};
static constexpr auto hull_of = [](const SurfaceTree& tree) -> Hull {
    Hull hull;
    for (int k = 0; k < 3; ++k) {
        hull.lower[k] = least(*(const v8*)(tree.boxes.data + 8 * k)) - 2.f * BOX_MARGIN;
        hull.upper[k] = greatest(*(const v8*)(tree.boxes.data + 8 * k + 24)) + 2.f * BOX_MARGIN;
    }
    return hull;
};
// Four rows of x, y, z as three vectors.
static constexpr auto columns = [](const double* row, d4* column) {
    const d4 a = *(const d4*)row, b = *(const d4*)(row + 4), c = *(const d4*)(row + 8);
    column[0] = __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 3, 6, 6), c, 0, 1, 2, 5);
    column[1] = __builtin_shufflevector(__builtin_shufflevector(a, b, 1, 4, 7, 7), c, 0, 1, 2, 6);
    column[2] = __builtin_shufflevector(__builtin_shufflevector(a, b, 2, 5, 5, 5), c, 0, 1, 4, 7);
};
static constexpr auto joined = [](const v4* half) {
    return __builtin_shufflevector(half[0], half[1], 0, 1, 2, 3, 4, 5, 6, 7);
};
// Eight vectors into eight rows, `stride` numbers apart.
static constexpr auto transpose = [](const v8* from, float* to, int stride) {
    v8 pair[8], four[8];
    for (int i = 0; i < 4; ++i) {
        pair[2 * i] = __builtin_shufflevector(from[2 * i], from[2 * i + 1], 0, 8, 1, 9, 4, 12, 5, 13);
        pair[2 * i + 1] = __builtin_shufflevector(from[2 * i], from[2 * i + 1], 2, 10, 3, 11, 6, 14, 7, 15);
    }
    for (int i = 0; i < 8; i += 4)
        for (int j = 0; j < 2; ++j) {
            const v8 a = pair[i + j], b = pair[i + j + 2];
            four[i + 2 * j] = __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13);
            four[i + 2 * j + 1] = __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
        }
    for (int i = 0; i < 4; ++i) {
        *(v8*)(to + i * stride) = __builtin_shufflevector(four[i], four[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        *(v8*)(to + (i + 4) * stride) = __builtin_shufflevector(four[i], four[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
};
// The lanes of rays that surely hit the triangle in a slot: more than SURE_MARGIN within its edges, ahead of their start
// and before `end`. Depth and place are multiplied by the slope, so that grazing rays lose no digits in a division.
//
// Starts are at most 2.01 from the middle along each axis, differences 3.01, and each of their components, of the
// directions and of the triangle's axes is rounded by 1.2e-7 or less. In the triangle's frame a place so has an error of
// at most 2e-6 and a slope one of 5e-7; by the products that becomes 1.3e-5, and for edges 1.9e-5 of the longest one.
// float64 decides with errors below 1e-9, for rays that start up to SURE_START away.
static constexpr auto surely_hit = [](const SurfaceTree& tree, int slot, const v8* at, const v8* way, const v8& end) {
    #pragma clang fp contract(fast)
    const float* const row = tree.leaves.data + 8 * PLANE_ROWS * (wp::int64)(slot >> 3) + (slot & 7);
    auto along = [&](const v8* p, int i) { return p[0] * row[8 * i] + p[1] * row[8 * i + 8] + p[2] * row[8 * i + 16]; };
    const v8 from[3] = {at[0] - row[0], at[1] - row[8], at[2] - row[16]};
    const v8 rise = along(from, 9), slope = along(way, 9), down = __builtin_elementwise_abs(slope);
    const v8 depth = slope < 0.f ? rise : -rise;
    const v8 x = along(from, 3) * down + along(way, 3) * depth, y = along(from, 6) * down + along(way, 6) * depth;
    const float longest = row[8 * 12], cx = row[8 * 13], cy = row[8 * 14], margin = SURE_MARGIN * longest;
    return mask_of((depth > SURE_MARGIN) & (depth + SURE_MARGIN < end * down) & (y > SURE_MARGIN)
                   & (cy * x - cx * y > margin) & ((cx - longest) * y - cy * (x - longest * down) > margin));
};
// Set-up of rays: eight rays, one lane each.
//
// For a single ray the set-up is a chain of divisions and conversions that took a quarter of a random ray's time. Half
// of those rays miss the mesh's box altogether, which costs no more to detect for eight rays than for one. The numbers
// that the traversal reads of a ray are transposed into 16 floats and 8 row numbers: copying them one by one took a
// tenth of a random ray's time. Doubles are processed in fours: vectors of 512 bits lower the clock of some processors
// for a while, and all traversals took 5 to 7 % longer.
//
// The next rays, up to eight, as from + s * along in local units with the largest component of along being 1:
// s = unit * t.
static constexpr auto set_up = [](const SurfaceTree& tree, const Hull& hull, const wp::array_t<wp::vec3d>& origins,
                                  const wp::array_t<wp::vec3d>& directions, double t_min, double max_distance,
                                  wp::array_t<int>& out_bad, Group& group, int first, int count) {
    // The result only selects candidates: fused products round less, and are faster.
    #pragma clang fp contract(fast)
    const double local = 1.0 / tree.scale;
    const double* place = (const double*)(origins.data + first);
    const double* heading = (const double*)(directions.data + first);
    for (int i = 0; i < 3; ++i) {
        __builtin_prefetch((const char*)(place + 3 * AHEAD) + 64 * i);
        __builtin_prefetch((const char*)(heading + 3 * AHEAD) + 64 * i);
    }
    double rows[2][24];
    if (count < 8) {
        for (int i = 0; i < 24; ++i) {
            const int j = i < 3 * count ? i : i % 3;
            rows[0][i] = place[j];
            rows[1][i] = heading[j];
        }
        place = rows[0];
        heading = rows[1];
    }
    d4 reach[2] = {max_distance, max_distance};
    if (max_distance < (double)INFINITY) {
        for (int i = 0; i < count; ++i) reach[i >> 2][i & 3] /= wp::length(directions.data[first + i]);
    }
    unsigned left = 0xffu >> (8 - count), near = 0xffu;
    v4 toward[3][2], reciprocal[3][2], start[3][2], length[2];
    // Unrolled, so that the results stay in registers: loading eight floats as one vector stalls if they were stored as
    // two halves.
    #pragma unroll
    for (int h = 0; h < 2; ++h) {
        d4 from[3], along[3], largest = 0.0, far = 0.0, none = 0.0;
        columns(place + 12 * h, from);
        columns(heading + 12 * h, along);
        for (int k = 0; k < 3; ++k) {
            // x - x is zero, unless x is infinite or NaN.
            none += (from[k] - from[k]) + (along[k] - along[k]);
            largest = larger(largest, __builtin_elementwise_abs(along[k]));
            from[k] = (from[k] - tree.origin[k]) * local;
            far = larger(far, __builtin_elementwise_abs(from[k]));
        }
        const unsigned good = mask_of_four((largest >= SHORTEST_DIRECTION) & (none == 0.0));
        if (good != 15u) {
            // The host rejects the whole batch and names the row.
            out_bad.data[0] = 1;
            left &= good << 4 * h | 15u << 4 * (1 - h);
        }
        const d4 shrink = 1.0 / largest, unit = largest * local;
        for (int k = 0; k < 3; ++k) {
            along[k] *= shrink;
            const v4 way = __builtin_convertvector(along[k], v4), shortest = LEAST_COMPONENT;
            toward[k][h] = way;
            reciprocal[k][h] =
                __builtin_elementwise_copysign(1.f / larger(__builtin_elementwise_abs(way), shortest), way);
        }
        d4 enter = t_min * unit;
        const auto outside = far > NEAR_START;
        if (mask_of_four(outside)) {
            // Slightly early and late: these reciprocals have the precision of float32, and the cube has a margin.
            const d4 edge = 1.0 + 1e-5 + 1e-6 * far;
            d4 in = enter, out = (double)INFINITY;
            for (int k = 0; k < 3; ++k) {
                const d4 rate = __builtin_convertvector(reciprocal[k][h], d4);
                const d4 t0 = (-edge - from[k]) * rate, t1 = (edge - from[k]) * rate;
                in = larger(in, smaller(t0, t1));
                out = smaller(out, larger(t0, t1));
            }
            left &= mask_of_four(~outside | (in <= out)) << 4 * h | 15u << 4 * (1 - h);
            near &= mask_of_four(far <= SURE_START) << 4 * h | 15u << 4 * (1 - h);
            enter = outside ? in : enter;
        }
        *(d4*)(group.best + 4 * h) = reach[h];
        *(d4*)(group.enter + 4 * h) = enter;
        *(d4*)(group.unit + 4 * h) = unit;
        length[h] = __builtin_convertvector(reach[h] * unit - enter, v4);
        for (int k = 0; k < 3; ++k) start[k][h] = __builtin_convertvector(from[k] + enter * along[k], v4);
    }
    // As length_of in walk_rays, for eight rays.
    const v8 last = smaller(joined(length) * 1.000001f + PLANE_MARGIN, (v8)ENDLESS);
    v8 field[16], in = 0.f, out = last, at[3], way[3];
    i8 back[3];
    for (int k = 0; k < 3; ++k) {
        at[k] = joined(start[k]);
        way[k] = joined(toward[k]);
        const v8 rate = joined(reciprocal[k]);
        const v8 aside = __builtin_elementwise_copysign((v8)BOX_MARGIN, rate);
        field[RATE + k] = rate;
        field[TO_NEAR + k] = -(at[k] + aside) * rate;
        field[TO_FAR + k] = -(at[k] - aside) * rate;
        back[k] = ((i8)rate >> 31) & 24;
        const v8 t0 = (hull.lower[k] - at[k]) * rate, t1 = (hull.upper[k] - at[k]) * rate;
        in = larger(in, smaller(t0, t1));
        out = smaller(out, larger(t0, t1));
    }
    group.first = first;
    group.waiting = left & mask_of(in <= out);
    group.sure = 0;
    if (ONE_HIT) {
        const v8 end = (last - PLANE_MARGIN) * 0.999997f;
        for (int k = 0; k < tree.wide.shape[0] && (group.waiting & near); ++k) {
            const unsigned hits = group.waiting & near & surely_hit(tree, tree.wide.data[k], at, way, end);
            group.sure |= hits;
            group.waiting &= ~hits;
        }
    }
    if (!group.waiting) return;
    // The axis of the largest component, 1 or -1, is the z of leaves.
    const auto z_is_x = __builtin_elementwise_abs(way[0]) == 1.f;
    const auto z_is_y = ~z_is_x & (__builtin_elementwise_abs(way[1]) == 1.f);
    const auto z_is_z = ~(z_is_x | z_is_y);
    const v8 forward = z_is_x ? way[0] : z_is_y ? way[1] : way[2];
    field[AT] = z_is_x ? at[1] : at[0];
    field[AT + 1] = z_is_z ? at[1] : at[2];
    field[AT + 2] = z_is_x ? at[0] : z_is_y ? at[1] : at[2];
    field[SHEAR] = (z_is_x ? way[1] : way[0]) * forward;
    field[SHEAR + 1] = (z_is_z ? way[1] : way[2]) * forward;
    field[FORWARD] = forward;
    field[LAST] = last;
    transpose(field, group.field[0], 16);
    transpose(field + 8, group.field[0] + 8, 16);
    const i8 axis = (z_is_y & 1) | (z_is_z & 2);
    const v8 row[8] = {(v8)back[0],        (v8)(back[1] + 8),  (v8)(back[2] + 16), (v8)(24 - back[0]),
                       (v8)(32 - back[1]), (v8)(40 - back[2]), (v8)axis,           (v8)axis};
    transpose(row, (float*)group.row[0], 8);
};
// Out of line, because the traversal needs the registers.
static constexpr auto next_group = [](const SurfaceTree& tree, const Hull& hull, const wp::array_t<wp::vec3d>& origins,
                                      const wp::array_t<wp::vec3d>& directions, double t_min, double max_distance,
                                      wp::array_t<int>& out_bad, Group& group, int first, int count,
                                      auto&& finish) OUT_OF_LINE {
    set_up(tree, hull, origins, directions, t_min, max_distance, out_bad, group, first, count);
    for (unsigned passed = ~group.waiting & (0xffu >> (8 - count)); passed; passed &= passed - 1) {
        Found r{};
        const int lane = __builtin_ctz(passed);
        r.id = first + lane;
        r.winner = ONE_HIT && (group.sure >> lane & 1) ? 0 : -1;  // any slot, where a hit is sure
        finish(r);
    }
};

// The rays `begin` to `end` - 1. take_hit(r, slot, t, v, w, shorten) is called at a hit no farther than r.best: it may
// lower r.best and call shorten(r), and returns true to end the ray's traversal. finish(r) is called when a traversal
// is over, with or without a hit. Both may use r.id, r.winner (-1 at first), r.count (0), r.weight_b and r.weight_c.
// With UNORDERED nothing may be shortened.
static constexpr auto walk_rays = [](const SurfaceTree& tree, const wp::array_t<wp::vec3d>& origins,
                                     const wp::array_t<wp::vec3d>& directions, int begin, int end, double t_min,
                                     double max_distance, wp::array_t<int>& out_bad, auto&& take_hit, auto&& finish) {
    // The traversal only selects candidates: fused products round less, and are faster.
    #pragma clang fp contract(fast)
    struct Ray : Found {
        alignas(32) float field[16];
        int row[8];
        double enter, unit;
        int node, height, block;
        unsigned hits;         // lanes of `block` that float64 decides
        int stack[STACK + 8];  // eight are written at a time; the first is DONE
        float entry[STACK + 8];
    };
    Ray rays[IN_FLIGHT];
    Group group;
    group.waiting = 0;
    const Hull hull = hull_of(tree);
    int next = begin;
    // Length of a ray up to `best`; finite, so that its product with a zero is zero.
    auto length_of = [&](double best, double unit, double enter) {
        return smaller((float)(best * unit - enter) * 1.000001f + PLANE_MARGIN, ENDLESS);
    };
    // Packs the numbers in some lanes.
    auto packed = [&](i8 numbers, unsigned lanes) {
    #if defined(__AVX2__) && defined(__BMI2__) && __has_builtin(__builtin_ia32_permvarsi256)
        const wp::uint64 bytes = __builtin_ia32_pdep_di(lanes, 0x0101010101010101ull) * 255;
        const i8 order =
            __builtin_convertvector(__builtin_bit_cast(c8, __builtin_ia32_pext_di(0x0706050403020100ull, bytes)), i8);
        return (i8)__builtin_ia32_permvarsi256(numbers, order);
    #else
        i8 front = numbers;
        for (int place = 0; lanes; lanes &= lanes - 1) front[place++] = numbers[__builtin_ctz(lanes)];
        return front;
    #endif
    };
    auto shorten = [&](Ray& r) {
        r.field[LAST] = length_of(r.best, r.unit, r.enter);
        // Drop waiting nodes that are now beyond the ray's end.
        int kept = 1;
        for (int i = 1; i < r.height; i += 8) {
            const v8 entry = *(const v8*)(r.entry + i);
            const i8 node = *(const i8*)(r.stack + i);
            const unsigned left =
                mask_of(entry <= r.field[LAST]) & (r.height - i < 8 ? 0xffu >> (8 - (r.height - i)) : 0xffu);
            *(i8*)(r.entry + kept) = packed((i8)entry, left);
            *(i8*)(r.stack + kept) = packed(node, left);
            kept += __builtin_popcount(left);
        }
        r.height = kept;
    };
    // Sentinel: the number of the leaf after the last one.
    const int DONE = -1 - (int)(tree.slot_triangle.shape[0] >> 3);
    const char* const body[2] = {(const char*)tree.boxes.data, (const char*)tree.ray_leaves.data};
    static_assert(4 * LEAF_WORDS == 48 * sizeof(float), "a leaf is as long as the boxes of a node");
    // Queues have room for eight more: they are written eight at a time.
    int at_node[IN_FLIGHT + 8], at_leaf[IN_FLIGHT + 8], at_hits[IN_FLIGHT + 8], idle[IN_FLIGHT + 8];
    int nodes = 0, leaves = 0, hits = 0, idles = IN_FLIGHT;
    for (int i = 0; i < IN_FLIGHT; ++i) idle[i] = IN_FLIGHT - 1 - i;
    // The queue in process: the rays, the boxes or triangles that each may hit, and where each goes on.
    alignas(32) unsigned keys[IN_FLIGHT][8];
    alignas(32) int masks[IN_FLIGHT], batch[IN_FLIGHT], onward[IN_FLIGHT];
    // Sets the next step of a ray, and prefetches the data for it.
    auto go_on = [&](Ray& r, int node) {
        const int side = node >> 31;
        const char* const data = body[-side] + 4 * LEAF_WORDS * (wp::int64)(node ^ side);
        for (int i = 0; i < 3; ++i) __builtin_prefetch(data + 64 * i);
        __builtin_prefetch(tree.children.data + 8 * (wp::int64)(node & ~side));
        r.node = node;
    };
    auto append = [&](int* queue, int& length, i8 numbers, unsigned lanes) {
        *(i8*)(queue + length) = packed(numbers, lanes);
        length += __builtin_popcount(lanes);
    };
    // Distributes the rays of the queue in process: those that stay have triangles for float64.
    auto distribute = [&](int count, bool may_stay) {
        for (int q = 0; q < count; q += 8) {
            const i8 numbers = *(const i8*)(batch + q), node = *(const i8*)(onward + q);
            unsigned left = count - q < 8 ? 0xffu >> (8 - (count - q)) : 0xffu;
            if (may_stay) {
                const unsigned staying = left & mask_of(*(const i8*)(masks + q) != 0);
                append(at_hits, hits, numbers, staying);
                left &= ~staying;
            }
            const unsigned inner = mask_of(node >= 0), done = mask_of(node == DONE);
            append(at_node, nodes, numbers, left & inner);
            append(at_leaf, leaves, numbers, left & ~(inner | done));
            append(idle, idles, numbers, left & done);
        }
    };
    const v8 zero = 0.f;
    const u8 lane = {0, 1, 2, 3, 4, 5, 6, 7};
    // Descending, by a bitonic network.
    auto sorted = [&](u8 k) {
        u8 t = __builtin_shufflevector(k, k, 1, 0, 3, 2, 5, 4, 7, 6);
        k = __builtin_shufflevector(larger(k, t), smaller(k, t), 0, 9, 2, 11, 4, 13, 6, 15);
        t = __builtin_shufflevector(k, k, 3, 2, 1, 0, 7, 6, 5, 4);
        k = __builtin_shufflevector(larger(k, t), smaller(k, t), 0, 1, 10, 11, 4, 5, 14, 15);
        t = __builtin_shufflevector(k, k, 1, 0, 3, 2, 5, 4, 7, 6);
        k = __builtin_shufflevector(larger(k, t), smaller(k, t), 0, 9, 2, 11, 4, 13, 6, 15);
        t = __builtin_shufflevector(k, k, 7, 6, 5, 4, 3, 2, 1, 0);
        k = __builtin_shufflevector(larger(k, t), smaller(k, t), 0, 1, 2, 3, 12, 13, 14, 15);
        t = __builtin_shufflevector(k, k, 2, 3, 0, 1, 6, 7, 4, 5);
        k = __builtin_shufflevector(larger(k, t), smaller(k, t), 0, 1, 10, 11, 4, 5, 14, 15);
        t = __builtin_shufflevector(k, k, 1, 0, 3, 2, 5, 4, 7, 6);
        return __builtin_shufflevector(larger(k, t), smaller(k, t), 0, 9, 2, 11, 4, 13, 6, 15);
    };
    while (true) {
        // Rays that may hit something replace finished ones.
        while (idles > 0) {
            if (!group.waiting) {
                if (next >= end) break;
                const int count = end - next < 8 ? end - next : 8;
                next_group(tree, hull, origins, directions, t_min, max_distance, out_bad, group, next, count, finish);
                next += count;
                continue;
            }
            const int number = idle[--idles], i = __builtin_ctz(group.waiting);
            Ray& r = rays[number];
            group.waiting &= group.waiting - 1;
            r.id = group.first + i;
            r.winner = -1;
            r.count = 0;
            r.weight_b = 0.0;
            r.weight_c = 0.0;
            r.best = group.best[i];
            r.enter = group.enter[i];
            r.unit = group.unit[i];
            *(v8*)r.field = *(const v8*)group.field[i];
            *(v8*)(r.field + 8) = *(const v8*)(group.field[i] + 8);
            *(i8*)r.row = *(const i8*)group.row[i];
            r.node = 0;
            r.height = 1;
            r.stack[0] = DONE;
            at_node[nodes++] = number;
        }
        if (nodes + leaves + hits == 0) break;
        const int finished = idles, node_count = nodes;
        nodes = 0;
        for (int q = 0; q < node_count; ++q) {
            const int number = at_node[q];
            const Ray& r = rays[number];
            const float* const box = tree.boxes.data + 48 * r.node;
            batch[q] = number;
            v8 in = *(const v8*)(box + r.row[NEAR_ROW]) * r.field[RATE] + r.field[TO_NEAR];
            v8 out = *(const v8*)(box + r.row[FAR_ROW]) * r.field[RATE] + r.field[TO_FAR];
            in = larger(in, *(const v8*)(box + r.row[NEAR_ROW + 1]) * r.field[RATE + 1] + r.field[TO_NEAR + 1]);
            out = smaller(out, *(const v8*)(box + r.row[FAR_ROW + 1]) * r.field[RATE + 1] + r.field[TO_FAR + 1]);
            in = larger(in, *(const v8*)(box + r.row[NEAR_ROW + 2]) * r.field[RATE + 2] + r.field[TO_NEAR + 2]);
            out = smaller(out, *(const v8*)(box + r.row[FAR_ROW + 2]) * r.field[RATE + 2] + r.field[TO_FAR + 2]);
            in = larger(in, zero);
            out = smaller(out, (v8)r.field[LAST]);
            const auto reached = in <= out;
            masks[q] = mask_of(reached);
            // Bits of non-negative floats sort as the floats do, and the lowest three hold the lane.
            if (!UNORDERED) *(u8*)keys[q] = reached ? ((u8)in & ~7u) | lane : 0u;
        }
        // The children go on the stack, in a loop of its own: the chain of a ray's operations is half as long, so that
        // those of more rays overlap.
        for (int q = 0; q < node_count; ++q) {
            const int number = batch[q];
            Ray& r = rays[number];
            const int* const child = tree.children.data + 8 * r.node;
            const int height = r.height, count = __builtin_popcount(masks[q]);
            if (UNORDERED) *(i8*)(r.stack + height) = packed(*(const i8*)child, masks[q]);
            else {
                // Sorted, the nearest last. Lanes that are not reached are zero and come behind it; so would be a key
                // that is zero, which is the same.
                u8 key = *(const u8*)keys[q];
                key = sorted(key);
                *(u8*)(r.entry + height) = key & ~7u;
        #if defined(__AVX2__) && __has_builtin(__builtin_ia32_permvarsi256)
                *(i8*)(r.stack + height) = __builtin_ia32_permvarsi256(*(const i8*)child, (i8)(key & 7u));
        #else
                for (int i = 0; i < count; ++i) r.stack[height + i] = child[key[i] & 7u];
        #endif
            }
            r.height = height + count - 1;
            onward[q] = r.stack[r.height];
            go_on(r, onward[q]);
        }
        distribute(node_count, false);
        // Before leaves are tested, so that the triangles that those pass on have a round to arrive in the cache.
        const int hit_count = hits;
        hits = 0;
        for (int q = 0; q < hit_count; ++q) {
            Ray& r = rays[at_hits[q]];
            batch[q] = at_hits[q];
            const point &start = origins.data[r.id], &direction = directions.data[r.id];
            for (; r.hits; r.hits &= r.hits - 1) {
                const int slot = 8 * r.block + __builtin_ctz(r.hits);
                double t, v, w;
                if (!hit(tree, t_min, start, direction, slot, t, v, w) || t > r.best) continue;
                if (take_hit(r, slot, t, v, w, shorten)) {
                    r.height = 1;  // nothing waits: the walk is over
                    break;
                }
            }
            onward[q] = r.stack[--r.height];
            go_on(r, onward[q]);
        }
        distribute(hit_count, false);
        const int leaf_count = leaves;
        leaves = 0;
        for (int q = 0; q < leaf_count; ++q) {
            const int number = at_leaf[q];
            Ray& r = rays[number];
            batch[q] = number;
            const int block = -1 - r.node;
            // The triangles of the leaf that the ray may hit, as a bit mask of lanes.
            const float* const words = tree.ray_leaves.data + LEAF_WORDS * (wp::int64)block;
            const unsigned short* const row = (const unsigned short*)words;
            const float* const head = words + HEAD;
            const int kz = r.row[AXIS], kx = kz == 0, ky = 2 - (kz == 2);
            // The ray's start in the quanta of the leaf.
            const float rate = head[3], sx = r.field[SHEAR], sy = r.field[SHEAR + 1],
                        az = (r.field[AT + 2] - head[kz]) * rate;
            const float ax = (r.field[AT] - head[kx]) * rate - sx * az,
                        ay = (r.field[AT + 1] - head[ky]) * rate - sy * az;
            auto coordinate = [&](int i) {
                return __builtin_convertvector(__builtin_convertvector(*(const h8*)(row + 8 * i), i8), v8);
            };
            const v8 z0 = coordinate(kz), z1 = coordinate(kz + 3), z2 = coordinate(kz + 6);
            const v8 x0 = (coordinate(kx) - sx * z0) - ax, y0 = (coordinate(ky) - sy * z0) - ay;
            const v8 x1 = (coordinate(kx + 3) - sx * z1) - ax, y1 = (coordinate(ky + 3) - sy * z1) - ay;
            const v8 x2 = (coordinate(kx + 6) - sx * z2) - ax, y2 = (coordinate(ky + 6) - sy * z2) - ay;
            const v8 e0 = x1 * y2 - y1 * x2, e1 = x2 * y0 - y2 * x0, e2 = x0 * y1 - y0 * x1;
            const v8 low = smaller(smaller(e0, e1), e2), high = larger(larger(e0, e1), e2);
            // The hit lies between the nearest and the farthest corner.
            const float forward = r.field[FORWARD], depth = az * forward, limit = r.field[LAST] * rate;
            const v8 d0 = z0 * forward, d1 = z1 * forward, d2 = z2 * forward;
            const v8 nearest = smaller(smaller(d0, d1), d2), farthest = larger(larger(d0, d1), d2);
            // And near the depth of the plane, times `whole`; NaN (0 * infinity) rejects nothing.
            const v8 signed_whole = e0 + e1 + e2, along = e1 * (d1 - d0) + e2 * (d2 - d0);
            const i8 sign = (i8)signed_whole & (int)0x80000000;
            const v8 whole = (v8)((i8)signed_whole ^ sign), over = (v8)((i8)along ^ sign);
            const v8 slack = 4.f * head[4] * (farthest - nearest);
            const auto aside = (over < (depth - head[5] - 1.f - d0) * whole - slack)
                               | (over > (depth + limit + head[5] + 1.f - d0) * whole + slack);
            const unsigned lanes = ((const unsigned*)head)[6] & 0xffu
                                   & mask_of(((low >= -head[4]) | (high <= head[4])) & (farthest >= depth - head[5])
                                             & (nearest <= depth + limit + head[5]) & ~aside);
            // As in go_on, or the triangles for float64.
            const int none = lanes == 0, slot = 8 * block + __builtin_ctz(lanes | 128u), node = r.stack[r.height - 1];
            const int side = node >> 31;
            r.hits = lanes;
            r.block = block;
            r.node = node;
            r.height -= none;
            masks[q] = lanes;
            onward[q] = node;
            const char* const data[2] = {(const char*)(tree.corners.data + 3 * slot),
                                         body[-side] + 4 * LEAF_WORDS * (wp::int64)(node ^ side)};
            const char* const rest[2] = {(const char*)(tree.slot_triangle.data + slot),
                                         (const char*)(tree.children.data + 8 * (wp::int64)(node & ~side))};
            __builtin_prefetch(data[none]);
            __builtin_prefetch(data[none] + 64);
            __builtin_prefetch(data[none] + 128 * none);
            __builtin_prefetch(rest[none]);
        }
        distribute(leaf_count, true);
        for (int q = finished; q < idles; ++q) finish(rays[idle[q]]);
    }
};
#endif
