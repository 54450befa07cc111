"""Writes the nodes of a NanoVDB grid in place: their tables, masks and statistics, and values and masks of leaves.

Children of a node follow each other in the order of their keys. Each word of a mask and each row of a table has a
single writer, so no atomics are needed and every device writes the same bytes. So have a node's statistics, which
are the box, flag and extrema of grids of floats or integers; values have the type of the extrema.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

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
    """Writes 1 where a new lower node begins, and where a new upper node does: where the key's leading bits change."""
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
    """Writes key and first child of each node (one more entry ends the last), and for upper nodes their first leaf.

    ``out_lower_end`` holds for each lower node the number of upper nodes up to its own, ``out_few`` as many keys of
    upper nodes as it has room for, ``out_count`` the numbers of lower and of upper nodes.
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


@wp.struct
class LevelLayout:
    """Where the nodes of a level and their children lie in a grid, in bytes from its start."""

    bits: int  # logarithm of the slots of a node
    span: int  # voxels along an axis of a node
    begin: wp.int64  # the first node
    size: wp.int64  # bytes of a node
    statistics: wp.int64  # bytes from a node to its extrema
    table: wp.int64  # bytes from a node to its slots
    child_begin: wp.int64  # the first child
    child_size: wp.int64  # bytes of a child


@wp.kernel
@cpp.native_item("volume/tree/device_writer.inl", "link_word")
def link_kernel(first: int, level: LevelLayout):
    """Writes 64 slots of a node: offsets of the children, tiles between them, and a word of the child mask."""


@wp.kernel
@cpp.native_item("volume/tree/device_writer.inl", "copy_plane")
def copy_leaves_kernel(first: int):
    """Copies a plane of a leaf's values (as bits) and of its mask, from rows in another order."""


@wp.kernel
@cpp.native_item("volume/tree/node_statistics.inl", "measure_leaf")
def leaf_kernel(first: int, out_extrema: wp.array(dtype=Any)):
    """Writes box, flag and extrema of a leaf with values and mask, and the number of its active voxels."""


@wp.kernel
@cpp.native_item("volume/tree/node_statistics.inl", "measure_part")
def part_kernel(first: int, extrema: wp.array(dtype=Any), out_extrema: wp.array(dtype=Any)):
    """Writes box and extrema of a part of a node's children, so that no thread has to reduce a large node alone."""


@wp.kernel
@cpp.native_item("volume/tree/node_statistics.inl", "measure_node")
def node_kernel(first: int, level: LevelLayout, extrema: wp.array(dtype=Any), out_extrema: wp.array(dtype=Any)):
    """Writes box, flag and extrema of an internal node from those of its children."""


# The kernels of leaves, parts and nodes, by the type of the extrema.
KERNELS = {
    dtype: (
        wp.overload(leaf_kernel, {"out_extrema": wp.array(dtype=dtype)}),
        wp.overload(part_kernel, {name: wp.array(dtype=dtype) for name in ("extrema", "out_extrema")}),
        wp.overload(node_kernel, {name: wp.array(dtype=dtype) for name in ("extrema", "out_extrema")}),
    )
    for dtype in (wp.float32, wp.int32)
}
