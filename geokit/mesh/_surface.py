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

# Triangles in a leaf of the warp Mesh. On a CPU a leaf of eight is one contiguous read; on a GPU one triangle per
# thread diverges least.
LEAF_SIZE_CPU = 8
LEAF_SIZE_CUDA = 1
# Triangles in a leaf of the packed nodes that GPU queries walk (made from the tree of the warp Mesh). Closest points
# gain from reading fewer nodes; rays lose from testing triangles that they pass (measured on an H100).
POINT_LEAF = 6
RAY_LEAF = 1


class Surface(SignQueries, RayQueries, OverlapQueries):
    """A mesh prepared once for many queries on one device.

    On a CPU queries walk a tree with eight children per node; on a GPU they walk the tree of a warp ``Mesh``. On either
    device the answers are those of float64 triangles.

    Arrays of a mesh that was made on the same GPU are used in place.

    Args:
        mesh: The triangles; at least one.
        device: "cpu", "cuda:0", a warp device, or None for the first GPU, else the CPU.
    Attributes:
        mesh: The triangles.
        bounds: Bounding box of the vertices that faces use [world], shape (2, 3).
    Raises:
        InputError: The mesh has no faces, or there is no such device.
        DeviceMemoryError: The device cannot hold the mesh.

    Held by: tests/mesh/test_surface.py
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
        """Store the frame, and the triangles in slot order: world corners in float64, and planes in float32."""
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
        """The mesh in local coordinates for warp's own queries; CPU queries do not need it, so it is built lazily."""
        return self._make_warp_mesh(self._faces)

    def _make_warp_mesh(self, faces: "wp.array") -> "wp.Mesh":
        import warp as wp

        from geokit.core.frame_kernels import local_kernel

        # Vertices that no face uses may lie anywhere: in the frame of the faces they could overflow float32.
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
        """Move the vertices and refit the tree, which takes a fraction of the time of building it.

        Afterwards answers equal those of a new Surface to the last bit, except for winding numbers: their clusters
        depend on the tree, and they stay within the error bound of :meth:`winding_number`. The tree of a new Surface
        fits the new shape and may be faster; build one after large deformations.

        Args:
            vertices: New vertex positions [world], shape (V, 3), with the same number of vertices V.
        Raises:
            InputError: The number of vertices differs, or a row is not finite; the surface is unchanged then.
        Example:
            >>> triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
            >>> surface = gk.mesh.Surface(triangle, device="cpu")
            >>> surface.update(triangle.vertices + [0, 0, 5])
            >>> surface.closest_point([[0.25, 0.25, 7.0]]).distance
            array([2.])

        Held by: tests/mesh/test_surface_update.py
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
            # On a GPU a new build takes no longer than a refit and the copies for it.
            self._take_warp_tree()

    @classmethod
    def _cached_names(cls) -> list[str]:
        """Names of the cached properties, all of which are derived from the vertices."""
        return [
            name for base in cls.__mro__ for name, value in vars(base).items() if isinstance(value, cached_property)
        ]

    @property
    def device(self) -> str:
        """Alias of the surface's device: "cpu", "cuda:0", ..."""
        return self._device.alias

    @property
    def id(self) -> int:
        """Handle of the warp ``Mesh`` for the user's own kernels: pass it as ``wp.uint64`` to warp's ``mesh_query_*``.

        This mesh is in local coordinates: ``(world - origin) / scale``. On a CPU it is built at the first access.
        :meth:`update` replaces it, so that the handle changes.
        """
        return int(self._warp_mesh.id)

    @property
    def origin(self) -> np.ndarray:
        """Origin of the local frame, the center of ``bounds`` in float64 [world], shape (3,).

        ``local = (world - origin) / scale``; the mesh lies in [-1, 1] there. Kernels that use :attr:`id` work in this
        frame.
        """
        return self._frame.origin.copy()

    @property
    def scale(self) -> float:
        """Length of one local unit [world]; ``local = (world - origin) / scale``."""
        return self._frame.scale

    @cached_property
    def audit(self) -> MeshAudit:
        """The :func:`geokit.mesh.audit` of this mesh, computed at the first access."""
        from geokit.mesh.topology.audit import audit_topology

        return audit_topology(self.mesh, self._topology)

    def __repr__(self) -> str:
        return f"Surface({self.mesh!r}, device={self.device!r})"
