// Rays in the CPU tree: eight boxes or triangles at a time.
//
// Boxes and triangles are tested in float32 with margins that cover its rounding. What passes is decided in float64 by
// edge functions that are exact opposites on the two sides of an edge, so that no ray leaks.
//
// A thread has many rays in flight. Rays that are at a node, at a leaf, or at triangles to be decided wait in one queue
// each, and one queue is processed at a time. So the data of a ray is prefetched while others are processed, and no
// branch depends on what a ray meets. Such branches are unpredictable: mispredicted, they took as long as the tests.
//
// Leaves are packed by pack_ray_leaf_bvh8_cpu.inl. The test projects corners along the ray (its largest component is z,
// x and y are sheared) and tests whether the ray's point is within the triangle, of either winding. Let a ray hit the
// true triangle at weights u, v, w. Its distance from the point with those weights in the rounded triangle is at most
// d, by which rounding moved the corners and the ray. Then each edge function, seen from the ray, is on the wrong side
// by at most d times the length of that edge. That is the margin: no hit is missed, also for slivers and triangles
// without area.
//
// Expects core/simd.inl and ray_setup_bvh8_cpu.inl; tree, origins, directions, begin and end (of the rays' numbers);
// hit(start, direction, slot, t, v, w) in float64; take_hit(r, slot, t, v, w, shorten), called at a hit no farther than
// r.best: it may lower r.best and call shorten(r), and returns true to end the ray's traversal; finish(r), called when
// a traversal is over, with or without a hit. Both may use r.id, r.winner (-1 at first), r.count (0), r.weight_b and
// r.weight_c. IN_FLIGHT, STACK, LEAF_WORDS, HEAD, PLANE_MARGIN, ENDLESS.
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
    auto shorten = [&](Ray& r) {
        r.field[LAST] = length_of(r.best, r.unit, r.enter);
        // Drop waiting nodes that are now beyond the ray's end.
        int kept = 1;
        for (int i = 1; i < r.height; ++i) {
            const float entry = r.entry[i];
            const int node = r.stack[i];
            r.entry[kept] = entry;
            r.stack[kept] = node;
            kept += entry <= r.field[LAST];
        }
        r.height = kept;
    };
    // Sentinel: the number of the leaf after the last one.
    const int DONE = -1 - (int)(tree.slot_triangle.shape[0] >> 3);
    const char* const body[2] = {(const char*)tree.boxes.data, (const char*)tree.ray_leaves.data};
    const char* const more[2] = {(const char*)tree.children.data, (const char*)tree.ray_leaves.data};
    const wp::int64 stride[2] = {32, 4 * LEAF_WORDS};
    static_assert(4 * LEAF_WORDS == 48 * sizeof(float), "a leaf is as long as the boxes of a node");
    int at_node[IN_FLIGHT], at_leaf[IN_FLIGHT], at_hits[IN_FLIGHT], idle[IN_FLIGHT];
    int nodes = 0, leaves = 0, hits = 0, idles = IN_FLIGHT;
    for (int i = 0; i < IN_FLIGHT; ++i) idle[i] = IN_FLIGHT - 1 - i;
    // Puts a ray into the queue of its next step, and prefetches the data for it.
    auto go_on = [&](int number, int node) {
        const int leaf = node < 0, done = node == DONE, index = node ^ (node >> 31);
        const char* const data = body[leaf] + 4 * LEAF_WORDS * (wp::int64)index;
        for (int i = 0; i < 3; ++i) __builtin_prefetch(data + 64 * i);
        __builtin_prefetch(more[leaf] + stride[leaf] * index);
        rays[number].node = node;
        at_node[nodes] = number;
        nodes += 1 - leaf;
        at_leaf[leaves] = number;
        leaves += leaf - done;
        idle[idles] = number;
        idles += done;
    };
    const v8 zero = 0.f;
    const u8 lane = {0, 1, 2, 3, 4, 5, 6, 7};
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
            Ray& r = rays[at_node[q]];
            const float* const box = tree.boxes.data + 48 * r.node;
            const int* const child = tree.children.data + 8 * r.node;
            v8 in = *(const v8*)(box + r.row[NEAR_ROW]) * r.field[RATE] + r.field[TO_NEAR];
            v8 out = *(const v8*)(box + r.row[FAR_ROW]) * r.field[RATE] + r.field[TO_FAR];
            in = larger(in, *(const v8*)(box + r.row[NEAR_ROW + 1]) * r.field[RATE + 1] + r.field[TO_NEAR + 1]);
            out = smaller(out, *(const v8*)(box + r.row[FAR_ROW + 1]) * r.field[RATE + 1] + r.field[TO_FAR + 1]);
            in = larger(in, *(const v8*)(box + r.row[NEAR_ROW + 2]) * r.field[RATE + 2] + r.field[TO_NEAR + 2]);
            out = smaller(out, *(const v8*)(box + r.row[FAR_ROW + 2]) * r.field[RATE + 2] + r.field[TO_FAR + 2]);
            in = larger(in, zero);
            out = smaller(out, (v8)r.field[LAST]);
            const auto reached = in <= out;
            const unsigned mask = mask_of(reached);
            // The nearest child goes first; sorting the others costs more than it saves. Bits of non-negative floats sort
            // as the floats do, and the lowest three hold the lane.
            const u8 key = reached ? ((u8)in & ~7u) | lane : (u8)~0u;
            u4 first = smaller(key.lo, key.hi);
            first = smaller(first, __builtin_shufflevector(first, first, 2, 3, 0, 1));
            first = smaller(first, __builtin_shufflevector(first, first, 1, 0, 3, 2));
            const int nearest = first[0] & 7, height = r.height, none = mask == 0;
            const unsigned rest = mask & ~(1u << nearest);
        // The other children and their entry distances go on the stack, side by side.
        #if defined(__AVX512VL__) && __has_builtin(__builtin_ia32_compresssf256_mask)
            *(v8*)(r.entry + height) = __builtin_ia32_compresssf256_mask(in, zero, rest);
            *(i8*)(r.stack + height) = __builtin_ia32_compresssi256_mask(*(const i8*)child, (i8)zero, rest);
        #elif defined(__AVX2__) && defined(__BMI2__) && __has_builtin(__builtin_ia32_permvarsf256)
            const wp::uint64 bytes = __builtin_ia32_pdep_di(rest, 0x0101010101010101ull) * 255;
            const i8 order = __builtin_convertvector(
                __builtin_bit_cast(c8, __builtin_ia32_pext_di(0x0706050403020100ull, bytes)), i8);
            *(v8*)(r.entry + height) = __builtin_ia32_permvarsf256(in, order);
            *(i8*)(r.stack + height) = __builtin_ia32_permvarsi256(*(const i8*)child, order);
        #else
            float distance[8];
            *(v8*)distance = in;
            int place = height;
            for (unsigned left = rest; left; left &= left - 1) {
                const int j = __builtin_ctz(left);
                r.entry[place] = distance[j];
                r.stack[place++] = child[j];
            }
        #endif
            r.height = height + __builtin_popcount(rest) - none;
            // A choice between addresses, so that the compiler emits no branch.
            const int* const onward[2] = {child + nearest, r.stack + height - 1};
            go_on(at_node[q], *onward[none]);
        }
        // Before leaves are tested, so that the triangles that those pass on have a round to arrive in the cache.
        const int hit_count = hits;
        hits = 0;
        for (int q = 0; q < hit_count; ++q) {
            Ray& r = rays[at_hits[q]];
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
            go_on(at_hits[q], r.stack[--r.height]);
        }
        const int leaf_count = leaves;
        leaves = 0;
        for (int q = 0; q < leaf_count; ++q) {
            const int number = at_leaf[q];
            Ray& r = rays[number];
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
            const unsigned lanes = ((const unsigned*)head)[6] & 0xffu
                                   & mask_of(((low >= -head[4]) | (high <= head[4])) & (farthest >= depth - head[5])
                                             & (nearest <= depth + limit + head[5]));
            // As in go_on, or into the queue of triangles for float64.
            const int none = lanes == 0, slot = 8 * block + __builtin_ctz(lanes | 128u), node = r.stack[r.height - 1];
            const int leaf = node < 0, done = node == DONE, index = node ^ (node >> 31);
            r.hits = lanes;
            r.block = block;
            r.node = node;
            r.height -= none;
            const char* const data[2] = {(const char*)(tree.corners.data + 3 * slot),
                                         body[leaf] + 4 * LEAF_WORDS * (wp::int64)index};
            const char* const rest[2] = {(const char*)(tree.slot_triangle.data + slot),
                                         more[leaf] + stride[leaf] * index};
            __builtin_prefetch(data[none]);
            __builtin_prefetch(data[none] + 64);
            __builtin_prefetch(data[none] + 128 * none);
            __builtin_prefetch(rest[none]);
            at_hits[hits] = number;
            hits += 1 - none;
            at_node[nodes] = number;
            nodes += none & (1 - leaf);
            at_leaf[leaves] = number;
            leaves += none & (leaf - done);
            idle[idles] = number;
            idles += none & done;
        }
        for (int q = finished; q < idles; ++q) finish(rays[idle[q]]);
    }
}
#endif
