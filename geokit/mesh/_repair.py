"""Repairs that keep the shape: consistent winding, merged vertices, no faces without area."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import merge_equal_points, repeated_triples
from geokit.core.user_arrays import require_finite_scalar
from geokit.errors import InputError
from geokit.mesh._model import MeshPart, TriangleMesh
from geokit.mesh.topology.connectivity import collapsed_faces, position_corners
from geokit.mesh.topology.measures import faces_without_area

__all__ = ["OrientedMesh", "drop_degenerate", "merge_vertices", "orient"]


class OrientedMesh(NamedTuple):
    """A mesh with consistent winding, and the faces that were flipped for it.

    Attributes:
        mesh: The mesh with some faces flipped.
        flipped: The flipped faces, (F,) bool.
        consistent: True if every component has one winding; False if one is one-sided, such as a Möbius strip.
    """

    mesh: TriangleMesh
    flipped: NDArray[np.bool_]
    consistent: bool


def orient(mesh: TriangleMesh) -> OrientedMesh:
    """Flip faces so that each component has one winding, solids outward and cavities inward.

    A component is a set of faces connected through edges of exactly two faces. Vertices at equal positions count as
    one, as in :func:`geokit.mesh.audit`.

    - Within a component the smaller set of faces is flipped; with equal halves, the lowest face keeps its winding.
      One-sided components have no consistent winding: they are left as they are, and ``consistent`` is False.
    - Closed components, which bound a volume, are turned outward by the sign of that volume. Components inside another
      closed component turn along with the outermost one around them: cavities remain cavities, and a solid that is
      inside out as a whole is turned as a whole. A cavity must lie inside a solid: a component that would face inward
      where no other one winds around it is turned outward.
    - Open components keep the winding of the majority of their faces.

    Copies of a face (the same three positions) turn along with the first of them. Faces with two equal corners stay as
    they are. Vertices, the order of the faces, name and parts do not change. Meshes that are oriented already do not
    change, and the result for closed components does not depend on their winding in the input. Flipped faces have their
    corners in reverse order.

    Open components come out right if fewer than half of their faces were flipped, closed ones always.

    Args:
        mesh: The mesh; it may be empty.
    Returns:
        OrientedMesh with mesh, flipped (F,) and consistent.
    Example:
        >>> gk.mesh.orient(gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        ...     [[0, 2, 1], [0, 1, 3], [0, 3, 2], [3, 2, 1]])).flipped
        array([False, False, False,  True])

    Held by: tests/mesh/topology/test_repair_property.py, tests/accuracy/stability/test_envelopes.py
    """
    from geokit.mesh._surface import Surface
    from geokit.mesh.topology.orientation import orient_faces

    found = orient_faces(mesh, partial(Surface, device="cpu"))
    if not found.flipped.any():
        return OrientedMesh(mesh, found.flipped, found.consistent)
    faces = np.where(found.flipped[:, None], mesh.faces[:, ::-1], mesh.faces)
    turned = TriangleMesh(mesh.vertices, faces, name=mesh.name, parts=mesh.parts)
    return OrientedMesh(turned, found.flipped, found.consistent)


def merge_vertices(mesh: TriangleMesh, *, tolerance: float = 0.0) -> TriangleMesh:
    """Merge vertices at the same position, or within a tolerance of each other.

    Vertices are processed in order. A vertex that is not merged yet stays where it is, and absorbs all later ones
    within the tolerance; distances are compared in float64, as in :class:`geokit.points.NeighborGrid`. So no corner
    moves farther than the tolerance, no two remaining vertices are within it, and chains of near vertices do not
    collapse. A vertex within the tolerance of several remaining ones is merged into the first.

    Vertices that no face uses are merged like the others. The number, order and parts of the faces do not change; some
    may have lost their area (see :func:`drop_degenerate`).

    The result is right for tolerances between the distance of vertices that belong together and 0.9 of the shortest
    edge.

    Args:
        mesh: The mesh; it may be empty.
        tolerance: Distance [world] within which vertices are merged; 0 for equal positions only (-0.0 equals 0.0).
    Returns:
        TriangleMesh.
    Raises:
        InputError: tolerance is not a finite number, is negative, or is so large that the average vertex has hundreds
            of others within it.
        DeviceMemoryError: The pairs of vertices within the tolerance do not fit in memory.
    Example:
        >>> soup = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        ...     [[0, 1, 2], [3, 4, 5]])
        >>> gk.mesh.merge_vertices(soup)
        TriangleMesh(4 vertices, 2 faces)

    Held by: tests/mesh/topology/test_repair_property.py, tests/accuracy/stability/test_envelopes.py
    """
    tolerance = require_finite_scalar(tolerance, "tolerance")
    if tolerance < 0.0:
        raise InputError(f"tolerance: {tolerance:g} is not a distance; give 0 for equal positions only, or more")
    kept, group = merge_equal_points(mesh.vertices)
    if tolerance > 0.0 and len(kept) > 1:
        from geokit.mesh.topology.merge_near import merge_near_points

        stays, goes_to = merge_near_points(mesh.vertices[kept], tolerance)
        kept, group = kept[stays], goes_to[group]
    return TriangleMesh(mesh.vertices[kept], group[mesh.faces], name=mesh.name, parts=mesh.parts)


def drop_degenerate(mesh: TriangleMesh, *, duplicates: bool = False, unreferenced: bool = False) -> TriangleMesh:
    """Remove the faces without area.

    These are the faces that :func:`geokit.mesh.audit` counts as degenerate: two corners at one position, or a height
    under 1e-12 of the longest edge. A needle with three different corners may be the only face between its neighbors.
    Removing it leaves a slit of zero width between them: an open edge.

    The remaining faces keep their order and their parts; a part may become empty. Vertices are kept unless
    ``unreferenced`` is True, so that data on vertices stays valid.

    Args:
        mesh: The mesh; it may be empty.
        duplicates: Also remove faces with the same three positions as an earlier one, in any order and either winding.
        unreferenced: Also remove the vertices that no remaining face uses.
    Returns:
        TriangleMesh.
    Example:
        >>> gk.mesh.drop_degenerate(gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, 1]]))
        TriangleMesh(3 vertices, 1 faces)

    Held by: tests/mesh/topology/test_repair.py
    """
    corners, _ = position_corners(mesh)
    keep = ~(faces_without_area(mesh) | collapsed_faces(corners))
    if duplicates:
        keep[repeated_triples(corners)[0]] = False
    faces, vertices = mesh.faces[keep], mesh.vertices
    if unreferenced:
        used = np.zeros(len(vertices), bool)
        used[faces] = True
        faces, vertices = (np.cumsum(used) - 1)[faces], vertices[used]
    return TriangleMesh(vertices, faces, name=mesh.name, parts=_kept_parts(mesh.parts, keep))


def _kept_parts(parts: tuple[MeshPart, ...], keep: NDArray[np.bool_]) -> tuple[MeshPart, ...]:
    """The parts with the face ranges that remain of them."""
    before = np.concatenate([[0], np.cumsum(keep)])
    ends = [(int(before[p.first_face]), int(before[p.first_face + p.face_count])) for p in parts]
    return tuple(MeshPart(p.name, begin, end - begin) for p, (begin, end) in zip(parts, ends, strict=True))
