"""Decides which faces that lie back to back with others are left out where signs are decided.

Some programs write each face twice, once for each side. The two cancel, so that nothing is inside. One of the two is
left out on each closed component, unless that component lies inside a solid: there the two are the contact of two
solids, or of a core and its shell.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory.pinned import host_flags
from geokit.mesh.topology.measures import largest_of_each

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

__all__ = ["left_out_faces"]

# Distance of a test point from its face, as a share of the square root of twice the face's area.
OFF_FACE = 1e-2


def left_out_faces(surface: Surface) -> NDArray[np.int64]:
    """Rows of the faces that are left out, ascending."""
    import warp as wp

    copies, piece, whole = surface._orientation.doubled
    if not whole.any():
        return np.asarray(copies)
    frame = surface._frame
    corners = (surface.mesh.vertices - frame.origin)[surface.mesh.faces[copies[whole]]] / frame.scale
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(normals, axis=1)
    rows = largest_of_each(piece[whole], twice)
    size = np.sqrt(twice[rows])[:, None]
    normals = normals[rows] / np.maximum(twice[rows], np.finfo(float).tiny)[:, None]
    starts = (corners[rows].mean(axis=1) + OFF_FACE * size * normals) * frame.scale + frame.origin
    points: Any = wp.array(starts, dtype=wp.vec3d, device=surface._device)
    # Doubled faces cancel here, so that this is the winding number of all others.
    winding = surface._winding(points, host_flags(1, surface._device), surface._winding_arguments_of_all()).numpy()
    within = piece[whole][rows][winding > 0.5]
    return np.asarray(copies[~(whole & np.isin(piece, within))])
