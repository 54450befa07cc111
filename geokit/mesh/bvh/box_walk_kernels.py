"""C++ text of a walk that visits the triangles of a surface whose boxes meet a box; and the boxes it compares."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.bvh2_packed_cuda_kernels import LOAD_NODE
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.tree_kernels import BOX_PADDING, SurfaceTree

wp.set_module_options({"enable_backward": False})

# Boxes end here, in local units: the mesh lies in [-1, 1], and children that do not exist beyond this.
FARTHEST = 1.0e18

# local_box(tree, lower, upper, low, high): the world box as three and three floats of the tree's frame, rounded
# outwards. Rounding is monotone: what touches in the world touches here. The boxes of a warp Mesh are of vertices that
# were rounded to the nearest.
LOCAL_BOX = f"""
    auto rounded_down = [](double x) {{ return (float)x - wp::abs((float)x) * 1.2e-7f - 1e-30f; }};
    auto local_box = [&](const auto& tree, const double* lower, const double* upper, float* low, float* high) {{
        for (int k = 0; k < 3; ++k) {{
            const double padding = tree.mesh ? (double){BOX_PADDING} : 0.0;
            const double from = (lower[k] - tree.origin[k]) / tree.scale - padding;
            const double to = (upper[k] - tree.origin[k]) / tree.scale + padding;
            low[k] = rounded_down(wp::clamp(from, -{FARTHEST}, {FARTHEST}));
            high[k] = -rounded_down(-wp::clamp(to, -{FARTHEST}, {FARTHEST}));
        }}
    }};
"""

# Names that the text expects: tree, low and high (arrays of three floats). VISIT is replaced by what is done with
# `first`: the first slot of a leaf of eight slots on a CPU, of one on CUDA, whose box meets the box.
BOX_WALK = f"""
    {{
    int stack[{STACK}], height = 1;
    #if defined(__CUDA_ARCH__)
    {LOAD_NODE}
    auto reaches = [&](float lx, float ly, float lz, float ux, float uy, float uz) {{
        return lx <= high[0] && ly <= high[1] && lz <= high[2] && ux >= low[0] && uy >= low[1] && uz >= low[2];
    }};
    stack[0] = tree.children.data[0];
    while (height > 0) {{
        const int node = stack[--height];
        if (node < 0) {{
            for (int first = first_slot(node); first < end_slot(node); ++first) {{ VISIT }}
            continue;
        }}
        const Node n = load_node(tree.boxes.data, node);
        if (reaches(n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ)) stack[height++] = n.right;
        if (reaches(n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ)) stack[height++] = n.left;
    }}
    #else
    typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    stack[0] = 0;
    while (height > 0) {{
        const int node = stack[--height];
        if (node < 0) {{
            const int first = 8 * (-1 - node);
            {{ VISIT }}
            continue;
        }}
        const v8* side = (const v8*)(tree.boxes.data + 48 * node);
        const auto meets = (side[0] <= high[0]) & (side[1] <= high[1]) & (side[2] <= high[2])
                           & (side[3] >= low[0]) & (side[4] >= low[1]) & (side[5] >= low[2]);
        const int* child = tree.children.data + 8 * node;
        unsigned mask = (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(meets, b8));
        for (; mask; mask &= mask - 1) stack[height++] = child[__builtin_ctz(mask)];
    }}
    #endif
    }}
"""

_SLOT_BOX = (
    LOCAL_BOX
    + """
    float* row = out_boxes.data + 48 * (slot / 8) + slot % 8;
    if (tree.slot_triangle.data[slot] < 0) {
        for (int k = 0; k < 3; ++k) { row[8 * k] = INFINITY; row[24 + 8 * k] = -INFINITY; }
        return;
    }
    double lower[3], upper[3];
    const wp::vec_t<3, wp::float64>* p = tree.corners.data + 3 * slot;
    for (int k = 0; k < 3; ++k) {
        lower[k] = wp::min(wp::min(p[0][k], p[1][k]), p[2][k]);
        upper[k] = wp::max(wp::max(p[0][k], p[1][k]), p[2][k]);
    }
    float low[3], high[3];
    local_box(tree, lower, upper, low, high);
    for (int k = 0; k < 3; ++k) { row[8 * k] = low[k]; row[24 + 8 * k] = high[k]; }
"""
)


@wp.func_native(_SLOT_BOX)
def slot_box(tree: SurfaceTree, slot: int, out_boxes: wp.array(dtype=wp.float32)): ...


@wp.kernel
def slot_boxes_kernel(first: int, tree: SurfaceTree, out_boxes: wp.array(dtype=wp.float32)):
    """For each block of eight slots their local boxes, six rows of eight: lower x y z, upper x y z."""
    slot_box(tree, first + wp.tid(), out_boxes)
