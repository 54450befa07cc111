"""Holds what bodies make together against winding numbers of those that were given, on both sides of its faces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.sign.left_out import CONTACT, INNER_POINT
from geokit.mesh.solids.pieces import Pieces
from geokit.mesh.topology.normals import cross

# Faces that are held against winding numbers at most, and the share of their area that may be found wrong: beside
# an edge where others cross, a face's side cannot be told from theirs.
CHECKED_FACES = 100_000
WRONG_SHARE = 1e-5
# Share of the surface of bodies inside of themselves, and of sheets inside of bodies, from which it is said: scans
# have folds.
OVERLAP_SHARE = 1e-3
FACES_FOR_A_SHARE = 10_000
SAMPLES = 10_000
# Faces with less than this many times CONTACT between their middle and their edges cannot be checked.
ROOM = 10.0


def verdict_of(
    given: Pieces,
    inside: Callable[[NDArray[np.float64]], NDArray[np.bool_]],
    make_surface: Callable[[TriangleMesh], Any],
    size: float,
    pieces: Pieces,
    inflation: float,
) -> str:
    """Nothing if pieces, of ``given`` faces of bodies that were moved by ``inflation`` [world], bound what is inside,
    "walls" if some have it on both sides, or "wrong".
    """
    off = CONTACT * size
    corners, area, normals, _ = checkable(pieces.vertices, pieces.faces, off)
    if not len(area) and len(pieces.faces):
        return "wrong"
    middle = INNER_POINT @ corners
    in_front = inside(middle + (off + 2.0 * inflation) * normals)
    behind = inside(middle - (off + 2.0 * inflation) * normals)
    most = WRONG_SHARE * area.sum()
    if area[~behind].sum() > most:
        return "wrong"
    # Nothing is missing: what is boundary of the bodies is there.
    corners, given_area, normals, at = checkable(given.vertices, given.faces, off)
    middle = INNER_POINT @ corners
    missing = inside(middle + off * normals) != inside(middle - off * normals)
    # The pieces of these faces first: a tree of all pieces takes longer.
    for some in (pieces.faces[np.isin(pieces.source, given.source[at[missing]])], pieces.faces):
        if len(some) and missing.any():
            made = make_surface(TriangleMesh(pieces.vertices, some))
            missing[missing] = made.closest_point(middle[missing]).distance > ROOM * off
    if given_area[missing].sum() > WRONG_SHARE * given_area.sum():
        return "wrong"
    return "walls" if area[in_front].sum() > most else ""


def self_overlap(mesh: TriangleMesh, judge: Any, off: float, rows: NDArray[np.int64] | None = None) -> str:
    """What is said of closed bodies that no other one comes near, if much of their surface is inside all the same."""
    if (rows is None and not judge._orientation.closed) or judge._solid_choice.method == "pseudonormal":
        return ""
    # Points on all of it: a large face may lie inside in part.
    corners = mesh.vertices[mesh.faces if rows is None else mesh.faces[rows]]
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice_area = np.linalg.norm(normals, axis=1)
    if not twice_area.any():
        return ""
    rng = np.random.default_rng(0)
    faces = rng.choice(len(corners), SAMPLES, p=twice_area / twice_area.sum())
    points = np.einsum("sk,skj->sj", rng.dirichlet((1.0, 1.0, 1.0), SAMPLES), corners[faces])
    step = off * normals[faces] / twice_area[faces, None]
    # Whichever way the faces are wound.
    inside = (judge.winding_number(points + step) > 0.5) & (judge.winding_number(points - step) > 0.5)
    share = np.count_nonzero(inside) / SAMPLES
    told = f"{share:.1%} of the surface of bodies lies inside of themselves, or of others that are not closed"
    return told if share > OVERLAP_SHARE else ""


def checkable(
    vertices: NDArray[np.float64], faces: NDArray[Any], off: float, most: int = CHECKED_FACES
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Of at most so many faces those whose middles are far from their edges, in units of ``off``: corners, areas,
    normals, rows.
    """
    rows = np.arange(len(faces))
    if len(faces) > most:
        # In order: faces that are near each other are asked one after another.
        rows = np.sort(np.random.default_rng(0).choice(len(faces), most, replace=False))
    corners = vertices[faces[rows]]
    sides = np.roll(corners, -1, axis=1) - corners
    normals = cross(sides[:, 0], sides[:, 1])
    twice_area = np.linalg.norm(normals, axis=1)
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    # The middle is a third of the height away from each edge.
    roomy = twice_area / 3.0 > ROOM * off * longest
    return corners[roomy], 0.5 * twice_area[roomy], normals[roomy] / twice_area[roomy, None], rows[roomy]


def areas_of(vertices: NDArray[np.float64], faces: NDArray[Any]) -> NDArray[np.float64]:
    corners = vertices[faces]
    return 0.5 * np.linalg.norm(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
