"""Signs of a level set's empty regions, propagated from the faces of its leaves through the slots of its nodes."""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# State of a slot during the propagation: unknown, outside, inside, or a child with one bit for each of its six faces.
UNKNOWN = wp.constant(wp.uint8(0))
OUTSIDE = wp.constant(wp.uint8(1))
INSIDE = wp.constant(wp.uint8(2))
CHILD = wp.constant(wp.uint8(64))


@wp.kernel
def leaf_faces_kernel(first: int, inside: wp.array2d(dtype=wp.uint64), out_faces: wp.array(dtype=wp.uint8)):
    """One bit for each face of a leaf, -x +x -y +y -z +z, set if the voxel next to its middle lies inside."""
    i = first + wp.tid()
    faces = int(0)
    for face in range(6):
        near = wp.where((face & 1) == 0, 0, 7)
        x = wp.where(face < 2, near, 4)
        y = wp.where(face >> 1 == 1, near, 4)
        z = wp.where(face >> 1 == 2, near, 4)
        bit = wp.int32((inside[i, x] >> wp.uint64(8 * y + z)) & wp.uint64(1))
        faces = faces | (bit << face)
    out_faces[i] = wp.uint8(faces)


@wp.kernel
def place_children_kernel(
    first: int,
    keys: wp.array(dtype=wp.int64),
    bits: int,
    ends: wp.array(dtype=int),
    faces: wp.array(dtype=wp.uint8),
    out_state: wp.array(dtype=wp.uint8),
):
    """Marks the slots of children in their parents; ``bits`` is the logarithm of the number of a parent's slots."""
    i = first + wp.tid()
    slot = int(keys[i] & ((wp.int64(1) << wp.int64(bits)) - wp.int64(1)))
    out_state[((ends[i] - 1) << bits) + slot] = CHILD | faces[i]


@wp.func
def seen_from(state: wp.uint8, face: int) -> wp.uint8:
    """The side that a slot shows on one of its faces: outside, inside, or unknown."""
    seen = state
    if (state & CHILD) != wp.uint8(0):
        seen = OUTSIDE
        if ((state >> wp.uint8(face)) & wp.uint8(1)) != wp.uint8(0):
            seen = INSIDE
    return seen


@wp.kernel
def sweep_kernel(first: int, bits: int, axis: int, out_state: wp.array(dtype=wp.uint8)):
    """Propagates signs along one line of slots of a node, forward and back, into slots that have none."""
    i = first + wp.tid()
    width = 1 << bits
    node = i >> (2 * bits)
    u = (i >> bits) & (width - 1)
    v = i & (width - 1)
    step = wp.where(axis == 2, 1, wp.where(axis == 1, width, width * width))
    start = wp.where(
        axis == 2, (u * width + v) * width, wp.where(axis == 1, u * width * width + v, i & (width * width - 1))
    )
    at = (node << (3 * bits)) + start
    for direction in range(2):
        seen = UNKNOWN
        for k in range(width):
            here = at + wp.where(direction == 0, k, width - 1 - k) * step
            if out_state[here] == UNKNOWN:
                out_state[here] = seen
            # Going forward, the next slot sees the upper face of this one; going back, the lower face.
            seen = seen_from(out_state[here], 2 * axis + 1 - direction)


@wp.kernel
def node_faces_kernel(first: int, bits: int, state: wp.array(dtype=wp.uint8), out_faces: wp.array(dtype=wp.uint8)):
    """As :func:`leaf_faces_kernel`, for nodes: the side that the slot in the middle of each face shows."""
    i = first + wp.tid()
    width = 1 << bits
    middle = width / 2
    faces = int(0)
    for face in range(6):
        near = wp.where((face & 1) == 0, 0, width - 1)
        x = wp.where(face < 2, near, middle)
        y = wp.where(face >> 1 == 1, near, middle)
        z = wp.where(face >> 1 == 2, near, middle)
        if seen_from(state[(i << (3 * bits)) + (x * width + y) * width + z], face) == INSIDE:
            faces = faces | (1 << face)
    out_faces[i] = wp.uint8(faces)


@wp.kernel
def negative_bits_kernel(
    first: int,
    begin: wp.int64,
    order: wp.array(dtype=int),
    values: wp.array(dtype=float),
    out_bits: wp.array2d(dtype=wp.uint64),
):
    """Writes bits for the negative values of a plane."""
    i = first + wp.tid()
    word = wp.uint64(0)
    start = 512 * order[i >> 3] + 64 * (i & 7)
    for b in range(64):
        if values[start + b] < 0.0:
            word = word | (wp.uint64(1) << wp.uint64(b))
    out_bits[i >> 3, i & 7] = word
