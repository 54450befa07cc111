// Rays in the CPU tree: eight boxes or triangles at a time.
//
// Boxes and triangles are tested in float32 with margins that cover its rounding. What passes is decided in float64 by
// edge functions that are exact opposites on the two sides of an edge, so that no ray leaks.
//
// A thread has many rays in flight. Rays that are at a node, at a leaf, or at triangles to be decided wait in one queue
// each, and one queue is processed at a time. So the data of a ray is prefetched while others are processed, and no
// branch depends on what a ray meets. Such branches are unpredictable: mispredicted, they took as long as the tests.
// Children wait on the stack, the nearest on top. With the macro UNORDERED they wait in the builder's order, leaves on
// top: for rays that any hit ends, and for rays that visit everything.
//
// Leaves are packed by pack_ray_leaf_bvh8_cpu.inl. The test projects corners along the ray (its largest component is z,
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
//
// Expects core/simd.inl and ray_setup_bvh8_cpu.inl; tree, origins, directions, begin and end (of the rays' numbers);
// hit(start, direction, slot, t, v, w) in float64; take_hit(r, slot, t, v, w, shorten), called at a hit no farther than
// r.best: it may lower r.best and call shorten(r), and returns true to end the ray's traversal; finish(r), called when
// a traversal is over, with or without a hit. Both may use r.id, r.winner (-1 at first), r.count (0), r.weight_b and
// r.weight_c. IN_FLIGHT, STACK, LEAF_WORDS, HEAD, PLANE_MARGIN, ENDLESS; optionally the macro UNORDERED, under which
// nothing may be shortened.
#if !defined(__CUDA_ARCH__)
{
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
                next_group(next, count);
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
        #if defined(UNORDERED)
            masks[q] = mask_of(reached);
        #else
            // Bits of non-negative floats sort as the floats do, and the lowest three hold the lane.
            masks[q] = mask_of(reached);
            *(u8*)keys[q] = reached ? ((u8)in & ~7u) | lane : 0u;
        #endif
        }
        // The children go on the stack, in a loop of its own: the chain of a ray's operations is half as long, so that
        // those of more rays overlap.
        for (int q = 0; q < node_count; ++q) {
            const int number = batch[q];
            Ray& r = rays[number];
            const int* const child = tree.children.data + 8 * r.node;
            const int height = r.height, count = __builtin_popcount(masks[q]);
        #if !defined(UNORDERED)
            // Sorted, the nearest last. Lanes that are not reached are zero and come behind it; so would be a key that
            // is zero, which is the same.
            u8 key = *(const u8*)keys[q];
            key = sorted(key);
            *(u8*)(r.entry + height) = key & ~7u;
        #endif
        #if defined(UNORDERED)
            *(i8*)(r.stack + height) = packed(*(const i8*)child, masks[q]);
        #elif defined(__AVX2__) && __has_builtin(__builtin_ia32_permvarsi256)
            *(i8*)(r.stack + height) = __builtin_ia32_permvarsi256(*(const i8*)child, (i8)(key & 7u));
        #else
            for (int i = 0; i < count; ++i) r.stack[height + i] = child[key[i] & 7u];
        #endif
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
                if (!hit(start, direction, slot, t, v, w) || t > r.best) continue;
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
}
#endif
