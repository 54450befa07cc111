"""A tree of boxes over points sorted along a space-filling curve: its arrays, and the kernels that fill them.

Consecutive points on the curve are close in space. Leaves are therefore runs of the sorted points, and the tree above
them needs no pointers: the children of node n are the nodes 8 n to 8 n + 7 of the level below.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core.morton_order_kernels import spread_bits

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Points of a leaf, and queries of a block: two vectors of eight float64.
LEAF = wp.constant(16)
# Children of a node: one vector of eight float64 for each side of their boxes.
WIDTH = wp.constant(8)
# Index of an absent point: larger than every other, so that it loses every tie.
NONE = wp.constant(2**31 - 1)
# Cells on an axis of the curve: three axes fill a 30-bit key.
CURVE_CELLS = wp.constant(wp.float64(1024.0))
# The inverse edge of a cell stays finite even if the points nearly coincide: zero times it must remain zero.
MAX_INVERSE = wp.constant(wp.float64(1.0e300))
# Points of a run whose bounding box makes the frame of the run. Other points are clamped to it; if they crowd there,
# they get a frame of their own in the next round.
FRAME_SAMPLE = wp.constant(256)


@wp.struct
class NearestTree:
    """Points sorted along a curve, 16 to a leaf, and boxes over them, 8 to a node.

    The coordinates of leaf b begin at ``48 b``: 16 of x, then of y, then of z; the rest of the last leaf is NaN.
    ``index`` holds the indices of the caller's points. The sides of the boxes of node n's children begin at ``48 n``: 8
    lower x, y, z, then 8 upper x, y, z; ``least`` holds the lowest index below each child. Level 1 is directly above
    the leaves, ``level_first[l]`` is the first node of level l, and ``top`` is the level with a single node. ``frame``
    is that of the curve.

    Of points in groups each begins with a leaf; then the rest of any leaf may be NaN, with the index NONE.
    """

    positions: wp.array(dtype=wp.float64)
    index: wp.array(dtype=wp.int32)
    boxes: wp.array(dtype=wp.float64)
    least: wp.array(dtype=wp.int32)
    level_first: wp.array(dtype=wp.int32)
    top: wp.int32
    count: wp.int32
    frame: wp.vec4d


@wp.struct
class NearestQueries:
    """Queries in blocks of 16, laid out like the points of the tree, with their options and result rows (Q, k).

    ``index`` is the row of each query. ``limit_squared`` holds one squared radius for all queries or one for each row.
    If ``seeded``, block b of the queries is leaf b of the tree. If ``excluded``, a query does not find the point with
    its own index. ``leaves`` holds the first leaf and the end of those that a block searches, or nothing for all. The
    rest of any block may have the index NONE. On a GPU a team answers ``run`` queries of a block; ``stretch`` times the
    squared distance of the farthest point of one query is probably enough for the next.
    """

    positions: wp.array(dtype=wp.float64)
    index: wp.array(dtype=wp.int32)
    limit_squared: wp.array(dtype=wp.float64)
    leaves: wp.array(dtype=wp.vec2i)
    count: wp.int32
    k: wp.int32
    seeded: wp.int32
    excluded: wp.int32
    run: wp.int32
    stretch: wp.float64
    distance: wp.array2d(dtype=wp.float64)
    indices: wp.array2d(dtype=wp.int32)


@wp.func
def curve_cell(x: wp.float64, center: wp.float64, inverse: wp.float64) -> wp.uint32:
    # Clamped as a float: casting a very large coordinate to int would be undefined.
    u = (x - center) * inverse + wp.float64(0.5)
    return wp.uint32(wp.clamp(u * CURVE_CELLS, wp.float64(0.0), CURVE_CELLS - wp.float64(1.0)))


@wp.func
def bit_mask(x: wp.uint32, bit: wp.uint32) -> wp.uint32:
    """All ones if the bit is set, else zero."""
    return wp.uint32(0) - ((x >> bit) & wp.uint32(1))


@wp.func
def hilbert_key(a: wp.uint32, b: wp.uint32, c: wp.uint32) -> wp.int32:
    """Position along the Hilbert curve of a cell with 10-bit coordinates (Skilling 2004, without branches)."""
    x = a
    y = b
    z = c
    bit = wp.uint32(9)
    while bit > wp.uint32(0):
        low = (wp.uint32(1) << bit) - wp.uint32(1)
        x = x ^ (low & bit_mask(x, bit))
        turned = bit_mask(y, bit)
        swap = (x ^ y) & low & ~turned
        x = x ^ swap ^ (low & turned)
        y = y ^ swap
        turned = bit_mask(z, bit)
        swap = (x ^ z) & low & ~turned
        x = x ^ swap ^ (low & turned)
        z = z ^ swap
        bit = bit - wp.uint32(1)
    y = y ^ x
    z = z ^ y
    flip = wp.uint32(0)
    bit = wp.uint32(9)
    while bit > wp.uint32(0):
        flip = flip ^ (((wp.uint32(1) << bit) - wp.uint32(1)) & bit_mask(z, bit))
        bit = bit - wp.uint32(1)
    x = x ^ flip
    y = y ^ flip
    z = z ^ flip
    return wp.int32((spread_bits(x) << wp.uint32(2)) | (spread_bits(y) << wp.uint32(1)) | spread_bits(z))


@wp.func
def key_in(frame: wp.vec4d, p: wp.vec3d) -> wp.int32:
    """Position of p along the curve through the cube that the frame (center, inverse edge) describes."""
    return hilbert_key(
        curve_cell(p[0], frame[0], frame[3]), curve_cell(p[1], frame[1], frame[3]), curve_cell(p[2], frame[2], frame[3])
    )


@wp.func
def frame_around(lower: wp.vec3d, upper: wp.vec3d) -> wp.vec4d:
    # Halved first: the whole extent may overflow.
    half = wp.float64(0.5)
    center = half * lower + half * upper
    reach = half * upper - half * lower
    extent = wp.max(wp.max(reach[0], reach[1]), reach[2])
    inverse = MAX_INVERSE
    if extent * MAX_INVERSE > half:
        inverse = half / extent
    return wp.vec4d(center[0], center[1], center[2], inverse)


@wp.kernel
def sample_kernel(
    first: int, points: wp.array(dtype=wp.vec3d), sample_count: wp.int32, out_sample: wp.array(dtype=wp.vec3d)
):
    """A sample of the points, evenly spaced in their order."""
    i = first + wp.tid()
    out_sample[i] = points[wp.int32(wp.int64(i) * wp.int64(points.shape[0]) // wp.int64(sample_count))]


@wp.kernel
def key_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    frame: wp.vec4d,
    out_key: wp.array(dtype=wp.int32),
    out_index: wp.array(dtype=wp.int32),
):
    """Position of each point along the curve."""
    i = first + wp.tid()
    out_key[i] = key_in(frame, points[i])
    out_index[i] = i


@wp.kernel
def head_kernel(first: int, key: wp.array(dtype=wp.int32), out_head: wp.array(dtype=wp.int32)):
    """1 at the beginning of each run of equal keys, else 0."""
    i = first + wp.tid()
    head = wp.int32(1)
    if i > 0 and key[i] == key[i - 1]:
        head = wp.int32(0)
    out_head[i] = head


@wp.kernel
def run_start_kernel(
    first: int, head: wp.array(dtype=wp.int32), run: wp.array(dtype=wp.int32), out_start: wp.array(dtype=wp.int32)
):
    """First sorted point of each run; runs are numbered from 1. The last entry is the number of points."""
    i = first + wp.tid()
    if head[i] == 1:
        out_start[run[i] - 1] = i
    if i == head.shape[0] - 1:
        out_start[run[i]] = i + 1


@wp.kernel
def crowded_kernel(
    first: int, run: wp.array(dtype=wp.int32), start: wp.array(dtype=wp.int32), out_crowded: wp.array(dtype=wp.int32)
):
    """1 for points of runs longer than a leaf, else 0."""
    i = first + wp.tid()
    r = run[i]
    crowded = wp.int32(0)
    if start[r] - start[r - 1] > LEAF:
        crowded = wp.int32(1)
    out_crowded[i] = crowded


@wp.kernel
def frame_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    start: wp.array(dtype=wp.int32),
    out_frame: wp.array(dtype=wp.vec4d),
):
    """Frame of each run longer than a leaf."""
    r = first + wp.tid()
    begin = start[r]
    count = start[r + 1] - begin
    if count <= LEAF:
        return
    lower = points[order[begin]]
    upper = lower
    taken = wp.min(count, FRAME_SAMPLE)
    for s in range(1, taken):
        p = points[order[begin + wp.int32(wp.int64(s) * wp.int64(count) // wp.int64(taken))]]
        lower = wp.min(lower, p)
        upper = wp.max(upper, p)
    out_frame[r] = frame_around(lower, upper)


@wp.kernel
def member_key_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    member: wp.array(dtype=wp.int32),
    run: wp.array(dtype=wp.int32),
    frame: wp.array(dtype=wp.vec4d),
    out_key: wp.array(dtype=wp.int32),
    out_sorted_key: wp.array(dtype=wp.int32),
    out_slot: wp.array(dtype=wp.int32),
):
    """Key of each member in the frame of its run, in two copies; one is for sorting."""
    i = first + wp.tid()
    at = member[i]
    key = key_in(frame[run[at] - 1], points[order[at]])
    out_key[i] = key
    out_sorted_key[i] = key
    out_slot[i] = i


@wp.kernel
def member_run_kernel(
    first: int,
    slot: wp.array(dtype=wp.int32),
    member: wp.array(dtype=wp.int32),
    run: wp.array(dtype=wp.int32),
    out_run: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    out_run[i] = run[member[slot[i]]]


@wp.kernel
def member_order_kernel(
    first: int,
    slot: wp.array(dtype=wp.int32),
    member: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    key: wp.array(dtype=wp.int32),
    out_order: wp.array(dtype=wp.int32),
    out_head: wp.array(dtype=wp.int32),
):
    """The points of the members in their new order, and the beginnings of runs of equal keys.

    Existing beginnings of runs stay: members and runs keep their positions, and only the points at these positions
    change.
    """
    i = first + wp.tid()
    out_order[i] = order[member[slot[i]]]
    if i > 0 and key[slot[i]] != key[slot[i - 1]]:
        out_head[member[i]] = 1


@wp.kernel
def put_back_kernel(
    first: int,
    values: wp.array(dtype=wp.int32),
    member: wp.array(dtype=wp.int32),
    out_order: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    out_order[member[i]] = values[i]


@wp.kernel
def block_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    span: wp.array(dtype=wp.vec2i),
    out_positions: wp.array(dtype=wp.float64),
    out_index: wp.array(dtype=wp.int32),
):
    """Blocks of points in the given order, one axis after the other; ``span`` has begin and end of those in groups.

    The rest of a block is NaN: every comparison with it is false, so it is never found.
    """
    i = first + wp.tid()
    block = i // LEAF
    at = i
    end = points.shape[0]
    if span.shape[0] > 0:
        at = span[block][0] + i % LEAF
        end = span[block][1]
    index = NONE
    p = wp.vec3d(wp.float64(wp.nan), wp.float64(wp.nan), wp.float64(wp.nan))
    if at < end:
        index = order[at]
        p = points[index]
    out_index[i] = index
    for axis in range(3):
        out_positions[(block * 3 + axis) * LEAF + i % LEAF] = p[axis]


@wp.func
def put_box(
    boxes: wp.array(dtype=wp.float64),
    least: wp.array(dtype=wp.int32),
    child: wp.int32,
    lower: wp.vec3d,
    upper: wp.vec3d,
    lowest: wp.int32,
):
    at = child // WIDTH * 6 * WIDTH + child % WIDTH
    for axis in range(3):
        boxes[at + axis * WIDTH] = lower[axis]
        boxes[at + (3 + axis) * WIDTH] = upper[axis]
    least[child] = lowest


@wp.func
def nowhere() -> wp.vec3d:
    return wp.vec3d(wp.float64(wp.inf), wp.float64(wp.inf), wp.float64(wp.inf))


@wp.kernel
def leaf_box_kernel(
    first: int,
    positions: wp.array(dtype=wp.float64),
    index: wp.array(dtype=wp.int32),
    count: wp.int32,
    out_boxes: wp.array(dtype=wp.float64),
    out_least: wp.array(dtype=wp.int32),
):
    """Boxes of the leaves, as children of level 1; the box of an absent child is empty and infinitely far away."""
    leaf = first + wp.tid()
    lower = nowhere()
    upper = -nowhere()
    lowest = NONE
    for j in range(wp.min(LEAF, count - leaf * LEAF)):
        if index[leaf * LEAF + j] != NONE:
            at = leaf * 3 * LEAF + j
            p = wp.vec3d(positions[at], positions[at + LEAF], positions[at + 2 * LEAF])
            lower = wp.min(lower, p)
            upper = wp.max(upper, p)
            lowest = wp.min(lowest, index[leaf * LEAF + j])
    put_box(out_boxes, out_least, leaf, lower, upper, lowest)


@wp.kernel
def node_box_kernel(
    first: int,
    first_node: wp.int32,
    node_count: wp.int32,
    parents_first: wp.int32,
    out_boxes: wp.array(dtype=wp.float64),
    out_least: wp.array(dtype=wp.int32),
):
    """Boxes of the nodes of a level, as children of the level above."""
    n = first + wp.tid()
    lower = nowhere()
    upper = -nowhere()
    lowest = NONE
    if n < node_count:
        node = first_node + n
        for lane in range(WIDTH):
            at = node * 6 * WIDTH + lane
            for axis in range(3):
                lower[axis] = wp.min(lower[axis], out_boxes[at + axis * WIDTH])
                upper[axis] = wp.max(upper[axis], out_boxes[at + (3 + axis) * WIDTH])
            lowest = wp.min(lowest, out_least[node * WIDTH + lane])
    put_box(out_boxes, out_least, parents_first * WIDTH + n, lower, upper, lowest)
