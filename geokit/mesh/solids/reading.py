"""Reads a mesh as solids, each of a closed body and its cavities, and as sheets, all other faces."""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.sign.inner_sheets import CONTACT, collapsed, is_inside, sheets_inside
from geokit.mesh.solids.judging import FACES_FOR_A_SHARE, OVERLAP_SHARE, checkable
from geokit.mesh.topology.bodies import Bodies, closed_bodies
from geokit.mesh.topology.orientation import enclosing_pairs

__all__ = ["Reading", "read_solids"]


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


def read_solids(mesh: TriangleMesh, given: Any, size: float, make_surface: Any) -> Reading:
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

    order = np.argsort(bodies.label, kind="stable")
    starts = np.searchsorted(bodies.label[order], np.arange(len(bodies.volume) + 1))
    rows = [order[a:b] for a, b in itertools.pairwise(starts)]
    others = [order[: starts[0]]]
    owner = np.arange(len(rows))
    cavities = np.flatnonzero(bodies.volume < 0.0)
    owner[cavities] = -1
    if len(cavities):
        inner, outer = enclosing_pairs(mesh, bodies.label, len(rows), partial(Surface, device="cpu"))
        # The smallest body around a cavity is the one that it is a cavity of.
        solid = (bodies.volume[outer] > 0.0) & (bodies.volume[inner] < 0.0)
        inner, outer = inner[solid], outer[solid]
        largest_first = np.argsort(-bodies.volume[outer], kind="stable")
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
