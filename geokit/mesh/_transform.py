"""Meshes under affine maps, in another unit of length, and with another axis up."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.interop.types import MeshLike
from geokit.core.memory.needs import needs
from geokit.core.memory.row_products import row_product
from geokit.core.require import described, require_affine, require_choice, require_number
from geokit.errors import InputError
from geokit.formats.objects import UNITS
from geokit.mesh.attributes.derived import derived, turned_normals, with_data
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh

# Matrices from angles in degrees keep an axis to rounding only.
UP_TOLERANCE = 1e-6

_METERS = {name: meters for meters, names in UNITS.items() for name in names}
_AXES = ("x", "y", "z")


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


@needs(lambda mesh, *_, **__: 72 * mesh.vertex_count)
def convert_unit(
    mesh: MeshLike,
    unit: str | float | None = None,
    *,
    up_axis: str | None = None,
    from_unit: str | float | None = None,
    from_up_axis: str | None = None,
) -> TriangleMesh:
    """The same body in another unit of length, or turned so that another axis is up.

    Positions are multiplied by the ratio of the units, and turned by a quarter about the axis that is neither the old
    nor the new one, which changes no digit. Normals turn too; all other attributes stay.

    Args:
        mesh: The mesh.
        unit: The new unit: "mm", "cm", "m", "km", "um", "in", "ft" (their names too), or its length [m]; None to leave
            it.
        up_axis: The axis that points up afterwards, "x", "y" or "z"; None to leave it.
        from_unit: The unit of the mesh, where ``meters_per_unit`` does not say it, or says it wrongly.
        from_up_axis: The axis that points up in the mesh, where ``up_axis`` does not say it, or says it wrongly.
    Returns:
        TriangleMesh with ``meters_per_unit`` and ``up_axis`` as asked for.
    Raises:
        InputError: A unit or axis is unknown, the mesh does not say what it is in, or a vertex leaves the range of
            float64.
    Example:
        >>> part = gk.mesh.TriangleMesh([[0, 0, 0], [4, 0, 0], [0, 2, 0]], [[0, 1, 2]], meters_per_unit=0.0254)
        >>> gk.mesh.convert_unit(part, "mm").bounds[1].tolist()
        [101.6, 50.8, 0.0]
    """
    mesh = require_mesh(mesh, "mesh")
    meters, up = mesh.meters_per_unit, mesh.up_axis
    if from_unit is not None:
        meters = meters_in(from_unit, "from_unit")
    if from_up_axis is not None:
        up = require_choice(from_up_axis, "from_up_axis", _AXES)
    matrix = np.eye(4)
    if up_axis is not None:
        if up is None:
            raise InputError("up_axis: the mesh does not say which axis is up now; give from_up_axis")
        wanted = require_choice(up_axis, "up_axis", _AXES)
        matrix[:3, :3] = _turn(_AXES.index(up), _AXES.index(wanted))
        up = wanted
    if unit is not None:
        new = meters_in(unit, "unit")
        if meters is None:
            raise InputError("unit: the mesh does not say what its unit is now; give from_unit")
        # From a larger unit the ratio is a whole number more often than its inverse is.
        ratio = meters / new if meters >= new else 1.0 / (new / meters)
        if not 0.0 < ratio < np.inf:
            raise InputError(f"unit: {meters:g} m in units of {new:g} m leaves the range of float64; give another unit")
        matrix[:3, :3] *= ratio
        meters = new
    moved = mesh if np.array_equal(matrix, np.eye(4)) else transform(mesh, matrix)
    return with_data(moved, meters_per_unit=meters, up_axis=up)


def meters_in(unit: Any, name: str) -> float:
    """Length of a unit [m], which is given by name or as that.

    Raises:
        InputError: It is neither.
    """
    if isinstance(unit, str):
        known = _METERS.get(unit.strip().lower())
        if known is None:
            shown = ", ".join(names[0] for names in UNITS.values())
            raise InputError(f"{name}: {described(unit)} is no known unit; use one of {shown}, or a length in meters")
        return known
    meters = require_number(unit, name)
    if not 0.0 < meters < np.inf:
        raise InputError(f"{name}: {described(unit)} is no length; give the unit's length in meters, as in 0.001")
    return float(meters)


def _turn(old: int, new: int) -> NDArray[np.float64]:
    """The quarter turn that takes one axis to another, about the third."""
    matrix = np.eye(3)
    if old != new:
        matrix[old, old] = matrix[new, new] = 0.0
        matrix[new, old], matrix[old, new] = 1.0, -1.0
    return matrix
