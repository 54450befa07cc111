"""Invariants of decimation: the topology of a mesh, and the directions of its normals."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.surface import Surface
from geokit.mesh.topology.audit import audit_topology
from geokit.mesh.topology.connectivity import MeshTopology, connected_components, mesh_topology, next_half_edge

# Faces whose neighborhoods are listed at once.
BLOCK = 1024


class Shape(NamedTuple):
    """Topological invariants of a mesh; decimation keeps the first six and must not increase the others."""

    watertight: bool
    manifold: bool
    oriented: bool
    component_count: int
    euler_number: int
    boundary_loop_count: int
    non_manifold_edge_count: int
    non_manifold_vertex_count: int
    degenerate_count: int
    duplicate_count: int

    def is_kept_by(self, other: Shape) -> bool:
        """Whether this mesh may become the other one.

        If edges have more than two faces, loops and the Euler number mean little: components and defects are compared.
        """
        kept = 6 if self.non_manifold_edge_count == 0 else 4
        return self[:kept] == other[:kept] and all(b <= a for a, b in zip(self[6:], other[6:], strict=True))


def shape_of(mesh: TriangleMesh) -> Shape:
    whole = mesh_topology(mesh)
    report = audit_topology(mesh, whole)
    named = {name: getattr(report, name) for name in Shape._fields if name != "boundary_loop_count"}
    return Shape(**named, boundary_loop_count=_boundary_loops(whole))


def _boundary_loops(whole: MeshTopology) -> int:
    """Number of components of the boundary that share no position."""
    edges = whole.edges
    if edges.boundary_count == 0:
        return 0
    half_edge = edges.order[edges.starts[edges.uses == 1]]
    end = edges.start[next_half_edge(half_edge)]
    position, at = np.unique(np.concatenate([edges.start[half_edge], end]), return_inverse=True)
    label = connected_components(len(position), at[: len(half_edge)], at[len(half_edge) :])
    return int(np.count_nonzero(label == np.arange(len(position))))


def turned_faces(mesh: TriangleMesh, original: Surface, distance: float) -> NDArray[np.int64]:
    """Faces that have no original face near their center whose normal differs by less than 90 degrees.

    Args:
        mesh: The mesh to check.
        original: The original surface.
        distance: Search distance [world], along each axis.
    """
    middle, normal = mesh.vertices[mesh.faces].mean(axis=1), mesh.face_normals
    before = original.mesh.face_normals
    left = np.flatnonzero(_cosines(normal, before[original.closest_point(middle).triangle_id]) <= 0.0)
    alike = alike_near(original, before, middle[left], normal[left], np.full(len(left), distance))
    none = [block[np.bincount(row, minlength=len(block)) == 0] for block, row, _ in alike]
    return left[np.concatenate([*none, np.zeros(0, np.int64)])]


def alike_near(
    original: Surface,
    facing: NDArray[np.float64],
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    distance: NDArray[np.float64],
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32]]]:
    """Triangles near points that face the same way: their normals differ by less than 90 degrees.

    The nearest one may be the other side of a thin wall, or the flank of a bump.

    Args:
        original: The surface.
        facing: Normals of its triangles.
        points: Points (N, 3).
        normals: Where each point's surface faces (N, 3).
        distance: Search distance [world] of each point, along each axis.
    Yields:
        Rows of a block of points, and pairs: the row within the block, and the triangle.
    """
    for begin in range(0, len(points), BLOCK):
        block = np.arange(begin, min(begin + BLOCK, len(points)))
        around = distance[block, None]
        near: Any = original.overlapping(points[block] - around, points[block] + around)
        row = np.repeat(np.arange(len(block)), np.diff(near.offsets))
        alike = _cosines(normals[block[row]], facing[near.triangle_id]) > 0.0
        yield block, row[alike], near.triangle_id[alike]


def _cosines(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.einsum("ij,ij->i", a, b))
