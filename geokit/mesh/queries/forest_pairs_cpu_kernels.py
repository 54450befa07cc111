"""Whether the triangles of each of many meshes intersect, on the CPU."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.scan_kernels import part_of
from geokit.mesh.bvh.box_walk_kernels import slot_box
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.queries.intersecting_kernels import find_pair

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class ForestBoxes:
    """What a search for the self-intersections of one tree needs."""

    tree: SurfaceTree
    slot_boxes: wp.array(dtype=wp.float32)
    # 1 as soon as a pair is found.
    found: wp.array(dtype=int)
    # A power of two near the inverse of the scale.
    unit: wp.float64


@wp.kernel
def forest_slot_boxes_kernel(first: int, begin: wp.array(dtype=int), forest: wp.array(dtype=ForestBoxes)):
    """As slot_boxes_kernel; ``begin`` has the first slot of each tree, and their number. Writes into the forest."""
    slot = first + wp.tid()
    tree = part_of(begin, slot)
    one = forest[tree]
    slot_box(one.tree, slot - begin[tree], one.slot_boxes)


@wp.kernel
def forest_pairs_kernel(
    first: int, trees: wp.array(dtype=int), leaves: wp.array(dtype=int), forest: wp.array(dtype=ForestBoxes)
):
    """One item is a leaf of a tree. Raises ``found`` in the forest."""
    i = first + wp.tid()
    one = forest[trees[i]]
    find_pair(leaves[i], one.tree, one.tree, one.slot_boxes, True, one.unit, one.found)
