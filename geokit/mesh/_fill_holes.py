"""Holes of a mesh closed by triangles between the points of their rims."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import repeated_triples
from geokit.core.frame import Frame
from geokit.core.interop.types import MeshLike
from geokit.core.interop.user_arrays import FROM_ZERO, require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_flag
from geokit.mesh._repair import orient
from geokit.mesh.attributes.derived import derived, with_data
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.surfaces.surface import Surface
from geokit.mesh.topology.connectivity import MeshTopology, mesh_topology
from geokit.mesh.topology.fairing import fair_patches
from geokit.mesh.topology.measures import faces_without_area
from geokit.mesh.topology.normals import face_normals
from geokit.mesh.topology.rims import Rims, edges_within, find_rims, patches

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

# Points of a rim whose distances are all measured.
MOST_PAIRED = 512
# How far points are moved by rounding to float32, in shares of the largest coordinate; of a rim's width it is no more.
ROUNDED = 2.0**-22, 1e-5
# Where triangles clash with others, the least area without them is tried so many times; edges count less each time.
EDGE_SHARES = [1e-3 * 0.02**trial for trial in range(8)]


class FilledHoles(NamedTuple):
    """A mesh whose holes are filled, and its holes.

    Attributes:
        mesh: The mesh: the faces of the input in their order, those of a patch behind a face at its rim.
        hole: The hole that each face fills, (F,) int32; -1 for faces of the input.
        width: Largest distance between two points of each rim [world], (H,).
        center: Mean of the points of each rim [world], (H, 3).
        filled: Whether each hole was filled, (H,) bool; others are as open as they were.
        faired: Whether its patch is a fair one, (H,) bool.
    """

    mesh: TriangleMesh
    hole: NDArray[np.int32]
    width: NDArray[np.float64]
    center: NDArray[np.float64]
    filled: NDArray[np.bool_]
    faired: NDArray[np.bool_]


@needs(lambda mesh, fair=False, **_: (520 if fair else 440) * mesh.face_count, late=True)
def fill_holes(mesh: MeshLike, *, max_width: float = math.inf, fair: bool = False) -> FilledHoles:
    """Close holes by triangles between the points of their rims, of least area.

    A rim is a loop of edges that one face has; vertices at equal positions count as one. Faces are wound as by
    :func:`orient`. No vertex is moved, and no face is removed. No face of a patch intersects or repeats
    another one (exact predicates), and none of its edges has more than two faces. A hole stays open where that cannot
    be had, where it is wider than ``max_width``, and where its rim ends at an edge of more than two faces, or of two
    that cannot be wound alike.

    With ``fair`` patches get points as dense as those around their rims, and curve as the faces there do. The patch of
    least area is kept where such a one would intersect something, or have over 131,072 faces, and ``faired`` says so.
    New vertices have the attributes of points of the rim.

    The border of a sheet is a rim too: ``max_width`` tells one from the other. A flat sheet keeps its border, as the
    patch would lie in the sheet. :func:`wrap` closes what has no rims: cracks, slits, loose faces.

    Patches have the attributes and the part of a face at their rim, and their corners those of the rim's corners. Up to
    256 sides the area is the least, where short edges count a little; longer rims lose their shortest ears first.

    Args:
        mesh: The mesh; it may be empty.
        max_width: Holes wider than this [world] stay open.
        fair: Whether to make patches as smooth as what is around them.
    Returns:
        FilledHoles with mesh, hole (F,), width [world] (H,), center (H, 3), filled (H,), faired (H,).
    Raises:
        InputError: mesh is no mesh, max_width is no number of 0 or more, or fair is no flag.
        MissingDependencyError: SciPy is missing, which ``fair`` needs.
        DeviceMemoryError: There is not enough memory.
    Source:
        Barequet and Sharir, Filling gaps in the boundary of a polyhedron (1995); Liepa, Filling holes in meshes (2003);
        Schneider and Kobbelt, Geometric fairing of irregular meshes for free-form surface design (2001).
    Example:
        >>> box = gk.mesh.box()
        >>> found = gk.mesh.fill_holes(gk.mesh.TriangleMesh(box.vertices, box.faces[1:]))
        >>> found.mesh.volume, found.hole.tolist().count(0), found.width.round(3)
        (1.0, 1, array([1.414]))
    """
    given, flipped, _ = orient(require_mesh(mesh, "mesh"))
    max_width = require_finite_scalar(max_width, "max_width", low=FROM_ZERO, infinite=True)
    require_flag(fair, "fair")
    whole = mesh_topology(given)
    _, _, collapsed, topology = whole
    rims = find_rims(topology)
    face = np.flatnonzero(~collapsed)[rims.half_edges // 3]
    corner = 3 * face + rims.half_edges % 3
    points, width, center = rim_points(given, rims, corner)
    wanted = rims.is_loop & (width <= max_width) & (width > 0.0)
    beside = face_normals(TriangleMesh(given.vertices, given.faces[face]))
    fixed = edges_within(topology, rims.begin, topology.start[rims.half_edges]), beside
    rows, hole = unclashing(given, rims, points, wanted, width, corner, fixed)
    filled, faired = np.isin(np.arange(len(width)), hole), np.zeros(len(width), bool)
    corners, faces = corner[rows], given.faces.reshape(-1)[corner[rows]]
    if fair and len(rows):
        given, corners, hole, faces, faired = _faired(given, whole, corners, hole, width)
    full, of_face = with_patches(given, corners, face[rims.begin[hole]], hole, faces)
    # Bodies in bodies are told apart by the input's winding, once both are closed.
    back = np.zeros(full.face_count, bool)
    back[of_face < 0] = flipped
    turned = np.where(back[:, None], full.faces[:, ::-1], full.faces)
    wound = orient(derived(full, full.vertices, turned, reversed_faces=back)).mesh
    return FilledHoles(wound, of_face, width, center, filled, faired)


def rim_points(mesh: TriangleMesh, rims: Rims, corner: Indices) -> tuple[Floats, Floats, Floats]:
    """Points of rims in units of their width (R, 3), widths [world] (H,), means of the points [world] (H, 3).

    ``corner`` is the corner of the mesh where each half-edge of the rims starts (R,).
    """
    frame = Frame.around(*mesh.bounds)
    points = (mesh.vertices[mesh.faces.reshape(-1)[corner]] - frame.origin) / frame.scale
    each = np.split(points, rims.begin[1:-1])[: len(rims.is_loop)]
    width = np.array([_width(rim) for rim in each])
    center = frame.scale * np.array([rim.mean(axis=0) for rim in each]).reshape(-1, 3) + frame.origin
    points /= np.where(width > 0.0, width, 1.0).repeat(np.diff(rims.begin))[:, None]
    return points, frame.scale * width, center


def unclashing(
    mesh: TriangleMesh,
    rims: Rims,
    points: Floats,
    wanted: NDArray[np.bool_],
    width: Floats,
    corner: Indices,
    fixed: tuple[Indices, Floats],
    source: Surface | None = None,
    gone: NDArray[np.bool_] | None = None,
) -> tuple[Indices, Indices]:
    """Triangles as rows of the rims (T, 3), and the hole of each (T,); none that clashes with faces of the mesh.

    ``points``, ``width`` and ``corner`` are those of :func:`rim_points`, ``fixed`` are edges and normals as in
    :func:`patches`. ``source`` is the surface of the mesh, if there is one; faces that are ``gone`` (F,) do not count.
    """
    rows, hole = np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    refused = rows
    # Coordinates may have been read from float32.
    rounded = np.minimum(ROUNDED[0] * np.abs(mesh.bounds).max() / np.where(width > 0.0, width, 1.0), ROUNDED[1])
    for edge_share in EDGE_SHARES:
        more, of_hole = patches(rims, points, wanted, refused, *fixed, rounded, edge_share)
        rows, hole = np.concatenate([rows, more]), np.concatenate([hole, of_hole])
        if not len(more):
            break
        source = source or Surface(mesh, device="cpu")
        clashes = _clashing(source, mesh.faces.reshape(-1)[corner[rows]], hole, width, gone)
        wanted = np.isin(np.arange(len(width)), hole[clashes])
        refused = np.concatenate([refused, rows[clashes]])
        rows, hole = rows[~wanted[hole]], hole[~wanted[hole]]
    return rows, hole


def _width(points: Floats) -> float:
    """The largest distance between two points."""
    if len(points) > MOST_PAIRED:
        cloud = TriangleMesh(points, np.arange(len(points))[:, None].repeat(3, axis=1))
        return float(Surface(cloud, device="cpu").furthest_point(points).distance.max())
    return float(np.linalg.norm(points[:, None] - points, axis=-1).max())


def with_patches(
    mesh: TriangleMesh, corners: Indices, beside: Indices, hole: Indices, faces: Indices | None = None
) -> tuple[TriangleMesh, NDArray[np.int32]]:
    """The mesh with patches, and the hole of each face (F,).

    Args:
        mesh: The mesh.
        corners: Corners of the patches' faces, as numbers of corners of the mesh (T, 3).
        beside: The face of the mesh that each is put behind, and takes its attributes from (T,).
        hole: The hole of each (T,).
        faces: Their vertices, if not those of the corners (T, 3).
    """
    source = np.concatenate([np.arange(mesh.face_count), beside])
    order = np.argsort(source, kind="stable")
    corner = np.concatenate([np.arange(3 * mesh.face_count).reshape(-1, 3), corners])[order]
    of_face = np.concatenate([np.full(mesh.face_count, -1, np.int32), hole.astype(np.int32)])[order]
    plain = with_data(mesh, corner_data={})
    faces = np.concatenate([mesh.faces, mesh.faces.reshape(-1)[corners] if faces is None else faces])[order]
    made = derived(plain, mesh.vertices, faces, face_source=source[order])
    at_corners = {name: v.reshape(-1, *v.shape[2:])[corner] for name, v in mesh.corner_data.items()}
    return with_data(made, corner_data=at_corners), of_face


def _faired(
    mesh: TriangleMesh, whole: MeshTopology, corners: Indices, hole: Indices, width: Floats
) -> tuple[TriangleMesh, Indices, Indices, Indices, NDArray[np.bool_]]:
    """Patches as for :func:`with_patches`, made fair where they clash with nothing.

    Returns:
        The mesh with all vertices, corners to take attributes from, holes and vertices of the patches' faces (T', 3),
        (T',), (T', 3), and whether the patch of each hole is fair (H,).
    """
    frame, every, count = Frame.around(*mesh.bounds), mesh.faces.reshape(-1), mesh.vertex_count
    places = np.empty((whole.position_count, 3))
    places[whole.corners] = (mesh.vertices[mesh.faces] - frame.origin) / frame.scale
    # Of each corner of a patch the point, the corner beside it and the hole.
    plain = np.stack([whole.corners.reshape(-1)[corners], corners, hole[:, None].repeat(3, axis=1)], axis=-1)
    fair, points = fair_patches(whole.edges, places, plain)
    plain[..., 0] = every[corners]
    fair[..., 0] = np.where(fair[..., 0] < len(places), every[fair[..., 1]], fair[..., 0] - len(places) + count)
    vertices = np.concatenate([mesh.vertices, points[len(places) :] * frame.scale + frame.origin])
    source = Surface(TriangleMesh(vertices, mesh.faces), device="cpu")
    faired = np.isin(np.arange(len(width)), fair[:, 0, 2])
    while True:
        table = np.concatenate([plain[~faired[plain[:, 0, 2]]], fair[faired[fair[:, 0, 2]]]])
        faces, corners, hole = np.moveaxis(table, 2, 0)
        wrong = faces_without_area(TriangleMesh(vertices, faces))
        wrong[_clashing(source, faces, hole[:, 0], np.where(faired, width, 0.0), None)] = True
        if not faired[hole[wrong]].any():
            break
        faired[hole[wrong]] = False
    beside = np.arange(len(vertices))
    beside[faces] = every[corners]
    used = np.union1d(beside[:count], faces)
    made = derived(mesh, vertices[used], mesh.faces, vertex_source=beside[used])
    return made, corners, hole[:, 0], np.searchsorted(used, faces), faired


def _clashing(
    source: Surface, faces: NDArray[np.int32], hole: Indices, width: Floats, gone: NDArray[np.bool_] | None
) -> Indices:
    """Patches' faces that intersect or repeat others, or give an edge a third face; of two that of the wider patch."""
    made = Surface(TriangleMesh(source.mesh.vertices, faces), device="cpu")
    touched = np.unique(made.intersecting_triangles(source)[:, 1])
    touched = touched if gone is None else touched[~gone[touched]]
    near = TriangleMesh(source.mesh.vertices, np.concatenate([source.mesh.faces[touched], faces]))
    corners, _, collapsed, topology = mesh_topology(near)
    first = np.repeat(topology.starts, topology.uses)
    third = np.flatnonzero((np.repeat(topology.uses, topology.uses) > 2) & (first != np.arange(len(first))))
    crowded = np.stack([topology.order[first[third]], topology.order[third]], axis=1)
    repeated = np.stack(repeated_triples(corners), axis=1)
    crossing = Surface(near, device="cpu").self_intersections()
    pairs = np.concatenate([crossing, repeated, np.flatnonzero(~collapsed)[crowded // 3]])
    pairs = pairs[(pairs >= len(touched)).any(axis=1)]
    size = np.concatenate([np.full(len(touched), -1.0), width[hole]])[pairs]
    return np.unique(pairs[np.arange(len(pairs)), size.argmax(axis=1)]) - len(touched)
