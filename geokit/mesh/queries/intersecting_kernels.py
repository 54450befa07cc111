"""Pairs of triangles that meet: their number for each leaf, then the pairs."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.box_walk_kernels import BOX_WALK, LOCAL_BOX
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.queries.triangle_pair_kernels import TRIANGLE_PAIR

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# An item is a leaf of eight slots on a CPU, a slot on CUDA. Pairs of a surface with itself are visited once: from the
# lower slot.
_PAIRS = (
    TRIANGLE_PAIR
    + LOCAL_BOX
    + """
    #if defined(__CUDA_ARCH__)
    const int width = 1;
    #else
    const int width = 8;
    #endif
    float lows[width][3], highs[width][3], low[3], high[3];
    for (int k = 0; k < 3; ++k) { low[k] = INFINITY; high[k] = -INFINITY; }
    for (int lane = 0; lane < width; ++lane) {
        const int slot = width * item + lane;
        if (asking.slot_triangle.data[slot] < 0) {
            for (int k = 0; k < 3; ++k) { lows[lane][k] = INFINITY; highs[lane][k] = -INFINITY; }
            continue;
        }
        double lower[3], upper[3];
        const point* p = asking.corners.data + 3 * slot;
        for (int k = 0; k < 3; ++k) {
            lower[k] = wp::min(wp::min(p[0][k], p[1][k]), p[2][k]);
            upper[k] = wp::max(wp::max(p[0][k], p[1][k]), p[2][k]);
        }
        local_box(tree, lower, upper, lows[lane], highs[lane]);
        for (int k = 0; k < 3; ++k) {
            low[k] = wp::min(low[k], lows[lane][k]);
            high[k] = wp::max(high[k], highs[lane][k]);
        }
    }
    auto test = [&](int slot, int other) {
        point t[3], u[3];
        for (int k = 0; k < 3; ++k) {
            t[k] = asking.corners.data[3 * slot + k] * unit;
            u[k] = tree.corners.data[3 * other + k] * unit;
        }
        if (!(itself ? meet_beyond_shared(t, u) : triangles_meet(t, u))) return;
        ON_PAIR
    };
"""
    + BOX_WALK
)
_VISIT = """
    if (itself && first < width * item) continue;
    #if defined(__CUDA_ARCH__)
    if (!itself || first > item) test(item, first);
    #else
    const v8* box = (const v8*)(slot_boxes.data + 6 * first);
    for (int lane = 0; lane < 8; ++lane) {
        const auto meets = (box[0] <= highs[lane][0]) & (box[1] <= highs[lane][1]) & (box[2] <= highs[lane][2])
                           & (box[3] >= lows[lane][0]) & (box[4] >= lows[lane][1]) & (box[5] >= lows[lane][2]);
        unsigned mask = (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(meets, b8));
        if (itself && first == 8 * item) mask &= ~0u << (lane + 1);
        for (; mask; mask &= mask - 1) test(8 * item + lane, first + __builtin_ctz(mask));
    }
    #endif
"""
_TEXT = _PAIRS.replace("VISIT", _VISIT)
_COUNT = "wp::int64 count = 0;" + _TEXT.replace("ON_PAIR", "++count;") + "out_count.data[item] = count;"
_ANY = (
    "if (out_found.data[0]) return;"  # others have found one
    + _TEXT.replace("ON_PAIR", "out_found.data[0] = 1;")
)
_FILL = "wp::int64 at = offset;" + _TEXT.replace(
    "ON_PAIR",
    """
        const int one = asking.slot_triangle.data[slot], another = tree.slot_triangle.data[other];
        const bool turned = itself && one > another;
        out_pairs.data[2 * at] = turned ? another : one;
        out_pairs.data[2 * at++ + 1] = turned ? one : another;
""",
)


@wp.func_native(_COUNT)
def count_pairs(
    item: int,
    asking: SurfaceTree,
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    itself: bool,
    unit: wp.float64,
    out_count: wp.array(dtype=wp.int64),
): ...


@wp.func_native(_FILL)
def fill_pairs(
    item: int,
    offset: wp.int64,
    asking: SurfaceTree,
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    itself: bool,
    unit: wp.float64,
    out_pairs: wp.array(dtype=int),
): ...


@wp.func_native(_ANY)
def find_pair(
    item: int,
    asking: SurfaceTree,
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    itself: bool,
    unit: wp.float64,
    out_found: wp.array(dtype=int),
): ...


@wp.kernel
def count_pairs_kernel(
    first: int,
    asking: SurfaceTree,
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    itself: bool,
    unit: wp.float64,
    out_count: wp.array(dtype=wp.int64),
):
    count_pairs(first + wp.tid(), asking, tree, slot_boxes, itself, unit, out_count)


@wp.kernel
def fill_pairs_kernel(
    first: int,
    items: wp.array(dtype=int),
    offsets: wp.array(dtype=wp.int64),
    asking: SurfaceTree,
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    itself: bool,
    unit: wp.float64,
    out_pairs: wp.array(dtype=int),
):
    """For the items that have pairs, from their place in the list on."""
    i = first + wp.tid()
    fill_pairs(items[i], offsets[i], asking, tree, slot_boxes, itself, unit, out_pairs)


@wp.kernel
def find_pair_kernel(
    first: int,
    asking: SurfaceTree,
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    itself: bool,
    unit: wp.float64,
    out_found: wp.array(dtype=int),
):
    """Whether there is a pair; the others stop once one is found."""
    find_pair(first + wp.tid(), asking, tree, slot_boxes, itself, unit, out_found)
