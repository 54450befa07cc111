"""Triangles that meet boxes: their number for each box, then their list."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.atomic_kernels import lower_to
from geokit.mesh.bvh.box_walk_kernels import BOX_WALK, LOCAL_BOX
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Relative to the sizes that meet in a separating axis: five roundings, on both sides of a comparison, and room.
GAP_ERROR = 3.0e-15

_OVERLAPS = (
    LOCAL_BOX
    + f"""
    typedef wp::vec_t<3, wp::float64> point;
    const point box_lower = lower.data[item], box_upper = upper.data[item];
    double corner_low[3], corner_high[3];
    float low[3], high[3];
    for (int k = 0; k < 3; ++k) {{ corner_low[k] = box_lower[k]; corner_high[k] = box_upper[k]; }}
    local_box(tree, corner_low, corner_high, low, high);
    auto meets = [&](int slot) {{
        const point a = tree.corners.data[3 * slot], b = tree.corners.data[3 * slot + 1],
                    c = tree.corners.data[3 * slot + 2];
        for (int k = 0; k < 3; ++k)
            if (wp::max(wp::max(a[k], b[k]), c[k]) < box_lower[k]
                || wp::min(wp::min(a[k], b[k]), c[k]) > box_upper[k]) return false;
        // Seen from a corner of the triangle: differences are right to their last bit.
        const point ab = b - a, ac = c - a, lo = box_lower - a, hi = box_upper - a;
        const double x = wp::max(wp::abs(lo[0]), wp::abs(hi[0])), y = wp::max(wp::abs(lo[1]), wp::abs(hi[1])),
                     z = wp::max(wp::abs(lo[2]), wp::abs(hi[2]));
        const double size = wp::max(wp::max(x, y), z);
        auto apart = [&](const point& n) {{
            double box_most = 0.0, box_least = 0.0;
            for (int k = 0; k < 3; ++k) {{
                box_most += n[k] * (n[k] > 0.0 ? hi[k] : lo[k]);
                box_least += n[k] * (n[k] > 0.0 ? lo[k] : hi[k]);
            }}
            const double bn = wp::dot(n, ab), cn = wp::dot(n, ac);
            const double gap = {GAP_ERROR} * (wp::abs(n[0]) + wp::abs(n[1]) + wp::abs(n[2])) * size;
            return wp::min(wp::min(bn, cn), 0.0) > box_most + gap || wp::max(wp::max(bn, cn), 0.0) < box_least - gap;
        }};
        if (apart(wp::cross(ab, ac))) return false;
        const point edge[3] = {{ab, ac, c - b}};
        for (int k = 0; k < 3; ++k)
            if (apart(point(0.0, -edge[k][2], edge[k][1])) || apart(point(edge[k][2], 0.0, -edge[k][0]))
                || apart(point(-edge[k][1], edge[k][0], 0.0))) return false;
        return true;
    }};
"""
    + BOX_WALK
)
_VISIT = """
    #if defined(__CUDA_ARCH__)
    if (meets(first)) { ON_TRIANGLE }
    #else
    const v8* box = (const v8*)(slot_boxes.data + 6 * first);
    const auto near = (box[0] <= high[0]) & (box[1] <= high[1]) & (box[2] <= high[2])
                      & (box[3] >= low[0]) & (box[4] >= low[1]) & (box[5] >= low[2]);
    unsigned lanes = (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(near, b8));
    const int leaf = first;
    for (; lanes; lanes &= lanes - 1) {
        const int first = leaf + __builtin_ctz(lanes);
        if (meets(first)) { ON_TRIANGLE }
    }
    #endif
"""
_TEXT = _OVERLAPS.replace("VISIT", _VISIT)
_COUNT = "wp::int64 count = 0;" + _TEXT.replace("ON_TRIANGLE", "++count;") + "out_count.data[item] = count;"
# A key sorts by box, then by triangle.
_FILL = "wp::int64 at = offsets.data[item];" + _TEXT.replace(
    "ON_TRIANGLE", "out_key.data[at++] = (wp::int64)item << 32 | tree.slot_triangle.data[first];"
)


@wp.func_native(_COUNT)
def count_overlaps(
    item: int,
    lower: wp.array(dtype=wp.vec3d),
    upper: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    out_count: wp.array(dtype=wp.int64),
): ...


@wp.func_native(_FILL)
def list_overlaps(
    item: int,
    lower: wp.array(dtype=wp.vec3d),
    upper: wp.array(dtype=wp.vec3d),
    offsets: wp.array(dtype=wp.int64),
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    out_key: wp.array(dtype=wp.int64),
): ...


@wp.kernel
def count_overlaps_kernel(
    first: int,
    lower: wp.array(dtype=wp.vec3d),
    upper: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    out_count: wp.array(dtype=wp.int64),
):
    count_overlaps(first + wp.tid(), lower, upper, tree, slot_boxes, out_count)


@wp.kernel
def list_overlaps_kernel(
    first: int,
    lower: wp.array(dtype=wp.vec3d),
    upper: wp.array(dtype=wp.vec3d),
    offsets: wp.array(dtype=wp.int64),
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    out_key: wp.array(dtype=wp.int64),
):
    list_overlaps(first + wp.tid(), lower, upper, offsets, tree, slot_boxes, out_key)


@wp.kernel
def first_inverted_kernel(
    first: int, lower: wp.array(dtype=wp.vec3d), upper: wp.array(dtype=wp.vec3d), out_row: wp.array(dtype=int)
):
    i = first + wp.tid()
    for k in range(3):
        if lower[i][k] > upper[i][k]:
            lower_to(out_row, 0, i)


@wp.kernel
def triangle_of_key_kernel(first: int, key: wp.array(dtype=wp.int64), out_triangle_id: wp.array(dtype=int)):
    i = first + wp.tid()
    out_triangle_id[i] = wp.int32(key[i] & wp.int64(0xFFFFFFFF))
