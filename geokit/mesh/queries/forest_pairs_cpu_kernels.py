"""Whether the triangles of each of many meshes intersect, on the CPU."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.forest_cpu_kernels import ForestBoxes
from geokit.mesh.queries.intersecting_kernels import find_pair

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.kernel
def forest_pairs_kernel(
    first: int, trees: wp.array(dtype=int), leaves: wp.array(dtype=int), forest: wp.array(dtype=ForestBoxes)
):
    """One item is a leaf of a tree. Raises ``found`` in the forest."""
    i = first + wp.tid()
    one = forest[trees[i]]
    find_pair(leaves[i], one.tree, one.tree, one.slot_boxes, True, one.unit, one.found)
