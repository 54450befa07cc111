"""Connected components by parallel union-find, and fans of faces around positions, walked from face to face.

``label`` holds a forest: the parent of each node, which is never above it; a root is its own parent. A root only ever
gets a lower root as its parent. So each component ends with its lowest node as the root, whatever the order of the
links.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.atomic_kernels import root_of, unite

wp.set_module_options({"enable_backward": False})


@wp.kernel
def join_kernel(
    first: int,
    one: wp.array(dtype=wp.int32),
    other: wp.array(dtype=wp.int32),
    out_label: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    unite(out_label, one[i], other[i])


@wp.kernel
def lowest_kernel(first: int, label: wp.array(dtype=wp.int32), out_label: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    out_label[i] = root_of(label, label[i])


@wp.func
def after(half_edge: wp.int32) -> wp.int32:
    if half_edge % 3 == 2:
        return half_edge - 2
    return half_edge + 1


@wp.func
def before(half_edge: wp.int32) -> wp.int32:
    if half_edge % 3 == 0:
        return half_edge + 2
    return half_edge - 1


@wp.func
def walk(corner: wp.int32, leaving: wp.int32, link: wp.array(dtype=wp.int32)) -> wp.int32:
    """Number of corners on the walk that starts across the half-edge ``leaving``; negative if it is a closed loop."""
    met = wp.int32(0)
    half_edge = leaving
    # Whether the half-edge starts at the position.
    starts = leaving == corner
    while True:
        across = link[half_edge]
        if across < 0:
            return met
        alike = (across & 1) != 0
        across = across >> 1
        # The half-edge across starts at the position if this one does and both run the same way, or if neither is true.
        starts = starts == alike
        here = after(across)
        half_edge = here
        if starts:
            here = across
            half_edge = before(across)
        if here == corner:
            return -met - 1
        met += 1
        starts = not starts
    return met


@wp.kernel
def fan_kernel(
    first: int,
    corner: wp.array(dtype=wp.int32),
    link: wp.array(dtype=wp.int32),
    out_seen: wp.array(dtype=wp.int32),
):
    """``link`` is twice the half-edge across, plus 1 if it runs the same way; negative if there is none."""
    position = first + wp.tid()
    c = corner[position]
    if c < 0:
        out_seen[position] = 0
        return
    met = walk(c, c, link)
    if met < 0:
        out_seen[position] = -met
        return
    out_seen[position] = met + walk(c, before(c), link) + 1
