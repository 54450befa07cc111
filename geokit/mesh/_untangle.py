"""Self-intersections removed: faces that cross others are cut out in discs, and these are filled anew."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop.types import MeshLike
from geokit.core.memory.needs import needs
from geokit.core.require import require_count
from geokit.errors import InputError
from geokit.mesh._fill_holes import rim_points, unclashing, with_patches
from geokit.mesh._hausdorff import hausdorff
from geokit.mesh.attributes.derived import derived
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.simplification.invariants import shape_of
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.surfaces.surface import Surface
from geokit.mesh.topology.connectivity import MeshTopology, Topology, connected_components, mesh_topology
from geokit.mesh.topology.measures import faces_without_area
from geokit.mesh.topology.normals import face_normals
from geokit.mesh.topology.rims import edges_within, find_rims

# Width of the bounds of the deviation, as a share of the mesh's diagonal.
BOUND_SHARE = 1e-5


class Untangled(NamedTuple):
    """A mesh without self-intersections, and what was done to it.

    Attributes:
        mesh: The mesh: the faces of the input that were not cut in their order, those of a patch where its disc was.
        patch: The disc that each face fills, (F,) int32; -1 for faces of the input.
        faces_cut: Faces of the input that are gone.
        places: Discs that were cut out and filled.
        deviation: Upper bound of the Hausdorff distance between both surfaces [world]: no point of either surface is
            farther from the other. 0 if the mesh is unchanged.
    """

    mesh: TriangleMesh
    patch: NDArray[np.int32]
    faces_cut: int
    places: int
    deviation: float


@needs(lambda mesh, **_: 700 * mesh.face_count, late=True)
def remove_self_intersections(mesh: MeshLike, *, rings: int = 8) -> Untangled:
    """Remove the places where a body crosses itself: they are cut out and filled, and the result is proven.

    Faces that cross others (exact predicates) are cut out with a ring of the faces around them, and with what they cut
    off. The holes are filled as by :func:`fill_holes`: triangles of least area between the points of the rims. Where
    that cannot be had without crossings, 2, 4, ... rings are cut, place by place. A mesh is returned only if

    - no two of its faces intersect, as :meth:`geokit.mesh.Surface.self_intersections` counts them;
    - each piece that was cut is a disc, and a disc again, with the same rim: components, handles and borders are those
      of the input; of no body more than half of the faces are cut;
    - no more edges have three faces, and no more faces are without area or repeated.

    Else nothing is done, and the error says how many places are left. ``deviation`` is proven for all points of the
    triangles, as in :func:`hausdorff`. A part that is folded or turned inside out comes back as a flat patch, as all
    that is certain there is the rim. Borders of sheets are rims too, and stay where they are.

    All else stays: the other faces are the same ones in the same order, and all vertices are there, also those that no
    face uses any more (:func:`drop_degenerate` removes them). Patches have the attributes and the part of a face at
    their rim, and their corners those of the rim's corners. The faces at a rim have to be wound alike, as by
    :func:`orient`.

    Args:
        mesh: The mesh; it may be empty.
        rings: Most rings of faces that are cut around those that cross, 1 or more; what they cut off is no farther.
    Returns:
        Untangled with mesh, patch (F,), faces_cut, places, deviation [world].
    Raises:
        InputError: mesh is no mesh, or rings is no whole number from 1 up; faces of different components intersect
            (:func:`union`); faces are repeated, or have two equal corners (:func:`repair`); places cannot be mended
            (:func:`wrap`); the mesh is under 1e-71 or over 1e71 in size.
        DeviceMemoryError: There is not enough memory.
    Source:
        Attene, A lightweight approach to repairing digitized polygon meshes (2010). Differs: what is cut are discs,
            patches are held against the mesh by exact predicates, and the deviation is proven.
    Example:
        >>> ball = gk.mesh.sphere()
        >>> vertices = ball.vertices.copy()
        >>> vertices[600] *= -1.5                                       # a spike through the other side
        >>> found = gk.mesh.remove_self_intersections(gk.mesh.TriangleMesh(vertices, ball.faces))
        >>> found.faces_cut, found.places, gk.mesh.audit(found.mesh).watertight
        (120, 2, True)
    """
    given = require_mesh(mesh, "mesh")
    rings = require_count(rings, "rings", 1)
    surface = Surface(given, device="cpu") if given.face_count else None
    pairs = surface.self_intersections() if surface else np.zeros((0, 2), np.int32)
    if surface is None or not len(pairs):
        return Untangled(given, np.full(given.face_count, -1, np.int32), 0, 0, 0.0)
    whole = mesh_topology(given)
    _require_one_body(given, whole, pairs)
    # Faces are numbered among those whose corners differ.
    sound, corners = np.flatnonzero(~whole.collapsed), whole.edges.faces
    crossing = np.searchsorted(sound, np.unique(pairs))
    links = corners[crossing][:, (0, 1)].ravel(), corners[crossing][:, (1, 2)].ravel()
    place = connected_components(whole.position_count, *links)[corners[crossing, 0]]
    tried = np.ones(whole.position_count, np.int64)
    while True:
        rows, piece = _cut_out(whole.edges, crossing, tried[place], rings)
        corner, beside, filled = _patches(surface, whole.edges, sound, rows, piece)
        fails = ~np.isin(piece, filled)
        if not fails.any():
            places, hole = np.unique(filled, return_inverse=True)
            full, patch = with_patches(given, corner, beside, hole)
            kept = patch >= 0
            kept[~kept] = ~np.isin(np.arange(given.face_count), sound[rows])
            made = derived(full, full.vertices, full.faces[kept], face_source=np.flatnonzero(kept))
            after = Surface(made, device="cpu")
            before, now = shape_of(given), shape_of(made)
            # Faces of a disc that were not wound alike are now.
            kept_shape = before._replace(oriented=before.oriented or now.oriented).is_kept_by(now)
            if kept_shape and not after._has_self_intersections():
                break
            fails[:] = True
        again = np.unique(place[np.isin(crossing, rows[fails])])
        if (tried[again] == rings).all():
            first = pairs[np.isin(pairs, sound[rows[fails]]).any(axis=1).argmax()]
            what = f"intersect, and {len(np.unique(piece[fails]))} such places cannot be mended within {rings} rings"
            remedy = "try repair first, more rings, union for bodies that overlap, or wrap"
            raise _refusal(given, first, f"{what} of faces; {remedy}")
        tried[again] = np.minimum(2 * tried[again], rings)
    deviation = hausdorff(surface, after, tolerance=BOUND_SHARE, samples=0).upper
    return Untangled(made, patch[kept], len(rows), len(places), deviation)


def _refusal(mesh: TriangleMesh, pair: NDArray[np.int32], what: str) -> InputError:
    at = ", ".join(f"{value:.6g}" for value in mesh.vertices[mesh.faces[pair[0]]].mean(axis=0))
    return InputError(f"mesh: faces {pair[0]} and {pair[1]} of {mesh.name or 'the mesh'}, near ({at}), {what}")


def _require_one_body(mesh: TriangleMesh, whole: MeshTopology, pairs: NDArray[np.int32]) -> None:
    """Refuse faces that repeat each other or have two equal corners, and faces of different components."""
    corners = whole.corners[pairs]
    none = whole.collapsed[pairs].any(axis=1) | ~np.ptp(np.sort(corners, axis=2), axis=1).any(axis=1)
    apart = np.ptp(whole.edges.pieces(whole.corners[whole.collapsed])[corners[..., 0]], axis=1) > 0
    for wrong, what, remedy in (
        (none, "have equal corners", "repair or drop_degenerate(duplicates=True) removes such faces"),
        (apart, "intersect in different components", "union joins bodies that overlap, wrap closes anything"),
    ):
        if wrong.any():
            raise _refusal(mesh, pairs[wrong.argmax()], f"{what} (pairs like this: {int(wrong.sum())}); {remedy}")


def _cut_out(
    topology: Topology, crossing: NDArray[np.int64], tried: NDArray[np.int64], rings: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces that cross others, the rings around each of them that are tried, and what these cut off (C,).

    Returned as well: the piece of each by the edges that they share, numbered by its first row (C,).
    """
    corners, count = topology.faces, len(topology.faces)
    one, other = (pair // 3 for pair in topology.pairs)

    def grown(rows: NDArray[np.int64], steps: int) -> NDArray[np.bool_]:
        found = np.isin(np.arange(count), rows)
        for _ in range(steps):
            touched = np.zeros(topology.position_count, bool)
            touched[corners[found]] = True
            found = np.asarray(touched[corners].any(axis=1))
        return found

    cut = np.zeros(count, bool)
    for steps in np.unique(tried).tolist():
        cut |= grown(crossing[tried == steps], steps)
    # Of what is left of a body all but the largest piece goes, if it is near.
    body, left = connected_components(count, one, other), ~(cut[one] | cut[other])
    part = connected_components(count, one[left], other[left])
    size, far = np.bincount(part), np.bincount(part, ~grown(crossing, rings))
    largest = np.zeros(count, np.int64)
    np.maximum.at(largest, body, size[part])
    cut |= (size[part] < largest[body]) & (far[part] == 0)
    # Faces that meet the others at a point alone stay.
    inside = cut[one] & cut[other]
    label = connected_components(count, one[inside], other[inside])
    rows = np.flatnonzero(cut & np.isin(label, label[crossing]))
    return rows, np.searchsorted(rows, label[rows])


def _patches(
    surface: Surface, topology: Topology, sound: NDArray[np.int64], rows: NDArray[np.int64], piece: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Faces that fill the pieces that are discs: their corners (T, 3), a face at the rim and the piece of each (T,)."""
    mesh, count = surface.mesh, topology.position_count
    edges, left = (Topology(each, count) for each in (topology.faces[rows], np.delete(topology.faces, rows, axis=0)))
    rims = find_rims(edges)
    corner = 3 * sound[rows[rims.half_edges // 3]] + rims.half_edges % 3
    of_rim = piece[rims.half_edges[rims.begin[:-1]] // 3]
    points, width, _ = rim_points(mesh, rims, corner)
    # A disc has no edges that are not between two of its faces but its rim, and as many points as Euler's formula says.
    is_cut, (one, other) = np.isin(np.arange(len(sound)), rows), (pair // 3 for pair in topology.pairs)
    paired = piece[np.searchsorted(rows, one[is_cut[one] & is_cut[other]])]
    faces, pairs = (np.bincount(each, minlength=len(rows)) for each in (piece, paired))
    used = np.bincount(np.unique(piece[:, None] * count + edges.faces) // count, minlength=len(rows))
    sides = np.diff(rims.begin)
    is_disc = ((3 * faces - 2 * pairs)[of_rim] == sides) & ((2 * used - faces)[of_rim] == sides + 2)
    # Of a body half of the faces stay at least: else it is not mended, but made anew.
    body = connected_components(len(sound), one, other)
    is_disc &= (2 * np.bincount(body, is_cut) <= np.bincount(body))[body[rows[of_rim]]]
    # Patches are wound against rims, and lie where the faces at the rims were.
    beside = -face_normals(TriangleMesh(mesh.vertices, mesh.faces[corner // 3]))
    fixed = edges_within(left, rims.begin, edges.start[rims.half_edges]), beside
    wanted, gone = rims.is_loop & is_disc & (width > 0.0), np.isin(np.arange(mesh.face_count), sound[rows])
    made, hole = unclashing(mesh, rims, points, wanted, width, corner, fixed, surface, gone)
    flat = faces_without_area(TriangleMesh(mesh.vertices, mesh.faces.reshape(-1)[corner[made]]))
    kept = ~np.isin(hole, hole[flat])
    made, hole = made[kept], hole[kept]
    return corner[made[:, ::-1]], corner[rims.begin[hole]] // 3, of_rim[hole]
