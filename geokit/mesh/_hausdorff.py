"""The Hausdorff distance between two surfaces within proven bounds, and mean and rms distances from samples."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.snapshot import snapshot
from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop.types import Device, MeshLike
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_count, require_one_world
from geokit.errors import InputError
from geokit.mesh._sample_surface import BYTES_PER_SAMPLE, sample_surface, scaled_areas
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.queries.hausdorff import DistanceSearch
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.surfaces.surface import BYTES_PER_FACE, Surface
from geokit.mesh.topology.size_limits import require_measurable

# This gives a standard error of about 0.3% of the mean where distances vary as much as they are large, and takes a
# tenth of a second on a CPU.
SAMPLES = 100_000
# closest_point is exact to 1e-12 of the diagonal: bounds closer than a few times that cannot be told apart, ...
LEAST_TOLERANCE = 4e-12
# ... nor bounds closer than a few roundings of the coordinates, where triangles cannot be cut any more.
COORDINATE_ROUNDINGS = 32.0 * np.finfo(np.float64).eps
# Vertices come first. Samples and cuts lie on the surface only to some roundings of the coordinates, so one of them
# replaces a vertex only if it is farther by more than that. The distance of a mesh from itself is thus 0.
WITNESS_ROUNDINGS = 8.0 * np.finfo(np.float64).eps


class DirectedDistance(NamedTuple):
    """Distances from the points of one surface to another surface, all [world].

    Attributes:
        max: The largest distance found, attained at ``point``: a lower bound of the largest distance.
        upper: An upper bound of the largest distance.
        mean: Mean over the area, from samples.
        rms: Root mean square over the area, from the same samples.
        mean_error: Standard error of ``mean``.
        rms_error: Standard error of ``rms``.
        point: The point of the first surface at distance ``max``, shape (3,).
        closest_point: Its closest point on the other surface, shape (3,).
    """

    max: float
    upper: float
    mean: float
    rms: float
    mean_error: float
    rms_error: float
    point: NDArray[np.float64]
    closest_point: NDArray[np.float64]


class HausdorffDistance(NamedTuple):
    """Distances between two surfaces, all [world].

    ``max``, ``upper``, ``mean`` and ``rms`` are the larger values of the two directions.

    Attributes:
        max: The largest distance found, between ``point_a`` and ``point_b``: a lower bound of the Hausdorff distance.
        upper: An upper bound of the Hausdorff distance.
        mean: The larger mean.
        rms: The larger root mean square.
        point_a: A point of the first surface, shape (3,). One of the two points is the closest point to the other.
        point_b: A point of the second surface, shape (3,).
        a_to_b: Distances from the points of the first surface to the second surface.
        b_to_a: Distances from the points of the second surface to the first surface.
    """

    max: float
    upper: float
    mean: float
    rms: float
    point_a: NDArray[np.float64]
    point_b: NDArray[np.float64]
    a_to_b: DirectedDistance
    b_to_a: DirectedDistance


def _bytes(a: TriangleMesh | Surface, b: TriangleMesh | Surface, *, samples: int = SAMPLES, **_: Any) -> float:
    made = sum(mesh.face_count for mesh in (a, b) if isinstance(mesh, TriangleMesh))
    return BYTES_PER_FACE * made + BYTES_PER_SAMPLE * samples


@of_constants
@needs(_bytes)
def hausdorff(
    a: MeshLike | Surface,
    b: MeshLike | Surface,
    *,
    tolerance: float = 1e-4,
    samples: int = SAMPLES,
    seed: int = 0,
    device: Device = None,
) -> HausdorffDistance:
    """Hausdorff distance between two surfaces within proven bounds, with mean and rms for both directions.

    The Hausdorff distance lies in ``[max, upper]``, and ``upper - max <= tolerance * diagonal``, where the diagonal is
    that of the bounding box of both meshes. Each bound is exact to 1e-12 of the diagonal. The bounds hold for all
    points of the triangles, not only for samples. The tolerance has a floor: 4e-12, or some roundings of the
    coordinates where these are larger.

    Mean and rms come from samples that are uniform by area, and have the given standard errors. They are NaN for a mesh
    without area and for ``samples=0``.

    Most of the time goes into regions whose distance is near the largest one. Two meshes that run close to each other
    everywhere take several times longer than others. Memory is bounded.

    The bounds keep tolerances down to 1e-11 diagonals. With a tolerance of 1e-7 they stay within 4e-6 diagonals up to
    1e8 diagonals from the origin.

    Args:
        a: The first surface: a TriangleMesh, or a Surface, which is used as it is, on its own device.
        b: The second surface, likewise.
        tolerance: Largest width of ``[max, upper]``, as a share of the diagonal.
        samples: Number of points on each surface for mean and rms.
        seed: Seed of the random samples, 0 or more.
        device: Device for meshes that are not Surfaces yet: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        HausdorffDistance with max, upper, mean, rms, point_a (3,), point_b (3,), a_to_b, b_to_a.
    Raises:
        InputError: a or b is neither a TriangleMesh nor a Surface, or has no faces; their units or up axes are known
            and differ; tolerance is not a positive finite number; samples or seed is negative or not a whole number;
            there is no such device.
        DeviceMemoryError: The device cannot hold the surfaces.
    Source:
        Guthe, Borodin, Klein, "Fast and accurate Hausdorff distance calculation between meshes" (2005); Cignoni,
        Rocchini, Scopigno, "Metro: measuring error on simplified surfaces" (1998) for mean and rms. Differs: triangles
        are cut where the closest triangle of the other surface changes, and bounded by convexity.
    Example:
        >>> low = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> high = gk.mesh.TriangleMesh([[0, 0, 2], [1, 0, 2], [0, 1, 2]], [[0, 1, 2]])
        >>> distance = gk.mesh.hausdorff(low, high, device="cpu")
        >>> distance.max, distance.upper, distance.a_to_b.point.tolist()
        (2.0, 2.0, [0.0, 0.0, 0.0])
    """
    tolerance = require_finite_scalar(tolerance, "tolerance", low=0.0)
    meshes = [_mesh_of(a, "a"), _mesh_of(b, "b")]
    require_one_world(a=meshes[0], b=meshes[1])
    samples = require_count(samples, "samples")
    first = _surface_of(a if isinstance(a, Surface) else meshes[0], device)
    second = first if b is a else _surface_of(b if isinstance(b, Surface) else meshes[1], device)
    for surface in (first, second):
        require_measurable(surface.mesh, surface._frame)
    corners = np.concatenate([mesh.bounds for mesh in meshes])
    drawn = [_samples(mesh, samples, seed) for mesh in meshes]
    diagonal = math.dist(corners.min(axis=0), corners.max(axis=0))
    size = float(np.abs(corners).max())
    gap = max(tolerance * diagonal, LEAST_TOLERANCE * diagonal, COORDINATE_ROUNDINGS * size)
    a_to_b = _directed(meshes[0], drawn[0], second, gap, WITNESS_ROUNDINGS * size)
    b_to_a = _directed(meshes[1], drawn[1], first, gap, WITNESS_ROUNDINGS * size)
    ends = (a_to_b.point, a_to_b.closest_point)
    if b_to_a.max > a_to_b.max:
        ends = (b_to_a.closest_point, b_to_a.point)
    both = [a_to_b, b_to_a]
    # NaN if either direction is NaN: there is no larger one then.
    mean, rms = (float(np.max([getattr(one, name) for one in both])) for name in ("mean", "rms"))
    largest, upper = max(one.max for one in both), max(one.upper for one in both)
    return HausdorffDistance(largest, upper, mean, rms, *ends, a_to_b, b_to_a)


def _mesh_of(given: Any, name: str) -> TriangleMesh:
    mesh = given.mesh if isinstance(given, Surface) else given
    mesh = require_mesh(mesh, name, images=False)
    if len(mesh.faces) == 0:
        raise InputError(f"{name}: {mesh.name or 'the mesh'} has no faces; distances need at least one triangle")
    return mesh


def _surface_of(given: TriangleMesh | Surface, device: Any) -> Surface:
    return snapshot(given) if isinstance(given, Surface) else Surface(given, device=device)


def _samples(mesh: TriangleMesh, count: int, seed: int) -> NDArray[np.float64]:
    """Points on the mesh; none if it has no area."""
    has_area = count > 0 and bool(scaled_areas(mesh)[1].any())
    return sample_surface(mesh, count if has_area else 0, seed=seed).points


def _directed(
    mesh: TriangleMesh, samples: NDArray[np.float64], target: Surface, gap: float, rounding: float
) -> DirectedDistance:
    search = DistanceSearch(target, gap, rounding)
    vertices = search.measure_vertices(mesh)
    distance = search.measure(samples)[0]
    mean = rms = mean_error = rms_error = math.nan
    if len(samples):
        squared = distance * distance
        mean, rms = float(distance.mean()), math.sqrt(float(squared.mean()))
        root = math.sqrt(len(samples))
        mean_error = float(distance.std()) / root
        rms_error = float(squared.std()) / (2.0 * rms * root) if rms > 0.0 else 0.0
    search.run(mesh, *vertices)
    return DirectedDistance(search.lower, search.upper, mean, rms, mean_error, rms_error, search.point, search.closest)
