"""Winding number data of a prepared surface: the moments of its tree's nodes, computed once for many queries."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher

if TYPE_CHECKING:
    import warp as wp
    from numpy.typing import NDArray

__all__ = ["build_winding_tree", "winding_tree_of_mesh"]

# Nodes per slice of a launch: the moments of one node, with its leaves, take a few microseconds.
NODE_GRAIN = 64


def build_winding_tree(tree: Any, flipped: NDArray[np.bool_] | None = None) -> Any:
    """Data for winding numbers beside the CPU tree.

    Args:
        tree: The :class:`SurfaceTree` with boxes, children, corners and slots.
        flipped: Triangles whose winding counts as reversed, shape (F,); None for none.
    Returns:
        A :class:`WindingTree`. It must be rebuilt after the tree's corners have moved.
    Source:
        Barill, Dickson, Schmidt, Levin, Jacobson, "Fast Winding Numbers for Soups and Clouds" (2018). Differs: harmonic
        moments of three orders, of exact integrals over triangles.
    """
    import warp as wp

    from geokit.mesh.bvh import bvh8_moments_kernels as kernels
    from geokit.mesh.bvh.winding_kernels import WindingTree

    device = tree.children.device
    turned = wp.empty(0, dtype=wp.bool, device=device)
    if flipped is not None and flipped.any():
        turned = wp.array(flipped, dtype=wp.bool, device=device)
    node_count = len(tree.children) // 8
    winding = WindingTree()
    winding.moments = wp.empty(8 * kernels.MOMENT_ROWS * node_count, dtype=wp.float32, device=device)
    winding.areas = wp.empty(len(tree.slot_triangle), dtype=wp.float32, device=device)
    raw = wp.empty(kernels.RAW_SIZE * node_count, dtype=wp.float64, device=device)
    for level in reversed(_levels(tree.children.numpy().reshape(-1, 8))):
        nodes = wp.array(level, dtype=wp.int32, device=device)
        inputs = [nodes, tree, turned, raw]
        outputs = [winding.moments, winding.areas]
        launcher.launch(kernels.moments_kernel, len(level), inputs, outputs, device, grain=NODE_GRAIN)
    return winding


def winding_tree_of_mesh(mesh: "wp.Mesh") -> Any:
    """Data for winding numbers on CUDA: warp's tree of a Mesh with ``support_winding_number``."""
    import warp as wp

    from geokit.mesh.bvh.winding_kernels import WindingTree

    winding = WindingTree()
    winding.mesh = wp.uint64(mesh.id)
    return winding


def _levels(children: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """The inner nodes, grouped by their distance from the root."""
    levels = []
    level = np.zeros(1, np.int32)
    while len(level):
        levels.append(level)
        below = children[level].ravel()
        # An absent child has the number of the root, which is never a child.
        level = below[below > 0]
    return levels
