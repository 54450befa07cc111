"""The tree that CUDA queries walk: both children's boxes in one row of 64 bytes; and how it is built.

Clusters of triangles, in Morton order, merge in rounds: those that are each other's best partner among the clusters
around them become a node.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.leaf_planes_kernels import SLOT_WORDS

wp.set_module_options({"enable_backward": False})

# Floats of a node: left lower x y z, left upper x y z, right lower x y z, right upper x y z, left and right child (as
# the bits of integers), two zeros.
NODE_FLOATS = 16
# A child that is a leaf is -1 - (slot << LEAF_BITS | triangles - 1).
LEAF_BITS = 3
NODE_CONSTANTS = {"NODE_FLOATS": NODE_FLOATS, "LEAF_BITS": LEAF_BITS, "SLOT_WORDS": SLOT_WORDS}
# Bits of a Morton key for each axis.
AXIS_BITS = 21
# Clusters that a block of THREADS threads merges, and those on either side of one among which it looks for a partner.
CHUNK = 512
REACH = 8
# The launcher's BLOCK_DIM.
THREADS = 128


@wp.struct
class Cluster:
    """Triangles under one node, or one triangle: -1 - its place in the order."""

    lower: wp.vec3
    node: int
    upper: wp.vec3
    # Of nodes below this one, at most.
    levels: int


@wp.func
def rounded_down(x: wp.float64) -> wp.float32:
    return wp.float32(x) - wp.abs(wp.float32(x)) * wp.float32(1.2e-7) - wp.float32(1e-30)


@wp.func
def spread_bits(x: wp.float64) -> wp.int64:
    """The AXIS_BITS bits of a coordinate from -1 to 1, with two zeros between neighbors."""
    cells = wp.float64(1 << AXIS_BITS)
    v = wp.int64(wp.clamp((x + wp.float64(1.0)) * wp.float64(0.5) * cells, wp.float64(0.0), cells - wp.float64(1.0)))
    v = (v | (v << wp.int64(32))) & wp.int64(0x1F00000000FFFF)
    v = (v | (v << wp.int64(16))) & wp.int64(0x1F0000FF0000FF)
    v = (v | (v << wp.int64(8))) & wp.int64(0x100F00F00F00F00F)
    v = (v | (v << wp.int64(4))) & wp.int64(0x10C30C30C30C30C3)
    return (v | (v << wp.int64(2))) & wp.int64(0x1249249249249249)


@wp.kernel
def key_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    origin: wp.vec3d,
    scale: wp.float64,
    out_key: wp.array(dtype=wp.int64),
    out_triangle: wp.array(dtype=int),
):
    """Morton keys of the middles of the triangles' boxes, and their numbers."""
    i = first + wp.tid()
    a = vertices[faces[3 * i]]
    b = vertices[faces[3 * i + 1]]
    c = vertices[faces[3 * i + 2]]
    middle = (wp.min(wp.min(a, b), c) * wp.float64(0.5) + wp.max(wp.max(a, b), c) * wp.float64(0.5) - origin) / scale
    key = spread_bits(middle[0]) | (spread_bits(middle[1]) << wp.int64(1)) | (spread_bits(middle[2]) << wp.int64(2))
    out_key[i] = key
    out_triangle[i] = i


@wp.kernel
def clusters_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    order: wp.array(dtype=int),
    origin: wp.vec3d,
    scale: wp.float64,
    out_clusters: wp.array(dtype=Cluster),
):
    """A cluster of each triangle in Morton order."""
    i = first + wp.tid()
    a = vertices[faces[3 * order[i]]]
    b = vertices[faces[3 * order[i] + 1]]
    c = vertices[faces[3 * order[i] + 2]]
    low = (wp.min(wp.min(a, b), c) - origin) / scale
    high = (origin - wp.max(wp.max(a, b), c)) / scale
    cluster = Cluster()
    cluster.lower = wp.vec3(rounded_down(low[0]), rounded_down(low[1]), rounded_down(low[2]))
    cluster.upper = -wp.vec3(rounded_down(high[0]), rounded_down(high[1]), rounded_down(high[2]))
    cluster.node = -1 - i
    cluster.levels = 0
    out_clusters[i] = cluster


@wp.kernel(grid_stride=False)
@cpp.native_item("mesh/bvh/bvh2_build.inl", "merge_chunk", CHUNK=CHUNK, REACH=REACH, THREADS=THREADS)
def merge_kernel(first: int, clusters: wp.array(dtype=Cluster), out_clusters: wp.array(dtype=Cluster)):
    """Merge the clusters of each CHUNK, and write what is left at its place, and how many those are.

    Nodes are numbered as they come. Of each node ``boxes`` has the lower and upper corners of its left and of its right
    child, and ``links`` those children and their numbers of triangles; ``parent`` has twice the node above each node,
    and above each triangle of the order behind them, plus one for a right child.
    """


@cpp.func_native("mesh/bvh/bvh2_build.inl", CHUNK=CHUNK, REACH=REACH, THREADS=THREADS)
def place_of(item: int, links: wp.array(dtype=wp.vec4i), parent: wp.array(dtype=int)) -> wp.vec2i: ...


@wp.kernel
def place_kernel(
    first: int,
    links: wp.array(dtype=wp.vec4i),
    parent: wp.array(dtype=int),
    order: wp.array(dtype=int),
    most: int,
    out_place: wp.array(dtype=wp.vec2i),
    out_kept: wp.array(dtype=int),
    out_slot_triangle: wp.array(dtype=int),
):
    """First slot of each node, and its number; by that, 1 for nodes of more triangles than a leaf may have, else 0.

    A node stands before those below it. Items behind the nodes are the triangles, which go to their slots.
    """
    item = first + wp.tid()
    triangles = links.shape[0] + 1
    if item < triangles - 1:
        place = place_of(item, links, parent)
        out_place[item] = place
        out_kept[place[1]] = wp.where(links[item][2] + links[item][3] > most, 1, 0)
    if item >= triangles:
        out_slot_triangle[place_of(item, links, parent)[0]] = order[item - triangles]


@wp.func
def reference_to(slot: int, triangles: int, number: int, most: int, row: wp.array(dtype=int)) -> int:
    """A child as a row refers to it; its number is that of a node if it has more triangles than a leaf."""
    reference = -1 - ((slot << LEAF_BITS) | (triangles - 1))
    if triangles > most:
        reference = row[number] - 1
    return reference


@wp.kernel
def nodes_kernel(
    first: int,
    boxes: wp.array(dtype=wp.vec3),
    links: wp.array(dtype=wp.vec4i),
    place: wp.array(dtype=wp.vec2i),
    row: wp.array(dtype=int),
    most: int,
    padding: float,
    out_nodes: wp.array(dtype=float),
    out_children: wp.array(dtype=int),
):
    """The rows, counted from one, of nodes with more triangles than a leaf; both outputs are the same memory."""
    node = first + wp.tid()
    link = links[node]
    if link[2] + link[3] <= most:
        return
    slot, number = place[node][0], place[node][1]
    at = NODE_FLOATS * (row[number] - 1)
    for k in range(2):
        for axis in range(3):
            out_nodes[at + 6 * k + axis] = boxes[4 * node + 2 * k][axis] - padding
            out_nodes[at + 6 * k + 3 + axis] = boxes[4 * node + 2 * k + 1][axis] + padding
    out_children[at + 14] = 0
    out_children[at + 15] = 0
    out_children[at + 12] = reference_to(slot, link[2], number + 1, most, row)
    # The right child stands behind all nodes of the left one.
    out_children[at + 13] = reference_to(slot + link[2], link[3], number + link[2], most, row)
