"""First hits on CUDA: a float32 walk that leaves a few candidates, then float64 for those.

Deciding in float64 on the way would make threads wait for each other at every triangle. A triangle that the ray meets
well inside ends the search behind it; one that it meets within the margins of an edge does not, and is decided with
the others.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.bvh2_packed_cuda_kernels import LOAD_NODE
from geokit.mesh.bvh.bvh8_leaves_cpu_kernels import SLOT_WORDS
from geokit.mesh.bvh.bvh8_ray_leaves_cpu_kernels import SLIVER
from geokit.mesh.bvh.bvh8_raycast_cpu_kernels import ENDLESS, LEAST_COMPONENT, NEAR_START, PLANE_MARGIN
from geokit.mesh.bvh.ray_triangle_kernels import RAY_HIT_AT_ALL, REFINE_SLIVER, SHORTEST_DIRECTION
from geokit.mesh.bvh.tree_kernels import NO_CANDIDATE, UNDECIDED, SurfaceTree

wp.set_module_options({"enable_backward": False})

# Candidates of a ray: the triangle that it hits first and, near an edge or a vertex, those around it. With 16 one ray
# of four million had too many among 3 million triangles, and the second walk took a sixth of the first one's time.
CANDIDATES = 32
# Of a thread on a GPU; see docs/design/layers.md.
REGISTERS = 48
# Bit of a candidate's slot; slots are fewer.
IS_SLIVER = 1 << 30

_SEARCH = f"""
    #if !defined(__CUDA_ARCH__)
    // Warp's CPU compiler has these as built-ins only; tests run the search there.
    auto fminf = [](float a, float b) {{ return __builtin_fminf(a, b); }};
    auto fmaxf = [](float a, float b) {{ return __builtin_fmaxf(a, b); }};
    auto fabsf = [](float a) {{ return __builtin_fabsf(a); }};
    auto sqrtf = [](float a) {{ return __builtin_sqrtf(a); }};
    auto copysignf = [](float a, float b) {{ return __builtin_copysignf(a, b); }};
    #endif
    {LOAD_NODE}
    struct alignas(16) Four {{ float x, y, z, w; }};
    int found[{CANDIDATES}];
    found[0] = {NO_CANDIDATE};
    auto search = [&]() {{
    float sx, sy, sz, tx, ty, tz, last;
    {{
        const double largest = wp::max(wp::max(wp::abs(direction[0]), wp::abs(direction[1])), wp::abs(direction[2]));
        const double local = 1.0 / tree.scale, shrink = 1.0 / largest, unit = largest * local;
        const double fx = (start[0] - tree.origin[0]) * local, fy = (start[1] - tree.origin[1]) * local,
                     fz = (start[2] - tree.origin[2]) * local;
        const double ax = direction[0] * shrink, ay = direction[1] * shrink, az = direction[2] * shrink;
        tx = (float)ax; ty = (float)ay; tz = (float)az;
        double enter = t_min * unit;
        const float far = fmaxf(fmaxf(fabsf((float)fx), fabsf((float)fy)), fabsf((float)fz));
        if (!(far < 1e30f && largest < 1e300)) {{
            found[0] = {UNDECIDED};
            return;
        }}
        if (far > {NEAR_START}f) {{
            // How far in the ray is near the cube, for certain before it enters: far from it nothing is missed.
            const float length = sqrtf(tx * tx + ty * ty + tz * tz);
            const float middle = -((float)fx * tx + (float)fy * ty + (float)fz * tz) / (length * length);
            enter = wp::max(enter, (double)(middle - (1.75f + 1e-5f * far) / length));
        }}
        sx = (float)(fx + enter * ax); sy = (float)(fy + enter * ay); sz = (float)(fz + enter * az);
        last = fminf((float)(t_max * unit - enter) * 1.000001f + {PLANE_MARGIN}f, {ENDLESS}f);
        if (last < 0.f) return;
        // Beside the ball around the cube; or still so far from it that float32 has too few digits.
        const float beside = fmaxf(fmaxf(fabsf(sx), fabsf(sy)), fabsf(sz));
        if (beside > 4.f) {{
            found[0] = far > 1e4f ? {UNDECIDED} : {NO_CANDIDATE};
            return;
        }}
    }}
    auto reciprocal_of = [&](float component) {{
        return 1.f / copysignf(fmaxf(fabsf(component), {LEAST_COMPONENT}f), component);
    }};
    const float ix = reciprocal_of(tx), iy = reciprocal_of(ty), iz = reciprocal_of(tz);
    const float ox = -sx * ix, oy = -sy * iy, oz = -sz * iz;
    // Where the ray enters a box, or infinity.
    auto entry_of = [&](float lx, float ly, float lz, float ux, float uy, float uz) {{
        const float x0 = lx * ix + ox, x1 = ux * ix + ox, y0 = ly * iy + oy, y1 = uy * iy + oy;
        const float z0 = lz * iz + oz, z1 = uz * iz + oz;
        const float in = fmaxf(fmaxf(fminf(x0, x1), fminf(y0, y1)), fmaxf(fminf(z0, z1), 0.f));
        const float out = fminf(fminf(fmaxf(x0, x1), fmaxf(y0, y1)), fminf(fmaxf(z0, z1), last));
        return in <= out ? in : (float)INFINITY;
    }};
    int slot_of[{CANDIDATES}];
    float nearest_of[{CANDIDATES}];
    int count = 0;
    bool full = false;
    auto prune = [&]() {{
        int kept = 0;
        for (int i = 0; i < count; ++i)
            if (nearest_of[i] <= last) {{
                slot_of[kept] = slot_of[i];
                nearest_of[kept++] = nearest_of[i];
            }}
        count = kept;
    }};
    // Everything times dz and turned so that dz is positive: grazing rays lose no digits in a division.
    auto test = [&](int slot) {{
        const Four* row = (const Four*)(tree.leaves.data + {SLOT_WORDS} * slot);
        const Four r0 = row[0], r1 = row[1], r2 = row[2], r3 = row[3];
        const float ax = sx - r0.x, ay = sy - r0.y, az = sz - r0.z;
        const float oz = ax * r2.y + ay * r2.z + az * r2.w, dz = tx * r2.y + ty * r2.z + tz * r2.w;
        const float depth = dz < 0.f ? oz : -oz, down = fabsf(dz);
        if (!(depth >= -{PLANE_MARGIN}f && depth <= last * down + {PLANE_MARGIN}f)) return;
        const float ox = ax * r0.w + ay * r1.x + az * r1.y, dx = tx * r0.w + ty * r1.x + tz * r1.y;
        const float oy = ax * r1.z + ay * r1.w + az * r2.x, dy = tx * r1.z + ty * r1.w + tz * r2.x;
        const float x = ox * down + dx * depth, y = oy * down + dy * depth;
        const float longest = r3.x, cx = r3.y, cy = r3.z, margin = {PLANE_MARGIN}f * longest;
        const float ca = cy * x - cx * y, bc = (cx - longest) * y - cy * (x - longest * down);
        if (!(y >= -{PLANE_MARGIN}f && ca >= -margin && bc >= -margin)) return;
        const float farthest = (depth + {PLANE_MARGIN}f) / down * 1.000001f;
        if (y > {PLANE_MARGIN}f && ca > margin && bc > margin && depth > {PLANE_MARGIN}f && farthest < last)
            last = farthest;
        if (count == {CANDIDATES}) prune();
        if (count == {CANDIDATES}) {{
            full = true;
            return;
        }}
        slot_of[count] = cy < {SLIVER}f * longest ? slot | {IS_SLIVER} : slot;
        nearest_of[count++] = (depth - {PLANE_MARGIN}f) / down * 0.999999f;
    }};
    int stack[64], height = 0, node = tree.ray_children.data[0];
    while (true) {{
        bool in_box = true;
        while (node >= 0 && in_box) {{
            const Node n = load_node(tree.ray_boxes.data, node);
            const float tl = entry_of(n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ);
            const float tr = entry_of(n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ);
            const bool left_first = tl <= tr;
            const float later = left_first ? tr : tl;
            if (later < INFINITY) stack[height++] = left_first ? n.right : n.left;
            node = left_first ? n.left : n.right;
            in_box = (left_first ? tl : tr) < INFINITY;
        }}
        if (in_box) {{
            for (int slot = first_slot(node); slot < end_slot(node); ++slot) test(slot);
        }}
        if (height == 0) break;
        node = stack[--height];
    }}
    prune();
    if (full) {{
        found[0] = {UNDECIDED};
        return;
    }}
    for (int i = 0; i < count; ++i) found[i] = slot_of[i];
    if (count < {CANDIDATES}) found[count] = {NO_CANDIDATE};
    }};
    search();
"""

_DECIDE = f"""
    {RAY_HIT_AT_ALL}
    {REFINE_SLIVER}
    if (found[0] == {UNDECIDED}) {{
        out_triangle_id.data[ray] = {UNDECIDED};
        out_bad.data[1] = 1;
        return;
    }}
    double best = t_max, weight_b = 0.0, weight_c = 0.0;
    int winner = -1;
    for (int i = 0; i < {CANDIDATES}; ++i) {{
        if (found[i] < 0) break;
        const int slot = found[i] & ~{IS_SLIVER};
        double t, v, w;
        if (!hit_at_all(start, direction, slot, t, v, w)) continue;
        if (slot != found[i]) refine_sliver(start, direction, slot, t, v, w);
        if (t < t_min || t > best) continue;
        // Ties go to the lowest triangle.
        if (t == best && winner >= 0 && tree.slot_triangle.data[slot] > tree.slot_triangle.data[winner]) continue;
        best = t;
        weight_b = v;
        weight_c = w;
        winner = slot;
    }}
    const double none = (double)NAN;
    out_t.data[ray] = winner < 0 ? (double)INFINITY : best;
    out_triangle_id.data[ray] = winner < 0 ? -1 : tree.slot_triangle.data[winner];
    out_barycentric.data[ray] = winner < 0 ? point(none, none, none)
                                           : point(1.0 - weight_b - weight_c, weight_b, weight_c);
"""


@wp.func_native(_SEARCH + _DECIDE)
def first_hit(
    tree: SurfaceTree,
    start: wp.vec3d,
    direction: wp.vec3d,
    t_min: wp.float64,
    t_max: wp.float64,
    ray: int,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
): ...


@wp.func_native(
    """
    const wp::vec_t<3, wp::float64> none = (start - start) + (direction - direction);
    return largest >= shortest && none[0] + none[1] + none[2] == 0.0;
"""
)
def is_usable(start: wp.vec3d, direction: wp.vec3d, largest: wp.float64, shortest: wp.float64) -> bool:
    """Whether all is finite (a number minus itself is zero, unless it is infinite or none) and the ray has a length."""
    ...


@wp.func
def length_in_t(max_distance: wp.float64, direction: wp.vec3d) -> wp.float64:
    t_max = max_distance
    if wp.isfinite(max_distance):
        t_max = max_distance / wp.length(direction)
    return t_max


@wp.kernel(cuda_max_registers=REGISTERS, grid_stride=False)
def first_hit_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
):
    """First hits; rays with more candidates than fit, or from too far away for float32, are UNDECIDED."""
    ray = first + wp.tid()
    start = origins[ray]
    direction = directions[ray]
    largest = wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2]))
    if is_usable(start, direction, largest, wp.float64(SHORTEST_DIRECTION)):
        t_max = length_in_t(max_distance, direction)
        first_hit(tree, start, direction, t_min, t_max, ray, out_t, out_triangle_id, out_barycentric, out_bad)
    else:
        # The host refuses the whole batch and says which row is to blame.
        out_bad[0] = 1
        out_triangle_id[ray] = NO_CANDIDATE
