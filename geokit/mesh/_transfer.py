"""Attributes of one mesh on another, by closest points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop.types import Device, MeshLike
from geokit.core.memory.needs import needs
from geokit.core.require import require_one_world
from geokit.mesh.attributes.derived import with_data
from geokit.mesh.attributes.interpolation import (
    chosen_names,
    closest_weights,
    interpolated,
    interpolation_bytes,
    weights_within,
)
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.simplification.invariants import alike_near
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.surfaces.surface import Surface

# How far a corner is moved towards the middle of its face, as a share of the way, so that the closest point lies on its
# own side of a crease or a seam.
INWARDS = 0.01
# Where triangles that face the same way are looked for first, as a share of the way.
FIRST_SHARE = 1.0 / 64.0


def _bytes(mesh: TriangleMesh, source: TriangleMesh | Surface, **_: Any) -> float:
    held = source.mesh if isinstance(source, Surface) else require_mesh(source, "source")
    corners, faces = 3 * mesh.face_count if held.corner_data else 0, mesh.face_count if held.face_data else 0
    points = max(mesh.vertex_count if held.vertex_data else 0, corners, faces)
    return 176 * mesh.face_count + 120 * corners + 48 * held.face_count + interpolation_bytes(held) * points


@needs(_bytes)
def transfer_attributes(
    mesh: MeshLike, source: MeshLike | Surface, *, names: Sequence[str] | None = None, device: Device = None
) -> TriangleMesh:
    """Give a mesh the attributes of another one, by closest points.

    Attributes of vertices are those of the source at the closest points of the mesh's vertices, attributes of faces
    those of the closest face of the face's middle. Attributes of corners are taken on the side of the face: a face that
    lies across a seam of the source mixes both sides. They are interpolated as in
    :meth:`geokit.mesh.Surface.sample_attributes`.

    Faces get nothing from the other side of a thin wall: if the closest triangle faces away from the face, or from the
    vertex's normal, the closest one that does not is taken, as far as the face's longest edge beyond it. So both meshes
    are to be wound alike; if no triangle faces the same way, the closest one is taken.

    The mesh keeps its other attributes. With ``material`` it gets the materials of the source.

    Args:
        mesh: The mesh that gets the attributes.
        source: The mesh, or its surface, that has them.
        names: The attributes; None for all.
        device: Where to search closest points of a mesh; None for the first GPU, else the CPU.
    Returns:
        The mesh with the attributes.
    Raises:
        InputError: One is not a mesh, the source has no faces or no attribute of a name, there is no such device, or
            units or up axes are known and differ.
    Example:
        >>> torus = gk.mesh.load("data/samples/torus.ply")
        >>> heights = gk.mesh.TriangleMesh(torus.vertices, torus.faces, vertex_data={"height": torus.vertices[:, 2]})
        >>> small = gk.mesh.simplify(torus, tolerance=0.01).mesh
        >>> small = gk.mesh.transfer_attributes(small, heights)
        >>> bool(abs(small.vertex_data["height"] - small.vertices[:, 2]).max() < 0.01)
        True
    """
    mesh = require_mesh(mesh, "mesh")
    if not isinstance(source, Surface):
        source = Surface(require_mesh(source, "source"), device=device)
    held = source.mesh
    require_one_world(mesh=mesh, source=held)
    asked = chosen_names(held, names)
    data: dict[str, dict[str, NDArray[Any]]] = {
        kind: dict(getattr(mesh, kind)) for kind in ("vertex_data", "face_data", "corner_data")
    }

    def wanted(kind: str) -> list[str]:
        return (
            [name for name in asked if name in getattr(held, kind)] if mesh.face_count or kind == "vertex_data" else []
        )

    corners = mesh.vertices[mesh.faces]
    middle, reach = corners.mean(axis=1), _reach(mesh)
    if found := wanted("vertex_data"):
        widest = np.zeros(mesh.vertex_count)
        np.maximum.at(widest, mesh.faces, reach[:, None])
        triangle_id, weights = _closest(source, mesh.vertices, mesh.vertex_normals, widest)
        plain = with_data(held, corner_data={}, face_data={})
        data["vertex_data"] |= interpolated(plain, triangle_id, weights, found)
    if found := wanted("face_data"):
        plain = with_data(held, corner_data={}, vertex_data={})
        triangle_id, weights = _closest(source, middle, mesh.face_normals, reach)
        data["face_data"] |= interpolated(plain, triangle_id, weights, found)
    if found := wanted("corner_data"):
        inside = corners + INWARDS * (middle[:, None] - corners)
        normals = np.repeat(mesh.face_normals, 3, axis=0)
        triangle_id, _ = _closest(source, inside.reshape(-1, 3), normals, np.repeat(reach, 3))
        weights = weights_within(held.vertices[held.faces[triangle_id]], corners.reshape(-1, 3))
        for name, values in interpolated(held, triangle_id, weights, found).items():
            data["corner_data"][name] = values.reshape(-1, 3, *values.shape[1:])
    materials = held.materials if "material" in wanted("face_data") else mesh.materials
    return with_data(mesh, **data, materials=materials)


def _reach(mesh: TriangleMesh) -> NDArray[np.float64]:
    """The longest edge of each face: with fewer faces a mesh may leave its original's surface by about as much."""
    corners = mesh.vertices[mesh.faces]
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1))


def _closest(
    surface: Surface, points: NDArray[np.float64], normals: NDArray[np.float64], reach: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Closest triangles that face as the points' normals do, and the weights of their corners.

    If there is none within ``reach`` of a point and its distance, or the normal is zero, any triangle is taken.
    """
    found, held, facing = surface.closest_point(points), surface.mesh, surface.mesh.face_normals
    triangle_id, weights = found.triangle_id.copy(), found.barycentric.copy()
    away = np.einsum("ij,ij->i", normals, facing[triangle_id]) <= 0.0
    left = np.flatnonzero(away & normals.any(axis=1))
    most = reach + found.distance
    radius: Any = np.maximum(2.0 * found.distance, most * FIRST_SHARE)
    while len(left):
        radius[left] = np.minimum(radius[left], most[left])
        for block, row, near in alike_near(surface, facing, points[left], normals[left], radius[left]):
            at = left[block[row]]
            shares, distance = closest_weights(held.vertices[held.faces[near]], points[at])
            # A box reaches farther than its half width.
            row, near, at, shares, distance = (a[distance <= radius[at]] for a in (row, near, at, shares, distance))
            order = np.lexsort((near, distance, row))
            best = order[np.unique(row[order], return_index=True)[1]]
            triangle_id[at[best]], weights[at[best]], away[at[best]] = near[best], shares[best], False
        left = left[away[left] & (radius[left] < most[left])]
        radius[left] *= 4.0
    return triangle_id, weights
