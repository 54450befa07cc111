"""The trees of many meshes, built and kept together: each is the tree that its mesh would get alone."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.forks import Lock
from geokit.core.memory.host_array import HostArray
from geokit.core.memory.struct_array import Parts, struct_array, struct_table

if TYPE_CHECKING:
    import warp as wp

__all__ = ["Forest"]

# Triangles side by side in a leaf.
WIDTH = 8
# Nodes per slice of a launch, see winding_moments.py.
NODE_GRAIN = 64


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

        self.begin, self.scales, self.device = begin, scales, vertices.device
        self._frames = [HostArray(origins), HostArray(scales)]
        self._lock = Lock()
        self._ray_table: NDArray[Any] | None = None
        built = build_wide_trees(vertices, faces, begin, origins, scales)
        self._boxes, self._children, slots, self._nodes, self.slots = built
        self._slot_triangle = slots
        placed = place_triangles(slots, self.slots, vertices, faces, origins, scales)
        self._corners, self._leaves = placed
        # Triangles of a tree are numbered from its own first one on.
        numbers = slots.numpy()
        numbers -= np.where(numbers >= 0, np.repeat(begin[:-1], np.diff(self.slots)), 0).astype(np.int32)

    @property
    def slot_offsets(self) -> HostArray:
        """``slots``, as kernels take it."""
        return HostArray(self.slots.astype(np.int32))

    def of_slots(self, array: "wp.array", each: int) -> Parts:
        """The parts of an array with ``each`` elements for each slot."""
        return Parts(array, each * self.slots[:-1], each * np.diff(self.slots))

    def _of_nodes(self, array: "wp.array", each: int) -> Parts:
        return Parts(array, each * self._nodes[:-1], each * np.diff(self._nodes))

    def of_faces(self, array: "wp.array", each: int = 1) -> Parts:
        """The parts of an array with ``each`` elements for each face."""
        return Parts(array, each * self.begin[:-1], each * np.diff(self.begin))

    @cached_property
    def table(self) -> NDArray[Any]:
        """The :class:`SurfaceTree` of each mesh, without leaves for rays."""
        from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        return struct_table(
            SurfaceTree,
            len(self.scales),
            origin=self._frames[0].values,
            scale=self.scales,
            corners=self.of_slots(self._corners, 3),
            slot_triangle=self.of_slots(self._slot_triangle, 1),
            boxes=self._of_nodes(self._boxes, 48),
            children=self._of_nodes(self._children, 8),
            leaves=self.of_slots(self._leaves, PLANE_ROWS),
        )

    @property
    def ray_table(self) -> NDArray[Any]:
        """The same with leaves for rays."""
        from geokit.mesh.bvh.bvh8 import ray_leaves
        from geokit.mesh.bvh.bvh8_leaves_cpu_kernels import LEAF_WORDS
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        # It has the addresses of leaves that this object keeps: threads must not make them twice.
        with self._lock:
            if self._ray_table is None:
                placed, frames = (self._corners, self._leaves), (frame.values for frame in self._frames)
                self._ray_leaves = ray_leaves(self._slot_triangle, self.slots, placed, *frames)
                starts = LEAF_WORDS * self.slots // WIDTH
                leaves = Parts(self._ray_leaves, starts[:-1], np.diff(starts))
                table = self.table.copy()
                table["ray_leaves"] = struct_table(SurfaceTree, len(table), ray_leaves=leaves)["ray_leaves"]
                self._ray_table = table
            return self._ray_table

    def tree(self, mesh: int) -> Any:
        """The :class:`SurfaceTree` of one mesh, over the same memory."""
        import warp as wp

        from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        node, node_end, slot, slot_end = map(int, (*self._nodes[mesh : mesh + 2], *self.slots[mesh : mesh + 2]))
        tree: Any = SurfaceTree()
        tree.origin = wp.vec3d(*self._frames[0].values[mesh].tolist())
        tree.scale = wp.float64(self.scales[mesh])
        tree.corners = self._corners[3 * slot : 3 * slot_end]
        tree.slot_triangle = self._slot_triangle[slot:slot_end]
        tree.boxes, tree.children = self._boxes[48 * node : 48 * node_end], self._children[8 * node : 8 * node_end]
        tree.leaves = self._leaves[PLANE_ROWS * slot : PLANE_ROWS * slot_end]
        return tree

    def windings(self, meshes: NDArray[np.int64], flipped: NDArray[np.bool_]) -> NDArray[Any]:
        """The :class:`WindingTree` of some meshes; rows of others are empty.

        Args:
            meshes: Rows of the meshes.
            flipped: Faces whose winding counts as reversed, (F,).
        """
        import warp as wp

        from geokit.mesh.bvh.bvh8_moments_kernels import MOMENT_ROWS, RAW_SIZE
        from geokit.mesh.bvh.forest_cpu_kernels import ForestMoments, forest_moments_kernel
        from geokit.mesh.bvh.winding_kernels import WindingTree

        count, nodes = len(self.scales), int(self._nodes[-1])

        def empty(size: int, dtype: Any) -> "wp.array":
            return wp.empty(size, dtype=dtype, device=self.device)

        self._moments = empty(8 * MOMENT_ROWS * nodes, wp.float32), empty(len(self._slot_triangle), wp.float32)
        moments, areas = self._of_nodes(self._moments[0], 8 * MOMENT_ROWS), self.of_slots(self._moments[1], 1)
        raw = empty(RAW_SIZE * nodes, wp.float64)
        turned: Any = wp.array(flipped, dtype=wp.bool, device=self.device)
        table = struct_table(
            ForestMoments,
            count,
            tree=self.table,
            flipped=self.of_faces(turned),
            raw=self._of_nodes(raw, RAW_SIZE),
            moments=moments,
            areas=areas,
        )
        forest = struct_array(table, ForestMoments, self.device)
        for level, owner in reversed(self._levels(meshes)):
            items = [HostArray((level - self._nodes[owner]).astype(np.int32)), HostArray(owner.astype(np.int32))]
            launcher.launch(forest_moments_kernel, len(level), items, [forest], self.device, grain=NODE_GRAIN)
        return struct_table(WindingTree, count, moments=moments, areas=areas)

    def _levels(self, meshes: NDArray[np.int64]) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """The inner nodes of some trees by their distance from the root, and the tree of each."""
        children = self._children.numpy().reshape(-1, WIDTH)
        level, owner, levels = self._nodes[meshes], meshes, []
        while len(level):
            levels.append((level, owner))
            below = children[level]
            row, lane = np.nonzero(below > 0)
            owner = owner[row]
            level = below[row, lane] + self._nodes[owner]
        return levels
