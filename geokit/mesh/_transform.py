"""Meshes under affine maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.interop.types import MeshLike
from geokit.core.memory.needs import needs
from geokit.core.memory.row_products import row_product
from geokit.core.require import require_affine
from geokit.errors import InputError
from geokit.mesh.attributes.derived import derived, turned_normals, with_data
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh

__all__ = ["transform"]

# Matrices from angles in degrees keep an axis to rounding only.
UP_TOLERANCE = 1e-6


@needs(lambda mesh, *_, **__: 56 * mesh.vertex_count)
def transform(mesh: MeshLike, matrix: ArrayLike) -> TriangleMesh:
    """A mesh under an affine map: rotated, moved, scaled, sheared or mirrored.

    A map that mirrors also reverses the faces, so that outside stays outside. ``normal`` is multiplied by the inverse
    transpose and keeps its length; ``up_axis`` becomes None where the map turns it; all other attributes stay as they
    are. Positions have the rounding of one product and three sums in float64.

    Args:
        mesh: The mesh; it may be empty.
        matrix: For column vectors, shape (4, 4), with the last row 0, 0, 0, 1.
    Returns:
        TriangleMesh with the same vertices, faces and parts.
    Raises:
        InputError: mesh is not a TriangleMesh, the matrix has another shape or last row or a number that is not finite,
            or a vertex leaves the range of float64.
    Example:
        >>> bracket = gk.mesh.load("data/samples/bracket.obj")
        >>> doubled = gk.mesh.transform(bracket, [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])
        >>> round(doubled.volume / bracket.volume, 9)
        8.0
    """
    mesh = require_mesh(mesh, "mesh")
    table = require_affine(matrix, "matrix")
    linear = table[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = row_product(mesh.vertices, linear.T, table[:3, 3])
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise InputError(f"matrix: vertex {int(np.argmax(bad))} leaves the range of float64; scale by less")
    # Scaled, so that the determinant neither overflows nor underflows.
    mirrored = np.linalg.det(linear / (np.abs(linear).max() or 1.0)) < 0.0
    faces, flipped = (mesh.faces[:, ::-1], np.ones(mesh.face_count, bool)) if mirrored else (mesh.faces, None)
    moved = derived(mesh, vertices, faces, reversed_faces=flipped)
    if mesh.up_axis is not None and not _keeps(linear, "xyz".index(mesh.up_axis)):
        moved = with_data(moved, up_axis=None)
    if not any("normal" in data for data in (moved.vertex_data, moved.face_data, moved.corner_data)):
        return moved
    return with_data(
        moved,
        vertex_data=turned_normals(moved.vertex_data, linear),
        face_data=turned_normals(moved.face_data, linear),
        corner_data=turned_normals(moved.corner_data, linear, axes=2),
    )


def _keeps(linear: NDArray[np.float64], axis: int) -> bool:
    """Whether a map keeps the direction of an axis."""
    column = linear[:, axis]
    return bool(column[axis] > 0.0 and np.abs(np.delete(column, axis)).max() <= UP_TOLERANCE * column[axis])
