"""Triangulation of the polygons of files, and their joining into one mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory.row_products import row_product
from geokit.errors import FileFormatError, InputError
from geokit.formats.attributes.joined import JoinedData
from geokit.formats.ears import clip_ears
from geokit.formats.file_content.body import Body
from geokit.mesh.model.triangle_mesh import MeshPart, TriangleMesh

__all__ = ["join", "triangulate"]


def join(bodies: list[Body], path: Path, name: str) -> TriangleMesh:
    """Join the bodies of a file into one mesh: transforms applied, polygons triangulated, names kept as parts.

    Attributes follow; a warning names those that are left out.

    Raises:
        FileFormatError: There is no polygon, a polygon has fewer than three corners, an index is out of range, or a
            vertex is not finite; the message names the file, the body and the first bad row.
    """
    if not any(len(body.counts) for body in bodies):
        held = sum(len(body.points) for body in bodies)
        what = f"holds {held} points but no faces" if held else "holds neither points nor faces"
        raise FileFormatError(f"{path}: {what}; a mesh needs faces, export the surface itself")
    vertices, faces, parts, data = [], [], [], JoinedData()
    first_vertex = first_face = 0
    for body in bodies:
        where = f"{path}, body {body.name!r}" if len(bodies) > 1 else str(path)
        points = np.asarray(body.points, np.float64)
        counts, indices = np.asarray(body.counts, np.int64), np.asarray(body.indices, np.int64)
        _check(points, counts, indices, where)
        body, points, indices = _without_unused(body, points, indices, where)
        flip = body.clockwise
        if body.transform is not None:
            linear = body.transform[:3, :3]
            # A mirroring transform turns a body inside out, so the winding is reversed.
            flip ^= bool(np.linalg.det(linear) < 0.0)
            with np.errstate(over="ignore", invalid="ignore"):
                points = row_product(points, linear.T, body.transform[:3, 3])
        corners, polygon = _triangulated(points, counts, indices)
        triangles = indices.reshape(-1, 3) if corners is None else indices[corners]
        if flip:
            triangles = triangles[:, ::-1]
        data.add(body, polygon, corners, reverse=flip)
        for part, first, count in body.groups or ((body.name, 0, len(counts)),):
            begin, end = np.searchsorted(polygon, (first, first + count))
            parts.append(MeshPart(part, first_face + int(begin), int(end - begin)))
        vertices.append(points)
        faces.append(triangles + first_vertex)
        first_vertex += len(points)
        first_face += len(triangles)
    if first_vertex > np.iinfo(np.int32).max:
        raise FileFormatError(f"{path}: {first_vertex} vertices are more than 32-bit indices reach; split the file")
    attributes = data.arguments(path)
    try:
        return TriangleMesh(
            np.concatenate(vertices),
            np.concatenate(faces),
            name=name,
            parts=tuple(parts) if len(parts) > 1 else (),
            **attributes,
        )
    except InputError as error:  # a transform that overflows
        raise FileFormatError(f"{path}: {error}") from error


def triangulate(
    points: NDArray[np.float64], counts: NDArray[np.int64], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangulate polygons; the triangles keep the winding and the order of the polygons.

    A convex polygon becomes the fan from its first corner, a concave quad the fan from its reflex corner. Other concave
    polygons lose one ear after the other, on the plane of their mean (Newell) normal, so that no triangle is flipped. A
    polygon that crosses itself has no correct triangulation: where no ear is left, its flattest corner is cut off,
    until there are ``corners - 2`` triangles, whose signed areas add up to the polygon's.

    Args:
        points: Vertex positions, shape (V, 3).
        counts: Corners of each polygon, shape (P,), all >= 3.
        indices: Vertex indices of all corners, shape (sum(counts),), all in [0, V).
    Returns:
        Triangles (T, 3), and the polygon (T,) of each, ascending.
    Source:
        Meisters, Polygons have ears (1975); Newell's normal as in Sutherland et al. (1974).
    """
    corners, polygon = _triangulated(points, counts, indices)
    return indices.reshape(-1, 3) if corners is None else indices[corners], polygon


def _triangulated(
    points: NDArray[np.float64], counts: NDArray[np.int64], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64] | None, NDArray[np.int64]]:
    """:func:`triangulate`, with places in ``indices`` in place of what stands there; None where all are triangles."""
    triangle_counts = counts - 2
    polygon = np.repeat(np.arange(len(counts)), triangle_counts)
    if np.all(counts == 3):
        return None, polygon
    faces = np.empty((len(polygon), 3), np.int64)
    first_corner = np.cumsum(counts) - counts
    first_triangle = np.cumsum(triangle_counts) - triangle_counts
    for size in np.unique(counts):
        members = np.flatnonzero(counts == size)
        corners = first_corner[members][:, None] + np.arange(size)
        triangles = _fan(corners)
        if size > 3:
            turns = _turns(points[indices[corners]])
            # Rounding must not send flat corners of convex polygons to the ear clipper, which would be correct but
            # slow.
            reflex = turns < -1e-12 * np.max(np.abs(turns), axis=1, keepdims=True)
            concave = np.flatnonzero(reflex.any(axis=1))
            if size == 4:
                rolled = (np.argmin(turns[concave], axis=1)[:, None] + np.arange(4)) % 4
                triangles[concave] = _fan(np.take_along_axis(corners[concave], rolled, axis=1))
            else:
                for row in concave:
                    triangles[row] = corners[row][clip_ears(_flatten(points[indices[corners[row]]]))]
        faces[first_triangle[members][:, None] + np.arange(size - 2)] = triangles
    return faces, polygon


def _check(points: NDArray[Any], counts: NDArray[Any], indices: NDArray[Any], where: str) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise FileFormatError(f"{where}: points of shape {points.shape} are not (N, 3); export the file again")
    small = counts < 3
    if small.any():
        row = int(np.argmax(small))
        raise FileFormatError(f"{where}: face {row} has {counts[row]} corners; a face needs three or more, remove it")
    if counts.sum() != len(indices):
        raise FileFormatError(
            f"{where}: the faces ask for {counts.sum()} corners but {len(indices)} are there; export the file again"
        )
    outside = (indices < 0) | (indices >= len(points))
    if outside.any():
        corner = int(np.argmax(outside))
        row = int(np.searchsorted(np.cumsum(counts), corner, side="right"))
        raise FileFormatError(
            f"{where}: face {row} (counted from 0) uses vertex {indices[corner]}, but there are {len(points)} "
            "(indices counted from 0); the file is damaged, export it again"
        )


def _without_unused(
    body: Body, points: NDArray[np.float64], indices: NDArray[np.int64], where: str
) -> tuple[Body, NDArray[np.float64], NDArray[np.int64]]:
    """The body, its points and its indices without points that are not finite and that no face uses.

    Raises:
        FileFormatError: A face uses a point that is not finite.
    """
    bad = np.atleast_1d(~np.isfinite(points).all(axis=1))
    if not bad.any():
        return body, points, indices
    used = np.zeros(len(points), bool)
    used[indices] = True
    if (bad & used).any():
        row = int(np.argmax(bad & used))
        raise FileFormatError(
            f"{where}: vertex {row} (counted from 0) is not finite ({points[row].tolist()}); "
            "remove it and the faces that use it"
        )
    kept = ~bad
    note = f"vertices that are not finite and that no face uses are left out: {int(bad.sum())}, the first is vertex "
    note += str(int(np.argmax(bad)))
    vertex = {
        name: np.asarray(values)[kept] if len(values) == len(kept) else values
        for name, values in body.vertex_data.items()
    }
    body = body._replace(points=points[kept], vertex_data=vertex, notes=(*body.notes, note))
    return body, points[kept], (np.cumsum(kept) - 1)[indices]


def _fan(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Fans from the first corner: (M, n) -> (M, n - 2, 3)."""
    apex = np.broadcast_to(corners[:, :1], corners[:, 1:-1].shape)
    return np.stack([apex, corners[:, 1:-1], corners[:, 2:]], axis=2)


def _turns(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn at each corner, positive where convex, seen along the mean normal: (M, n, 3) -> (M, n)."""
    # Relative to the first corner, so that far-away polygons keep their digits; halved, since differences could
    # overflow.
    local = points * 0.5 - points[:, :1] * 0.5
    # Scaled to unit size, so that products of four lengths neither underflow nor overflow.
    size = np.max(np.abs(local), axis=(1, 2), keepdims=True)
    local = local / np.where(size > 0.0, size, 1.0)
    following = np.roll(local, -1, axis=1)
    normal = np.cross(local, following).sum(axis=1)
    into = local - np.roll(local, 1, axis=1)
    return np.einsum("mnk,mk->mn", np.cross(into, following - local), normal)


def _flatten(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project a polygon (n, 3) to the plane of its mean normal, counter-clockwise, (n, 2)."""
    local = points * 0.5 - points[0] * 0.5
    local = local / (np.max(np.abs(local)) or 1.0)
    normal = np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    # Dropping the normal's largest axis preserves the order of corners and all inside tests.
    flat = local[:, [(axis + 1) % 3, (axis + 2) % 3]]
    return flat if normal[axis] >= 0.0 else flat * (-1.0, 1.0)
