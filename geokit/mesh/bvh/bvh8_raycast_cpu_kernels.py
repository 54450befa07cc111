"""C++ text of ray queries over the wide tree, on the CPU: eight boxes or triangles at a time.

Boxes and triangles are tested in float32 with margins that cover its rounding; what passes is decided in float64 by
edge functions that are exact opposites on the two sides of an edge, so that no ray leaks.

A thread has many rays in flight. Those that are at a node, at a leaf, or at triangles to be decided wait in queues, one
for each, and a queue is worked off at a time: what a ray needs is fetched while others are worked on, and no branch
depends on what a ray meets. A processor foresees none of those branches: mispredicted, they took as long as the tests.
Rays are set up by eights (bvh8_ray_packets_cpu_kernels).
"""

from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.bvh8_ray_leaves_cpu_kernels import LEAF_TEST, LEAF_WORDS

# Rays in flight on a thread.
IN_FLIGHT = 32
# Rays that start farther out than this, in local units, are tested from where they enter the cube around the mesh.
NEAR_START = 2.0
# What rounding moves a box or a ray by, in local units: coordinates up to NEAR_START are rounded by 1.2e-7, and four
# such roundings meet in a slab test.
BOX_MARGIN = 1.0e-6
# The same for a point on the ray in a triangle's own frame, whose axes are rounded too; see DISTANCE_ERROR. A ray's
# length has as much to spare.
PLANE_MARGIN = 8.0e-6
# Rays without an end are this long, in local units.
ENDLESS = 1.0e30
# Direction components, where the largest is 1, that are smaller count as this: its reciprocal must not overflow.
LEAST_COMPONENT = 1.0e-18

# The children and entries of a node that wait, those in the lanes `rest`, are put on the stack side by side.
PUSH = """
    #if defined(__AVX512VL__) && __has_builtin(__builtin_ia32_compresssf256_mask)
    *(v8*)(r.entry + height) = __builtin_ia32_compresssf256_mask(in, zero, rest);
    *(i8*)(r.stack + height) = __builtin_ia32_compresssi256_mask(*(const i8*)child, (i8)zero, rest);
    #elif defined(__AVX2__) && defined(__BMI2__) && __has_builtin(__builtin_ia32_permvarsf256)
    const wp::uint64 bytes = __builtin_ia32_pdep_di(rest, 0x0101010101010101ull) * 255;
    const i8 order =
        __builtin_convertvector(__builtin_bit_cast(c8, __builtin_ia32_pext_di(0x0706050403020100ull, bytes)), i8);
    *(v8*)(r.entry + height) = __builtin_ia32_permvarsf256(in, order);
    *(i8*)(r.stack + height) = __builtin_ia32_permvarsi256(*(const i8*)child, order);
    #else
    float distance[8];
    *(v8*)distance = in;
    int place = height;
    for (unsigned left = rest; left; left &= left - 1) {
        const int j = __builtin_ctz(left);
        r.entry[place] = distance[j]; r.stack[place++] = child[j];
    }
    #endif
"""

# Names that the text expects: tree; origins and directions; begin and end (of the rays' numbers); t_min; hit (a lambda:
# start, direction, slot, t, v, w -> bool, in float64); NOTHING_WAITS, 1. RAY_GROUPS is replaced by the text of that
# name; ON_HIT by what is done with a hit of the ray `r` at t, which may lower r.best and call shorten(r), `continue`,
# or set r.height to NOTHING_WAITS and `break` to end the walk; ON_END by what is done when a ray's walk is over, hit or
# not. Both may use r.winner (-1 at first), r.count (0), r.weight_b and r.weight_c.
WIDE_WALK = f"""
    {{
    // What follows only selects: fused products round less, and are quicker.
    #pragma clang fp contract(fast)
    typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef int i8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef unsigned n8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef unsigned n4 __attribute__((ext_vector_type(4), aligned(4)));
    typedef unsigned short h8 __attribute__((ext_vector_type(8), aligned(2)));
    typedef unsigned char c8 __attribute__((ext_vector_type(8)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    auto mask_of = [](auto lanes) {{
        return (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(lanes, b8));
    }};
    // One instruction each: the built-in functions make sure that the other number comes back for one that is none.
    auto larger = [](auto a, auto b) {{ return a > b ? a : b; }};
    auto smaller = [](auto a, auto b) {{ return a < b ? a : b; }};
    auto greatest = [&](v8 a) {{
        a = larger(a, __builtin_shufflevector(a, a, 4, 5, 6, 7, 0, 1, 2, 3));
        a = larger(a, __builtin_shufflevector(a, a, 2, 3, 0, 1, 6, 7, 4, 5));
        a = larger(a, __builtin_shufflevector(a, a, 1, 0, 3, 2, 5, 4, 7, 6));
        return a[0];
    }};
    auto least = [&](v8 a) {{ return -greatest(-a); }};
    // What is known of a ray so far.
    struct Found {{
        double best, weight_b, weight_c;
        int id, winner, count;
    }};
    // Numbers of a ray in local units: reciprocals of its direction; those times where it starts, moved by BOX_MARGIN
    // against near planes and far ones; where it starts and its slopes, along the axes of leaves; 1 or -1 along their
    // z; its length. Rows of a node's boxes that it meets first and last; which axis is the z of leaves.
    enum {{ RATE = 0, TO_NEAR = 3, TO_FAR = 6, AT = 9, SHEAR = 12, FORWARD = 14, LAST = 15 }};
    enum {{ NEAR_ROW = 0, FAR_ROW = 3, AXIS = 6 }};
    struct Ray : Found {{
        alignas(32) float field[16];
        int row[8];
        double enter, unit;
        int node, height, block;
        unsigned hits;  // lanes of `block` that are to be decided in float64
        int stack[{STACK} + 8];  // eight are written at a time; the lowest is DONE
        float entry[{STACK} + 8];
    }};
    Ray rays[{IN_FLIGHT}];
    int next = begin;
    auto finish = [&](Found& r) {{ ON_END }};
    // What is left of a ray up to `best`; finite, so that its product with a zero is zero.
    auto length_of = [&](double best, double unit, double enter) {{
        return smaller((float)(best * unit - enter) * 1.000001f + {PLANE_MARGIN}f, {ENDLESS}f);
    }};
    RAY_GROUPS
    auto shorten = [&](Ray& r) {{
        r.field[LAST] = length_of(r.best, r.unit, r.enter);
        // What waits and is beyond its reach now need not be asked again.
        int kept = 1;
        for (int i = 1; i < r.height; ++i) {{
            const float entry = r.entry[i];
            const int node = r.stack[i];
            r.entry[kept] = entry; r.stack[kept] = node;
            kept += entry <= r.field[LAST];
        }}
        r.height = kept;
    }};
    // The number of a leaf that there is not, after the last one.
    const int DONE = -1 - (int)(tree.slot_triangle.shape[0] >> 3);
    const char* const body[2] = {{(const char*)tree.boxes.data, (const char*)tree.ray_leaves.data}};
    const char* const more[2] = {{(const char*)tree.children.data, (const char*)tree.ray_leaves.data}};
    const wp::int64 stride[2] = {{32, {4 * LEAF_WORDS}}};
    static_assert({4 * LEAF_WORDS} == 48 * sizeof(float), "a leaf is as long as the boxes of a node");
    int at_node[{IN_FLIGHT}], at_leaf[{IN_FLIGHT}], at_hits[{IN_FLIGHT}], idle[{IN_FLIGHT}];
    int nodes = 0, leaves = 0, hits = 0, idles = {IN_FLIGHT};
    for (int i = 0; i < {IN_FLIGHT}; ++i) idle[i] = {IN_FLIGHT} - 1 - i;
    // Into the queue of what it meets next, which is asked for.
    auto go_on = [&](int number, int node) {{
        const int leaf = node < 0, done = node == DONE, index = node ^ (node >> 31);
        const char* const data = body[leaf] + {4 * LEAF_WORDS} * (wp::int64)index;
        for (int i = 0; i < 3; ++i) __builtin_prefetch(data + 64 * i);
        __builtin_prefetch(more[leaf] + stride[leaf] * index);
        rays[number].node = node;
        at_node[nodes] = number; nodes += 1 - leaf;
        at_leaf[leaves] = number; leaves += leaf - done;
        idle[idles] = number; idles += done;
    }};
    const v8 zero = 0.f;
    const n8 lane = {{0, 1, 2, 3, 4, 5, 6, 7}};
    while (true) {{
        // Rays that may hit something take the places of those that are done.
        while (idles > 0) {{
            if (!group.waiting) {{
                if (next >= end) break;
                const int count = end - next < 8 ? end - next : 8;
                next_group(next, count);
                next += count;
                continue;
            }}
            const int number = idle[--idles], i = __builtin_ctz(group.waiting);
            Ray& r = rays[number];
            group.waiting &= group.waiting - 1;
            r.id = group.first + i;
            r.winner = -1; r.count = 0; r.weight_b = 0.0; r.weight_c = 0.0;
            r.best = group.best[i]; r.enter = group.enter[i]; r.unit = group.unit[i];
            *(v8*)r.field = *(const v8*)group.field[i];
            *(v8*)(r.field + 8) = *(const v8*)(group.field[i] + 8);
            *(i8*)r.row = *(const i8*)group.row[i];
            r.node = 0; r.height = 1; r.stack[0] = DONE;
            at_node[nodes++] = number;
        }}
        if (nodes + leaves + hits == 0) break;
        const int finished = idles, node_count = nodes;
        nodes = 0;
        for (int q = 0; q < node_count; ++q) {{
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
            // The nearest child goes first; the order of the others costs more than it saves. Bits of floats that are
            // not negative are in their order, and the lowest three make room for the lane.
            const n8 key = reached ? ((n8)in & ~7u) | lane : (n8)~0u;
            n4 first = smaller(key.lo, key.hi);
            first = smaller(first, __builtin_shufflevector(first, first, 2, 3, 0, 1));
            first = smaller(first, __builtin_shufflevector(first, first, 1, 0, 3, 2));
            const int nearest = first[0] & 7, height = r.height, none = mask == 0;
            const unsigned rest = mask & ~(1u << nearest);
            {PUSH}
            r.height = height + __builtin_popcount(rest) - none;
            // A choice between addresses, so that the compiler makes no branch of it.
            const int* const onward[2] = {{child + nearest, r.stack + height - 1}};
            go_on(at_node[q], *onward[none]);
        }}
        // Before leaves are tested: what those leave to be decided is on its way for a round.
        const int hit_count = hits;
        hits = 0;
        for (int q = 0; q < hit_count; ++q) {{
            Ray& r = rays[at_hits[q]];
            const point &start = origins.data[r.id], &direction = directions.data[r.id];
            for (; r.hits; r.hits &= r.hits - 1) {{
                const int slot = 8 * r.block + __builtin_ctz(r.hits);
                double t, v, w;
                if (!hit(start, direction, slot, t, v, w) || t > r.best) continue;
                ON_HIT
            }}
            go_on(at_hits[q], r.stack[--r.height]);
        }}
        const int leaf_count = leaves;
        leaves = 0;
        for (int q = 0; q < leaf_count; ++q) {{
            const int number = at_leaf[q];
            Ray& r = rays[number];
            const int block = -1 - r.node;
            {LEAF_TEST}
            // As go_on, or into the queue of what float64 decides.
            const int none = lanes == 0, slot = 8 * block + __builtin_ctz(lanes | 128u), node = r.stack[r.height - 1];
            const int leaf = node < 0, done = node == DONE, index = node ^ (node >> 31);
            r.hits = lanes; r.block = block; r.node = node; r.height -= none;
            const char* const data[2] = {{(const char*)(tree.corners.data + 3 * slot),
                                         body[leaf] + {4 * LEAF_WORDS} * (wp::int64)index}};
            const char* const rest[2] = {{(const char*)(tree.slot_triangle.data + slot),
                                         more[leaf] + stride[leaf] * index}};
            __builtin_prefetch(data[none]);
            __builtin_prefetch(data[none] + 64);
            __builtin_prefetch(data[none] + 128 * none);
            __builtin_prefetch(rest[none]);
            at_hits[hits] = number; hits += 1 - none;
            at_node[nodes] = number; nodes += none & (1 - leaf);
            at_leaf[leaves] = number; leaves += none & (leaf - done);
            idle[idles] = number; idles += none & done;
        }}
        for (int q = finished; q < idles; ++q) finish(rays[idle[q]]);
    }}
    }}
"""
