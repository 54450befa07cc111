"""Box, flag and extrema of the nodes of a grid of floats or integers, written where the grid is.

Each node's statistics have one writer: no atomics, and the same bytes on every device.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


# A leaf from its mask and values: T is float or int. Boxes are first and last voxel; an empty one starts at the leaf.
_LEAF = """
    unsigned char* out = out_buffer.data + begin + 2144ll * leaf;
    const unsigned long long* mask = (const unsigned long long*)(out + 16);
    const T* values = (const T*)(out + 96);
    unsigned long long columns = 0;
    int first_x = 8, last_x = -1, count = 0;
    T least = 0, most = 0;
    for (int x = 0; x < 8; ++x) {
        if (!mask[x]) continue;
        columns |= mask[x];
        first_x = first_x < x ? first_x : x;
        last_x = x;
        for (int b = 0; b < 64; ++b) {
            if (!(mask[x] >> b & 1)) continue;
            const T value = values[64 * x + b];
            least = count == 0 || value < least ? value : least;
            most = count == 0 || value > most ? value : most;
            ++count;
        }
    }
    int first_y = 8, last_y = -1;
    unsigned line = 0;
    for (int y = 0; y < 8; ++y) {
        const unsigned bits = (unsigned)(columns >> (8 * y)) & 0xff;
        if (!bits) continue;
        line |= bits;
        first_y = first_y < y ? first_y : y;
        last_y = y;
    }
    int first_z = 8, last_z = -1;
    for (int z = 0; z < 8; ++z)
        if (line >> z & 1) {
            first_z = first_z < z ? first_z : z;
            last_z = z;
        }
    const wp::vec_t<3, int> tile = tiles.data[rows.data[leaf]];
    const int corner[3] = {8 * tile[0], 8 * tile[1], 8 * tile[2]};
    const int low[3] = {first_x, first_y, first_z}, high[3] = {last_x, last_y, last_z};
    int* box = out_boxes.data + 6ll * leaf;
    for (int k = 0; k < 3; ++k) {
        ((int*)out)[k] = count ? corner[k] + low[k] : corner[k];
        out[12 + k] = count ? (unsigned char)(high[k] - low[k]) : 0;
        box[k] = count ? corner[k] + low[k] : 2147483647;
        box[3 + k] = count ? corner[k] + high[k] : -2147483647 - 1;
    }
    out[15] = count ? 2 : 0;
    ((T*)(out + 80))[0] = ((T*)out_extrema.data)[2ll * leaf] = least;
    ((T*)(out + 80))[1] = ((T*)out_extrema.data)[2ll * leaf + 1] = most;
    out_count.data[leaf] = count;
"""

# Box and extrema of `child` to `end`.
_MERGE = """
    int box[6] = {2147483647, 2147483647, 2147483647, -2147483647 - 1, -2147483647 - 1, -2147483647 - 1};
    T least = 0, most = 0;
    bool some = false;
    for (; child < end; ++child) {
        const int* of = boxes.data + 6ll * child;
        if (of[0] > of[3]) continue;
        const T low = ((const T*)extrema.data)[2ll * child], high = ((const T*)extrema.data)[2ll * child + 1];
        least = !some || low < least ? low : least;
        most = !some || high > most ? high : most;
        some = true;
        for (int k = 0; k < 3; ++k) {
            box[k] = of[k] < box[k] ? of[k] : box[k];
            box[3 + k] = of[3 + k] > box[3 + k] ? of[3 + k] : box[3 + k];
        }
    }
"""

# A part of a node's children, which stand from first_child[node] on.
_PART = (
    """
    const int node = item / parts, part = item % parts;
    const int begin = first_child.data[node], count = first_child.data[node + 1] - begin;
    int child = begin + (int)((long long)count * part / parts);
    const int end = begin + (int)((long long)count * (part + 1) / parts);
"""
    + _MERGE
    + """
    for (int k = 0; k < 6; ++k) out_boxes.data[6ll * item + k] = box[k];
    ((T*)out_extrema.data)[2ll * item] = least;
    ((T*)out_extrema.data)[2ll * item + 1] = most;
"""
)

# A node's box and extrema from those of its children, or of as many parts of them as there are.
_NODE = (
    """
    int child = parts ? node * parts : first_child.data[node];
    const int end = parts ? child + parts : first_child.data[node + 1];
"""
    + _MERGE
    + """
    unsigned char* out = out_buffer.data + begin + node * size;
    const wp::vec_t<3, int> tile = tiles.data[rows.data[first_leaf.data[node]]];
    for (int k = 0; k < 6; ++k) {
        out_boxes.data[6ll * node + k] = box[k];
        // Readers take a node's origin from its box: an empty one starts there too, and ends before it.
        ((int*)out)[k] = some || k >= 3 ? box[k] : (8 * tile[k]) & ~(span - 1);
    }
    *(unsigned long long*)(out + 24) = some ? 2 : 0;
    ((T*)(out + statistics))[0] = ((T*)out_extrema.data)[2ll * node] = least;
    ((T*)(out + statistics))[1] = ((T*)out_extrema.data)[2ll * node + 1] = most;
"""
)


def _kernels_of(name: str) -> tuple[wp.Kernel, wp.Kernel, wp.Kernel]:
    """The kernels for leaves, parts and nodes whose values are of a type of C++."""

    def typed(text: str) -> str:
        return f"typedef {name} T;\n{text}"

    @wp.func_native(typed(_LEAF))
    def leaf(
        leaf: int,
        begin: wp.int64,
        tiles: wp.array(dtype=wp.vec3i),
        rows: wp.array(dtype=int),
        out_buffer: wp.array(dtype=wp.uint8),
        out_boxes: wp.array(dtype=int),
        out_extrema: wp.array(dtype=int),
        out_count: wp.array(dtype=int),
    ): ...

    @wp.kernel
    def leaf_kernel(
        first: int,
        begin: wp.int64,
        tiles: wp.array(dtype=wp.vec3i),
        rows: wp.array(dtype=int),
        out_buffer: wp.array(dtype=wp.uint8),
        out_boxes: wp.array(dtype=int),
        out_extrema: wp.array(dtype=int),
        out_count: wp.array(dtype=int),
    ):
        """Box, flag and extrema of a leaf whose values and mask are written, and how many of its voxels are active."""
        leaf(first + wp.tid(), begin, tiles, rows, out_buffer, out_boxes, out_extrema, out_count)

    @wp.func_native(typed(_PART))
    def part(
        item: int,
        parts: int,
        first_child: wp.array(dtype=int),
        boxes: wp.array(dtype=int),
        extrema: wp.array(dtype=int),
        out_boxes: wp.array(dtype=int),
        out_extrema: wp.array(dtype=int),
    ): ...

    @wp.kernel
    def part_kernel(
        first: int,
        parts: int,
        first_child: wp.array(dtype=int),
        boxes: wp.array(dtype=int),
        extrema: wp.array(dtype=int),
        out_boxes: wp.array(dtype=int),
        out_extrema: wp.array(dtype=int),
    ):
        """Box and extrema of a part of a node's children, for threads that would wait for the last node."""
        part(first + wp.tid(), parts, first_child, boxes, extrema, out_boxes, out_extrema)

    @wp.func_native(typed(_NODE))
    def node(
        node: int,
        parts: int,
        span: int,
        begin: wp.int64,
        size: wp.int64,
        statistics: wp.int64,
        first_child: wp.array(dtype=int),
        first_leaf: wp.array(dtype=int),
        boxes: wp.array(dtype=int),
        extrema: wp.array(dtype=int),
        tiles: wp.array(dtype=wp.vec3i),
        rows: wp.array(dtype=int),
        out_buffer: wp.array(dtype=wp.uint8),
        out_boxes: wp.array(dtype=int),
        out_extrema: wp.array(dtype=int),
    ): ...

    @wp.kernel
    def node_kernel(
        first: int,
        parts: int,
        span: int,
        begin: wp.int64,
        size: wp.int64,
        statistics: wp.int64,
        first_child: wp.array(dtype=int),
        first_leaf: wp.array(dtype=int),
        boxes: wp.array(dtype=int),
        extrema: wp.array(dtype=int),
        tiles: wp.array(dtype=wp.vec3i),
        rows: wp.array(dtype=int),
        out_buffer: wp.array(dtype=wp.uint8),
        out_boxes: wp.array(dtype=int),
        out_extrema: wp.array(dtype=int),
    ):
        """Box, flag and extrema of an internal node from those of its children."""
        node(
            first + wp.tid(), parts, span, begin, size, statistics, first_child, first_leaf, boxes, extrema, tiles,
            rows, out_buffer, out_boxes, out_extrema,
        )  # fmt: skip

    return leaf_kernel, part_kernel, node_kernel


float_leaf_kernel, float_part_kernel, float_node_kernel = _kernels_of("float")
int_leaf_kernel, int_part_kernel, int_node_kernel = _kernels_of("int")
