"""Box, flag and extrema of the nodes of a grid of floats or integers, written in place.

Each node's statistics have a single writer, so no atomics are needed and every device writes the same bytes. Values
have the type of the extrema.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.volume.tree.device_writer_kernels import LevelLayout

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


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
