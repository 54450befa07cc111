// Nearest triangle in the tree of a warp Mesh, on CUDA: a float32 traversal keeps the triangles that are possible
// within its rounding error; those are evaluated in float64, where ties go to the lowest triangle.
//
// Expects closest_on_triangle.inl and load_node_bvh2.inl; tree, p, max_squared [world]; DISTANCE_ERROR, FAR, UNBOUNDED,
// BOX_PADDING, SLOT_WORDS, CUDA_CANDIDATES; optionally the macro ANY_WITHIN, which accepts any triangle within the
// distance: the first in traversal order. Returns a slot or -1. The stack is as deep as that of warp's own queries:
// warp's builders bound the depth of the tree by 32.
#if defined(__CUDA_ARCH__)
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
            #if defined(ANY_WITHIN)
            if (winner >= 0) return winner;
            #endif
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
    #if defined(ANY_WITHIN)
    evaluate(slot);
    return;
    #endif
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
    #if defined(ANY_WITHIN)
    if (winner >= 0) return winner;
    #endif
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
#endif
