"""How inside is told from outside: orientation first, then pseudonormals, winding numbers or rays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit import _arrays, _launch
from geokit.mesh._merge import merge_equal_points
from geokit.mesh.model import TriangleMesh

if TYPE_CHECKING:
    import warp as wp

__all__ = ["Orientation", "find_orientation", "pseudonormal_tables"]

# Directions of the rays that vote; along no axis or diagonal, where meshes like to have edges and vertices in a row.
PARITY_DIRECTIONS = (
    (0.7548776662, 0.5698402910, 0.3247179572),
    (-0.4142135, 0.7320508, -0.5412),
    (0.2360679, -0.6180, 0.7861513),
)


class Orientation(NamedTuple):
    """Which faces count as turned, (F,) bool, and whether every edge joins two triangles that wind alike."""

    flipped: NDArray[np.bool_]
    closed: bool


def find_orientation(mesh: TriangleMesh) -> Orientation:
    """All faces of a closed mesh that is inside out are turned, those of others are not."""
    from geokit.mesh.audit import audit

    report = audit(mesh)
    return Orientation(np.full(len(mesh.faces), report.inside_out), report.watertight and report.oriented)


def pseudonormal_tables(mesh: TriangleMesh, flipped: NDArray[np.bool_], device: "wp.Device") -> list["wp.array"]:
    """What :func:`pseudonormal` reads: vertices, faces, flipped, the triangle across each edge (-1 for none), the
    vertex normal of each corner, and the angle-weighted vertex normals, one for each position.
    """
    import warp as wp

    first, group = merge_equal_points(mesh.vertices)
    corners = group[mesh.faces]
    normals = _vertex_normals(mesh, flipped, corners, len(first))

    def on_device(values: NDArray[Any], dtype: Any) -> "wp.array":
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

    return [
        on_device(mesh.vertices, wp.vec3d),
        on_device(mesh.faces.ravel(), wp.int32),
        on_device(flipped, wp.bool),
        on_device(_across(corners), wp.int32),
        on_device(corners.ravel(), wp.int32),
        on_device(normals, wp.vec3d),
    ]


def _vertex_normals(
    mesh: TriangleMesh, flipped: NDArray[np.bool_], corners: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    points = mesh.vertices[mesh.faces]
    edges = [points[:, (k + 1) % 3] - points[:, k] for k in range(3)]
    with np.errstate(divide="ignore", invalid="ignore"):
        units = [edge / np.linalg.norm(edge, axis=1, keepdims=True) for edge in edges]
        # Of unit edges: products of short ones would underflow. Two edges may be parallel in a sliver, not all three.
        normal = np.cross(units[0], -units[2])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[flipped] *= -1.0
    summed = np.zeros((count, 3))
    for k in range(3):
        towards, back = units[k], -units[(k + 2) % 3]
        # The angle from both its sine and its cosine is good to rounding, for slivers too.
        sine = np.linalg.norm(np.cross(towards, back), axis=1)
        angle = np.arctan2(sine, np.einsum("ij,ij->i", towards, back))
        weighted = np.nan_to_num(normal * angle[:, None])
        for axis in range(3):
            summed[:, axis] += np.bincount(corners[:, k], weighted[:, axis], minlength=count)
    return summed


def _across(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """For the edge from corner k of each triangle to the next, number 3 f + k, the triangle on its other side."""
    start, end = corners.ravel(), corners[:, (1, 2, 0)].ravel()
    key = np.minimum(start, end) * (int(corners.max()) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    step = np.concatenate([[True], ordered[1:] != ordered[:-1], [True]])
    # Pairs: an edge that begins at i and whose next one begins at i + 2.
    pairs = np.flatnonzero(step[:-2] & ~step[1:-1] & step[2:])
    across = np.full(len(key), -1, np.int64)
    one, other = order[pairs], order[pairs + 1]
    across[one], across[other] = other // 3, one // 3
    return across


def by_pseudonormal(found: list[Any], tables: list["wp.array"], distance: "wp.array", device: "wp.Device") -> None:
    from geokit.mesh._sign_kernels import pseudonormal_sign_kernel

    _launch.launch(pseudonormal_sign_kernel, len(distance), [*found, *tables], [distance], device)


def any_missed(triangle_id: "wp.array") -> bool:
    import warp as wp

    from geokit.mesh._sign_kernels import missed_kernel

    found = wp.zeros(1, dtype=wp.int32, device=triangle_id.device)
    _launch.launch(missed_kernel, len(triangle_id), [triangle_id], [found], triangle_id.device)
    return bool(found.numpy()[0])


def missed_by_winding(winding: "wp.array", closest: Any, device: "wp.Device") -> None:
    from geokit.mesh._sign_kernels import missed_sign_kernel

    _launch.launch(missed_sign_kernel, len(winding), [winding, closest.triangle_id], [closest.distance], device)


def by_parity(surface: Any, points: "wp.array", distance: "wp.array") -> None:
    import warp as wp

    from geokit.mesh._sign_kernels import parity_sign_kernel, vote_kernel

    count, device = len(points), points.device
    votes = wp.zeros(count, dtype=wp.int32, device=device)
    rays = _arrays.Batch(points, False, lambda out: out)
    for direction in PARITY_DIRECTIONS:
        heading = wp.full(count, wp.vec3d(*direction), dtype=wp.vec3d, device=device)
        crossings = surface._count_crossings(rays, _arrays.Batch(heading, False, lambda out: out), 0.0, np.inf)
        _launch.launch(vote_kernel, count, [crossings], [votes], device)
    needed = len(PARITY_DIRECTIONS) // 2 + 1
    _launch.launch(parity_sign_kernel, count, [votes, needed], [distance], device)
