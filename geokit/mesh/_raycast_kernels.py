"""First hits of rays without leaks: float32 boxes widened by their rounding, edge functions in float64.

Warp's own ray query tests unpadded boxes and leaks thousands of rays per million that aim at edges and vertices.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh._bvh_kernels import BOX_PADDING, triangle_in_slot

wp.set_module_options({"enable_backward": False})

# Edge functions of the two triangles at an edge must be exact negatives of each other: a fused multiply-add would
# round the two products of each differently, and a ray through the edge could miss both (Woop, Benthin, Wald,
# "Watertight Ray/Triangle Intersection", JCGT 2013). Differs: all in float64, no fall-back needed.
_EXACT = """
    typedef wp::vec_t<3, wp::float64> point;
    #if defined(__CUDA_ARCH__)
    auto product = [](double x, double y) { return __dmul_rn(x, y); };
    auto minus = [](double x, double y) { return __dsub_rn(x, y); };
    #else
    auto product = [](double x, double y) {
        #pragma clang fp contract(off)
        return x * y;
    };
    auto minus = [](double x, double y) {
        #pragma clang fp contract(off)
        return x - y;
    };
    #endif
"""

_RAY = (
    _EXACT
    + """
    double size[3] = {direction[0] < 0 ? -direction[0] : direction[0],
                      direction[1] < 0 ? -direction[1] : direction[1],
                      direction[2] < 0 ? -direction[2] : direction[2]};
    // The axis along which the ray moves most becomes z of a sheared frame in which the ray is the z axis.
    const int kz = size[0] >= size[1] ? (size[0] >= size[2] ? 0 : 2) : (size[1] >= size[2] ? 1 : 2);
    const int kx = direction[kz] < 0.0 ? (kz + 2) % 3 : (kz + 1) % 3;
    const int ky = direction[kz] < 0.0 ? (kz + 1) % 3 : (kz + 2) % 3;
    const double sx = direction[kx] / direction[kz], sy = direction[ky] / direction[kz], sz = 1.0 / direction[kz];
    // False where the ray misses the triangle in this slot; t in units of the direction, v and w the weights of b, c.
    auto hit = [&](int slot, double& t, double& v, double& w) {
        const point a = corners.data[3 * slot] - start, b = corners.data[3 * slot + 1] - start,
                    c = corners.data[3 * slot + 2] - start;
        const double ax = minus(a[kx], product(sx, a[kz])), ay = minus(a[ky], product(sy, a[kz]));
        const double bx = minus(b[kx], product(sx, b[kz])), by = minus(b[ky], product(sy, b[kz]));
        const double cx = minus(c[kx], product(sx, c[kz])), cy = minus(c[ky], product(sy, c[kz]));
        const double fa = minus(product(cx, by), product(cy, bx));
        const double fb = minus(product(ax, cy), product(ay, cx));
        const double fc = minus(product(bx, ay), product(by, ax));
        if ((fa < 0.0 || fb < 0.0 || fc < 0.0) && (fa > 0.0 || fb > 0.0 || fc > 0.0)) return false;
        const double whole = fa + fb + fc;
        if (whole == 0.0) return false;  // seen edge-on: its neighbours take the ray
        v = fb / whole;
        w = fc / whole;
        t = (fa * a[kz] + fb * b[kz] + fc * c[kz]) * sz / whole;
        return t >= 0.0;
    };
"""
)

_WALK = f"""
    const wp::Mesh mesh = wp::mesh_get(id);
    auto triangle_in = [&](int slot) {{ return wp::bvh_load_int(mesh.bvh.primitive_indices, slot); }};
    double inverse[3], begin[3], far = 0.0;
    const double largest = size[kz];
    for (int k = 0; k < 3; ++k) {{
        begin[k] = (start[k] - origin[k]) / scale;
        far += begin[k] < 0 ? -begin[k] : begin[k];
        // A component that is zero, or too small to matter, must not make 0 * inf in the slab test.
        const double least = 1e-200 * largest;
        const double d = size[k] > least ? direction[k] : (direction[k] < 0 ? -least : least);
        inverse[k] = scale / d;
    }}
    const double padding = {BOX_PADDING} + 1e-15 * far;
    double best = t_max;
    int winner = -1;
    // Where the ray enters the widened box, or infinity.
    auto entry_of = [&](const wp::BVHPackedNodeHalf& l, const wp::BVHPackedNodeHalf& u) {{
        const double x0 = (l.x - padding - begin[0]) * inverse[0], x1 = (u.x + padding - begin[0]) * inverse[0];
        const double y0 = (l.y - padding - begin[1]) * inverse[1], y1 = (u.y + padding - begin[1]) * inverse[1];
        const double z0 = (l.z - padding - begin[2]) * inverse[2], z1 = (u.z + padding - begin[2]) * inverse[2];
        double in = 0.0, out = best;
        in = wp::max(in, wp::min(x0, x1)); out = wp::min(out, wp::max(x0, x1));
        in = wp::max(in, wp::min(y0, y1)); out = wp::min(out, wp::max(y0, y1));
        in = wp::max(in, wp::min(z0, z1)); out = wp::min(out, wp::max(z0, z1));
        return in <= out ? in : (double)INFINITY;
    }};
    int stack[64];
    double entry[64];
    int depth = 1;
    stack[0] = *mesh.bvh.root;
    entry[0] = 0.0;
    while (depth > 0) {{
        --depth;
        if (entry[depth] > best) continue;
        wp::BVHPackedNodeHalf l = wp::bvh_load_node(mesh.bvh.node_lowers, stack[depth]);
        wp::BVHPackedNodeHalf u = wp::bvh_load_node(mesh.bvh.node_uppers, stack[depth]);
        bool reached = true;
        while (!l.b && reached) {{
            const int left = l.i, right = u.i;
            const wp::BVHPackedNodeHalf ll = wp::bvh_load_node(mesh.bvh.node_lowers, left);
            const wp::BVHPackedNodeHalf lu = wp::bvh_load_node(mesh.bvh.node_uppers, left);
            const wp::BVHPackedNodeHalf rl = wp::bvh_load_node(mesh.bvh.node_lowers, right);
            const wp::BVHPackedNodeHalf ru = wp::bvh_load_node(mesh.bvh.node_uppers, right);
            const double tl = entry_of(ll, lu), tr = entry_of(rl, ru);
            const bool left_first = tl <= tr;
            const double later = left_first ? tr : tl;
            reached = (left_first ? tl : tr) < INFINITY;
            if (later < INFINITY) {{
                stack[depth] = left_first ? right : left;
                entry[depth++] = later;
            }}
            l = left_first ? ll : rl;
            u = left_first ? lu : ru;
        }}
        if (!reached) continue;
        for (int slot = l.i; slot < (int)u.i; ++slot) {{
            double t, v, w;
            if (!hit(slot, t, v, w) || t > best) continue;
            // Ties go to the lowest triangle: the answer must not depend on the order of the walk.
            if (t == best && winner >= 0 && triangle_in(slot) > triangle_in(winner)) continue;
            best = t;
            winner = slot;
            ON_HIT
        }}
    }}
    return winner;
"""

_FIRST_HIT = _RAY + _WALK.replace("ON_HIT", "")
_ANY_HIT = _RAY + _WALK.replace("ON_HIT", "return slot;")
_HIT_IN_SLOT = (
    _RAY
    + """
    double t = INFINITY, v = 0.0, w = 0.0;
    hit(slot, t, v, w);
    return point(t, v, w);
"""
)


@wp.func_native(_FIRST_HIT)
def first_hit_slot(
    id: wp.uint64,
    corners: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    start: wp.vec3d,
    direction: wp.vec3d,
    t_max: wp.float64,
) -> int: ...


@wp.func_native(_ANY_HIT)
def any_hit_slot(
    id: wp.uint64,
    corners: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    start: wp.vec3d,
    direction: wp.vec3d,
    t_max: wp.float64,
) -> int: ...


@wp.func_native(_HIT_IN_SLOT)
def hit_in_slot(corners: wp.array(dtype=wp.vec3d), slot: int, start: wp.vec3d, direction: wp.vec3d) -> wp.vec3d:
    """t and the weights of b and c, for a slot that the ray is known to hit."""
    ...


@wp.func
def entry_into_cube(start: wp.vec3d, direction: wp.vec3d) -> wp.float64:
    """Where a ray enters the cube [-1, 1]^3, 0 where it starts inside or misses."""
    t = wp.float64(0.0)
    one = wp.float64(1.0)
    for k in range(3):
        if wp.abs(start[k]) > one and direction[k] * start[k] < wp.float64(0.0):
            t = wp.max(t, (wp.abs(start[k]) - one) / wp.abs(direction[k]))
    return t


@wp.kernel
def entry_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    out_points: wp.array(dtype=wp.vec3d),
):
    """Local point where each ray enters the mesh's box: rays from one camera differ only there."""
    i = first + wp.tid()
    start = (origins[i] - origin) / scale
    direction = directions[i] / scale
    out_points[i] = start + entry_into_cube(start, direction) * direction


@wp.kernel
def raycast_kernel(
    first: int,
    order: wp.array(dtype=int),
    entries: wp.array(dtype=wp.vec3d),
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    mesh: wp.uint64,
    corners: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    max_distance: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
):
    i = order[first + wp.tid()]
    start = origins[i]
    direction = directions[i]
    t_max = max_distance / wp.length(direction)
    slot = first_hit_slot(mesh, corners, origin, scale, start, direction, t_max)
    if slot < 0:
        none = wp.float64(wp.nan)
        out_t[i] = wp.float64(wp.inf)
        out_triangle_id[i] = -1
        out_barycentric[i] = wp.vec3d(none, none, none)
    else:
        hit = hit_in_slot(corners, slot, start, direction)
        out_t[i] = hit[0]
        out_triangle_id[i] = triangle_in_slot(mesh, slot)
        out_barycentric[i] = wp.vec3d(wp.float64(1.0) - hit[1] - hit[2], hit[1], hit[2])


@wp.kernel
def occluded_kernel(
    first: int,
    order: wp.array(dtype=int),
    entries: wp.array(dtype=wp.vec3d),
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    mesh: wp.uint64,
    corners: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    max_distance: wp.float64,
    out_occluded: wp.array(dtype=wp.bool),
):
    i = order[first + wp.tid()]
    direction = directions[i]
    t_max = max_distance / wp.length(direction)
    out_occluded[i] = any_hit_slot(mesh, corners, origin, scale, origins[i], direction, t_max) >= 0
