"""How each of many meshes tells inside from outside: found for all at once where a mesh is one component."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.forks import Lock
from geokit.core.base.late_warp import wp
from geokit.core.equal_rows import merge_equal_points, repeated_triples
from geokit.core.memory.host_array import HostArray
from geokit.core.memory.struct_array import Parts, struct_array, struct_rows, struct_table
from geokit.mesh.bvh.forest import WIDTH, Forest
from geokit.mesh.bvh.winding_moments import NODE_GRAIN
from geokit.mesh.model.triangle_mesh import trusted_mesh
from geokit.mesh.sign.queries import FAR
from geokit.mesh.topology.connectivity import MeshTopology, Topology, collapsed_faces, connected_components
from geokit.mesh.topology.measures import DEGENERATE_RATIO, measure_each
from geokit.mesh.topology.orientation import FLAT_SHARE


class ForestSigns:
    """Sign methods, pseudonormals and winding numbers of many meshes.

    A mesh is simple if it is one component of faces that are wound alike, without repeated faces and edges of three
    faces. Topology, winding and self-intersections of simple meshes are found for all of them together, by the rules of
    :mod:`geokit.mesh.topology.orientation` and :mod:`geokit.mesh.sign.choice`. Others are asked one by one.

    Args:
        count: Number of meshes, B.
        device: Where queries run.
        arrays: Vertices (V, 3), faces (F, 3), the first face of each mesh and F (B + 1,), and bounding boxes (B, 2, 3);
            no two meshes share a vertex.
        uploaded: Vertices and faces on the device.
        forest: The trees, None on a GPU: no mesh counts as simple there.
        surface: Gives the surface of a mesh.
    """

    def __init__(
        self,
        count: int,
        device: "wp.Device",
        arrays: tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64], NDArray[np.float64]],
        uploaded: tuple["wp.array", "wp.array"],
        forest: Forest | None,
        surface: Callable[[int], Any],
    ) -> None:
        self._count, self._device, self._forest, self._surface = count, device, forest, surface
        self._vertices, self._faces, self._begin, self._bounds = arrays
        self._uploaded = uploaded
        self.simple = np.zeros(count, bool)
        self._closed = np.zeros(count, bool)
        self._flipped = np.zeros(len(self._faces), bool)
        self._flat = np.zeros(len(self._faces), bool)
        if forest is not None:
            self._find_simple()
        others = np.flatnonzero(~self.simple)
        # Meshes with faces that are left out where signs are decided; see left_out.py.
        self.apart = np.zeros(count, bool)
        for mesh in others:
            found = surface(int(mesh))
            self.apart[mesh] = found._signs is not found
            self._closed[mesh] = found.is_closed
        self._kept: dict[str, tuple[NDArray[np.bool_], NDArray[Any]]] = {}
        # Rows of tables are addresses, and this object keeps what is there: threads must not make a table twice.
        self._lock = Lock()

    def _find_simple(self) -> None:
        count = self._count
        owner = np.repeat(np.arange(count), np.diff(self._begin))
        corners = self._positions(owner)
        collapsed = collapsed_faces(corners)
        kept = np.flatnonzero(~collapsed)
        of_kept = owner[kept]
        self._corners, self._topology = corners, Topology(corners[kept], int(corners.max()) + 1)
        topology = self._topology

        def tells(meshes: NDArray[Any]) -> NDArray[np.bool_]:
            return np.bincount(meshes, minlength=count) > 0

        of_edge = of_kept[topology.order[topology.starts] // 3]
        one, other = topology.pairs
        component = connected_components(len(kept), one // 3, other // 3)
        components = np.bincount(of_kept[component == np.arange(len(kept))], minlength=count)
        self.simple = components == 1
        self.simple &= ~tells(owner[collapsed]) & ~tells(of_edge[topology.uses > 2])
        self.simple &= ~tells(of_kept[one[~topology.opposed] // 3]) & ~tells(owner[repeated_triples(corners)[0]])
        self._closed = self.simple & ~tells(of_edge[topology.uses == 1])
        twice_area, six_volume, longest_squared = measure_each(self._vertices, self._faces, self._begin, self._bounds)
        volume, area = (np.bincount(owner, values, minlength=count) for values in (six_volume, twice_area))
        self._flipped = (self._closed & (volume < 0.0) & (np.abs(volume) > FLAT_SHARE * area))[owner]
        of_position = np.empty(topology.position_count, np.int64)
        of_position[corners.ravel()] = np.repeat(owner, 3)
        self._sound = self._closed & ~tells(of_position[topology.split_vertices()])
        self._flat = twice_area <= DEGENERATE_RATIO * longest_squared
        self._sound &= ~tells(owner[self._flat])

    def _positions(self, owner: NDArray[np.int64]) -> NDArray[np.int32]:
        """Corners as numbers of distinct positions of each mesh, (F, 3)."""
        first, group = merge_equal_points(self._vertices)
        if len(first) == len(self._vertices):
            return self._faces
        mesh = np.zeros(len(self._vertices), np.int64)
        mesh[self._faces.ravel()] = np.repeat(owner, 3)
        number = np.unique(group * self._count + mesh, return_inverse=True)[1].ravel()
        return np.take(number.astype(np.int32), self._faces.ravel()).reshape(-1, 3)

    @cached_property
    def by_pseudonormal(self) -> NDArray[np.bool_]:
        """Meshes whose ``sign="auto"`` is by pseudonormals; that of others is by winding numbers."""
        chosen = np.zeros(self._count, bool)
        if self._forest is not None:
            sound = np.flatnonzero(self._sound)
            chosen[sound[~_self_intersecting(self._forest, sound)]] = True
        for mesh in np.flatnonzero(~(self.simple & self._closed)):
            chosen[mesh] = self._surface(int(mesh))._method("auto") == "pseudonormal"
        return chosen

    @cached_property
    def outside(self) -> NDArray[np.float64]:
        """Distance from which on all points are outside, (B,)."""
        half = (self._bounds[:, 1] * 0.5 - self._bounds[:, 0] * 0.5).max(axis=1)
        return np.where(self._closed, FAR * np.where(half > 0.0, half, 1.0), math.inf)

    @cached_property
    def outward(self) -> NDArray[np.int32]:
        """1 for faces whose winding shows outward, -1 inward, 0 for those without area, (F,)."""
        found = np.where(self._flat, 0, np.where(self._flipped, -1, 1)).astype(np.int32)
        for mesh in np.flatnonzero(~self.simple):
            found[self._begin[mesh] : self._begin[mesh + 1]] = self._surface(int(mesh))._outward
        return found

    @property
    def empty(self) -> NDArray[np.float64]:
        """Half width of the cube outside of which the winding number is 0 [local], (B,)."""
        return np.where(self._closed, 1.0, math.inf)

    def pseudonormals(self, meshes: NDArray[np.bool_]) -> NDArray[Any]:
        """The :class:`Pseudonormals` of some meshes; other rows may be empty."""
        from geokit.mesh.sign.pseudonormals_kernels import Pseudonormals

        def of_simple() -> NDArray[Any]:
            return self._simple_pseudonormals()

        return self._table("pseudonormals", Pseudonormals, meshes, of_simple, lambda found: found._pseudonormals)

    def windings(self, meshes: NDArray[np.bool_]) -> NDArray[Any]:
        """The :class:`WindingTree` of some meshes; other rows may be empty."""
        from geokit.mesh.bvh.winding_kernels import WindingTree

        def of_simple() -> NDArray[Any]:
            assert self._forest is not None
            return self._forest.windings(np.flatnonzero(self.simple), self._flipped)

        return self._table("windings", WindingTree, meshes, of_simple, lambda found: found._winding_tree)

    def _table(
        self,
        name: str,
        struct: Any,
        meshes: NDArray[np.bool_],
        of_simple: Callable[[], NDArray[Any]],
        of_surface: Callable[[Any], Any],
    ) -> NDArray[Any]:
        with self._lock:
            if name not in self._kept:
                some = self.simple.any()
                self._kept[name] = self.simple.copy(), of_simple() if some else struct_table(struct, self._count)
            done, table = self._kept[name]
            missing = np.flatnonzero(meshes & ~done)
            if len(missing):
                table[missing] = struct_rows(struct, (of_surface(self._surface(int(mesh))) for mesh in missing))
                done[missing] = True
            return table

    def _simple_pseudonormals(self) -> NDArray[Any]:
        from geokit.mesh.sign.pseudonormals import pseudonormal_tables
        from geokit.mesh.sign.pseudonormals_kernels import Pseudonormals

        whole = trusted_mesh(self._vertices, self._faces, "", ())
        topology = MeshTopology(
            self._corners, self._topology.position_count, collapsed_faces(self._corners), self._topology
        )
        tables = self._tables = pseudonormal_tables(whole, topology, self._flipped, *self._uploaded)
        # Triangles across edges are numbered from the first one of their mesh on.
        across = tables.across.numpy()
        across -= np.where(across >= 0, np.repeat(self._begin[:-1], 3 * np.diff(self._begin)), 0).astype(np.int32)
        assert isinstance(tables.faces, wp.array)
        return struct_table(
            Pseudonormals,
            self._count,
            vertices=tables.vertices,
            faces=Parts.between(tables.faces, self._begin, 3),
            flipped=Parts.between(tables.flipped, self._begin),
            across=Parts.between(tables.across, self._begin, 3),
            corner_normal=Parts.between(tables.corner_normal, self._begin, 3),
            vertex_normals=tables.vertex_normals,
        )


def _self_intersecting(forest: Forest, meshes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of some meshes have self-intersections, as :meth:`geokit.mesh.Surface.self_intersections` lists them."""
    from geokit.mesh.queries import intersecting_kernels as kernels

    device, count, slots = forest.device, len(forest.scales), int(forest.slots[-1])
    boxes: Any = wp.empty(6 * slots, dtype=wp.float32, device=device)
    found: Any = wp.zeros(count, dtype=wp.int32, device=device)
    table = struct_table(
        kernels.ForestBoxes,
        count,
        tree=forest.table,
        slot_boxes=Parts.between(boxes, forest.slots, 6),
        found=Parts.between(found, np.arange(count + 1)),
        unit=2.0 ** -np.round(np.log2(forest.scales)),
    )
    searches = struct_array(table, kernels.ForestBoxes, device)
    begin = HostArray(forest.slots.astype(np.int32))
    launcher.launch(kernels.forest_slot_boxes_kernel, slots, [begin], [searches], device)
    leaves = np.diff(forest.slots)[meshes] // WIDTH
    owner = np.repeat(meshes, leaves)
    leaf = np.arange(len(owner)) - np.repeat(np.cumsum(leaves) - leaves, leaves)
    items = [HostArray(values.astype(np.int32)) for values in (owner, leaf)]
    launcher.launch(kernels.forest_pairs_kernel, len(owner), items, [searches], device, grain=NODE_GRAIN)
    return np.asarray(found.numpy()[meshes] != 0)
