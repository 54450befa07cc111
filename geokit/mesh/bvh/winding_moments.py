"""Winding number data of a prepared surface: the moments of its tree's nodes, computed once for many queries."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.host_array import HostArray
from geokit.core.memory.struct_array import Parts, struct_array, struct_rows, struct_table

# Nodes per slice of a launch: the moments of one node, with its leaves, take a few microseconds.
NODE_GRAIN = 64


def build_winding_tree(tree: Any, flipped: NDArray[np.bool_] | None = None) -> Any:
    """Data for winding numbers beside the CPU tree.

    Args:
        tree: The :class:`SurfaceTree` with boxes, children, corners and slots.
        flipped: Triangles whose winding counts as reversed, shape (F,); None for none.
    Returns:
        A :class:`WindingTree`. It must be rebuilt after the tree's corners have moved.
    """
    from geokit.mesh.bvh.tree_kernels import SurfaceTree
    from geokit.mesh.bvh.winding_kernels import WindingTree

    some = np.empty(0, bool) if flipped is None or not flipped.any() else flipped
    turned: Any = wp.array(some, dtype=wp.bool, device=tree.children.device)
    nodes, slots = np.array([0, len(tree.children) // 8]), np.array([0, len(tree.slot_triangle)])
    table = struct_rows(SurfaceTree, [tree])
    moments, areas = build_moments(table, tree.children, nodes, slots, turned, np.zeros(1, np.int64))
    winding = WindingTree()
    winding.moments, winding.areas = moments.array, areas.array
    return winding


def build_moments(
    trees: NDArray[Any],
    children: "wp.array",
    nodes: NDArray[np.int64],
    slots: NDArray[np.int64],
    flipped: "Parts | wp.array",
    chosen: NDArray[np.int64],
) -> tuple[Parts, Parts]:
    """The moments and areas of :class:`WindingTree` for some of many trees on the CPU.

    Args:
        trees: The table of :class:`SurfaceTree`.
        children: Those of all trees.
        nodes, slots: The first ones of each tree, and their number, (B + 1,).
        flipped: For each tree the triangles whose winding counts as reversed; without elements for none.
        chosen: Rows of the trees that are asked; those of others stay as they are.
    Source:
        Barill, Dickson, Schmidt, Levin, Jacobson, "Fast Winding Numbers for Soups and Clouds" (2018). Differs: harmonic
        moments of three orders, of exact integrals over triangles.
    """
    from geokit.mesh.bvh.bvh8_moments_kernels import MOMENT_ROWS, RAW_SIZE, TreeMoments, moments_kernel

    device = children.device

    def empty(begin: NDArray[np.int64], each: int, dtype: Any) -> Parts:
        return Parts.between(wp.empty(each * int(begin[-1]), dtype=dtype, device=device), begin, each)

    moments, areas = empty(nodes, 8 * MOMENT_ROWS, wp.float32), empty(slots, 1, wp.float32)
    raw = empty(nodes, RAW_SIZE, wp.float64)
    fields = {"tree": trees, "flipped": flipped, "raw": raw, "moments": moments, "areas": areas}
    table = struct_array(struct_table(TreeMoments, len(trees), **fields), TreeMoments, device)
    for level, owner in reversed(_levels(children.numpy().reshape(-1, 8), nodes, chosen)):
        items = [HostArray((level - nodes[owner]).astype(np.int32)), HostArray(owner.astype(np.int32))]
        launcher.launch(moments_kernel, len(level), items, [table], device, grain=NODE_GRAIN)
    return moments, areas


def winding_tree_of_mesh(mesh: "wp.Mesh") -> Any:
    """Data for winding numbers on CUDA: warp's tree of a Mesh with ``support_winding_number``."""
    from geokit.mesh.bvh.winding_kernels import WindingTree

    winding = WindingTree()
    winding.mesh = wp.uint64(mesh.id)
    return winding


def _levels(
    children: NDArray[np.int32], nodes: NDArray[np.int64], owner: NDArray[np.int64]
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """The inner nodes of some trees by their distance from the root, and the tree of each."""
    level, levels = nodes[owner], []
    while len(level):
        levels.append((level, owner))
        below = children[level]
        # An absent child has the number of the root, which is never a child.
        row, lane = np.nonzero(below > 0)
        owner = owner[row]
        level = below[row, lane] + nodes[owner]
    return levels
