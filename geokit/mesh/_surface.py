"""A triangle mesh prepared for queries: frame, bounding volume hierarchy and sign."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.frame import Frame
from geokit.errors import DeviceMemoryError, InputError
from geokit.mesh._device_mesh import arrays_on
from geokit.mesh._model import TriangleMesh
from geokit.mesh.queries.overlaps import OverlapQueries
from geokit.mesh.queries.rays import RayQueries
from geokit.mesh.sign.queries import SignQueries

if TYPE_CHECKING:
    import warp as wp
    from numpy.typing import ArrayLike

    from geokit.mesh.topology.audit import MeshAudit

__all__ = ["Surface"]

# Triangles in a leaf of the warp Mesh: on a CPU a leaf of eight is one contiguous read, on a GPU one triangle a thread
# diverges least.
LEAF_SIZE_CPU = 8
LEAF_SIZE_CUDA = 1
# Triangles in a leaf of the nodes that queries on a GPU walk, which are packed from that tree: closest points gain by
# reading fewer nodes, rays lose by testing triangles that they pass (measured on an H100).
POINT_LEAF = 6
RAY_LEAF = 1


class Surface(SignQueries, RayQueries, OverlapQueries):
    """A mesh prepared once for many queries on one device.

    On a CPU queries walk a tree of eight children a node; on a GPU they walk the tree of a warp ``Mesh``. Answers are
    those of float64 triangles on either.

    Arrays of a mesh that was made on the same GPU are used where they are.

    Args:
        mesh: The triangles; at least one.
        device: "cpu", "cuda:0", a warp device, or None for the first GPU, else the CPU.
    Attributes:
        mesh: The triangles.
        bounds: Box around them [world], shape (2, 3).
    Raises:
        InputError: The mesh has no faces, or there is no such device.
        DeviceMemoryError: The device cannot hold the mesh.
    """

    def __init__(self, mesh: TriangleMesh, *, device: Any = None) -> None:
        if not isinstance(mesh, TriangleMesh):
            raise InputError(f"mesh: {type(mesh).__name__} is not a TriangleMesh; make one from vertices and faces")
        if mesh.face_count == 0:
            raise InputError(f"mesh: {mesh.name or 'it'} has no faces; queries need at least one triangle")
        self._device = launcher.resolve_device(device)
        self._set_mesh(mesh)
        try:
            self._upload()
            if self._device.is_cpu:
                self._build_wide_tree()
            else:
                self._take_warp_tree()
        except (RuntimeError, MemoryError) as error:
            if "allocat" not in str(error).lower():
                raise
            size = 350 * mesh.face_count + 36 * mesh.vertex_count
            raise DeviceMemoryError(
                f"mesh: {mesh.face_count} faces need about {size >> 20} MiB on {self.device}; "
                "free some there or use another device"
            ) from error

    def _set_mesh(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self.bounds = mesh.bounds
        self._frame = Frame.around(*self.bounds)

    def _upload(self) -> None:
        self._vertices, self._faces = arrays_on(self.mesh, self._device)

    def _build_wide_tree(self) -> None:
        from geokit.mesh.bvh.bvh8 import build_wide_tree
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        self._tree = SurfaceTree()
        for name, array in build_wide_tree(self._vertices, self._faces, self._frame).items():
            setattr(self._tree, name, array)
        self._place_triangles()

    def _take_warp_tree(self) -> None:
        import warp as wp

        from geokit.mesh.bvh.bvh2_packed import pack_nodes
        from geokit.mesh.bvh.ray_walk_kernels import RAY_PADDING
        from geokit.mesh.bvh.tree_kernels import SurfaceTree, leaf_order_kernel

        self._tree = SurfaceTree()
        self._tree.mesh = wp.uint64(self._warp_mesh.id)
        self._tree.slot_triangle = wp.empty(self.mesh.face_count, dtype=wp.int32, device=self._device)
        inputs, outputs = [self._tree.mesh], [self._tree.slot_triangle]
        launcher.launch(leaf_order_kernel, self.mesh.face_count, inputs, outputs, self._device)
        self._place_triangles()
        tree = self._tree
        tree.boxes, tree.children = pack_nodes(self._warp_mesh, POINT_LEAF, 0.0, tree.leaves)
        tree.ray_boxes, tree.ray_children = pack_nodes(self._warp_mesh, RAY_LEAF, RAY_PADDING, tree.leaves)

    def _place_triangles(self) -> None:
        """The frame, and the triangles in the order of the slots: world corners, and planes in float32."""
        import warp as wp

        from geokit.mesh.bvh.bvh8 import fill_leaves
        from geokit.mesh.bvh.tree_kernels import gather_corners_kernel
        from geokit.mesh.bvh.tree_memory import tree_array

        tree = self._tree
        tree.origin = wp.vec3d(*map(float, self._frame.origin))
        tree.scale = wp.float64(self._frame.scale)
        slots = len(tree.slot_triangle)
        tree.corners = tree_array(3 * slots, wp.vec3d, self._device)
        inputs = [tree.slot_triangle, self._vertices, self._faces]
        launcher.launch(gather_corners_kernel, slots, inputs, [tree.corners], self._device)
        tree.leaves = fill_leaves(tree.slot_triangle, tree.corners, self._frame, wide=not tree.mesh)

    @cached_property
    def _warp_mesh(self) -> "wp.Mesh":
        """The mesh in local coordinates for warp's own queries; CPU queries do without, and make it when asked for."""
        return self._make_warp_mesh(self._faces)

    def _make_warp_mesh(self, faces: "wp.array") -> "wp.Mesh":
        import warp as wp

        from geokit.core.frame_kernels import local_kernel

        # Vertices that no face uses may lie anywhere; in the frame of the faces they could overflow float32.
        local = wp.empty(len(self._vertices), dtype=wp.vec3, device=self._device)
        corners = [wp.vec3d(*corner.tolist()) for corner in (*self.bounds, self._frame.origin)]
        inputs = [self._vertices, *corners, wp.float64(self._frame.scale)]
        launcher.launch(local_kernel, len(local), inputs, [local], self._device)
        return wp.Mesh(
            points=local,
            indices=faces,
            support_winding_number=True,
            bvh_leaf_size=LEAF_SIZE_CPU if self._device.is_cpu else LEAF_SIZE_CUDA,
        )

    def update(self, vertices: ArrayLike) -> None:
        """Move the vertices; the tree is refitted, which takes a fraction of building it.

        Answers are those of a new Surface, to the last bit, but for winding numbers, whose clusters follow the tree:
        they stay within the error that they are given with (tests/mesh/test_surface_update.py). The tree of a new
        Surface is made for the new shape and may be faster: build one after large deformations.

        Args:
            vertices: New vertex positions [world], shape (V, 3), as many as before.
        Raises:
            InputError: Another number of vertices, or a row that is not finite; the surface is then as it was.
        """
        given, expected = np.shape(vertices), self.mesh.vertex_count
        if len(given) == 2 and given[0] != expected:
            raise InputError(
                f"vertices: {given[0]} rows for a mesh of {expected} vertices; make a new Surface for another mesh"
            )
        mesh = TriangleMesh(vertices, self.mesh.faces, name=self.mesh.name, parts=self.mesh.parts)
        for name in self._cached_names():
            self.__dict__.pop(name, None)
        self._set_mesh(mesh)
        self._upload()
        if self._device.is_cpu:
            from geokit.mesh.bvh.bvh8 import refit_wide_tree

            self._place_triangles()
            refit_wide_tree(self._tree, self._frame)
        else:
            # A GPU builds as quickly as it would refit and copy.
            self._take_warp_tree()

    @classmethod
    def _cached_names(cls) -> list[str]:
        """What is derived from the vertices and computed when first asked for."""
        return [
            name for base in cls.__mro__ for name, value in vars(base).items() if isinstance(value, cached_property)
        ]

    @property
    def device(self) -> str:
        """Alias of the device that answers: "cpu", "cuda:0", ..."""
        return self._device.alias

    @property
    def id(self) -> int:
        """Handle for the user's own kernels: pass it as ``wp.uint64`` to warp's ``mesh_query_*`` built-ins.

        The mesh behind it is in local coordinates: ``(world - origin) / scale``. On a CPU it is made when first asked
        for. After :meth:`update` there is another one.
        """
        return int(self._warp_mesh.id)

    @property
    def origin(self) -> np.ndarray:
        """Origin of the local frame [world], shape (3,)."""
        return self._frame.origin.copy()

    @property
    def scale(self) -> float:
        """Length of one local unit [world]."""
        return self._frame.scale

    @cached_property
    def audit(self) -> MeshAudit:
        """What :func:`geokit.mesh.audit` says of the mesh; computed when first asked for."""
        from geokit.mesh.topology.audit import audit_topology

        return audit_topology(self.mesh, self._topology)

    def __repr__(self) -> str:
        return f"Surface({self.mesh!r}, device={self.device!r})"
