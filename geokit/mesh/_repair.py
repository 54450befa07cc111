"""Repairs that keep the shape: consistent winding, merged vertices, no faces without area."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import merge_equal_points, repeated_triples
from geokit.core.interop.types import MeshLike
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_flag
from geokit.errors import InputError
from geokit.mesh.attributes.derived import derived, moved_to_corners, used_vertices
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.topology.connectivity import collapsed_faces, position_corners
from geokit.mesh.topology.measures import faces_without_area


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


@needs(lambda mesh: 104 * mesh.face_count)
def orient(mesh: MeshLike) -> OrientedMesh:
    """Flip faces so that each component has one winding, solids outward and cavities inward.

    A component is a set of faces connected through edges of exactly two faces; sets that only together bound a volume
    count as one, such as bodies with a wall in common. Vertices at equal positions are one, as in :func:`audit`.

    - Within a component the smaller set of faces is flipped; with equal halves, the lowest face keeps its winding.
      One-sided components have no consistent winding: they are left as they are, and ``consistent`` is False.
    - Closed components, which bound a volume, are turned outward by the sign of that volume. Components inside another
      closed component turn along with the outermost one around them: cavities remain cavities, and a solid that is
      inside out as a whole is turned as a whole. A cavity must lie inside a solid: a component that would face inward
      where no other one winds around it is turned outward.
    - Open components keep the winding of the majority of their faces.

    Copies of a face (the same three positions) turn along with the first of them, so that those that lie back to back
    stay so; :func:`drop_degenerate` with ``duplicates=True`` leaves one of each. Faces with two equal corners stay as
    they are. Vertices, the order of the faces, name, parts and attributes do not change; also normals are those of the
    input. Meshes that are oriented already do not change, and the result for closed components does not depend on their
    winding in the input. Flipped faces have their corners in reverse order, with the attributes of the corners.

    Open components come out right if fewer than half of their faces were flipped, closed ones always.

    Args:
        mesh: The mesh; it may be empty.
    Returns:
        OrientedMesh with mesh, flipped (F,) and consistent.
    Example:
        >>> gk.mesh.orient(gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        ...     [[0, 2, 1], [0, 1, 3], [0, 3, 2], [3, 2, 1]])).flipped
        array([False, False, False,  True])
    """
    from geokit.mesh.surfaces.surface import Surface
    from geokit.mesh.topology.orientation import orient_faces

    mesh = require_mesh(mesh, "mesh")
    found = orient_faces(mesh, partial(Surface, device="cpu"))
    if not found.flipped.any():
        return OrientedMesh(mesh, found.flipped, found.consistent)
    faces = np.where(found.flipped[:, None], mesh.faces[:, ::-1], mesh.faces)
    turned = derived(mesh, mesh.vertices, faces, reversed_faces=found.flipped)
    return OrientedMesh(turned, found.flipped, found.consistent)


@needs(lambda mesh, **_: 100 * mesh.vertex_count)
def merge_vertices(mesh: MeshLike, *, tolerance: float = 0.0) -> TriangleMesh:
    """Merge vertices at the same position, or within a tolerance of each other.

    Vertices are processed in order. A vertex that is not merged yet stays where it is, and absorbs all later ones
    within the tolerance; distances are compared in float64, as in :class:`geokit.points.NeighborGrid`. So no corner
    moves farther than the tolerance, no two remaining vertices are within it, and chains of near vertices do not
    collapse. A vertex within the tolerance of several remaining ones is merged into the first.

    Vertices that no face uses are merged like the others. The number, order and parts of the faces do not change; some
    may have lost their area (see :func:`drop_degenerate`). An attribute in which merged vertices differ, such as
    texture coordinates at a seam, moves to ``corner_data``, where each corner keeps its value.

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
    """
    mesh = require_mesh(mesh, "mesh")
    tolerance = require_finite_scalar(tolerance, "tolerance")
    if tolerance < 0.0:
        raise InputError(f"tolerance: {tolerance:g} is not a distance; give 0 for equal positions only, or more")
    kept, group = merge_equal_points(mesh.vertices)
    if tolerance > 0.0 and len(kept) > 1:
        from geokit.mesh.topology.merge_near import merge_near_points

        stays, goes_to = merge_near_points(mesh.vertices[kept], tolerance)
        kept, group = kept[stays], goes_to[group]
    mesh = moved_to_corners(mesh, kept, group)
    # NumPy ends the process where indices of 32 bits find no memory for their cast; take() says so.
    return derived(mesh, mesh.vertices[kept], group.take(mesh.faces), vertex_source=kept)


@needs(lambda mesh, **_: 36 * mesh.face_count)
def drop_degenerate(mesh: MeshLike, *, duplicates: bool = False, unreferenced: bool = False) -> TriangleMesh:
    """Remove the faces without area.

    These are the faces that :func:`geokit.mesh.audit` counts as degenerate: two corners at one position, or a height
    under 1e-12 of the longest edge. A needle with three different corners may be the only face between its neighbors.
    Removing it leaves a slit of zero width between them: an open edge.

    The remaining faces keep their order and their parts; a part may become empty. Vertices are kept unless
    ``unreferenced`` is True. What remains keeps its attributes.

    Args:
        mesh: The mesh; it may be empty.
        duplicates: Also remove faces with the same three positions as an earlier one, in any order and either winding.
            Of faces that lie back to back (``MeshAudit.back_to_back_count``) the earlier one stays; :func:`orient` then
            gives all of them one winding.
        unreferenced: Also remove the vertices that no remaining face uses.
    Returns:
        TriangleMesh.
    Example:
        >>> gk.mesh.drop_degenerate(gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, 1]]))
        TriangleMesh(3 vertices, 1 faces)
    """
    mesh = require_mesh(mesh, "mesh")
    require_flag(duplicates, "duplicates")
    require_flag(unreferenced, "unreferenced")
    corners, _ = position_corners(mesh)
    keep = ~(faces_without_area(mesh) | collapsed_faces(corners))
    if duplicates:
        keep[repeated_triples(corners)[0]] = False
    faces, vertices, used = mesh.faces[keep], mesh.vertices, None
    if unreferenced:
        used, faces = used_vertices(faces, len(vertices))
        vertices = vertices[used]
    return derived(mesh, vertices, faces, vertex_source=used, face_source=np.flatnonzero(keep))
