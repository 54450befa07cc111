"""C++ text of packets over the wide tree, on the CPU: rays that run alike share one walk.

Eight rays of a camera visit nearly the same nodes. A node's children are tested once for all of them, by intervals of
what the rays start at and head for, and each child that is left for eight rays in one vector operation. A leaf is
tested for each ray that reached it, and decided in float64, as in the walk of single rays: float32 only says what
float64 is to look at, so the answers are the same to the last bit.

The interval test passes by nothing that a ray may hit. Its ends are the rays' own numbers, not rounded; of a product
of two intervals the extremes are at their ends; and a bound, (plane - start) * reciprocal, has two roundings of 6e-8,
relative, where the test of a single ray has three, one of them of start * reciprocal: BOX_MARGIN covers more than that.
"""

from geokit.mesh._wide_build_kernels import STACK
from geokit.mesh._wide_leaf_kernels import PLANE_ROWS
from geokit.mesh._wide_raycast_kernels import ASK_AHEAD, BOX_MARGIN, ENDLESS, LEAF_TEST, PLANE_MARGIN

# Rays run alike whose directions, their largest component being 1, differ by less than this, and whose starts, in local
# units, by less than that. Neither is critical: where rays part, each goes on alone.
ALIKE_DIRECTION = 0.1
ALIKE_START = 0.1
# Groups that are left to the walk of single rays after one whose rays parted: more of its nodes were visited by one ray
# than by several. A walk alone waits for caches, single rays do so in turn: rays farther apart than triangles were 1.2
# times slower in packets.
APART = 7

# Names that the text expects: those of RAY_GROUPS, hit, and ON_HIT, which may lower r.best and call shorten(r), or set
# group.last[i] below zero to end the walk of this ray, or `continue` or `break`.
PACKETS = f"""
    // True where the rays that wait go the same way along each axis, and nearly so.
    auto run_alike = [&]() {{
        const int some = __builtin_ctz(group.waiting);
        unsigned alike = group.waiting;
        for (int k = 0; k < 3; ++k) {{
            const v8 way = *(const v8*)group.toward[k], at = *(const v8*)group.at[k];
            alike &= mask_of((__builtin_elementwise_abs(way - way[some]) < {ALIKE_DIRECTION}f)
                             & (__builtin_elementwise_abs(at - at[some]) < {ALIKE_START}f)
                             & (((i8)way ^ ((i8)way)[some]) >= 0));
        }}
        return alike == group.waiting;
    }};
    if (group.apart > 0) {{
        --group.apart;
    }} else if ((group.waiting & (group.waiting - 1)) && run_alike()) {{
        struct Waiting {{ v8 entry; int node; unsigned rays; }};
        Waiting stack[{STACK}];
        Found found[8];
        // Intervals of the reciprocals, and of where a plane is measured from that is reached first and last.
        float slow[3], fast[3], near_start[3], far_start[3];
        const float *near_row[3], *far_row[3];
        const i8 lane = {{1, 2, 4, 8, 16, 32, 64, 128}};
        const auto within = (lane & (int)group.waiting) != 0;
        const int some = __builtin_ctz(group.waiting);
        for (int k = 0; k < 3; ++k) {{
            // Rays that pass by must not widen the intervals.
            const v8 all_rates = *(const v8*)group.reciprocal[k], all_starts = *(const v8*)group.at[k];
            const v8 rate = within ? all_rates : (v8)all_rates[some], at = within ? all_starts : (v8)all_starts[some];
            slow[k] = least(rate);
            fast[k] = greatest(rate);
            const bool back = slow[k] < 0.f;
            const float lowest = least(at) - {BOX_MARGIN}f, highest = greatest(at) + {BOX_MARGIN}f;
            near_start[k] = back ? lowest : highest;
            far_start[k] = back ? highest : lowest;
            near_row[k] = tree.boxes.data + 8 * k + (back ? 24 : 0);
            far_row[k] = tree.boxes.data + 8 * k + (back ? 0 : 24);
        }}
        for (int i = 0; i < 8; ++i) {{
            found[i].best = group.best[i];
            found[i].winner = -1;
            found[i].id = group.first + i;
        }}
        auto shorten = [&](Found& r) {{
            const int i = r.id - group.first;
            group.last[i] = length_of(r.best, group.unit[i], group.enter[i]);
        }};
        const v8 zero = 0.f, lowest = -{PLANE_MARGIN}f;
        unsigned active = group.waiting;
        float reach = {ENDLESS}f;
        int height = 0, node = 0, together = 0, alone = 0;
        while (true) {{
            if (node >= 0) {{
                const int at_box = 48 * node, bottom = height;
                const int* child = tree.children.data + 8 * node;
                float entry[8], shortest = INFINITY;
                int nearest = height;
                if (active & (active - 1)) {{
                    ++together;
                    v8 in = zero, out = reach;
                    for (int k = 0; k < 3; ++k) {{
                        const v8 near = *(const v8*)(near_row[k] + at_box) - near_start[k];
                        const v8 far = *(const v8*)(far_row[k] + at_box) - far_start[k];
                        in = larger(in, smaller(near * slow[k], near * fast[k]));
                        out = smaller(out, larger(far * slow[k], far * fast[k]));
                    }}
                    *(v8*)entry = in;
                    for (unsigned mask = mask_of(in <= out); mask; mask &= mask - 1) {{
                        const int j = __builtin_ctz(mask);
                        v8 in = zero, out = *(const v8*)group.last;
                        for (int k = 0; k < 3; ++k) {{
                            const v8 rate = *(const v8*)group.reciprocal[k];
                            in = larger(in, near_row[k][at_box + j] * rate + *(const v8*)group.to_near[k]);
                            out = smaller(out, far_row[k][at_box + j] * rate + *(const v8*)group.to_far[k]);
                        }}
                        const unsigned reached = mask_of(in <= out) & active;
                        if (!reached) continue;
                        if (entry[j] < shortest) {{ shortest = entry[j]; nearest = height; }}
                        stack[height++] = Waiting{{in, child[j], reached}};
                        // Where rays part, each waits for caches: not now for all, then for one after the other.
                        prefetch(child[j]);
                    }}
                }} else {{
                    ++alone;
                    const int i = __builtin_ctz(active);
                    v8 in = zero, out = group.last[i];
                    for (int k = 0; k < 3; ++k) {{
                        const float rate = group.reciprocal[k][i];
                        in = larger(in, *(const v8*)(near_row[k] + at_box) * rate + group.to_near[k][i]);
                        out = smaller(out, *(const v8*)(far_row[k] + at_box) * rate + group.to_far[k][i]);
                    }}
                    *(v8*)entry = in;
                    for (unsigned mask = mask_of(in <= out); mask; mask &= mask - 1) {{
                        const int j = __builtin_ctz(mask);
                        if (entry[j] < shortest) {{ shortest = entry[j]; nearest = height; }}
                        stack[height++] = Waiting{{(v8)entry[j], child[j], active}};
                        prefetch(child[j]);
                    }}
                }}
                if (height > bottom) {{
                    const Waiting first = stack[nearest];
                    stack[nearest] = stack[--height];
                    node = first.node;
                    active = first.rays;
                    continue;
                }}
            }} else {{
                const int block = -1 - node;
                const v8* row = (const v8*)(tree.leaves.data + {8 * PLANE_ROWS} * block);
                unsigned undecided = 0;
                int lanes_of[8];
                for (; active; active &= active - 1) {{
                    const int i = __builtin_ctz(active);
                    const float tx = group.toward[0][i], ty = group.toward[1][i], tz = group.toward[2][i];
                    const v8 ax = group.at[0][i] - row[0], ay = group.at[1][i] - row[1], az = group.at[2][i] - row[2];
                    const v8 limit = group.last[i];
                    {LEAF_TEST}
                    lanes_of[i] = lanes;
                    if (lanes) {{
                        undecided |= 1u << i;
                        {ASK_AHEAD}
                    }}
                }}
                for (; undecided; undecided &= undecided - 1) {{
                    const int i = __builtin_ctz(undecided);
                    Found& r = found[i];
                    for (unsigned lanes = lanes_of[i]; lanes; lanes &= lanes - 1) {{
                        const int slot = 8 * block + __builtin_ctz(lanes);
                        double t, v, w;
                        if (!hit(origins.data[r.id], directions.data[r.id], slot, t, v, w) || t > r.best) continue;
                        ON_HIT
                    }}
                }}
                reach = greatest(within ? *(const v8*)group.last : zero);
            }}
            // On to what waits, for those of its rays that it is still within the reach of.
            active = 0;
            while (!active && --height >= 0)
                active = stack[height].rays & mask_of(stack[height].entry <= *(const v8*)group.last);
            if (!active) break;
            node = stack[height].node;
        }}
        for (unsigned done = group.waiting; done; done &= done - 1) finish(found[__builtin_ctz(done)]);
        group.waiting = 0;
        if (alone > together) group.apart = {APART};
    }}
"""
