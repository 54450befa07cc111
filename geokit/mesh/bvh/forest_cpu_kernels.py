"""Trees of many meshes side by side: what is computed for all of them at once, on the CPU."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.scan_kernels import part_of
from geokit.mesh.bvh.box_walk_kernels import slot_box
from geokit.mesh.bvh.bvh8_moments_kernels import node_moments
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class ForestMoments:
    """What the winding numbers of one tree need."""

    tree: SurfaceTree
    flipped: wp.array(dtype=wp.bool)
    raw: wp.array(dtype=wp.float64)
    moments: wp.array(dtype=wp.float32)
    areas: wp.array(dtype=wp.float32)


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
def forest_moments_kernel(
    first: int,
    nodes: wp.array(dtype=int),
    trees: wp.array(dtype=int),
    forest: wp.array(dtype=ForestMoments),
):
    """Moments of the children of some nodes; ``nodes`` count from the root of their tree. Writes into the forest."""
    i = first + wp.tid()
    one = forest[trees[i]]
    node_moments(one.tree, one.flipped, nodes[i], one.raw, one.moments, one.areas)


@wp.kernel
def forest_slot_boxes_kernel(first: int, begin: wp.array(dtype=int), forest: wp.array(dtype=ForestBoxes)):
    """As slot_boxes_kernel; ``begin`` has the first slot of each tree, and their number. Writes into the forest."""
    slot = first + wp.tid()
    tree = part_of(begin, slot)
    one = forest[tree]
    slot_box(one.tree, slot - begin[tree], one.slot_boxes)
