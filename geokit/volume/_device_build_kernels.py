"""Nodes of a NanoVDB grid written where the grid is: tables, masks, boxes and extrema.

Children of a node follow each other in the order of their keys. Each word of a mask, each row of a table and each
node's statistics have one writer: no atomics, and the same bytes on every device.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


@wp.kernel
def starts_kernel(
    first: int,
    keys: wp.array(dtype=wp.int64),
    lower_shift: int,
    upper_shift: int,
    out_lower: wp.array(dtype=int),
    out_upper: wp.array(dtype=int),
):
    """1 where a new lower node begins, and where a new upper node does: where the key changes before its last bits."""
    i = first + wp.tid()
    changed = wp.int64(-1)
    if i > 0:
        changed = keys[i] ^ keys[i - 1]
    out_lower[i] = wp.where((changed >> wp.int64(lower_shift)) != wp.int64(0), 1, 0)
    out_upper[i] = wp.where((changed >> wp.int64(upper_shift)) != wp.int64(0), 1, 0)


@wp.kernel
def nodes_kernel(
    first: int,
    keys: wp.array(dtype=wp.int64),
    lower_shift: int,
    upper_shift: int,
    lower_starts: wp.array(dtype=int),
    lower_ends: wp.array(dtype=int),
    upper_starts: wp.array(dtype=int),
    upper_ends: wp.array(dtype=int),
    out_lower_key: wp.array(dtype=wp.int64),
    out_lower_first: wp.array(dtype=int),
    out_lower_end: wp.array(dtype=int),
    out_upper_key: wp.array(dtype=wp.int64),
    out_upper_first: wp.array(dtype=int),
    out_upper_leaf: wp.array(dtype=int),
    out_few: wp.array(dtype=wp.int64),
    out_count: wp.array(dtype=int),
):
    """Key and first child of each node (one more entry ends the last), and for uppers their first leaf.

    ``out_lower_end`` is for each lower node the upper nodes up to its own; ``out_few`` takes keys of upper nodes as far
    as there is room; ``out_count`` the numbers of lower and of upper nodes.
    """
    i = first + wp.tid()
    lower = lower_ends[i]
    upper = upper_ends[i]
    if lower_starts[i] != 0:
        out_lower_key[lower - 1] = keys[i] >> wp.int64(lower_shift)
        out_lower_first[lower - 1] = i
        out_lower_end[lower - 1] = upper
    if upper_starts[i] != 0:
        key = keys[i] >> wp.int64(upper_shift)
        out_upper_key[upper - 1] = key
        out_upper_first[upper - 1] = lower - 1
        out_upper_leaf[upper - 1] = i
        if upper <= out_few.shape[0]:
            out_few[upper - 1] = key
    if i == keys.shape[0] - 1:
        out_lower_first[lower] = i + 1
        out_upper_first[upper] = lower
        out_count[0] = lower
        out_count[1] = upper


_LINK = """
    const int words = 1 << (bits - 6);
    const int node = item / words, word = item % words;
    const long long key = parent_keys.data[node] << bits | (long long)word << 6;
    int low = first_child.data[node], high = first_child.data[node + 1];
    const int end = high;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (child_keys.data[middle] < key) low = middle + 1; else high = middle;
    }
    const long long at = begin + node * size;
    unsigned char* out = out_buffer.data + at;
    unsigned long long mask = 0;
    for (int slot = 0; slot < 64; ++slot) {
        unsigned long long value = 0;
        if (low < end && child_keys.data[low] == key + slot) {
            mask |= 1ull << slot;
            value = (unsigned long long)(child_begin + low * child_size - at);
            ++low;
        } else {
            value = state.data && state.data[((long long)item << 6) + slot] == 2 ? inside : outside;
        }
        *(unsigned long long*)(out + table + 8ll * (64 * word + slot)) = value;
    }
    *(unsigned long long*)(out + 32 + 8ll * words + 8ll * word) = mask;
"""


@wp.func_native(_LINK)
def link_word(
    item: int,
    bits: int,
    parent_keys: wp.array(dtype=wp.int64),
    first_child: wp.array(dtype=int),
    child_keys: wp.array(dtype=wp.int64),
    begin: wp.int64,
    size: wp.int64,
    table: wp.int64,
    child_begin: wp.int64,
    child_size: wp.int64,
    state: wp.array(dtype=wp.uint8),
    outside: wp.uint64,
    inside: wp.uint64,
    out_buffer: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def link_kernel(
    first: int,
    bits: int,
    parent_keys: wp.array(dtype=wp.int64),
    first_child: wp.array(dtype=int),
    child_keys: wp.array(dtype=wp.int64),
    begin: wp.int64,
    size: wp.int64,
    table: wp.int64,
    child_begin: wp.int64,
    child_size: wp.int64,
    state: wp.array(dtype=wp.uint8),
    outside: wp.uint64,
    inside: wp.uint64,
    out_buffer: wp.array(dtype=wp.uint8),
):
    """64 slots of a node: offsets of the children, tiles in between, and a word of the child mask."""
    link_word(
        first + wp.tid(),
        bits,
        parent_keys,
        first_child,
        child_keys,
        begin,
        size,
        table,
        child_begin,
        child_size,
        state,
        outside,
        inside,
        out_buffer,
    )


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


def _of_type(text: str, name: str) -> str:
    return f"typedef {name} T;\n{text}"


@wp.func_native(_of_type(_LEAF, "float"))
def float_leaf(
    leaf: int,
    begin: wp.int64,
    tiles: wp.array(dtype=wp.vec3i),
    rows: wp.array(dtype=int),
    out_buffer: wp.array(dtype=wp.uint8),
    out_boxes: wp.array(dtype=int),
    out_extrema: wp.array(dtype=int),
    out_count: wp.array(dtype=int),
): ...


@wp.func_native(_of_type(_LEAF, "int"))
def int_leaf(
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
def float_leaf_kernel(
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
    float_leaf(first + wp.tid(), begin, tiles, rows, out_buffer, out_boxes, out_extrema, out_count)


@wp.kernel
def int_leaf_kernel(
    first: int,
    begin: wp.int64,
    tiles: wp.array(dtype=wp.vec3i),
    rows: wp.array(dtype=int),
    out_buffer: wp.array(dtype=wp.uint8),
    out_boxes: wp.array(dtype=int),
    out_extrema: wp.array(dtype=int),
    out_count: wp.array(dtype=int),
):
    """As :func:`float_leaf_kernel`, of integers."""
    int_leaf(first + wp.tid(), begin, tiles, rows, out_buffer, out_boxes, out_extrema, out_count)


@wp.func_native(_of_type(_NODE, "float"))
def float_node(
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


@wp.func_native(_of_type(_NODE, "int"))
def int_node(
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
def float_node_kernel(
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
    float_node(
        first + wp.tid(), parts, span, begin, size, statistics, first_child, first_leaf, boxes, extrema, tiles, rows,
        out_buffer, out_boxes, out_extrema,
    )  # fmt: skip


@wp.kernel
def int_node_kernel(
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
    """As :func:`float_node_kernel`, of integers."""
    int_node(
        first + wp.tid(), parts, span, begin, size, statistics, first_child, first_leaf, boxes, extrema, tiles, rows,
        out_buffer, out_boxes, out_extrema,
    )  # fmt: skip


@wp.func_native(_of_type(_PART, "float"))
def float_part(
    item: int,
    parts: int,
    first_child: wp.array(dtype=int),
    boxes: wp.array(dtype=int),
    extrema: wp.array(dtype=int),
    out_boxes: wp.array(dtype=int),
    out_extrema: wp.array(dtype=int),
): ...


@wp.func_native(_of_type(_PART, "int"))
def int_part(
    item: int,
    parts: int,
    first_child: wp.array(dtype=int),
    boxes: wp.array(dtype=int),
    extrema: wp.array(dtype=int),
    out_boxes: wp.array(dtype=int),
    out_extrema: wp.array(dtype=int),
): ...


@wp.kernel
def float_part_kernel(
    first: int,
    parts: int,
    first_child: wp.array(dtype=int),
    boxes: wp.array(dtype=int),
    extrema: wp.array(dtype=int),
    out_boxes: wp.array(dtype=int),
    out_extrema: wp.array(dtype=int),
):
    """Box and extrema of one of ``parts`` parts of a node's children, for threads that would wait for the last node."""
    float_part(first + wp.tid(), parts, first_child, boxes, extrema, out_boxes, out_extrema)


@wp.kernel
def int_part_kernel(
    first: int,
    parts: int,
    first_child: wp.array(dtype=int),
    boxes: wp.array(dtype=int),
    extrema: wp.array(dtype=int),
    out_boxes: wp.array(dtype=int),
    out_extrema: wp.array(dtype=int),
):
    """As :func:`float_part_kernel`, of integers."""
    int_part(first + wp.tid(), parts, first_child, boxes, extrema, out_boxes, out_extrema)


# A row of 64 values of 32 bits, whatever they are, and their mask.
_COPY = """
    unsigned char* out = out_buffer.data + begin + 2144ll * leaf;
    const unsigned* from = (const unsigned*)values.data + 512ll * order.data[leaf] + 64 * x;
    unsigned* to = (unsigned*)(out + 96) + 64 * x;
    for (int b = 0; b < 64; ++b) to[b] = from[b];
    ((unsigned long long*)(out + 16))[x] = masks.data[8ll * order.data[leaf] + x];
"""


@wp.func_native(_COPY)
def copy_plane(
    leaf: int,
    x: int,
    begin: wp.int64,
    order: wp.array(dtype=int),
    values: wp.array(dtype=int),
    masks: wp.array(dtype=wp.uint64),
    out_buffer: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def copy_leaves_kernel(
    first: int,
    begin: wp.int64,
    order: wp.array(dtype=int),
    values: wp.array(dtype=int),
    masks: wp.array(dtype=wp.uint64),
    out_buffer: wp.array(dtype=wp.uint8),
):
    """A plane of a leaf's values (as bits) and of its mask, from rows in another order."""
    i = first + wp.tid()
    copy_plane(i >> 3, i & 7, begin, order, values, masks, out_buffer)
