"""Search over the tree of a warp Mesh: float32 boxes, widened by their rounding, around float64 triangles.

Warp's own mesh queries answer in float32, skip slivers and test unpadded boxes. The native snippets here walk the
same tree (``node_lowers``, ``node_uppers``, ``primitive_indices`` of ``wp::BVH``) with conservative boxes and evaluate
triangles in float64, so that an answer is the float64 answer whatever the traversal order was. ``corners`` holds the
triangles' world-space corners in leaf order: a leaf is one contiguous read.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh._triangle_kernels import CLOSEST_ON_TRIANGLE

wp.set_module_options({"enable_backward": False})

# Local coordinates lie in [-1, 1] and are rounded to float32 by at most 2^-25 (half a unit in the last place) an axis;
# 2e-7 covers that in three axes, and the rounding of the box distance itself, about twice over.
BOX_PADDING = 2.0e-7

_LEAF_ORDER = """
    wp::Mesh mesh = wp::mesh_get(id);
    return wp::bvh_load_int(mesh.bvh.primitive_indices, slot);
"""


@wp.func_native(_LEAF_ORDER)
def triangle_in_slot(id: wp.uint64, slot: int) -> int: ...


# Distances in world units: `scale` is the size of a local unit. The stack holds what warp's own queries need: its
# builders bound the depth of the tree by 32.
_NEAREST = f"""
    {CLOSEST_ON_TRIANGLE}
    const wp::Mesh mesh = wp::mesh_get(id);
    const double qx = (p[0] - origin[0]) / scale, qy = (p[1] - origin[1]) / scale, qz = (p[2] - origin[2]) / scale;
    const double far = (qx < 0 ? -qx : qx) + (qy < 0 ? -qy : qy) + (qz < 0 ? -qz : qz);
    const double padding = {BOX_PADDING} + 1e-15 * far;
    const wp::BVHPackedNodeHalf* lowers = mesh.bvh.node_lowers;
    const wp::BVHPackedNodeHalf* uppers = mesh.bvh.node_uppers;
    auto triangle_in = [&](int slot) {{ return wp::bvh_load_int(mesh.bvh.primitive_indices, slot); }};
    auto box_squared = [&](const wp::BVHPackedNodeHalf& l, const wp::BVHPackedNodeHalf& u) {{
        double x = l.x - qx, y = l.y - qy, z = l.z - qz;
        const double x1 = qx - u.x, y1 = qy - u.y, z1 = qz - u.z;
        x = x > x1 ? x : x1; y = y > y1 ? y : y1; z = z > z1 ? z : z1;
        x = x > 0.0 ? x : 0.0; y = y > 0.0 ? y : 0.0; z = z > 0.0 ? z : 0.0;
        return x * x + y * y + z * z;
    }};
    double best = max_squared;         // world units squared
    int winner = -1;
    auto reach_of = [&](double squared) {{
        const double reach = sqrt(squared) / scale + padding;
        return reach * reach;
    }};
    double reach = reach_of(best);     // local units squared, widened
    int stack[64];
    double entry[64];
    int depth = 0;
    stack[0] = *mesh.bvh.root;
    entry[0] = 0.0;
    depth = 1;
    while (depth > 0) {{
        --depth;
        if (entry[depth] > reach) continue;
        int node = stack[depth];
        wp::BVHPackedNodeHalf l = wp::bvh_load_node(lowers, node), u = wp::bvh_load_node(uppers, node);
        while (!l.b) {{
            const int left = l.i, right = u.i;
            const wp::BVHPackedNodeHalf ll = wp::bvh_load_node(lowers, left), lu = wp::bvh_load_node(uppers, left);
            const wp::BVHPackedNodeHalf rl = wp::bvh_load_node(lowers, right), ru = wp::bvh_load_node(uppers, right);
            const double dl = box_squared(ll, lu), dr = box_squared(rl, ru);
            const bool left_first = dl <= dr;
            const double near = left_first ? dl : dr, later = left_first ? dr : dl;
            if (later <= reach) {{
                stack[depth] = left_first ? right : left;
                entry[depth++] = later;
            }}
            if (near > reach) break;
            l = left_first ? ll : rl;
            u = left_first ? lu : ru;
        }}
        if (!l.b) continue;
        for (int slot = l.i; slot < (int)u.i; ++slot) {{
            const point a = corners.data[3 * slot], b = corners.data[3 * slot + 1], c = corners.data[3 * slot + 2];
            double v, w;
            const double squared = closest_on_triangle(p - a, b - a, c - a, v, w);
            if (squared > best) continue;
            // Ties go to the lowest triangle: the answer must not depend on the order of the walk.
            if (squared == best && winner >= 0 && triangle_in(slot) > triangle_in(winner)) continue;
            if (squared < best) reach = reach_of(squared);
            best = squared;
            winner = slot;
        }}
    }}
    return winner;
"""


@wp.func_native(_NEAREST)
def nearest_slot(
    id: wp.uint64,
    corners: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    p: wp.vec3d,
    max_squared: wp.float64,
) -> int: ...


@wp.kernel
def gather_corners_kernel(
    first: int,
    id: wp.uint64,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    out_corners: wp.array(dtype=wp.vec3d),
):
    slot = first + wp.tid()
    triangle = triangle_in_slot(id, slot)
    for k in range(3):
        out_corners[3 * slot + k] = vertices[faces[3 * triangle + k]]
