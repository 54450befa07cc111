"""Audit of a mesh from its topology: counts and measures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import repeated_triples
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.topology.connectivity import MeshTopology, connected_components, position_corners
from geokit.mesh.topology.doubled_faces import back_to_back_pairs
from geokit.mesh.topology.measures import FaceMeasures, measure_faces

# Minimum, quartiles, maximum.
ASPECT_QUANTILES = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class MeshAudit:
    """The result of :func:`geokit.mesh.audit`.

    Topology is that of positions: vertices with exactly equal coordinates count as one, whatever their indices, and
    triangles with two equal corners are ignored.

    Args:
        vertex_count: Vertices of the mesh, V.
        face_count: Triangles of the mesh, F.
        component_count: Components that share no vertex position with each other.
        boundary_edge_count: Edges of only one triangle.
        non_manifold_edge_count: Edges of three or more triangles.
        watertight: There are faces, and no boundary and no non-manifold edges.
        manifold: No non-manifold edges, and the triangles around each vertex form a single fan.
        oriented: Each edge of exactly two triangles is used once in each direction.
        non_manifold_vertex_count: Positions whose triangles do not form a single fan: ends of edges of three or more
            triangles, and points where components only touch.
        degenerate_count: Triangles without area (height under 1e-12 of the longest edge).
        duplicate_count: Triangles with the same three positions as an earlier one, in any order.
        back_to_back_count: Pairs of triangles with the same three positions and opposite windings, as of files in which
            each face is doubled. They cancel in a winding number; :class:`geokit.mesh.Surface` counts those of closed
            components once.
        coincident_count: Vertices at exactly the position of an earlier one.
        unreferenced_count: Vertices that no face uses.
        signed_volume: Volume [world^3], positive where faces wind counterclockwise seen from outside; meaningful only
            for closed and oriented meshes.
        inside_out: Watertight and oriented with a negative signed volume.
        area: Sum of the triangles' areas [world^2].
        bounds: Lower and upper corner [world] of the used vertices, shape (2, 3); NaN without faces.
        diagonal: Length of the bounds' diagonal [world]; NaN without faces.
        euler_number: Vertices - edges + faces; 2 for each closed component without handles.
        aspect_ratio_quantiles: Aspect ratios at the quantiles 0, 1/4, 1/2, 3/4 and 1, shape (5,), each that of the
            nearest triangle. The aspect ratio is the longest edge over 2 sqrt(3) times the inradius: 1 for
            equilateral triangles, infinite for those without area. NaN without faces.
        self_intersection_count: Pairs of triangles that intersect beyond the vertex or edge that they share, as listed
            by :meth:`geokit.mesh.Surface.self_intersections`; None if they were not counted.
    """

    vertex_count: int
    face_count: int
    component_count: int
    boundary_edge_count: int
    non_manifold_edge_count: int
    watertight: bool
    manifold: bool
    oriented: bool
    degenerate_count: int
    duplicate_count: int
    back_to_back_count: int
    coincident_count: int
    unreferenced_count: int
    signed_volume: float
    inside_out: bool
    area: float
    bounds: NDArray[np.float64]
    diagonal: float
    euler_number: int
    non_manifold_vertex_count: int
    aspect_ratio_quantiles: NDArray[np.float64]
    self_intersection_count: int | None


def audit_topology(mesh: TriangleMesh, whole: MeshTopology) -> MeshAudit:
    """The audit of a mesh whose topology is known."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces.reshape(-1)] = True
    bounds = mesh.bounds
    measures = measure_faces(mesh, bounds)
    corners, position_count, collapsed, topology = whole
    split_count = len(topology.split_vertices())
    has_faces = len(mesh.faces) > 0
    watertight = has_faces and topology.boundary_count == 0 and topology.non_manifold_count == 0
    component_count = topology.piece_count(corners[collapsed])
    repeats, repeated = repeated_triples(corners)
    spread = ~collapsed[repeats]
    pairs = back_to_back_pairs(corners, repeats[spread], repeated[spread])[1] if spread.any() else repeats[:0]
    flat = measures.flat | collapsed
    area, volume = area_and_volume(measures)
    return MeshAudit(
        vertex_count=len(mesh.vertices),
        face_count=len(mesh.faces),
        component_count=component_count,
        boundary_edge_count=topology.boundary_count,
        non_manifold_edge_count=topology.non_manifold_count,
        watertight=watertight,
        manifold=len(topology.faces) > 0 and topology.non_manifold_count == 0 and split_count == 0,
        oriented=topology.oriented,
        non_manifold_vertex_count=split_count,
        degenerate_count=int(np.count_nonzero(flat)),
        duplicate_count=len(repeats),
        back_to_back_count=int(pairs.sum()),
        coincident_count=len(mesh.vertices) - position_count,
        unreferenced_count=int(np.count_nonzero(~used)),
        signed_volume=volume,
        inside_out=watertight and topology.oriented and volume < 0.0,
        area=area,
        bounds=bounds,
        diagonal=diagonal_of(bounds),
        euler_number=topology.vertex_count - topology.edge_count + len(topology.faces),
        aspect_ratio_quantiles=_aspect_ratio_quantiles(measures, flat),
        self_intersection_count=None,
    )


def face_parts(mesh: TriangleMesh) -> NDArray[Any]:
    """The component label of each face, (F,); components share no vertex position with each other."""
    corners, position_count = position_corners(mesh)
    label = connected_components(position_count, corners[:, (0, 1)].ravel(), corners[:, (1, 2)].ravel())
    return np.take(label, corners[:, 0])


def area_and_volume(measures: FaceMeasures) -> tuple[float, float]:
    """Area and signed volume [world]."""
    size = measures.size
    # Products, because Python's powers raise OverflowError where products give inf.
    area = float(measures.twice_area.sum()) / 2.0 * size * size
    return area, float(measures.six_volume.sum()) / 6.0 * size * size * size


def aspect_ratios(measures: FaceMeasures, flat: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Aspect ratio of each face, (F,); infinite for those without area."""
    # The inradius is twice the area over the perimeter.
    longest = np.sqrt(measures.longest_squared)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        aspect: NDArray[np.float64] = longest * measures.perimeter / (2.0 * math.sqrt(3.0) * measures.twice_area)
    aspect[flat] = np.inf
    return aspect


def _aspect_ratio_quantiles(measures: FaceMeasures, flat: NDArray[np.bool_]) -> NDArray[np.float64]:
    count = len(flat)
    if count == 0:
        return np.full(len(ASPECT_QUANTILES), np.nan)
    aspect = aspect_ratios(measures, flat)
    # Each quantile is that of one triangle: between a finite and an infinite ratio there is nothing to interpolate.
    rank = [round(quantile * (count - 1)) for quantile in ASPECT_QUANTILES]
    return np.partition(aspect, rank)[rank]


def diagonal_of(bounds: NDArray[np.float64]) -> float:
    """Length of the diagonal of bounds (2, 3)."""
    half = bounds[1] * 0.5 - bounds[0] * 0.5
    size = float(np.max(half))
    # At unit size: the squares of 1e200 overflow, those of 1e-200 underflow.
    return 2.0 * size * float(np.linalg.norm(half / size)) if size > 0.0 else size
