// The slot of the nearest triangle in a tree, -1 if none is within the squared distance [world].
//
// The search runs in float32 and keeps every triangle that is possible within its rounding error. Those few are
// evaluated in float64, where ties go to the lowest triangle. The answer is therefore the float64 one, whatever the
// traversal order. With ANY_WITHIN a GPU accepts any triangle within the distance: the first in traversal order.
#include "core/simd.inl"
#include "mesh/triangle/closest.inl"
#include "mesh/bvh/bvh2.inl"

#if defined(__CUDA_ARCH__)
// The stack is deeper than a tree of bvh2.py may be.
static constexpr auto nearest_slot = [](const SurfaceTree& tree, const point& p, double max_squared, int) -> int {
    const float* nodes = tree.boxes.data;
    double exact = max_squared;  // world units squared
    int winner = -1;
    auto evaluate = [&](int slot) {
        const point a = tree.corners.data[3 * slot], b = tree.corners.data[3 * slot + 1],
                    c = tree.corners.data[3 * slot + 2];
        double v, w;
        const double squared = closest_on_triangle(p - a, b - a, c - a, v, w);
        if (squared > exact) return;
        // Ties go to the lowest triangle: the answer must not depend on the traversal order.
        if (squared == exact && winner >= 0 && tree.slot_triangle.data[slot] > tree.slot_triangle.data[winner]) return;
        exact = squared;
        winner = slot;
    };
    const double qx = (p[0] - tree.origin[0]) / tree.scale, qy = (p[1] - tree.origin[1]) / tree.scale,
                 qz = (p[2] - tree.origin[2]) / tree.scale;
    const double size = wp::max(wp::max(wp::abs(qx), wp::abs(qy)), wp::abs(qz));
    int stack[64], depth = 0, node = tree.children.data[0];
    if (size > FAR) {
        // Far queries are searched in float64, with the boxes' own rounding as slack.
        const double padding = BOX_PADDING + 3e-15 * size;
        double entry[64];
        auto box_squared = [&](double lx, double ly, double lz, double ux, double uy, double uz) {
            const double x = wp::max(wp::max(lx - qx, qx - ux), 0.0), y = wp::max(wp::max(ly - qy, qy - uy), 0.0),
                         z = wp::max(wp::max(lz - qz, qz - uz), 0.0);
            return x * x + y * y + z * z;
        };
        while (true) {
            const double reach = sqrt(exact) / tree.scale + padding, limit = reach * reach;
            if (node >= 0) {
                const Node n = load_node(nodes, node);
                const double dl = box_squared(n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ);
                const double dr = box_squared(n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ);
                const bool left_first = dl <= dr;
                if ((left_first ? dr : dl) <= limit) {
                    stack[depth] = left_first ? n.right : n.left;
                    entry[depth++] = left_first ? dr : dl;
                }
                node = left_first ? n.left : n.right;
                if ((left_first ? dl : dr) <= limit) continue;
            } else {
                for (int slot = first_slot(node); slot < end_slot(node); ++slot) evaluate(slot);
                if (ANY_WITHIN && winner >= 0) return winner;
            }
            const double now = sqrt(exact) / tree.scale + padding;
            do --depth;
            while (depth >= 0 && entry[depth] > now * now);
            if (depth < 0) break;
            node = stack[depth];
        }
        return winner;
    }
    const float X = (float)qx, Y = (float)qy, Z = (float)qz;
    const float slack = 2.f * DISTANCE_ERROR * ((float)size + 1.f);
    // Any triangle nearer than this, in float32, can be the nearest.
    auto widened = [&](float squared) {
        const float reach = sqrtf(squared) + slack;
        return reach * reach;
    };
    const double radius = max_squared / (tree.scale * tree.scale);
    float reach = radius < UNBOUNDED ? widened((float)radius * 1.000001f) : (float)UNBOUNDED;
    float least = (float)UNBOUNDED;
    int candidate[CUDA_CANDIDATES];
    float candidate_squared[CUDA_CANDIDATES];
    int candidates = 0;
    auto settle = [&]() {
        for (int i = 0; i < candidates; ++i)
            if (candidate_squared[i] <= reach) evaluate(candidate[i]);
        candidates = 0;
    };
    auto clamped = [](float x, float upper) { return fminf(fmaxf(x, 0.f), upper); };
    auto test = [&](int slot) {
        const float4* row = (const float4*)(tree.leaves.data + SLOT_WORDS * slot);
        const float4 r0 = row[0], r1 = row[1], r2 = row[2], r3 = row[3];
        const float ax = X - r0.x, ay = Y - r0.y, az = Z - r0.z;
        const float x = ax * r0.w + ay * r1.x + az * r1.y;
        const float y = ax * r1.z + ay * r1.w + az * r2.x;
        const float z = ax * r2.y + ay * r2.z + az * r2.w;
        const float length = r3.x, cx = r3.y, cy = r3.z, bx = x - length, bcx = cx - length;
        float flat = 0.f;
        if (!(y > 0.f && cy * x > cx * y && bcx * y > cy * bx)) {
            const float ex = x - clamped(x, length);
            const float s = clamped((x * cx + y * cy) * r3.w, 1.f), sx = x - s * cx, sy = y - s * cy;
            const float t = clamped((bx * bcx + y * cy) * row[4].x, 1.f), tx = bx - t * bcx, ty = y - t * cy;
            flat = fminf(fminf(ex * ex + y * y, sx * sx + sy * sy), tx * tx + ty * ty);
        }
        const float d2 = flat + z * z;
        if (!(d2 <= reach)) return;
        if (ANY_WITHIN) {
            evaluate(slot);
            return;
        }
        if (d2 < least) {
            least = d2;
            reach = fminf(reach, widened(d2));
        }
        if (candidates == CUDA_CANDIDATES) {
            int kept = 0;
            for (int i = 0; i < candidates; ++i)
                if (candidate_squared[i] <= reach) {
                    candidate[kept] = candidate[i];
                    candidate_squared[kept++] = candidate_squared[i];
                }
            candidates = kept;
            if (candidates == CUDA_CANDIDATES) settle();
        }
        candidate[candidates] = slot;
        candidate_squared[candidates++] = d2;
    };
    auto box_squared = [&](float lx, float ly, float lz, float ux, float uy, float uz) {
        const float x = fmaxf(fmaxf(lx - X, X - ux), 0.f), y = fmaxf(fmaxf(ly - Y, Y - uy), 0.f),
                    z = fmaxf(fmaxf(lz - Z, Z - uz), 0.f);
        return x * x + y * y + z * z;
    };
    float entry[64];
    while (true) {
        // Descend to a leaf first: threads that have reached one wait for the others, and all test triangles together.
        bool reached = true;
        while (node >= 0 && reached) {
            const Node n = load_node(nodes, node);
            const float dl = box_squared(n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ);
            const float dr = box_squared(n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ);
            const bool left_first = dl <= dr;
            const float later = left_first ? dr : dl;
            if (later <= reach) {
                stack[depth] = left_first ? n.right : n.left;
                entry[depth++] = later;
            }
            node = left_first ? n.left : n.right;
            reached = (left_first ? dl : dr) <= reach;
        }
        if (reached)
            for (int slot = first_slot(node); slot < end_slot(node); ++slot) test(slot);
        if (ANY_WITHIN && winner >= 0) return winner;
        do --depth;
        while (depth >= 0 && entry[depth] > reach);
        if (depth < 0) break;
        node = stack[depth];
    }
    if (winner < 0 && max_squared == (double)INFINITY) {
        // A single remaining candidate needs no float64 evaluation here; the caller computes its distance.
        int alone = -1, left = 0;
        for (int i = 0; i < candidates; ++i)
            if (candidate_squared[i] <= reach) {
                alone = candidate[i];
                ++left;
            }
        if (left == 1) return alone;
    }
    settle();
    return winner;
};
#else
// Eight boxes or triangles at a time. `seed` is a slot that is probably near, or -1.
static constexpr auto nearest_slot = [](const SurfaceTree& tree, const point& p, double max_squared, int seed) -> int {
    const float* boxes = tree.boxes.data;
    const int* children = tree.children.data;
    const float* leaves = tree.leaves.data;
    double exact = max_squared;  // world units squared
    int winner = -1;
    auto evaluate = [&](int slot) {
        const int triangle = tree.slot_triangle.data[slot];
        if (triangle < 0) return;
        const point a = tree.corners.data[3 * slot], b = tree.corners.data[3 * slot + 1],
                    c = tree.corners.data[3 * slot + 2];
        double v, w;
        const double squared = closest_on_triangle(p - a, b - a, c - a, v, w);
        if (squared > exact) return;
        // Ties go to the lowest triangle: the answer must not depend on the traversal order.
        if (squared == exact && winner >= 0 && triangle > tree.slot_triangle.data[winner]) return;
        exact = squared;
        winner = slot;
    };
    const double q[3] = {(p[0] - tree.origin[0]) / tree.scale, (p[1] - tree.origin[1]) / tree.scale,
                         (p[2] - tree.origin[2]) / tree.scale};
    double size = 0.0;
    for (int k = 0; k < 3; ++k) size = wp::max(size, q[k] < 0.0 ? -q[k] : q[k]);
    int stack[STACK], height = 1;
    if (size > FAR) {
        // Far queries are searched in float64, with the boxes' own rounding as slack.
        const d8 X = q[0], Y = q[1], Z = q[2], zero = 0.0;
        double entry[STACK];
        auto reach_of = [&](double squared) {
            const double reach = sqrt(squared) / tree.scale * (1.0 + 1e-12) + 1e-15 * size;
            return reach * reach;
        };
        double reach = reach_of(exact);
        stack[0] = 0;
        entry[0] = 0.0;
        while (height > 0) {
            --height;
            if (entry[height] > reach) continue;
            const int node = stack[height];
            if (node < 0) {
                const double before = exact;
                for (int j = 0; j < 8; ++j) evaluate(8 * (-1 - node) + j);
                if (exact < before) reach = reach_of(exact);
                continue;
            }
            d8 side[6];
            for (int k = 0; k < 6; ++k) side[k] = __builtin_convertvector(*(const v8*)(boxes + 48 * node + 8 * k), d8);
            const d8 dx = __builtin_elementwise_max(__builtin_elementwise_max(side[0] - X, X - side[3]), zero);
            const d8 dy = __builtin_elementwise_max(__builtin_elementwise_max(side[1] - Y, Y - side[4]), zero);
            const d8 dz = __builtin_elementwise_max(__builtin_elementwise_max(side[2] - Z, Z - side[5]), zero);
            const d8 d2 = dx * dx + dy * dy + dz * dz;
            const int base = height;
            for (int j = 0; j < 8; ++j) {
                const double d = d2[j];
                if (!(d <= reach) || side[0][j] > side[3][j]) continue;
                int at = height++;
                for (; at > base && entry[at - 1] < d; --at) {
                    entry[at] = entry[at - 1];
                    stack[at] = stack[at - 1];
                }
                entry[at] = d;
                stack[at] = children[8 * node + j];
            }
        }
        return winner;
    }
    {
// The rest only selects candidates: fused products round less, and are faster.
#pragma clang fp contract(fast)
        // One instruction each; the built-ins take three, because they must prefer a number to NaN. These prefer the
        // number only if the NaN is the first operand, so callers put the operand that may be NaN first.
        auto larger = [](v8 a, v8 b) { return a > b ? a : b; };
        auto smaller = [](v8 a, v8 b) { return a < b ? a : b; };
        const float X = (float)q[0], Y = (float)q[1], Z = (float)q[2];
        const v8 zero = 0.f, one = 1.f;
        const i8 number = {0, 1, 2, 3, 4, 5, 6, 7};
        // Squares are never negative or NaN: their bits sort as the floats do, and integer comparisons are faster.
        auto bits_of = [](v8 squares) { return __builtin_bit_cast(i8, squares); };
        auto least_of = [](i8 a) {
            i4 low = __builtin_shufflevector(a, a, 0, 1, 2, 3), other = __builtin_shufflevector(a, a, 4, 5, 6, 7);
            low = low < other ? low : other;
            other = __builtin_shufflevector(low, low, 2, 3, 2, 3);
            low = low < other ? low : other;
            other = __builtin_shufflevector(low, low, 1, 1, 1, 1);
            low = low < other ? low : other;
            return (int)low[0];
        };
        const float slack = 2.f * DISTANCE_ERROR * ((float)size + 1.f);
        // Any triangle nearer than this, in float32, can be the nearest.
        auto widened = [&](float squared) {
            const float reach = __builtin_sqrtf(squared) + slack;
            return reach * reach;
        };
        const double radius = max_squared / (tree.scale * tree.scale);
        float reach = radius < UNBOUNDED ? widened((float)radius * 1.000001f) : (float)UNBOUNDED;
        float least = (float)UNBOUNDED;  // the smallest squared distance seen
        float entry[STACK];
        int candidate[CPU_CANDIDATES];
        float candidate_squared[CPU_CANDIDATES];
        int candidates = 0;
        auto settle = [&]() {
            for (int i = 0; i < candidates; ++i)
                if (candidate_squared[i] <= reach) evaluate(candidate[i]);
            candidates = 0;
        };
        auto leaf = [&](int block) {
            const v8* row = (const v8*)(leaves + PLANE_ROWS * 8 * block);
            const v8 ax = X - row[0], ay = Y - row[1], az = Z - row[2];
            const v8 x = ax * row[3] + ay * row[4] + az * row[5];
            const v8 y = ax * row[6] + ay * row[7] + az * row[8];
            const v8 z = ax * row[9] + ay * row[10] + az * row[11];
            const v8 length = row[12], cx = row[13], cy = row[14];
            // The three edges, then the interior; the edge from a to b is the x axis from 0 to length.
            const v8 ex = x - smaller(larger(x, zero), length);
            const v8 yy = y * y;
            v8 flat = ex * ex + yy;
            const v8 bx = x - length, bcx = cx - length;
            const v8 s = smaller(larger((x * cx + y * cy) * row[15], zero), one);
            const v8 sx = x - s * cx, sy = y - s * cy;
            flat = smaller(sx * sx + sy * sy, flat);
            const v8 t = smaller(larger((bx * bcx + y * cy) * row[16], zero), one);
            const v8 tx = bx - t * bcx, ty = y - t * cy;
            flat = smaller(tx * tx + ty * ty, flat);
            const i8 inside = (y > zero) & (cy * x > cx * y) & (bcx * y > cy * bx);
            const v8 d2 = (inside ? zero : flat) + z * z;
            const unsigned hits = mask_of(d2 <= reach);
            if (!hits) return;
            const float nearest = __builtin_bit_cast(float, least_of(bits_of(d2)));
            if (nearest < least) {
                least = nearest;
                const float narrower = widened(nearest);
                reach = narrower < reach ? narrower : reach;
            }
            const i8 possible = d2 <= reach;
            if (candidates > CPU_CANDIDATES - 8) {
                int kept = 0;
                for (int i = 0; i < candidates; ++i)
                    if (candidate_squared[i] <= reach) {
                        candidate[kept] = candidate[i];
                        candidate_squared[kept++] = candidate_squared[i];
                    }
                candidates = kept;
                if (candidates > CPU_CANDIDATES - 8) settle();
            }
            float squared[8];
            *(v8*)squared = d2;
            for (unsigned mask = mask_of(possible); mask; mask &= mask - 1) {
                const int j = __builtin_ctz(mask);
                candidate[candidates] = 8 * block + j;
                candidate_squared[candidates++] = squared[j];
                // Prefetch for the float64 evaluation at the end.
                const char* corners = (const char*)(tree.corners.data + 3 * (8 * block + j));
                __builtin_prefetch(corners);
                __builtin_prefetch(corners + 64);
                __builtin_prefetch(tree.slot_triangle.data + 8 * block);
            }
        };
        const int seed_block = seed >= 0 ? seed >> 3 : -1;
        if (seed >= 0) leaf(seed_block);
        int node = 0;
        height = 0;
        for (;;) {
            if (node >= 0) {
                const v8* side = (const v8*)(boxes + 48 * node);
                const v8 dx = larger(larger(side[0] - X, X - side[3]), zero);
                const v8 dy = larger(larger(side[1] - Y, Y - side[4]), zero);
                const v8 dz = larger(larger(side[2] - Z, Z - side[5]), zero);
                const v8 d2 = dx * dx + dy * dy + dz * dz;
                unsigned mask = mask_of(d2 <= reach);
                if (mask) {
                    // The nearest child is next; its number replaces the last bits of its distance. The others wait:
                    // sorting them costs more than their order saves.
                    const int first = least_of((bits_of(d2) & -8) | number) & 7;
                    const int* child = children + 8 * node;
                    float distance[8];
                    *(v8*)distance = d2;
                    for (mask &= ~(1u << first); mask; mask &= mask - 1) {
                        const int j = __builtin_ctz(mask), next = child[j];
                        entry[height] = distance[j];
                        stack[height++] = next;
                        // Prefetch a node, or that much of a leaf; the hardware prefetcher fetches the rest.
                        const float* place = next < 0 ? leaves + PLANE_ROWS * 8 * (-1 - next) : boxes + 48 * next;
                        for (int line = 0; line < 3; ++line) __builtin_prefetch(place + 16 * line);
                        __builtin_prefetch(next < 0 ? (const void*)(place + 48) : children + 8 * next);
                    }
                    node = child[first];
                    continue;
                }
            } else if (-1 - node != seed_block) leaf(-1 - node);
            while (height > 0 && entry[height - 1] > reach) --height;
            if (height == 0) break;
            node = stack[--height];
        }
        if (winner < 0 && max_squared == (double)INFINITY) {
            // A single remaining candidate needs no float64 evaluation here; the caller computes its distance.
            int alone = -1, left = 0;
            for (int i = 0; i < candidates; ++i)
                if (candidate_squared[i] <= reach) {
                    alone = candidate[i];
                    ++left;
                }
            if (left == 1) return alone;
        }
        settle();
    }
    return winner;
};
#endif
