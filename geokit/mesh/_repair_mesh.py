"""All repairs of a mesh in one call."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import repeated_triples
from geokit.core.interop.types import MeshLike
from geokit.core.memory.needs import needs
from geokit.mesh._fill_holes import FilledHoles, fill_holes
from geokit.mesh._repair import merge_vertices
from geokit.mesh.attributes.derived import derived
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.topology.connectivity import MeshTopology, Topology, mesh_topology


class Repaired(NamedTuple):
    """A repaired mesh, and what was done to it.

    Attributes:
        mesh: The repaired mesh.
        merged: Vertices that were merged into others.
        dropped: Faces that were removed.
        flipped: Faces that were turned.
        holes: The holes, and which of them were filled; its mesh is the same one.
    """

    mesh: TriangleMesh
    merged: int
    dropped: int
    flipped: int
    holes: FilledHoles


@needs(lambda mesh, tolerance=0.0, **_: 460 * mesh.face_count + (48 << 20) * (tolerance > 0.0), late=True)
def repair(mesh: MeshLike, *, tolerance: float = 0.0, max_width: float = math.inf, fair: bool = False) -> Repaired:
    """Merge vertices, drop faces that are none, wind faces alike, and fill holes.

    What is sound stays as it is. Vertices are merged as by :func:`merge_vertices`. Three kinds of faces are dropped:
    those with two corners at one position; those that repeat an earlier one, where an edge of them has more than two
    faces; and fins, which hang by one edge beside the two faces that it joins. Needles stay, as they close the gap
    between their neighbors. Then holes are filled as by :func:`fill_holes`, which winds faces as :func:`orient` does.

    Edges of three faces, and faces that intersect, are left: :func:`audit` counts them. :func:`union` removes what lies
    inside of bodies, :func:`remove_self_intersections` folds and spikes, and :func:`wrap` makes a solid of anything.

    Args:
        mesh: The mesh; it may be empty.
        tolerance: Distance [world] within which vertices are merged; 0 for equal positions only.
        max_width: Holes wider than this [world] stay open.
        fair: Whether to make patches as smooth as what is around them, as :func:`fill_holes` does.
    Returns:
        Repaired with mesh, merged, dropped, flipped, holes.
    Raises:
        InputError: mesh is no mesh, tolerance or max_width is no number of 0 or more, or fair is no flag.
        MissingDependencyError: SciPy is missing, which ``fair`` needs.
        DeviceMemoryError: There is not enough memory.
    Example:
        >>> found = gk.mesh.repair(gk.mesh.load("data/samples/broken.obj"))
        >>> found.dropped, found.flipped, int(found.holes.filled.sum()), gk.mesh.audit(found.mesh).watertight
        (35, 20, 10, True)
    """
    given = require_mesh(mesh, "mesh")
    merged = merge_vertices(given, tolerance=tolerance)
    left = merged
    for is_none in (_copies, _fins):
        dropped = is_none(mesh_topology(left))
        if dropped.any():
            left = derived(left, left.vertices, left.faces[~dropped], face_source=np.flatnonzero(~dropped))
    filled = fill_holes(left, max_width=max_width, fair=fair)
    flipped = (filled.mesh.faces[filled.hole < 0] != left.faces).any(axis=1)
    counts = given.vertex_count - merged.vertex_count, given.face_count - left.face_count, int(flipped.sum())
    return Repaired(filled.mesh, *counts, filled)


def _copies(found: MeshTopology) -> NDArray[np.bool_]:
    """Faces with two equal corners, and copies of earlier faces at an edge of more than two (F,)."""
    dropped, edges = found.collapsed.copy(), found.edges
    repeats, _ = repeated_triples(edges.faces)
    repeats = repeats[(_uses(edges)[repeats] > 2).any(axis=1)]
    dropped[np.flatnonzero(~dropped)[repeats]] = True
    return dropped


def _fins(found: MeshTopology) -> NDArray[np.bool_]:
    """Faces that hang by one edge beside the two faces that it joins (F,)."""
    edges = found.edges
    uses = _uses(edges)
    hangs = ((uses == 1).sum(axis=1) == 2) & (uses > 2).any(axis=1)
    at_edge = (
        np.add.reduceat(hangs[edges.order // 3], edges.starts, dtype=np.int64) if len(edges.starts) else edges.uses
    )
    joins = np.zeros(len(edges.order), bool)
    joins[edges.order] = np.repeat(edges.uses - at_edge == 2, edges.uses)
    return hangs & (joins.reshape(-1, 3) & (uses > 2)).any(axis=1)


def _uses(edges: Topology) -> NDArray[np.int64]:
    """The number of faces at each edge of each face (F, 3)."""
    uses = np.empty(len(edges.order), np.int64)
    uses[edges.order] = np.repeat(edges.uses, edges.uses)
    return uses.reshape(-1, 3)
