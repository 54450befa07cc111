"""C++ text of the nearest-triangle search over the tree of a warp Mesh, on CUDA.

As on the CPU the search runs in float32 and keeps what its rounding leaves possible; those triangles are evaluated in
float64, where ties go to the lowest.
"""

from geokit.mesh._tree_kernels import BOX_PADDING
from geokit.mesh._wide_leaf_kernels import SLOT_WORDS
from geokit.mesh._wide_nearest_kernels import DISTANCE_ERROR, FAR, UNBOUNDED

# Candidates that wait for float64, in a thread's local memory.
CANDIDATES = 8

# Names as in WIDE_NEAREST; the seed is of no use here. The stack holds what warp's own queries need: its builders bound
# the depth of the tree by 32.
BINARY_NEAREST = f"""
    const wp::Mesh mesh = wp::mesh_get(tree.mesh);
    const wp::BVHPackedNodeHalf* lowers = mesh.bvh.node_lowers;
    const wp::BVHPackedNodeHalf* uppers = mesh.bvh.node_uppers;
    double exact = max_squared;  // world units squared
    int winner = -1;
    auto evaluate = [&](int slot) {{
        const point a = tree.corners.data[3 * slot], b = tree.corners.data[3 * slot + 1],
                    c = tree.corners.data[3 * slot + 2];
        double v, w;
        const double squared = closest_on_triangle(p - a, b - a, c - a, v, w);
        if (squared > exact) return;
        // Ties go to the lowest triangle: the answer must not depend on the order of the walk.
        if (squared == exact && winner >= 0 && tree.slot_triangle.data[slot] > tree.slot_triangle.data[winner]) return;
        exact = squared;
        winner = slot;
    }};
    const double qx = (p[0] - tree.origin[0]) / tree.scale, qy = (p[1] - tree.origin[1]) / tree.scale,
                 qz = (p[2] - tree.origin[2]) / tree.scale;
    const double size = wp::max(wp::max(wp::abs(qx), wp::abs(qy)), wp::abs(qz));
    int stack[64], depth = 1;
    stack[0] = *mesh.bvh.root;
    if (size > {FAR}) {{
        // Far out all in float64, with the boxes' own rounding as slack.
        const double padding = {BOX_PADDING} + 3e-15 * size;
        auto box_squared = [&](const wp::BVHPackedNodeHalf& l, const wp::BVHPackedNodeHalf& u) {{
            const double x = wp::max(wp::max(l.x - qx, qx - u.x), 0.0), y = wp::max(wp::max(l.y - qy, qy - u.y), 0.0),
                         z = wp::max(wp::max(l.z - qz, qz - u.z), 0.0);
            return x * x + y * y + z * z;
        }};
        while (depth > 0) {{
            const int node = stack[--depth];
            const wp::BVHPackedNodeHalf l = wp::bvh_load_node(lowers, node), u = wp::bvh_load_node(uppers, node);
            const double reach = sqrt(exact) / tree.scale + padding;
            if (box_squared(l, u) > reach * reach) continue;
            if (l.b) {{
                for (int slot = l.i; slot < (int)u.i; ++slot) evaluate(slot);
                continue;
            }}
            const int left = l.i, right = u.i;
            const bool left_first = box_squared(wp::bvh_load_node(lowers, left), wp::bvh_load_node(uppers, left))
                                    <= box_squared(wp::bvh_load_node(lowers, right), wp::bvh_load_node(uppers, right));
            stack[depth++] = left_first ? right : left;
            stack[depth++] = left_first ? left : right;
        }}
        return winner;
    }}
    const float X = (float)qx, Y = (float)qy, Z = (float)qz;
    const float slack = 2.f * {DISTANCE_ERROR}f * ((float)size + 1.f);
    // Anything nearer than this, in float32, can be the nearest.
    auto widened = [&](float squared) {{
        const float reach = sqrtf(squared) + slack;
        return reach * reach;
    }};
    const double radius = max_squared / (tree.scale * tree.scale);
    float reach = radius < {UNBOUNDED} ? widened((float)radius * 1.000001f) : {UNBOUNDED}f;
    float least = {UNBOUNDED}f;
    int candidate[{CANDIDATES}];
    float candidate_squared[{CANDIDATES}];
    int candidates = 0;
    auto settle = [&]() {{
        for (int i = 0; i < candidates; ++i)
            if (candidate_squared[i] <= reach) evaluate(candidate[i]);
        candidates = 0;
    }};
    auto clamped = [](float x, float upper) {{ return fminf(fmaxf(x, 0.f), upper); }};
    auto test = [&](int slot) {{
        const float4* row = (const float4*)(tree.leaves.data + {SLOT_WORDS} * slot);
        const float4 r0 = row[0], r1 = row[1], r2 = row[2], r3 = row[3];
        const float ax = X - r0.x, ay = Y - r0.y, az = Z - r0.z;
        const float x = ax * r0.w + ay * r1.x + az * r1.y;
        const float y = ax * r1.z + ay * r1.w + az * r2.x;
        const float z = ax * r2.y + ay * r2.z + az * r2.w;
        const float length = r3.x, cx = r3.y, cy = r3.z, bx = x - length, bcx = cx - length;
        float flat = 0.f;
        if (!(y > 0.f && cy * x > cx * y && bcx * y > cy * bx)) {{
            const float ex = x - clamped(x, length);
            const float s = clamped((x * cx + y * cy) * r3.w, 1.f), sx = x - s * cx, sy = y - s * cy;
            const float t = clamped((bx * bcx + y * cy) * row[4].x, 1.f), tx = bx - t * bcx, ty = y - t * cy;
            flat = fminf(fminf(ex * ex + y * y, sx * sx + sy * sy), tx * tx + ty * ty);
        }}
        const float d2 = flat + z * z;
        if (!(d2 <= reach)) return;
        if (d2 < least) {{
            least = d2;
            reach = fminf(reach, widened(d2));
        }}
        if (candidates == {CANDIDATES}) {{
            int kept = 0;
            for (int i = 0; i < candidates; ++i)
                if (candidate_squared[i] <= reach) {{
                    candidate[kept] = candidate[i]; candidate_squared[kept++] = candidate_squared[i];
                }}
            candidates = kept;
            if (candidates == {CANDIDATES}) settle();
        }}
        candidate[candidates] = slot;
        candidate_squared[candidates++] = d2;
    }};
    auto box_squared = [&](const wp::BVHPackedNodeHalf& l, const wp::BVHPackedNodeHalf& u) {{
        const float x = fmaxf(fmaxf(l.x - X, X - u.x), 0.f), y = fmaxf(fmaxf(l.y - Y, Y - u.y), 0.f),
                    z = fmaxf(fmaxf(l.z - Z, Z - u.z), 0.f);
        return x * x + y * y + z * z;
    }};
    float entry[64];
    entry[0] = 0.f;
    while (depth > 0) {{
        --depth;
        if (entry[depth] > reach) continue;
        wp::BVHPackedNodeHalf l = wp::bvh_load_node(lowers, stack[depth]);
        wp::BVHPackedNodeHalf u = wp::bvh_load_node(uppers, stack[depth]);
        bool reached = true;
        while (!l.b && reached) {{
            const int left = l.i, right = u.i;
            const wp::BVHPackedNodeHalf ll = wp::bvh_load_node(lowers, left), lu = wp::bvh_load_node(uppers, left);
            const wp::BVHPackedNodeHalf rl = wp::bvh_load_node(lowers, right), ru = wp::bvh_load_node(uppers, right);
            const float dl = box_squared(ll, lu), dr = box_squared(rl, ru);
            const bool left_first = dl <= dr;
            const float later = left_first ? dr : dl;
            reached = (left_first ? dl : dr) <= reach;
            if (later <= reach) {{
                stack[depth] = left_first ? right : left;
                entry[depth++] = later;
            }}
            l = left_first ? ll : rl;
            u = left_first ? lu : ru;
        }}
        if (!reached) continue;
        for (int slot = l.i; slot < (int)u.i; ++slot) test(slot);
    }}
    settle();
    return winner;
"""
