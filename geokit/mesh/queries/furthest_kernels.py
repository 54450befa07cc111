"""Furthest point of a surface: a vertex, found through the tree by the far corners of its boxes."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.morton_order_kernels import prefetch_query
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.tree_kernels import BOX_PADDING, SurfaceTree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Best of the three corners in a slot; ties go to the lowest triangle and its first corner.
_CORNERS = """
    typedef wp::vec_t<3, wp::float64> point;
    double best = -1.0;  // world units squared
    int winner = -1;
    auto evaluate = [&](int slot) {
        const int triangle = tree.slot_triangle.data[slot];
        if (triangle < 0) return;
        for (int k = 0; k < 3; ++k) {
            const point d = tree.corners.data[3 * slot + k] - p;
            const double squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
            if (squared < best) continue;
            if (squared == best && triangle >= tree.slot_triangle.data[winner / 3]) continue;
            best = squared;
            winner = 3 * slot + k;
        }
    };
    const point q = (p - tree.origin) / tree.scale;
    const double far = wp::max(wp::max(wp::abs(q[0]), wp::abs(q[1])), wp::abs(q[2]));
    // Distance of the far corner of a box, squared, in world units and with what rounding can have taken.
    auto reach_of = [&](const float* lower, const float* upper, int stride) {
        double sum = 0.0;
        for (int k = 0; k < 3; ++k) {
            const double reach = wp::max(q[k] - lower[k * stride], upper[k * stride] - q[k]) + SLACK;
            sum += reach * reach;
        }
        return sum * tree.scale * tree.scale * (1.0 + 1e-12);
    };
"""

_WALK = f"""
    {_CORNERS.replace("SLACK", f"({BOX_PADDING} + 1e-15 * far)")}
    #if defined(__CUDA_ARCH__)
    const wp::Mesh mesh = wp::mesh_get(tree.mesh);
    int stack[64], height = 1;
    stack[0] = *mesh.bvh.root;
    while (height > 0) {{
        const int node = stack[--height];
        const wp::BVHPackedNodeHalf l = wp::bvh_load_node(mesh.bvh.node_lowers, node);
        const wp::BVHPackedNodeHalf u = wp::bvh_load_node(mesh.bvh.node_uppers, node);
        if (reach_of(&l.x, &u.x, 1) < best) continue;
        if (l.b) {{
            for (int slot = l.i; slot < (int)u.i; ++slot) evaluate(slot);
        }} else {{
            stack[height++] = l.i;
            stack[height++] = u.i;
        }}
    }}
    #else
    int stack[{STACK}], height = 1;
    double entry[{STACK}];
    stack[0] = 0; entry[0] = INFINITY;
    while (height > 0) {{
        --height;
        if (entry[height] < best) continue;
        const int node = stack[height];
        if (node < 0) {{
            for (int j = 0; j < 8; ++j) evaluate(8 * (-1 - node) + j);
            continue;
        }}
        const float* box = tree.boxes.data + 48 * node;
        const int base = height;
        for (int j = 0; j < 8; ++j) {{
            if (box[j] > box[24 + j]) continue;
            const double reach = reach_of(box + j, box + 24 + j, 8);
            if (reach < best) continue;
            int at = height++;
            for (; at > base && entry[at - 1] > reach; --at) {{ entry[at] = entry[at - 1]; stack[at] = stack[at - 1]; }}
            entry[at] = reach;
            stack[at] = tree.children.data[8 * node + j];
        }}
    }}
    #endif
    return winner;
"""


@wp.func_native(_WALK)
def furthest_corner(tree: SurfaceTree, p: wp.vec3d) -> int:
    """Three times the slot plus the corner."""
    ...


@wp.kernel
def furthest_point_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    out_points: wp.array(dtype=wp.vec3d),
    out_distance: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
):
    prefetch_query(points, order, first + wp.tid())
    i = order[first + wp.tid()]
    corner = furthest_corner(tree, points[i])
    found = tree.corners[corner]
    out_points[i] = found
    out_distance[i] = wp.length(found - points[i])
    out_triangle_id[i] = tree.slot_triangle[corner / 3]
