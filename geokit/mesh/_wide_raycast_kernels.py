"""C++ text of ray queries over the wide tree, on the CPU: eight boxes or triangles at a time.

Boxes and triangles are tested in float32 with margins that cover its rounding; what passes is decided in float64 by
edge functions that are exact opposites on the two sides of an edge, so that no ray leaks.

Rays are set up by eights (_wide_ray_groups_kernels); those that run alike are walked together (_wide_packet_kernels)
where hits but not all of them are asked for, all others as follows.

A thread walks several rays in turn, one node each: while a node is fetched for one ray the others go on. The latency
of the caches, not arithmetic, is what a single ray waits for.
"""

from geokit.mesh._wide_build_kernels import STACK
from geokit.mesh._wide_leaf_kernels import PLANE_ROWS

# Rays in flight on a thread.
IN_FLIGHT = 8
# Rays that start farther out than this, in local units, are tested from where they enter the cube around the mesh.
NEAR_START = 2.0
# What rounding moves a box or a ray by, in local units: coordinates up to NEAR_START are rounded by 1.2e-7, and four
# such roundings meet in a slab test.
BOX_MARGIN = 1.0e-6
# The same for a point on the ray in a triangle's own frame, whose axes are rounded too; see DISTANCE_ERROR.
PLANE_MARGIN = 8.0e-6
# Rays without an end are this long, in local units.
ENDLESS = 1.0e30
# Direction components, where the largest is 1, that are smaller count as this: its reciprocal must not overflow.
LEAST_COMPONENT = 1.0e-18

# Which triangles of a leaf a ray may hit: lanes. Names that the text expects: row (of the leaf), ax, ay and az (from
# the triangles' corners to the ray's start), tx, ty and tz (its direction), limit (its length).
LEAF_TEST = """
    const v8 oz = ax * row[9] + ay * row[10] + az * row[11];
    const v8 dz = tx * row[9] + ty * row[10] + tz * row[11];
    // Everything times dz and turned so that dz is positive: grazing rays lose no digits in a division.
    const i8 sign = (i8)dz & (int)0x80000000;
    const v8 depth = (v8)((i8)(-oz) ^ sign), down = (v8)((i8)dz ^ sign);
    const v8 ox = ax * row[3] + ay * row[4] + az * row[5];
    const v8 oy = ax * row[6] + ay * row[7] + az * row[8];
    const v8 dx = tx * row[3] + ty * row[4] + tz * row[5];
    const v8 dy = tx * row[6] + ty * row[7] + tz * row[8];
    const v8 x = ox * down + dx * depth, y = oy * down + dy * depth;
    const v8 longest = row[12], cx = row[13], cy = row[14];
    const v8 margin = longest * lowest;
    const v8 ca = cy * x - cx * y, bc = (cx - longest) * y - cy * (x - longest * down);
    const unsigned lanes = mask_of((depth >= lowest) & (depth <= limit * down - lowest) & (y >= lowest)
                                   & (ca >= margin) & (bc >= margin));
"""
# What float64 needs of the triangles in those lanes of the leaf `block`.
ASK_AHEAD = """
    for (unsigned left = lanes; left; left &= left - 1) {
        const int slot = 8 * block + __builtin_ctz(left);
        __builtin_prefetch(tree.corners.data + 3 * slot);
        __builtin_prefetch((const char*)(tree.corners.data + 3 * slot) + 64);
        __builtin_prefetch(tree.slot_triangle.data + slot);
    }
"""

# Names that the text expects: tree; origins and directions; begin and end (of the rays' numbers); t_min; hit (a lambda:
# start, direction, slot, t, v, w -> bool, in float64). RAY_GROUPS is replaced by the text of that name; ON_HIT by what
# is done with a hit of the ray `r` at t, which may lower r.best and call shorten(r), or set r.height to -1 to end the
# walk, or `continue`; ON_END by what is done when a ray's walk is over, hit or not. Both may use r.winner (-1 at
# first), r.count (0), r.weight_b and r.weight_c.
WIDE_WALK = f"""
    {{
    // What follows only selects: fused products round less, and are quicker.
    #pragma clang fp contract(fast)
    typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef int i8 __attribute__((ext_vector_type(8), aligned(4)));
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
    struct Ray : Found {{
        float at[3], toward[3], reciprocal[3], to_near[3], to_far[3];
        const float *near_row[3], *far_row[3];
        point start, direction;
        double enter, unit;
        float last;
        int node, height, block;
        unsigned hits;  // lanes of `block` that are to be decided in float64
        int stack[{STACK}];
        float entry[{STACK}];
    }};
    Ray rays[{IN_FLIGHT}];
    int next = begin, flying = 0;
    auto finish = [&](Found& r) {{ ON_END }};
    // Without a branch, which would be foreseen as badly as the one that follows for the node itself: of an inner node
    // three lines of boxes and that of its children, of a leaf eight lines.
    auto prefetch = [&](int node) {{
        const char* data = node < 0 ? (const char*)(tree.leaves.data + {8 * PLANE_ROWS} * (-1 - node))
                                    : (const char*)(tree.boxes.data + 48 * node);
        const char* rest = node < 0 ? data + 256 : (const char*)(tree.children.data + 8 * node);
        const int step = node < 0 ? 64 : 0;
        for (int i = 0; i < 4; ++i) __builtin_prefetch(data + 64 * i);
        for (int i = 0; i < 4; ++i) __builtin_prefetch(rest + step * i);
    }};
    // What is left of a ray up to `best`; finite, so that its product with a zero is zero.
    auto length_of = [&](double best, double unit, double enter) {{
        return smaller((float)(best * unit - enter) * 1.000001f + {PLANE_MARGIN}f, {ENDLESS}f);
    }};
    RAY_GROUPS
    auto shorten = [&](Ray& r) {{
        r.last = length_of(r.best, r.unit, r.enter);
    }};
    // The next ray that may hit something takes the place of one that is done; false where there is none.
    auto refill = [&](Ray& r) {{
        while (!group.waiting) {{
            if (next >= end) return false;
            const int count = end - next < 8 ? end - next : 8;
            next_group(next, count);
            next += count;
        }}
        const int i = __builtin_ctz(group.waiting);
        group.waiting &= group.waiting - 1;
        r.id = group.first + i;
        r.winner = -1; r.count = 0; r.node = 0; r.height = 0; r.hits = 0; r.weight_b = 0.0; r.weight_c = 0.0;
        r.start = origins.data[r.id]; r.direction = directions.data[r.id];
        r.best = group.best[i]; r.enter = group.enter[i]; r.unit = group.unit[i]; r.last = group.last[i];
        for (int k = 0; k < 3; ++k) {{
            r.at[k] = group.at[k][i]; r.toward[k] = group.toward[k][i]; r.reciprocal[k] = group.reciprocal[k][i];
            r.to_near[k] = group.to_near[k][i]; r.to_far[k] = group.to_far[k][i];
            const int back = r.reciprocal[k] < 0.f ? 24 : 0;
            r.near_row[k] = tree.boxes.data + 8 * k + back;
            r.far_row[k] = tree.boxes.data + 8 * k + 24 - back;
        }}
        return true;
    }};
    while (flying < {IN_FLIGHT} && refill(rays[flying])) ++flying;
    const v8 zero = 0.f, lowest = -{PLANE_MARGIN}f;
    for (int turn = 0; flying > 0; turn = turn + 1 < flying ? turn + 1 : 0) {{
        Ray& r = rays[turn];
        if (r.hits) {{
            for (; r.hits; r.hits &= r.hits - 1) {{
                const int slot = 8 * r.block + __builtin_ctz(r.hits);
                double t, v, w;
                if (!hit(r.start, r.direction, slot, t, v, w) || t > r.best) continue;
                ON_HIT
            }}
        }} else if (r.node >= 0) {{
            const int at_box = 48 * r.node;
            v8 in = *(const v8*)(r.near_row[0] + at_box) * r.reciprocal[0] + r.to_near[0];
            v8 out = *(const v8*)(r.far_row[0] + at_box) * r.reciprocal[0] + r.to_far[0];
            in = larger(in, *(const v8*)(r.near_row[1] + at_box) * r.reciprocal[1] + r.to_near[1]);
            out = smaller(out, *(const v8*)(r.far_row[1] + at_box) * r.reciprocal[1] + r.to_far[1]);
            in = larger(in, *(const v8*)(r.near_row[2] + at_box) * r.reciprocal[2] + r.to_near[2]);
            out = smaller(out, *(const v8*)(r.far_row[2] + at_box) * r.reciprocal[2] + r.to_far[2]);
            in = larger(in, zero);
            const v8 limit = r.last;
            unsigned mask = mask_of((in <= out) & (in <= limit));
            if (mask) {{
                float distance[8];
                *(v8*)distance = in;
                const int* child = tree.children.data + 8 * r.node;
                // Only the nearest child need be first: sorting the others costs more than their order saves.
                int nearest = __builtin_ctz(mask);
                for (mask &= mask - 1; mask; mask &= mask - 1) {{
                    const int j = __builtin_ctz(mask);
                    const bool nearer = distance[j] < distance[nearest];
                    const int later = nearer ? nearest : j;
                    nearest = nearer ? j : nearest;
                    r.entry[r.height] = distance[later]; r.stack[r.height++] = child[later];
                }}
                r.node = child[nearest];
                prefetch(r.node);
                continue;
            }}
        }} else {{
            const int block = -1 - r.node;
            const v8* row = (const v8*)(tree.leaves.data + {8 * PLANE_ROWS} * block);
            const v8 ax = r.at[0] - row[0], ay = r.at[1] - row[1], az = r.at[2] - row[2];
            const float tx = r.toward[0], ty = r.toward[1], tz = r.toward[2];
            const v8 limit = r.last;
            {LEAF_TEST}
            // What may be hit is decided in float64 at the ray's next turn: until then its corners are on their way.
            if (lanes) {{
                r.hits = lanes;
                r.block = block;
                {ASK_AHEAD}
                continue;
            }}
        }}
        // On to the nearest box that waits and is still within reach.
        while (--r.height >= 0 && r.entry[r.height] > r.last) {{}}
        if (r.height >= 0) {{
            r.node = r.stack[r.height];
            prefetch(r.node);
            continue;
        }}
        finish(r);
        if (!refill(r)) {{
            --flying;
            if (turn < flying) rays[turn] = rays[flying];
            --turn;
        }}
    }}
    }}
"""
