"""The boundary of what a mesh encloses: its closed bodies are united, and surface inside of them is left out.

An assembly, a union by concatenation, a shell around a core: such meshes have surface with the solid on both sides.
It is no boundary. Where bodies touch but for rounding, they are made to overlap by a millionth of the mesh's size or
less. Every result is held against winding numbers of the mesh that was given, on both sides of its faces."""

from __future__ import annotations

import itertools
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.attributes.derived import derived, with_data
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.sign.left_out import CONTACT, EXTREME_SIZE, collapsed, is_inside, left_out_faces, sheets_inside
from geokit.mesh.solids.contact import within_contact
from geokit.mesh.solids.judging import FACES_FOR_A_SHARE, OVERLAP_SHARE, checkable, self_overlap, verdict_of
from geokit.mesh.solids.pieces import Pieces, boxes_that_meet, combined, inflated, pieces_of, together
from geokit.mesh.topology.audit import face_parts
from geokit.mesh.topology.bodies import Bodies, closed_bodies
from geokit.mesh.topology.boxes import boxes_of
from geokit.mesh.topology.connectivity import connected_components
from geokit.mesh.topology.orientation import enclosing_pairs

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface


class Boundary(NamedTuple):
    """What is left of a mesh without the surface inside of its solids.

    Attributes:
        mesh: The boundary, with the parts and the attributes of faces; the mesh that was given if nothing is removed.
        source: Row of the given mesh's face in which each face lies (F,), ascending; None if nothing is removed.
        kept: Why surface inside of solids is still there; "" if none is.
    """

    mesh: TriangleMesh
    source: NDArray[np.int64] | None
    kept: str


def boundary_of(surface: Surface) -> Boundary:
    """The boundary of what a surface's mesh encloses."""
    given: Any = surface._counted
    mesh: TriangleMesh = given.mesh
    unchanged = Boundary(surface.mesh, None, "")
    size = float((mesh.bounds[1] - mesh.bounds[0]).max())
    if not 1.0 / EXTREME_SIZE < size < EXTREME_SIZE:
        return unchanged
    if _are_apart(given, CONTACT * size):
        return unchanged._replace(kept=self_overlap(mesh, given, CONTACT * size))
    flipped = given._orientation.flipped[:, None]
    oriented = TriangleMesh(mesh.vertices, np.where(flipped, mesh.faces[:, ::-1], mesh.faces))
    make_surface = partial(surface._of, device=surface._device)
    read = _read_solids(oriented, given, size, make_surface)
    crowded, alone = _by_contact(read.bodies, read.solids, CONTACT * size)
    distinct = _without_copies(oriented, crowded)
    has_copies = len(distinct) < len(crowded)
    crowded, alone = (distinct, alone) if len(distinct) > 1 else ([], [*alone, *distinct])
    if (
        crowded
        and given._solid_choice.method == "pseudonormal"
        and not _touch(read.bodies, crowded, size, make_surface)
    ):
        crowded, alone = [], read.solids
    outward = make_surface(oriented) if crowded and flipped.any() else given
    pieces, kept = _joined(oriented, read, crowded, size, outward) if crowded else (None, "")
    kept = kept or read.said
    if not kept and alone:
        # Where sheets are left, bodies may be inside of others that lack a face.
        judge = read.judge if len(read.inner) == len(read.sheets) else given
        kept = self_overlap(oriented, judge, CONTACT * size, np.concatenate(alone))
    inner, sheets = read.inner, read.sheets
    unchanged = unchanged._replace(kept=kept)
    if pieces is None and not len(inner) and not has_copies:
        return unchanged
    rest = [*alone, np.setdiff1d(sheets, inner), *(crowded if pieces is None else [])]
    result = _assembled(oriented, np.concatenate(rest), pieces)
    source = result.source
    if given is not surface:
        source = np.delete(np.arange(surface.mesh.face_count), left_out_faces(surface))[source]
    plain = with_data(surface.mesh, vertex_data={}, corner_data={})
    return unchanged._replace(mesh=derived(plain, result.vertices, result.faces, face_source=source), source=source)


def _are_apart(given: Any, within: float) -> bool:
    """Whether it is quick to see that no part of the mesh can be inside another, or touch it."""
    audit = given.audit
    if not audit.manifold:
        # Bodies that share an edge or a vertex are one component.
        return False
    if audit.component_count == 1:
        return True
    _, part = np.unique(face_parts(given.mesh), return_inverse=True)
    boxes = boxes_of(given.mesh.vertices, given.mesh.faces, part, int(part.max()) + 1)
    return not len(boxes_that_meet(*boxes, within)[0])


def _touch(bodies: Bodies, crowded: list[NDArray[np.int64]], size: float, make_surface: Any) -> bool:
    """Whether bodies that do not intersect do so when they grow by what counts as contact."""
    rows = np.concatenate(crowded)
    grown = TriangleMesh(inflated(bodies.positions, bodies.corners[rows], CONTACT * size), bodies.corners[rows])
    return bool(make_surface(grown)._has_self_intersections())


def _by_contact(
    bodies: Bodies, solids: list[NDArray[np.int64]], within: float
) -> tuple[list[NDArray[np.int64]], list[NDArray[np.int64]]]:
    """The solids whose boxes meet others', and those that are alone."""
    if not len(bodies.volume):
        return [], []
    rows, count = np.flatnonzero(bodies.label >= 0), len(bodies.volume)
    boxes = boxes_of(bodies.positions, bodies.corners[rows], bodies.label[rows], count)
    group = connected_components(count, *boxes_that_meet(*boxes, within))
    # A cavity's box lies within its body's.
    of_solid = [int(group[bodies.label[rows].max()]) for rows in solids]
    counts = Counter(of_solid)
    crowded = [rows for rows, name in zip(solids, of_solid, strict=True) if counts[name] > 1]
    return crowded, [rows for rows, name in zip(solids, of_solid, strict=True) if counts[name] == 1]


def _without_copies(mesh: TriangleMesh, solids: list[NDArray[np.int64]]) -> list[NDArray[np.int64]]:
    """The solids of which no earlier one has the same faces: manifold3d may leave a fold where two are the same."""
    kept: list[NDArray[np.int64]] = []
    alike: dict[bytes, list[NDArray[np.int64]]] = {}
    for rows in solids:
        places = np.take(mesh.vertices, mesh.faces[rows].ravel(), axis=0)
        # Axis by axis: NumPy's reductions over the long axis of an (N, 3) array are ten times slower.
        key = np.array([len(rows), *(bound for axis in places.T for bound in (axis.min(), axis.max()))]).tobytes()
        alike.setdefault(key, []).append(rows)
    for group in alike.values():
        faces = [_canonical(mesh.vertices[mesh.faces[rows]]) for rows in group if len(group) > 1]
        for k, rows in enumerate(group):
            if not any(all(map(np.array_equal, faces[k], faces[j])) for j in range(k)):
                kept.append(rows)
    return kept


def _canonical(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Positions and faces in an order that is the same for the same faces."""
    places, at = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    at = at.reshape(-1, 3)
    first = at.argmin(axis=1)[:, None]
    at = np.take_along_axis(at, (first + np.arange(3)) % 3, axis=1)
    return places, at[np.lexsort(at.T)]


def _joined(
    mesh: TriangleMesh, read: Reading, crowded: list[NDArray[np.int64]], size: float, surface: Any
) -> tuple[Pieces | None, str]:
    """The boundary of the union, and why surface inside of it is still there; None if no union is right."""
    bodies, judge = read.bodies, read.judge
    rows = np.concatenate(crowded)

    def made(positions: NDArray[np.float64]) -> Pieces | None:
        return combined([pieces_of(positions, bodies.corners, some) for some in crowded], "Add")

    def inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(judge.winding_number(points) > 0.5)

    def near(within: float) -> bool:
        body = np.full(mesh.face_count, -1, np.int32)
        body[rows] = np.repeat(np.arange(len(crowded)), [len(some) for some in crowded])
        return bool(surface._has_facing(surface, within, body=body))

    given = Pieces(mesh.vertices, mesh.faces[rows], rows)
    verdict = partial(verdict_of, given, inside, partial(judge._of, device=judge._device), size)
    return within_contact(made, verdict, bodies.positions, bodies.corners[rows], size, near)


def _assembled(mesh: TriangleMesh, rest: NDArray[np.int64], pieces: Pieces | None) -> Pieces:
    """Faces of the mesh and pieces in one, in the order of the faces that they come from."""
    whole = pieces_of(mesh.vertices, mesh.faces, rest)
    if pieces is not None:
        whole = together([whole, pieces])
    order = np.argsort(whole.source, kind="stable")
    return Pieces(whole.vertices, whole.faces[order], whole.source[order])


class Reading(NamedTuple):
    """A mesh read as solids and sheets.

    Attributes:
        bodies: The closed bodies.
        solids: Rows of the faces of each outer body with its cavities.
        sheets: Rows of all other faces.
        inner: Rows of those sheets that lie inside of solids.
        judge: A surface that has the winding numbers of the solids; None if there are none.
        said: What is said of sheets that are not removed and make the inside doubtful.
    """

    bodies: Bodies
    solids: list[NDArray[np.int64]]
    sheets: NDArray[np.int64]
    inner: NDArray[np.int64]
    judge: Any
    said: str


def _read_solids(mesh: TriangleMesh, given: Any, size: float, make_surface: Any) -> Reading:
    """The reading of a mesh that leaves no sheets outside of solids, else the one with most faces in solids."""
    found = []
    for bodies in closed_bodies(mesh, None if given._orientation.flipped.any() else given._topology):
        solids, sheets = _solids(mesh, bodies)
        judge = given
        if len(sheets):
            rows = np.sort(np.concatenate([*solids, sheets[:0]]))
            judge = make_surface(TriangleMesh(mesh.vertices, mesh.faces[rows])) if len(rows) else None
        inner, crossing = _inner_sheets(mesh, sheets, judge, CONTACT * size)
        said = "open sheets lie inside of a body in part" if crossing else ""
        found.append(Reading(bodies, solids, sheets, inner, judge, said))
        if len(inner) == len(sheets):
            return found[-1]._replace(said="")
    return found[0]


def _solids(mesh: TriangleMesh, bodies: Bodies) -> tuple[list[NDArray[np.int64]], NDArray[np.int64]]:
    """Rows of the faces of each outer body with its cavities, and rows of all other faces but those without corners."""
    from geokit.mesh.surfaces.surface import Surface

    by_label = np.argsort(bodies.label, kind="stable")
    starts = np.searchsorted(bodies.label[by_label], np.arange(len(bodies.volume) + 1))
    rows = [by_label[a:b] for a, b in itertools.pairwise(starts)]
    others = [by_label[: starts[0]]]
    owner = np.arange(len(rows))
    cavities = np.flatnonzero(bodies.volume < 0.0)
    owner[cavities] = -1
    if len(cavities):
        inner, outer = enclosing_pairs(mesh, bodies.label, len(rows), partial(Surface, device="cpu"))
        # The smallest body around a cavity is the one that it is a cavity of.
        solid = (bodies.volume[outer] > 0.0) & (bodies.volume[inner] < 0.0)
        inner, outer = inner[solid], outer[solid]
        # Of a body that is there several times each copy has its own copy of the cavity.
        lower, _ = boxes_of(mesh.vertices, mesh.faces, bodies.label, len(rows))
        _, alike = np.unique(np.column_stack([bodies.volume, lower]), axis=0, return_inverse=True)
        order = np.argsort(alike, kind="stable")
        copy = np.empty_like(order)
        copy[order] = np.arange(len(order)) - np.searchsorted(alike[order], alike[order])
        largest_first = np.lexsort([copy[inner] == copy[outer], -bodies.volume[outer]])
        owner[inner[largest_first]] = outer[largest_first]
    solids = [[part] for part in rows]
    for cavity in cavities:
        (solids[owner[cavity]] if owner[cavity] >= 0 else others).append(rows[cavity])
    joined = [np.sort(np.concatenate(parts)) for parts, volume in zip(solids, bodies.volume, strict=True) if volume > 0]
    loose = np.sort(np.concatenate(others))
    return joined, loose[~collapsed(mesh.vertices[mesh.faces[loose]])]


def _inner_sheets(
    mesh: TriangleMesh, sheets: NDArray[np.int64], judge: Any, off: float
) -> tuple[NDArray[np.int64], bool]:
    """Rows of those sheets that lie inside of solids, and whether others do so in part."""
    if judge is None or not len(sheets):
        return sheets[:0], False
    inner, outer = sheets_inside(mesh, sheets, judge, off)
    if not len(outer):
        return inner, False
    corners, area, *_ = checkable(mesh.vertices, mesh.faces[outer], off, most=FACES_FOR_A_SHARE)
    share = area[is_inside(corners, judge, off)].sum() / max(area.sum(), np.finfo(float).tiny)
    return inner, bool(share > OVERLAP_SHARE)
