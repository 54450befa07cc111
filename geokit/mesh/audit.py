"""What a mesh is fit for: closedness, manifoldness, orientation, defects, volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh._merge import merge_equal_points, merge_equal_rows
from geokit.mesh.model import TriangleMesh

__all__ = ["MeshAudit", "audit"]

# A triangle whose height is under this share of its longest edge has no area: float64 coordinates as far away as 1e4
# edges give the height that much noise, so that its normal is made of rounding alone.
DEGENERATE_RATIO = 1e-12


@dataclass(frozen=True)
class MeshAudit:
    """The findings of :func:`audit`.

    Topology is that of the positions: vertices at exactly equal coordinates count as one, whatever their indices, and
    a triangle with two equal corners takes no part in it.

    Args:
        vertex_count: Vertices of the mesh, V.
        face_count: Triangles of the mesh, F.
        component_count: Pieces that share no vertex position with each other.
        boundary_edge_count: Edges of one triangle only.
        non_manifold_edge_count: Edges of three or more triangles.
        watertight: There are faces, and no boundary and no non-manifold edges.
        manifold: No non-manifold edges, and the triangles around each vertex form a single fan.
        oriented: Each edge of exactly two triangles is used once in each direction.
        degenerate_count: Triangles without area (height under 1e-12 of the longest edge).
        duplicate_count: Triangles on the same three positions as an earlier one, in any order.
        coincident_count: Vertices at exactly the position of an earlier one.
        unreferenced_count: Vertices that no face uses.
        signed_volume: Volume [world^3], positive where faces wind counter-clockwise seen from outside; it means
            something only where the mesh is closed and oriented.
        inside_out: Watertight and oriented with a negative signed volume.
        area: Sum of the triangles' areas [world^2].
        bounds: Lower and upper corner [world] of the used vertices, shape (2, 3); NaN without faces.
        diagonal: Length of the bounds' diagonal [world]; NaN without faces.
        euler_number: Vertices - edges + faces; 2 for each closed component without handles.
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
    coincident_count: int
    unreferenced_count: int
    signed_volume: float
    inside_out: bool
    area: float
    bounds: NDArray[np.float64]
    diagonal: float
    euler_number: int


def audit(mesh: TriangleMesh) -> MeshAudit:
    """Defects, topology and measures of a mesh; see :class:`MeshAudit` for each.

    Counts are exact. Area and volume are summed in float64 relative to the middle of the bounds: relative error under
    1e-12 for up to a million faces, also far away from the origin as far as the coordinates' own digits go.

    Args:
        mesh: The mesh; it may be empty.
    Returns:
        MeshAudit.
    Example:
        >>> audit(geokit.mesh.load("data/samples/bracket.obj")).watertight
        True
    """
    _, group = merge_equal_points(mesh.vertices)
    faces = group[mesh.faces]
    collapsed = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    distinct, _ = merge_equal_rows(np.sort(faces, axis=1))
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces] = True
    bounds = _bounds(mesh.vertices[used])
    area, volume, flat = _measures(mesh, bounds)
    position_count = int(group.max(initial=-1)) + 1
    topology = _Topology(faces[~collapsed], position_count)
    has_faces = len(mesh.faces) > 0
    watertight = has_faces and topology.boundary_count == 0 and topology.non_manifold_count == 0
    return MeshAudit(
        vertex_count=len(mesh.vertices),
        face_count=len(mesh.faces),
        component_count=topology.component_count(faces),
        boundary_edge_count=topology.boundary_count,
        non_manifold_edge_count=topology.non_manifold_count,
        watertight=watertight,
        manifold=topology.non_manifold_count == 0 and topology.single_fans(),
        oriented=topology.oriented,
        degenerate_count=int(np.count_nonzero(flat | collapsed)),
        duplicate_count=len(faces) - len(distinct),
        coincident_count=len(mesh.vertices) - position_count,
        unreferenced_count=int(np.count_nonzero(~used)),
        signed_volume=volume,
        inside_out=watertight and topology.oriented and volume < 0.0,
        area=area,
        bounds=bounds,
        diagonal=_diagonal(bounds),
        euler_number=topology.vertex_count - topology.edge_count + len(topology.faces),
    )


def _bounds(points: NDArray[np.float64]) -> NDArray[np.float64]:
    if len(points) == 0:
        return np.full((2, 3), np.nan)
    # Axis by axis: NumPy's reductions over the long axis of an (N, 3) array are ten times slower.
    return np.array([[points[:, axis].min() for axis in range(3)], [points[:, axis].max() for axis in range(3)]])


def _diagonal(bounds: NDArray[np.float64]) -> float:
    half = bounds[1] * 0.5 - bounds[0] * 0.5
    size = float(np.max(half))
    # At unit size: the squares of 1e200 overflow, those of 1e-200 vanish.
    return 2.0 * size * float(np.linalg.norm(half / size)) if size > 0.0 else size


def _measures(mesh: TriangleMesh, bounds: NDArray[np.float64]) -> tuple[float, float, NDArray[np.bool_]]:
    """Area, signed volume, and the triangles without area (F,)."""
    if len(mesh.faces) == 0:
        return 0.0, 0.0, np.zeros(0, bool)
    lower, upper = bounds
    middle = lower * 0.5 + upper * 0.5
    size = float(np.max(upper * 0.5 - lower * 0.5)) or 1.0
    # At unit size: products of lengths must neither overflow nor underflow.
    # Unused vertices may lie anywhere, also where this overflows.
    with np.errstate(over="ignore"):
        local = (mesh.vertices - middle) / size
    a, b, c = (local[mesh.faces[:, corner]] for corner in range(3))
    ab, ac = b - a, c - a
    cross = np.cross(ab, ac)
    twice = np.sqrt(np.einsum("ij,ij->i", cross, cross))
    bc = c - b
    longest = np.einsum("ij,ij->i", ab, ab)
    for edge in (ac, bc):
        np.maximum(longest, np.einsum("ij,ij->i", edge, edge), out=longest)
    # a . (ab x ac) is six times the volume of the tetrahedron with the middle.
    volume = float(np.einsum("ij,ij->i", a, cross).sum()) / 6.0
    # Python's products go to inf where its powers raise.
    return float(twice.sum()) / 2.0 * size * size, volume * size * size * size, twice <= DEGENERATE_RATIO * longest


class _Topology:
    """Edges of faces (F, 3) whose three corners differ."""

    def __init__(self, faces: NDArray[np.int64], position_count: int) -> None:
        self.faces = faces
        start, end = faces.ravel(), faces[:, (1, 2, 0)].ravel()
        low, high = np.minimum(start, end), np.maximum(start, end)
        # Half-edges of one edge stand together after one sort of one key.
        keys = low * position_count + high
        self.order = np.argsort(keys)
        ordered = keys[self.order]
        self.starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]])) if len(keys) else keys
        self.uses = np.diff(np.append(self.starts, len(keys)))
        self.forward = (start < end)[self.order]
        self.edge_count = len(self.starts)
        self.boundary_count = int(np.count_nonzero(self.uses == 1))
        self.non_manifold_count = int(np.count_nonzero(self.uses > 2))
        self.vertex_count = int(np.count_nonzero(np.bincount(start, minlength=position_count))) if len(keys) else 0

    @property
    def oriented(self) -> bool:
        pairs = self.starts[self.uses == 2]
        return len(self.faces) > 0 and bool(np.all(self.forward[pairs] != self.forward[pairs + 1]))

    def component_count(self, faces: NDArray[np.int64]) -> int:
        """Pieces of ``faces``, the collapsed ones included: a piece of such faces only is a piece too."""
        if len(faces) == 0:
            return 0
        label = _components(int(faces.max()) + 1, faces[:, (0, 1)].ravel(), faces[:, (1, 2)].ravel())
        used = np.zeros(len(label), bool)
        used[faces] = True
        return int(np.count_nonzero(used & (label == np.arange(len(label)))))

    def single_fans(self) -> bool:
        """Whether the faces at each vertex hang together through edges at that vertex."""
        if len(self.faces) == 0:
            return False
        # Nodes are the corners of faces, numbered 3 * face + corner; the half-edge of the same number starts there.
        pairs = self.starts[self.uses == 2]
        one, other = self.order[pairs], self.order[pairs + 1]
        one_end, other_end = _next_corner(one), _next_corner(other)
        opposed = self.forward[pairs] != self.forward[pairs + 1]
        # Corners at the same vertex: start and end meet where the two faces run against each other.
        links = np.where(opposed, other_end, other), np.where(opposed, other, other_end)
        label = _components(3 * len(self.faces), np.concatenate([one, one_end]), np.concatenate(links))
        return int(np.count_nonzero(label == np.arange(len(label)))) == self.vertex_count


def face_parts(mesh: TriangleMesh) -> NDArray[Any]:
    """For each face the label of its piece of the mesh, (F,): pieces share no vertex position with each other."""
    _, group = merge_equal_points(mesh.vertices)
    faces = group[mesh.faces]
    label = _components(int(faces.max()) + 1, faces[:, (0, 1)].ravel(), faces[:, (1, 2)].ravel())
    return label[faces[:, 0]]


def _next_corner(corner: NDArray[np.int64]) -> NDArray[np.int64]:
    return corner - corner % 3 + (corner + 1) % 3


def _components(count: int, one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
    """Label (count,) of each node's component under the links ``one[i] - other[i]``: its lowest node.

    Source:
        Shiloach and Vishkin, An O(log n) parallel connectivity algorithm (1982). Differs: roots hook onto the lowest
        neighbouring root, and paths are halved to the end before the next round.
    """
    # Half the bytes, half the time: the rounds are bound by memory.
    dtype = np.int32 if count <= np.iinfo(np.int32).max else np.int64
    label, one, other = np.arange(count, dtype=dtype), one.astype(dtype), other.astype(dtype)
    while len(one):
        a, b = label[one], label[other]
        apart = a != b
        # Links within a component have nothing more to say.
        one, other = one[apart], other[apart]
        np.minimum.at(label, np.maximum(a, b)[apart], np.minimum(a, b)[apart])
        while True:
            jumped = label[label]
            if np.array_equal(jumped, label):
                break
            label = jumped
    return label
