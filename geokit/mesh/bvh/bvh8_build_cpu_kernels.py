"""Building the wide tree of a surface on the CPU: binned surface area heuristic, eight children a node.

Warp's host builders run on one thread and read boxes through an index; here the boxes themselves are moved, and
subtrees are built by all threads. Numbers of nodes do not depend on the number of threads.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Children of a node and triangles of a leaf: lanes of one vector operation.
WIDTH = 8
# Bins an axis. More than 16 gain nothing on smooth meshes.
BINS = 16
# From this many levels of nodes on, ranges are halved by count: no input can make the tree deeper than a stack.
HALVING_DEPTH = 20
# Nodes in flight while a tree is walked: seven siblings a level, HALVING_DEPTH levels and those that halving adds
# for 2^31 triangles.
STACK = 256

# A reference is a box and the triangle in it: lower x y z, triangle, upper x y z, unused.
REFERENCE = 8


@wp.func
def rounded_down(x: wp.float64) -> wp.float32:
    """A float32 at most x, one unit in the last place or less below the nearest one."""
    f = wp.float32(x)
    return f - wp.float32(1.2e-7) * wp.abs(f) - wp.float32(1.0e-30)


@wp.kernel
def references_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    origin: wp.vec3d,
    scale: wp.float64,
    out_references: wp.array(dtype=wp.float32),
):
    """The local box of each triangle, rounded outwards."""
    i = first + wp.tid()
    a = vertices[faces[3 * i]] - origin
    b = vertices[faces[3 * i + 1]] - origin
    c = vertices[faces[3 * i + 2]] - origin
    lower = wp.min(wp.min(a, b), c) / scale
    upper = wp.max(wp.max(a, b), c) / scale
    for k in range(3):
        out_references[8 * i + k] = rounded_down(lower[k])
        out_references[8 * i + 4 + k] = -rounded_down(-upper[k])
    out_references[8 * i + 3] = wp.cast(i, wp.float32)
    out_references[8 * i + 7] = wp.float32(0.0)


# What the top of the tree and its subtrees share: a range of references is split in two, and a node is opened by
# splitting its largest range again until it has eight.
_BUILD = f"""
    typedef float v4 __attribute__((ext_vector_type(4), aligned(4)));
    struct Range {{ int begin, end; v4 lower, upper, low_centre, high_centre; }};
    v4* data = (v4*)references.data;
    const float HUGE_BOX = 3e38f;
    auto empty = [&](Range& r) {{
        r.lower = HUGE_BOX; r.upper = -HUGE_BOX; r.low_centre = HUGE_BOX; r.high_centre = -HUGE_BOX;
    }};
    auto add = [&](Range& r, int i) {{
        const v4 l = data[2 * i], u = data[2 * i + 1], c = l + u;
        r.lower = __builtin_elementwise_min(r.lower, l); r.upper = __builtin_elementwise_max(r.upper, u);
        r.low_centre = __builtin_elementwise_min(r.low_centre, c);
        r.high_centre = __builtin_elementwise_max(r.high_centre, c);
    }};
    auto area = [](const v4& l, const v4& u) {{
        const v4 e = u - l;
        return e.x * e.y + e.y * e.z + e.z * e.x;
    }};
    auto swap = [&](int i, int j) {{
        const v4 l = data[2 * i], u = data[2 * i + 1];
        data[2 * i] = data[2 * j]; data[2 * i + 1] = data[2 * j + 1];
        data[2 * j] = l; data[2 * j + 1] = u;
    }};
    // Splits a range in two, both not empty, by the cheapest plane between bins, blocks of a leaf being the cost.
    auto split = [&](const Range& range, bool halve, Range& left, Range& right) {{
        const int count = range.end - range.begin;
        const v4 extent = range.high_centre - range.low_centre;
        const int bins = count < 64 ? {BINS} / 2 : {BINS};
        int best_axis = -1, best_bin = 0;
        v4 factor;
        for (int k = 0; k < 3; ++k) factor[k] = extent[k] > 1e-30f ? bins * 0.9999f / extent[k] : 0.f;
        factor.w = 0.f;
        if (!halve && (factor.x > 0.f || factor.y > 0.f || factor.z > 0.f)) {{
            v4 low[3][{BINS}], high[3][{BINS}];
            int filled[3][{BINS}];
            for (int k = 0; k < 3; ++k)
                for (int b = 0; b < bins; ++b) {{ low[k][b] = HUGE_BOX; high[k][b] = -HUGE_BOX; filled[k][b] = 0; }}
            for (int i = range.begin; i < range.end; ++i) {{
                const v4 l = data[2 * i], u = data[2 * i + 1], at = (l + u - range.low_centre) * factor;
                for (int k = 0; k < 3; ++k) {{
                    const int b = (int)at[k];
                    low[k][b] = __builtin_elementwise_min(low[k][b], l);
                    high[k][b] = __builtin_elementwise_max(high[k][b], u);
                    ++filled[k][b];
                }}
            }}
            float best = HUGE_BOX;
            for (int k = 0; k < 3; ++k) {{
                if (factor[k] == 0.f) continue;
                float cost[{BINS}];
                v4 l = HUGE_BOX, u = -HUGE_BOX;
                int n = 0;
                for (int b = bins - 1; b > 0; --b) {{
                    l = __builtin_elementwise_min(l, low[k][b]); u = __builtin_elementwise_max(u, high[k][b]);
                    n += filled[k][b];
                    cost[b] = n ? area(l, u) * ((n + 7) >> 3) : HUGE_BOX;
                }}
                l = HUGE_BOX; u = -HUGE_BOX; n = 0;
                for (int b = 1; b < bins; ++b) {{
                    l = __builtin_elementwise_min(l, low[k][b - 1]); u = __builtin_elementwise_max(u, high[k][b - 1]);
                    n += filled[k][b - 1];
                    if (n == 0 || cost[b] == HUGE_BOX) continue;
                    const float whole = cost[b] + area(l, u) * ((n + 7) >> 3);
                    if (whole < best) {{ best = whole; best_axis = k; best_bin = b; }}
                }}
            }}
        }}
        empty(left); empty(right);
        int middle;
        if (best_axis >= 0) {{
            int i = range.begin, j = range.end;
            while (i < j) {{
                const v4 at = (data[2 * i] + data[2 * i + 1] - range.low_centre) * factor;
                if ((int)at[best_axis] < best_bin) {{ add(left, i); ++i; }}
                else {{ --j; swap(i, j); add(right, j); }}
            }}
            middle = i;
        }} else {{
            middle = range.begin + count / 2;
            for (int i = range.begin; i < middle; ++i) add(left, i);
            for (int i = middle; i < range.end; ++i) add(right, i);
        }}
        left.begin = range.begin; left.end = middle; right.begin = middle; right.end = range.end;
    }};
    // Children of one node; returns how many.
    auto open = [&](const Range& range, bool halve, Range* child) {{
        int count = 1;
        child[0] = range;
        while (count < {WIDTH}) {{
            int largest = -1;
            float most = -1.f;
            for (int c = 0; c < count; ++c) {{
                if (child[c].end - child[c].begin <= {WIDTH}) continue;
                const float a = area(child[c].lower, child[c].upper);
                if (a > most || largest < 0) {{ most = a; largest = c; }}
            }}
            if (largest < 0) break;
            const Range whole = child[largest];
            split(whole, halve, child[largest], child[count]);
            ++count;
        }}
        return count;
    }};
    auto write = [&](int node, const Range* child, int count) {{
        for (int c = 0; c < {WIDTH}; ++c)
            for (int k = 0; k < 3; ++k) {{
                boxes.data[node * 48 + k * 8 + c] = c < count ? child[c].lower[k] : 3e38f;
                boxes.data[node * 48 + 24 + k * 8 + c] = c < count ? child[c].upper[k] : -3e38f;
            }}
    }};
"""

# The number of a child that there is not; its box is empty. The root is nobody's child.
NO_CHILD = 0

# The top of the tree: nodes are opened in the order of their numbers until their children hold at most `limit`
# references; those are left to subtree_kernel, child number -1 - subtree.
_TOP = (
    _BUILD
    + f"""
    Range root;
    empty(root);
    for (int i = 0; i < count; ++i) add(root, i);
    root.begin = 0; root.end = count;
    Range* waiting = (Range*)scratch.data;
    int* depth = (int*)(waiting + capacity);
    int nodes = 1, subtrees = 0;
    waiting[0] = root;
    depth[0] = 0;
    for (int node = 0; node < nodes; ++node) {{
        Range child[{WIDTH}];
        const int found = open(waiting[node], depth[node] >= {HALVING_DEPTH}, child);
        write(node, child, found);
        for (int c = 0; c < {WIDTH}; ++c) {{
            int number = {NO_CHILD};
            if (c < found && child[c].end - child[c].begin > limit && nodes < capacity) {{
                waiting[nodes] = child[c];
                depth[nodes] = depth[node] + 1;
                number = nodes++;
            }} else if (c < found) {{
                out_subtree.data[3 * subtrees] = child[c].begin;
                out_subtree.data[3 * subtrees + 1] = child[c].end;
                out_subtree.data[3 * subtrees + 2] = depth[node] + 1;
                number = -1 - subtrees++;
            }}
            children.data[node * {WIDTH} + c] = number;
        }}
    }}
    out_size.data[0] = nodes;
    out_size.data[1] = subtrees;
"""
)

# One subtree. Its nodes get the numbers from node_base on, parents before their children; its leaves are written from
# place `begin` on, which has room for one leaf a reference.
_SUBTREE = (
    _BUILD
    + f"""
    Range root;
    empty(root);
    for (int i = begin; i < end; ++i) add(root, i);
    root.begin = begin; root.end = end;
    int nodes = 0, leaves = 0;
    auto leaf = [&](const Range& r) {{
        leaf_begin.data[begin + leaves] = r.begin;
        leaf_end.data[begin + leaves] = r.end;
        return -1 - leaves++;
    }};
    if (end - begin <= {WIDTH}) leaf(root);
    else {{
        Range waiting[{STACK}];
        int number[{STACK}], depth[{STACK}], height = 1;
        waiting[0] = root; number[0] = nodes++; depth[0] = start_depth;
        while (height > 0) {{
            --height;
            const int node = number[height], level = depth[height];
            const Range range = waiting[height];
            Range child[{WIDTH}];
            const int found = open(range, level >= {HALVING_DEPTH}, child);
            write(node_base + node, child, found);
            for (int c = 0; c < {WIDTH}; ++c) {{
                int value = {NO_CHILD};
                if (c < found && child[c].end - child[c].begin <= {WIDTH}) value = leaf(child[c]);
                else if (c < found) {{
                    waiting[height] = child[c]; depth[height] = level + 1;
                    number[height++] = value = nodes++;
                }}
                children.data[(node_base + node) * {WIDTH} + c] = value;
            }}
        }}
    }}
    out_size.data[2 * subtree] = nodes;
    out_size.data[2 * subtree + 1] = leaves;
"""
)


def _host_only(text: str) -> str:
    """The text for the CPU: CUDA's compiler, which sees the file too, has no vector types."""
    return f"#if !defined(__CUDA_ARCH__)\n{text}\n#endif\n;"


@wp.func_native(_host_only(_TOP))
def build_top(
    references: wp.array(dtype=wp.float32),
    count: int,
    limit: int,
    capacity: int,
    scratch: wp.array(dtype=int),
    boxes: wp.array(dtype=wp.float32),
    children: wp.array(dtype=int),
    out_subtree: wp.array(dtype=int),
    out_size: wp.array(dtype=int),
): ...


@wp.func_native(_host_only(_SUBTREE))
def build_subtree(
    references: wp.array(dtype=wp.float32),
    subtree: int,
    begin: int,
    end: int,
    start_depth: int,
    node_base: int,
    boxes: wp.array(dtype=wp.float32),
    children: wp.array(dtype=int),
    leaf_begin: wp.array(dtype=int),
    leaf_end: wp.array(dtype=int),
    out_size: wp.array(dtype=int),
): ...


@wp.kernel
def top_kernel(
    first: int,
    references: wp.array(dtype=wp.float32),
    count: int,
    limit: int,
    capacity: int,
    scratch: wp.array(dtype=int),
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
    out_subtree: wp.array(dtype=int),
    out_size: wp.array(dtype=int),
):
    """Run for one item: the top of the tree is one thread's work."""
    build_top(references, count, limit, capacity, scratch, out_boxes, out_children, out_subtree, out_size)


@wp.kernel
def subtree_kernel(
    first: int,
    references: wp.array(dtype=wp.float32),
    subtree: wp.array(dtype=int),
    node_base: wp.array(dtype=int),
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
    out_leaf_begin: wp.array(dtype=int),
    out_leaf_end: wp.array(dtype=int),
    out_size: wp.array(dtype=int),
):
    i = first + wp.tid()
    build_subtree(
        references,
        i,
        subtree[3 * i],
        subtree[3 * i + 1],
        subtree[3 * i + 2],
        node_base[i],
        out_boxes,
        out_children,
        out_leaf_begin,
        out_leaf_end,
        out_size,
    )


@wp.kernel
def join_kernel(
    first: int,
    references: wp.array(dtype=wp.float32),
    subtree: wp.array(dtype=int),
    node_base: wp.array(dtype=int),
    size: wp.array(dtype=int),
    node_offset: wp.array(dtype=int),
    leaf_offset: wp.array(dtype=int),
    boxes: wp.array(dtype=wp.float32),
    children: wp.array(dtype=int),
    leaf_begin: wp.array(dtype=int),
    leaf_end: wp.array(dtype=int),
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
    out_slot_triangle: wp.array(dtype=int),
):
    """Moves the nodes and leaves of one subtree to their final places."""
    i = first + wp.tid()
    for n in range(size[2 * i]):
        source = node_base[i] + n
        target = node_offset[i] + n
        for k in range(48):
            out_boxes[48 * target + k] = boxes[48 * source + k]
        for c in range(8):
            number = children[8 * source + c]
            if number > 0:
                number += node_offset[i]
            elif number < 0:
                number -= leaf_offset[i]
            out_children[8 * target + c] = number
    for n in range(size[2 * i + 1]):
        place = subtree[3 * i] + n
        slot = 8 * (leaf_offset[i] + n)
        begin = leaf_begin[place]
        filled = leaf_end[place] - begin
        for c in range(8):
            triangle = int(-1)
            if c < filled:
                triangle = wp.cast(references[8 * (begin + c) + 3], int)
            out_slot_triangle[slot + c] = triangle


@wp.kernel
def link_top_kernel(
    first: int,
    size: wp.array(dtype=int),
    node_offset: wp.array(dtype=int),
    leaf_offset: wp.array(dtype=int),
    boxes: wp.array(dtype=wp.float32),
    children: wp.array(dtype=int),
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
):
    """Copies a node of the top and points its children at the roots of their subtrees."""
    node = first + wp.tid()
    for k in range(48):
        out_boxes[48 * node + k] = boxes[48 * node + k]
    for c in range(8):
        number = children[8 * node + c]
        if number < 0:
            subtree = -1 - number
            if size[2 * subtree] > 0:
                number = node_offset[subtree]
            else:
                number = -1 - leaf_offset[subtree]
        out_children[8 * node + c] = number


@wp.kernel
def block_boxes_kernel(
    first: int,
    slot_triangle: wp.array(dtype=int),
    corners: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    out_boxes: wp.array(dtype=wp.float32),
):
    """The local box of the triangles in each block, rounded outwards: lower x y z, upper x y z."""
    block = first + wp.tid()
    big = wp.float64(1.0e30)
    lower = wp.vec3d(big, big, big)
    upper = -lower
    for lane in range(8):
        slot = 8 * block + lane
        if slot_triangle[slot] >= 0:
            for k in range(3):
                p = (corners[3 * slot + k] - origin) / scale
                lower = wp.min(lower, p)
                upper = wp.max(upper, p)
    for k in range(3):
        out_boxes[6 * block + k] = rounded_down(lower[k])
        out_boxes[6 * block + 3 + k] = -rounded_down(-upper[k])


_REFIT = f"""
    // Children have larger numbers than their parents: from the last node to the first everything below is done.
    for (int node = count - 1; node >= 0; --node) {{
        for (int c = 0; c < {WIDTH}; ++c) {{
            const int child = children.data[{WIDTH} * node + c];
            if (child == {NO_CHILD}) continue;
            for (int k = 0; k < 6; ++k) {{
                float side;
                if (child < 0) side = block_boxes.data[6 * (-1 - child) + k];
                else {{
                    // Of empty children the boxes are inside out: they widen nothing.
                    const float* row = boxes.data + 48 * child + 8 * k;
                    side = row[0];
                    for (int j = 1; j < {WIDTH}; ++j) side = k < 3 ? wp::min(side, row[j]) : wp::max(side, row[j]);
                }}
                boxes.data[48 * node + 8 * k + c] = side;
            }}
        }}
    }}
"""


@wp.func_native(_REFIT)
def refit_nodes(
    count: int,
    children: wp.array(dtype=int),
    block_boxes: wp.array(dtype=wp.float32),
    boxes: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def refit_kernel(
    first: int,
    count: int,
    children: wp.array(dtype=int),
    block_boxes: wp.array(dtype=wp.float32),
    out_boxes: wp.array(dtype=wp.float32),
):
    """Run for one item: nodes are few against triangles."""
    refit_nodes(count, children, block_boxes, out_boxes)
