"""Areas, volumes and shapes of single triangles, in float64 at unit size."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.memory.host_array import HostArray
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.topology.connectivity import kernels_pay

# A triangle whose height is under this share of its longest edge has no area. For float64 coordinates at a distance of
# 1e4 edges the height has that much noise, so that the normal consists of rounding alone.
DEGENERATE_RATIO = 1e-12
# Faces per block: the intermediate results stay in the caches, which is four times faster than all faces at once.
BLOCK = 1 << 13


class FaceMeasures(NamedTuple):
    """Measures of each triangle, (F,), of the mesh moved to the origin and divided by ``size``.

    Attributes:
        size: A power of two near half the longest side of the bounds [world].
        twice_area: Twice the area.
        six_volume: Six times the signed volume of the tetrahedron with the center of the bounds.
        longest_squared: Square of the longest edge.
        perimeter: Sum of the edges.
    """

    size: float
    twice_area: NDArray[np.float64]
    six_volume: NDArray[np.float64]
    longest_squared: NDArray[np.float64]
    perimeter: NDArray[np.float64]

    @property
    def flat(self) -> NDArray[np.bool_]:
        """Triangles without area."""
        return self.twice_area <= DEGENERATE_RATIO * self.longest_squared


def faces_without_area(mesh: TriangleMesh) -> NDArray[np.bool_]:
    """Triangles whose height is under DEGENERATE_RATIO of their longest edge, (F,)."""
    return measure_faces(mesh, mesh.bounds).flat


def largest_of_each(part: NDArray[Any], size: NDArray[np.float64]) -> NDArray[np.int64]:
    """For each component, the index of its largest face."""
    order = np.lexsort([size, part])
    last = np.append(part[order][1:] != part[order][:-1], True)
    return order[last]


def measure_faces(mesh: TriangleMesh, bounds: NDArray[np.float64]) -> FaceMeasures:
    """Measures of all triangles; ``bounds`` is the mesh's bounding box."""
    count = len(mesh.faces)
    measured = np.empty((4, count))
    if count == 0:
        return FaceMeasures(1.0, *measured)
    lower, upper = bounds
    middle = lower * 0.5 + upper * 0.5
    # At about unit size, so that products of lengths neither overflow nor underflow; a power of two does not round.
    exponent = math.frexp(float(np.max(upper * 0.5 - lower * 0.5)))[1]
    size = math.ldexp(1.0, max(exponent - 1, -1022))
    if kernels_pay(count):
        _measure_by_kernel(mesh, middle, size, measured)
        return FaceMeasures(size, *measured)
    # Unused vertices may lie anywhere, also where this overflows.
    with np.errstate(over="ignore"):
        local = [(mesh.vertices[:, axis] - middle[axis]) * (1.0 / size) for axis in range(3)]
    for begin in range(0, count, BLOCK):
        _measure(local, mesh.faces[begin : begin + BLOCK], measured[:, begin : begin + BLOCK])
    return FaceMeasures(size, *measured)


def measure_each(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], begin: NDArray[np.int64], bounds: NDArray[np.float64]
) -> NDArray[np.float64]:
    """``twice_area``, ``six_volume`` and ``longest_squared`` of the faces of many meshes, (3, F).

    Each mesh gets the bits that :func:`measure_faces` gives it alone.

    Args:
        vertices: Positions [world], (V, 3).
        faces: Vertex indices, (F, 3).
        begin: The first face of each mesh, and F, (B + 1,).
        bounds: Their bounding boxes, (B, 2, 3).
    """
    lower, upper = bounds[:, 0], bounds[:, 1]
    middle = lower * 0.5 + upper * 0.5
    exponent = np.frexp((upper * 0.5 - lower * 0.5).max(axis=1))[1]
    inverse = 1.0 / np.ldexp(1.0, np.maximum(exponent - 1, -1022))
    owner = np.repeat(np.arange(len(bounds)), np.diff(begin))
    measured = np.empty((4, len(faces)))
    for first in range(0, len(faces), BLOCK):
        rows = slice(first, first + BLOCK)
        corners, mesh = faces[rows].ravel(), np.repeat(owner[rows], 3)
        local = [(vertices[corners, axis] - middle[mesh, axis]) * inverse[mesh] for axis in range(3)]
        _measure(local, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), measured[:, rows])
    return measured[:3]


def _measure_by_kernel(
    mesh: TriangleMesh, middle: NDArray[np.float64], size: float, measured: NDArray[np.float64]
) -> None:
    """The same measures by a kernel, equal to the last bit."""
    from geokit.mesh.topology.measures_kernels import measure_kernel

    device = launcher.resolve_device("cpu")
    inputs = [HostArray(mesh.vertices), HostArray(mesh.faces.reshape(-1)), tuple(middle.tolist()), 1.0 / size]
    launcher.launch(measure_kernel, len(mesh.faces), inputs, [HostArray(row) for row in measured], device)


def _measure(local: list[NDArray[np.float64]], faces: NDArray[np.int32], measured: NDArray[np.float64]) -> None:
    # Axis by axis, because NumPy is fast with contiguous columns.
    columns = [np.ascontiguousarray(faces[:, corner]) for corner in range(3)]
    a, b, c = ([np.take(axis, column) for axis in local] for column in columns)
    ab, ac, bc = ([q - p for p, q in zip(*ends, strict=True)] for ends in ((a, b), (a, c), (b, c)))
    cross = [ab[1] * ac[2] - ab[2] * ac[1], ab[2] * ac[0] - ab[0] * ac[2], ab[0] * ac[1] - ab[1] * ac[0]]
    squares = [_dot(edge, edge) for edge in (ab, ac, bc)]
    measured[0] = np.sqrt(_dot(cross, cross))
    # a . (ab x ac) is six times the volume of the tetrahedron with the center.
    measured[1] = _dot(a, cross)
    measured[2] = np.maximum(np.maximum(squares[0], squares[1]), squares[2])
    measured[3] = np.sqrt(squares[0]) + np.sqrt(squares[1]) + np.sqrt(squares[2])


def _dot(p: list[NDArray[np.float64]], q: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]
