"""Box, flag and extrema of the nodes of a grid of floats or integers, written in place.

Each node's statistics have a single writer, so no atomics are needed and every device writes the same bytes.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.cpp import cpp
from geokit.volume.tree.device_writer_kernels import LevelLayout

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


def _kernels_of(name: str) -> tuple[wp.Kernel, wp.Kernel, wp.Kernel]:
    """The kernels for leaves, parts and nodes whose values have the given C++ type."""

    def text(*files: str) -> str:
        return cpp("core/simd.inl", *(f"volume/tree/{file}.inl" for file in files), defines={"T": name})

    @wp.func_native(text("leaf_statistics"))
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
        """Writes box, flag and extrema of a leaf with values and mask, and the number of its active voxels."""
        leaf(first + wp.tid(), begin, tiles, rows, out_buffer, out_boxes, out_extrema, out_count)

    @wp.func_native(text("part_children", "merge_statistics", "part_statistics"))
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
        """Writes box and extrema of a part of a node's children, so that no thread has to reduce a large node alone."""
        part(first + wp.tid(), parts, first_child, boxes, extrema, out_boxes, out_extrema)

    @wp.func_native(text("node_children", "merge_statistics", "node_statistics"))
    def node(
        node: int,
        level: LevelLayout,
        parts: int,
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
        level: LevelLayout,
        parts: int,
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
        """Writes box, flag and extrema of an internal node from those of its children."""
        i = first + wp.tid()
        node(i, level, parts, first_child, first_leaf, boxes, extrema, tiles, rows, out_buffer, out_boxes, out_extrema)

    return leaf_kernel, part_kernel, node_kernel


float_leaf_kernel, float_part_kernel, float_node_kernel = _kernels_of("float")
int_leaf_kernel, int_part_kernel, int_node_kernel = _kernels_of("int")
