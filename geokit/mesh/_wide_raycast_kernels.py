"""C++ text of ray queries over the wide tree, on the CPU: eight boxes or triangles at a time.

Boxes and triangles are tested in float32 with margins that cover its rounding; what passes is decided in float64 by
edge functions that are exact opposites on the two sides of an edge, so that no ray leaks.

A thread walks several rays in turn, one node each: while a node is fetched for one ray the others go on. The latency
of the caches, not arithmetic, is what a single ray waits for.
"""

from geokit.mesh._wide_build_kernels import STACK
from geokit.mesh._wide_leaf_kernels import PLANE_ROWS

# Cache lines of a leaf that are asked for ahead; the hardware goes on where it sees a stream.
PREFETCHED_LINES = 8
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

# Names that the text expects: tree; begin and end (of the rays' numbers); fetch (a lambda that fills id, start,
# direction and t_max for a number); t_min; hit (a lambda: start, direction, slot, t, v, w -> bool, in float64). ON_HIT
# is replaced by what is done with a hit of the ray `r` at t, which may lower r.best and call shorten(r), or set
# r.height to -1 to end the walk, or `continue`; ON_END by what is done when a ray's walk is over, hit or not. Both may
# use r.winner (-1 at first), r.count (0), r.weight_b and r.weight_c (0).
_WALK = f"""
    {{
    // What follows only selects: fused products round less, and are quicker.
    #pragma clang fp contract(fast)
    typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef int i8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    typedef double d4 __attribute__((ext_vector_type(4)));
    typedef float f4 __attribute__((ext_vector_type(4)));
    auto mask_of = [](i8 lanes) {{
        return (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(lanes, b8));
    }};
    struct Ray {{
        f4 at, toward, reciprocal, to_near, to_far;
        const float *near_row[3], *far_row[3];
        point start, direction;
        double best, enter, unit, weight_b, weight_c;
        float last;
        int id, winner, count, node, height, block;
        unsigned hits;  // lanes of `block` that are to be decided in float64
        int stack[{STACK}];
        float entry[{STACK}];
    }};
    Ray rays[{IN_FLIGHT}];
    int next = begin, flying = 0;
    const double local = 1.0 / tree.scale;
    // Finite, so that its product with a zero is zero.
    auto shorten = [&](Ray& r) {{
        r.last = __builtin_fminf((float)(r.best * r.unit - r.enter) * 1.000001f + {PLANE_MARGIN}f, {ENDLESS}f);
    }};
    // False where the ray passes by the mesh.
    auto set_up = [&](Ray& r, const point& start, const point& direction) {{
        r.winner = -1; r.count = 0; r.node = 0; r.height = 0; r.hits = 0; r.weight_b = 0.0; r.weight_c = 0.0;
        // The ray as from + s * along in local units, the largest component of along being 1: s = unit * t.
        const d4 heading = {{direction[0], direction[1], direction[2], 0.0}};
        const d4 begin = {{start[0] - tree.origin[0], start[1] - tree.origin[1], start[2] - tree.origin[2], 0.0}};
        const double largest = __builtin_reduce_max(__builtin_elementwise_abs(heading));
        const d4 from = begin * local, along = heading * (1.0 / largest);
        r.unit = largest * local;
        r.toward = __builtin_convertvector(along, f4);
        const f4 least = {LEAST_COMPONENT}f;
        r.reciprocal = __builtin_elementwise_copysign(
            1.f / __builtin_elementwise_max(__builtin_elementwise_abs(r.toward), least), r.toward);
        r.enter = t_min * r.unit;
        const double far = __builtin_reduce_max(__builtin_elementwise_abs(from));
        if (far > {NEAR_START}) {{
            // A little early and late: these reciprocals have the digits of float32, and the cube has a margin.
            const d4 rate = __builtin_convertvector(r.reciprocal, d4);
            const double edge = 1.0 + 1e-5 + 1e-6 * far;
            const d4 t0 = (-edge - from) * rate, t1 = (edge - from) * rate;
            const d4 in = __builtin_elementwise_min(t0, t1), out = __builtin_elementwise_max(t0, t1);
            r.enter = wp::max(r.enter, wp::max(in[0], wp::max(in[1], in[2])));
            if (r.enter > wp::min(out[0], wp::min(out[1], out[2]))) return false;
        }}
        shorten(r);
        r.at = __builtin_convertvector(from + r.enter * along, f4);
        const f4 margin = {BOX_MARGIN}f, aside = __builtin_elementwise_copysign(margin, r.toward);
        r.to_near = -(r.at + aside) * r.reciprocal;
        r.to_far = -(r.at - aside) * r.reciprocal;
        for (int k = 0; k < 3; ++k) {{
            const int back = r.reciprocal[k] < 0.f ? 24 : 0;
            r.near_row[k] = tree.boxes.data + 8 * k + back;
            r.far_row[k] = tree.boxes.data + 8 * k + 24 - back;
        }}
        return true;
    }};
    auto finish = [&](Ray& r) {{ ON_END }};
    // The next ray that may hit something takes the place of one that is done; false where there is none.
    auto refill = [&](Ray& r) {{
        while (next < end) {{
            // In registers: what was just stored is slow to load again in other pieces.
            point start, direction;
            fetch(next++, r.id, start, direction, r.best);
            if (set_up(r, start, direction)) {{
                r.start = start;
                r.direction = direction;
                return true;
            }}
            finish(r);
        }}
        return false;
    }};
    auto prefetch = [&](int node) {{
        const char* data = node < 0 ? (const char*)(tree.leaves.data + {8 * PLANE_ROWS} * (-1 - node))
                                    : (const char*)(tree.boxes.data + 48 * node);
        const int lines = node < 0 ? {PREFETCHED_LINES} : 3;
        for (int i = 0; i < lines; ++i) __builtin_prefetch(data + 64 * i);
        if (node >= 0) __builtin_prefetch(tree.children.data + 8 * node);
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
            in = __builtin_elementwise_max(in, *(const v8*)(r.near_row[1] + at_box) * r.reciprocal[1] + r.to_near[1]);
            out = __builtin_elementwise_min(out, *(const v8*)(r.far_row[1] + at_box) * r.reciprocal[1] + r.to_far[1]);
            in = __builtin_elementwise_max(in, *(const v8*)(r.near_row[2] + at_box) * r.reciprocal[2] + r.to_near[2]);
            out = __builtin_elementwise_min(out, *(const v8*)(r.far_row[2] + at_box) * r.reciprocal[2] + r.to_far[2]);
            in = __builtin_elementwise_max(in, zero);
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
            const v8 oz = ax * row[9] + ay * row[10] + az * row[11];
            const v8 dz = r.toward[0] * row[9] + r.toward[1] * row[10] + r.toward[2] * row[11];
            // Everything times dz and turned so that dz is positive: grazing rays lose no digits in a division.
            const i8 sign = (i8)dz & (int)0x80000000;
            const v8 depth = (v8)((i8)(-oz) ^ sign), down = (v8)((i8)dz ^ sign);
            const v8 limit = r.last;
            const v8 ox = ax * row[3] + ay * row[4] + az * row[5];
            const v8 oy = ax * row[6] + ay * row[7] + az * row[8];
            const v8 dx = r.toward[0] * row[3] + r.toward[1] * row[4] + r.toward[2] * row[5];
            const v8 dy = r.toward[0] * row[6] + r.toward[1] * row[7] + r.toward[2] * row[8];
            const v8 x = ox * down + dx * depth, y = oy * down + dy * depth;
            const v8 longest = row[12], cx = row[13], cy = row[14];
            const v8 margin = longest * lowest;
            const v8 ca = cy * x - cx * y, bc = (cx - longest) * y - cy * (x - longest * down);
            r.hits = mask_of((depth >= lowest) & (depth <= limit * down - lowest) & (y >= lowest) & (ca >= margin)
                             & (bc >= margin));
            ON_LANES
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

# Lanes that may be hit are decided in float64, at the ray's next turn: until then their corners are on their way.
_DECIDE_EXACTLY = """
            if (r.hits) {
                r.block = block;
                for (unsigned lanes = r.hits; lanes; lanes &= lanes - 1) {
                    const int slot = 8 * block + __builtin_ctz(lanes);
                    __builtin_prefetch(tree.corners.data + 3 * slot);
                    __builtin_prefetch((const char*)(tree.corners.data + 3 * slot) + 64);
                    __builtin_prefetch(tree.slot_triangle.data + slot);
                }
                continue;
            }
"""

WIDE_WALK = _WALK.replace("ON_LANES", _DECIDE_EXACTLY)
