"""Repairs that keep the shape: one winding, one vertex for each place, no faces without area."""

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
    """A mesh and how it came to its winding.

    Attributes:
        mesh: The mesh with some faces turned.
        flipped: The faces that were turned, (F,) bool.
        consistent: Every piece winds alike; False where the mesh has a one-sided piece such as a Möbius strip.
    """

    mesh: TriangleMesh
    flipped: NDArray[np.bool_]
    consistent: bool


def orient(mesh: TriangleMesh) -> OrientedMesh:
    """Turn faces so that each piece winds alike, solids outward and cavities inward.

    A piece is the faces that hang together through edges of exactly two faces, by position as in
    :func:`geokit.mesh.audit`.

    - The faces of a piece are made to wind alike by turning the fewest of them; where half of them would do either
      way, the lowest face stays. One-sided pieces cannot wind alike: they are left as they are, and ``consistent`` is
      False.
    - Closed pieces, which bound a volume, are turned outward by the sign of that volume. Those within another closed
      piece turn along with the outermost one around them, so that cavities remain cavities, and a solid that is inside
      out as a whole is turned as a whole; but a cavity needs something to be a cavity in: a piece that would face
      inward where no other winds around it is turned outward.
    - Open pieces stay the way most of their faces wind.

    Copies of a face (the same three positions) turn along with the first of them; faces with two equal corners stay.
    Vertices, the order of the faces, name and parts stay. What is oriented already stays as it is, and closed pieces
    come out the same whichever way they are given (tests/mesh/topology/test_repair_property.py). Turned faces have
    their corners in reverse.

    Open pieces come out right while fewer than half of their faces were flipped, closed ones always. Held by
    tests/accuracy/stability/test_envelopes.py.

    Args:
        mesh: The mesh; it may be empty.
    Returns:
        OrientedMesh with mesh, flipped (F,) and consistent.
    Example:
        >>> gk.mesh.orient(gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        ...     [[0, 2, 1], [0, 1, 3], [0, 3, 2], [3, 2, 1]])).flipped
        array([False, False, False,  True])
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
    """One vertex in place of several at the same position, or within a tolerance.

    Vertices are taken in their order: each that is not yet taken stays where it is, and takes those after it that are
    within the tolerance (distances are compared in float64, as :class:`geokit.points.NeighborGrid` does). So no corner
    moves farther than the tolerance, no two vertices that remain are within it, and chains of near vertices do not run
    together; a vertex within the tolerance of several that stay goes to the first of them
    (tests/mesh/topology/test_repair_property.py).

    Vertices that no face uses are vertices like the others. Faces keep their number, order and parts: some may have
    lost their area (:func:`drop_degenerate`).

    Right for tolerances between the distance of vertices that belong together and 0.9 of the shortest edge. Held by
    tests/accuracy/stability/test_envelopes.py.

    Args:
        mesh: The mesh; it may be empty.
        tolerance: Distance [world] within which vertices become one; 0 for equal positions only (-0.0 equals 0.0).
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
    """The mesh without its faces that have no area.

    Those are the faces that :func:`geokit.mesh.audit` counts as degenerate: with two corners at one position, or of a
    height under 1e-12 of their longest edge. A needle whose corners differ may be the only face between its neighbours,
    and then leaves a slit of no width between them: an open edge.

    The faces that remain keep their order, and their parts, which may come out empty. Vertices stay as they are unless
    asked for, so that data on vertices stays with them.

    Args:
        mesh: The mesh; it may be empty.
        duplicates: Drop also the faces on the same three positions as an earlier one, in any order, whichever way they
            wind.
        unreferenced: Drop also the vertices that no remaining face uses.
    Returns:
        TriangleMesh.
    Example:
        >>> gk.mesh.drop_degenerate(gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, 1]]))
        TriangleMesh(3 vertices, 1 faces)
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
    """The ranges of faces that remain of each part."""
    before = np.concatenate([[0], np.cumsum(keep)])
    ends = [(int(before[p.first_face]), int(before[p.first_face + p.face_count])) for p in parts]
    return tuple(MeshPart(p.name, begin, end - begin) for p, (begin, end) in zip(parts, ends, strict=True))
