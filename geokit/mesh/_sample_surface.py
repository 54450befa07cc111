"""Points on a mesh's surface: uniform by area, or evenly spread with a minimum distance."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop.types import MeshLike
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory import available_memory
from geokit.core.memory.needs import needs
from geokit.core.require import require_choice, require_count
from geokit.errors import InputError
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.queries import poisson_disk
from geokit.mesh.surfaces.objects import require_mesh

# Their corners fit into the caches.
FACES_AT_A_TIME = 1 << 14
# So many take a hundred kilobytes.
FEW_FACES = 1 << 9

METHODS = ("uniform", "poisson_disk")
# A point with its triangle, weights and corners, and the copies while they are made (220 measured). Not less: where
# memory runs out in the buffers of a sum, NumPy ends the process.
BYTES_PER_SAMPLE = 230
# A point that is as far from the others as it must be, with the candidates and cells around it.
BYTES_PER_DART = 1170


class SurfaceSamples(NamedTuple):
    """Points on a surface.

    Attributes:
        points: The points [world], shape (N, 3).
        triangle_id: Triangles that they lie on, shape (N,) int32.
        barycentric: Weights of the triangles' corners there, shape (N, 3).
        radius: No two points are nearer to each other than that [world]; 0.0 for uniform samples.
    """

    points: NDArray[np.float64]
    triangle_id: NDArray[np.int32]
    barycentric: NDArray[np.float64]
    radius: float


def samples_bytes(
    mesh: TriangleMesh, count: int | None = None, *, method: str = "uniform", radius: float | None = None, **_: Any
) -> float:
    if method == "uniform":
        return BYTES_PER_SAMPLE * (count or 0)
    if radius is None:
        return BYTES_PER_SAMPLE * poisson_disk.CANDIDATES_PER_POINT * (count or 0)
    # The area by some of the faces: this is asked where there is no memory for all.
    step = max(1, mesh.face_count // 4096)
    with np.errstate(all="ignore"):
        corners = mesh.vertices[mesh.faces[::step]] / radius
        doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    return BYTES_PER_DART * poisson_disk.SATURATED_SHARE * 0.5 * step * float(doubled)


@needs(samples_bytes, late=True)
def sample_surface(
    mesh: MeshLike, count: int | None = None, *, method: str = "uniform", radius: float | None = None, seed: int = 0
) -> SurfaceSamples:
    """Random points on the surface; the same mesh, arguments and seed give the same points.

    - "uniform": independent points. A triangle is chosen in proportion to its area, and the point is uniform in it.
    - "poisson_disk" with ``count``: exactly that many points, evenly spread. Their minimum distance is returned as
      ``radius``: about 0.8 times the square root of the area per point, less on thin or folded shapes.
    - "poisson_disk" with ``radius``: points at least that far apart, as many as random throwing finds; less than half a
      percent of the surface has room for another point.

    Distances between points are straight lines through space, ``sqrt((dx * dx + dy * dy) + dz * dz)`` in float64. The
    minimum holds for every pair up to the last digit of that square root. Points lie on their triangles to 4 roundings
    of the largest coordinate. Triangles without area are never chosen.

    Args:
        mesh: The triangles.
        count: Number of points; required by "uniform". "poisson_disk" takes either this or ``radius``.
        method: "uniform" or "poisson_disk".
        radius: Minimum distance between any two points [world], for "poisson_disk".
        seed: Seed of the random numbers, 0 or more.
    Returns:
        SurfaceSamples with points (N, 3) [world], triangle_id (N,), barycentric (N, 3), radius.
    Raises:
        InputError: mesh is not a TriangleMesh, or its area is zero; there is no such method; count is missing, negative
            or not a whole number; radius is not a positive finite number or does not go with the method and count; seed
            is negative or not a whole number; or float64 does not have ``count`` different points on the surface.
        DeviceMemoryError: That many points, or points that far apart, would not fit in memory.
    Source:
        Turk, "Generating random points in triangles" (1990), by folding the square. Cook, "Stochastic sampling in
        computer graphics" (1986); for a given count McCool and Fiume, "Hierarchical Poisson disk sampling
        distributions" (1992). Differs: on surfaces, candidates drawn beforehand.
    Example:
        >>> triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> gk.mesh.sample_surface(triangle, 1000).points.shape
        (1000, 3)
        >>> gk.mesh.sample_surface(triangle, 100, method="poisson_disk").radius > 0.05
        True
    """
    mesh = require_mesh(mesh, "mesh", images=False)
    count, radius = _checked(count, method, radius)
    generator = np.random.default_rng(require_count(seed, "seed"))
    if count == 0:
        return SurfaceSamples(np.empty((0, 3)), np.empty(0, np.int32), np.empty((0, 3)), 0.0)
    available_memory.require_room(
        (count or 0) * BYTES_PER_SAMPLE,
        f"count: {count} points need",
        lambda times: f"ask for {int((count or 0) / times)} or fewer",
    )
    scale, areas = scaled_areas(mesh)
    bounds = np.cumsum(areas)
    label = mesh.name or "the mesh"
    if len(bounds) == 0 or not bounds[-1] > 0.0:
        raise InputError(f"mesh: {label} has no area to put a point on; give one with triangles that have")

    def draw(n: int) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
        return _draw(mesh, bounds, n, generator)

    if method == "uniform":
        assert count is not None
        triangle_id, barycentric, points = draw(count)
        return SurfaceSamples(points, triangle_id, barycentric, 0.0)
    lower, upper = mesh.bounds * scale
    place = scale, float(bounds[-1]), lower, float((upper - lower).max()), label
    if radius is None:
        assert count is not None
        (triangle_id, barycentric, points), radius = poisson_disk.throw_count(draw, count, *place)
    else:
        (triangle_id, barycentric, points), radius = poisson_disk.throw_radius(draw, radius, *place)
    return SurfaceSamples(points, triangle_id, barycentric, radius)


def _checked(count: Any, method: str, radius: Any) -> tuple[int | None, float | None]:
    require_choice(method, "method", METHODS)
    if method == "uniform":
        if count is None:
            raise InputError("count: method 'uniform' needs the number of points; give one")
        if radius is not None:
            raise InputError("radius: method 'uniform' keeps no distance; use method='poisson_disk' or leave it out")
    elif (count is None) == (radius is None):
        raise InputError("count: method 'poisson_disk' takes either count or radius; give one of them")
    return (
        None if count is None else require_count(count, "count"),
        None if radius is None else require_finite_scalar(radius, "radius", low=0.0),
    )


def scaled_areas(mesh: TriangleMesh) -> tuple[float, NDArray[np.float64]]:
    """A power of two that scales the mesh to about unit size, and the areas (F,) of its triangles at that size."""
    scale, areas, first = _scale_of(mesh), np.empty(len(mesh.faces)), 0
    for block in _area_blocks(mesh, scale, FACES_AT_A_TIME):
        areas[first : first + len(block)] = block
        first += len(block)
    return scale, areas


def total_area(mesh: TriangleMesh) -> tuple[float, float]:
    """The scale of :func:`scaled_areas`, and the sum of the areas, in little memory: for estimates where it ran out."""
    scale = _scale_of(mesh)
    return scale, sum(float(block.sum()) for block in _area_blocks(mesh, scale, FEW_FACES))


def _scale_of(mesh: TriangleMesh) -> float:
    lower, upper = mesh.bounds
    # Halved before the difference: boxes as large as float64 must not overflow.
    half = float(np.max(upper * 0.5 - lower * 0.5)) if len(mesh.faces) else 0.0
    return math.ldexp(1.0, -math.frexp(half)[1]) if half > 0.0 else 1.0


def _area_blocks(mesh: TriangleMesh, scale: float, count: int) -> Iterator[NDArray[np.float64]]:
    """Areas of the scaled triangles, so many at a time."""
    for first in range(0, len(mesh.faces), count):
        corners = mesh.faces[first : first + count].T
        # Axis by axis: numpy.cross over rows of three is many times slower.
        a, b, c = (np.ascontiguousarray(mesh.vertices.take(corner, axis=0).T) * scale for corner in corners)
        (ux, uy, uz), (vx, vy, vz) = b - a, c - a
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        yield 0.5 * np.sqrt(x * x + y * y + z * z)


def _draw(
    mesh: TriangleMesh, bounds: NDArray[np.float64], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
    """Uniform samples: triangle_id, barycentric, points. ``bounds`` are the cumulative areas."""
    choice, v, w = generator.random((3, count))
    # The first triangle whose cumulative area exceeds the number; one without area is never the first.
    triangle_id = np.searchsorted(bounds, choice * bounds[-1], side="right").astype(np.int32)
    beyond = v + w > 1.0
    v, w = np.where(beyond, 1.0 - v, v), np.where(beyond, 1.0 - w, w)
    barycentric = np.stack([1.0 - (v + w), v, w], axis=1)
    # take() is several times faster than fancy indexing.
    a, b, c = (mesh.vertices.take(corner, axis=0) for corner in mesh.faces.take(triangle_id, axis=0).T)
    # Built from differences: a coordinate that all corners share stays exactly the same.
    points = a + v[:, None] * (b - a) + w[:, None] * (c - a)
    return triangle_id, barycentric, points
