"""The trees of many meshes, built and kept together: each is the tree that its mesh would get alone."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.forks import Lock
from geokit.core.base.late_warp import wp
from geokit.core.memory.struct_array import Parts, struct_table

# Triangles side by side in a leaf.
WIDTH = 8


class Forest:
    """Trees with eight children per node, on the CPU.

    Args:
        vertices: Positions [world], (V,) of vec3d.
        faces: Vertex indices, (3 F,) of int32.
        begin: The first face of each mesh, which has at least one, and F, (B + 1,).
        origins, scales: Their local frames, (B, 3) and (B,).
    Attributes:
        begin, scales: As given.
        slots: The first slot of each tree, and their number, (B + 1,).
        device: The CPU.
    """

    def __init__(
        self,
        vertices: "wp.array",
        faces: "wp.array",
        begin: NDArray[np.int64],
        origins: NDArray[np.float64],
        scales: NDArray[np.float64],
    ) -> None:
        from geokit.mesh.bvh.bvh8 import build_wide_trees, place_triangles
        from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS

        self.begin, self._origins, self.scales, self.device = begin, origins, scales, vertices.device
        self._lock = Lock()
        self._ray_table: NDArray[Any] | None = None
        built = build_wide_trees(vertices, faces, begin, origins, scales)
        boxes, self._children, slots, self._nodes, self.slots = built
        self._placed = place_triangles(slots, self.slots, vertices, faces, origins, scales)
        # Triangles of a tree are numbered from its own first one on.
        numbers = slots.numpy()
        numbers -= np.where(numbers >= 0, np.repeat(begin[:-1], np.diff(self.slots)), 0).astype(np.int32)
        self._parts = {
            "corners": Parts.between(self._placed[0], self.slots, 3),
            "slot_triangle": Parts.between(slots, self.slots),
            "boxes": Parts.between(boxes, self._nodes, 48),
            "children": Parts.between(self._children, self._nodes, 8),
            "leaves": Parts.between(self._placed[1], self.slots, PLANE_ROWS),
        }

    def _table(self, **more: Any) -> NDArray[Any]:
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        fields = {"origin": self._origins, "scale": self.scales, **self._parts, **more}
        return struct_table(SurfaceTree, len(self.scales), **fields)

    @cached_property
    def table(self) -> NDArray[Any]:
        """The :class:`SurfaceTree` of each mesh, without leaves for rays."""
        return self._table()

    @property
    def ray_table(self) -> NDArray[Any]:
        """The same with leaves for rays."""
        from geokit.mesh.bvh.bvh8 import ray_leaves
        from geokit.mesh.bvh.bvh8_build_cpu_kernels import LEAF_WORDS

        # It has the addresses of leaves that this object keeps: threads must not make them twice.
        with self._lock:
            if self._ray_table is None:
                slots = self._parts["slot_triangle"].array
                self._ray_leaves = ray_leaves(slots, self.slots, self._placed, self._origins, self.scales)
                self._ray_table = self._table(
                    ray_leaves=Parts.between(self._ray_leaves, self.slots // WIDTH, LEAF_WORDS)
                )
            return self._ray_table

    def tree(self, mesh: int) -> Any:
        """The :class:`SurfaceTree` of one mesh, over the same memory."""
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        tree: Any = SurfaceTree()
        tree.origin = wp.vec3d(*self._origins[mesh].tolist())
        tree.scale = wp.float64(self.scales[mesh])
        for name, (array, starts, counts) in self._parts.items():
            setattr(tree, name, array[int(starts[mesh]) : int(starts[mesh] + counts[mesh])])
        return tree

    def windings(self, meshes: NDArray[np.int64], flipped: NDArray[np.bool_]) -> NDArray[Any]:
        """The :class:`WindingTree` of some meshes; rows of others are empty.

        Args:
            meshes: Rows of the meshes.
            flipped: Faces whose winding counts as reversed, (F,).
        """
        from geokit.mesh.bvh.winding_kernels import WindingTree
        from geokit.mesh.bvh.winding_moments import build_moments

        turned = Parts.between(wp.array(flipped, dtype=wp.bool, device=self.device), self.begin)
        # The table has the addresses of both.
        moments, areas = build_moments(self.table, self._children, self._nodes, self.slots, turned, meshes)
        self._moments = moments, areas
        return struct_table(WindingTree, len(self.scales), moments=moments, areas=areas)
