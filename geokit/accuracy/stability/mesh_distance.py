"""Sweeps of closest points and signed distances: position, size, slivers, far queries, thin walls."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.stability.fields import unit_vectors
from geokit.accuracy.stability.shapes import (
    OBLIQUE,
    around_and_near,
    judged,
    moved,
    on_gpu,
    powers,
    rotated,
    scaled,
    size_sweeps,
    sliver_fan,
    surface_of,
    thin_plate,
    torus,
    turned,
    unit_sized,
)
from geokit.accuracy.trials.model import Judgement, Sweeps
from geokit.mesh.model.triangle_mesh import TriangleMesh

SWEEPS = Sweeps()
of_closest = partial(SWEEPS.add, "mesh.Surface.closest_point", "sizes of the mesh")

QUERIES = 200
# Queries of sweeps from afar: brute force is slowest there, because no candidate is excluded early.
FAR_QUERIES = 50
# Beyond this distance float64 cannot distinguish the mesh from its center point; squares of brute force overflow
# farther out [sizes].
POINT_LIKE = 1e18
# Number of slivers in a fan: few, so that slanted ones fit even at small aspect ratios.
FAN = 6
# The far edge of the fan is slanted by this many times its width: slivers then have an angle of some degrees at the
# short edge, where digits are lost first.
LEAN = 30.0
# Signs are checked at this distance from the surface and beyond [sizes]: more than ten times the effect of rounding the
# coordinates at the last position that keeps its promise.
CLEAR = 1e-5
# Depth inside a thin wall, and equal distance outside, at which it is queried [thicknesses].
DEPTH = 0.25


class _Known(NamedTuple):
    """A mesh of size 1 next to the origin, with reference answers by brute force."""

    mesh: TriangleMesh
    queries: NDArray[np.float64]
    points: NDArray[np.float64]
    distance: NDArray[np.float64]
    inside: NDArray[np.bool_]


def _torus(seed: int) -> TriangleMesh:
    """A smooth non-convex mesh, randomly rotated; few triangles keep brute force fast."""
    return unit_sized(rotated(torus(20, 10), seed))


@lru_cache(maxsize=4)
def _known(seed: int) -> _Known:
    mesh = _torus(seed)
    queries = around_and_near(mesh, QUERIES, seed)
    closest = reference.closest_point(mesh.vertices, mesh.faces, queries)
    inside = reference.winding_number(mesh.vertices, mesh.faces, queries) > 0.5
    clear = closest.distance > CLEAR
    return _Known(mesh, queries[clear], closest.points[clear], closest.distance[clear], inside[clear])


@of_closest(
    "closest_point_origin",
    "distance from the origin [sizes of the mesh]",
    powers(0, 13),
    last=1e8,
    error=1e-6,
    statement="Closest points have an error of at most 1e-6 of the mesh's size up to 1e8 sizes from the "
    "origin; farther away float64 coordinates themselves are coarser.",
)
def _closest_at(offset: float, device: Any, seed: int = 0) -> Judgement:
    """Comparison with the ideal mesh near the origin: float64 rounding of moved coordinates counts as error."""
    known, away = _known(seed), offset * OBLIQUE
    found = surface_of(moved(known.mesh, away), device).closest_point(known.queries + away)
    errors = np.linalg.norm(found.points - away - known.points, axis=1)
    return judged(errors, found.triangle_id < 0, known.queries)


@size_sweeps(
    SWEEPS,
    "closest_point",
    "mesh.Surface.closest_point",
    (*powers(0, 70, 10), 1e74, *powers(80, 90, 10)),
    (*powers(0, -70, -10), 1e-74, *powers(-80, -90, -10)),
    "Distances have",
)
def _closest_sized(scale: float, device: Any, seed: int = 0) -> Judgement:
    known = _known(seed)
    found = surface_of(scaled(known.mesh, scale), device).closest_point(known.queries * scale)
    return judged(found.distance / scale - known.distance, found.triangle_id < 0, known.queries)


@of_closest(
    "closest_point_slivers",
    "longest edge of the triangles over their height",
    powers(1, 13),
    last=1e13,
    error=1e-12,
    statement="Distances have an error of at most 1e-12 of the mesh's size on slivers of any aspect ratio: no "
    "failure found.",
)
def _closest_on_slivers(aspect: float, device: Any, seed: int = 0) -> Judgement:
    """Distances from a fan of slivers, known from the planar triangle that all slivers form together."""
    rng = np.random.default_rng(seed)
    width = FAN / aspect
    slant = min(LEAN * width, 0.5)
    outline = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0 - slant, width, 0.0]])
    # Points on the slivers, and at all distances from them.
    away = rng.normal(size=(2 * QUERIES, 3)) * 10.0 ** rng.uniform(-16.0, 0.0, (2 * QUERIES, 1))
    queries = rng.dirichlet(np.ones(3), 2 * QUERIES) @ outline + away
    surface = surface_of(rotated(sliver_fan(FAN, aspect, slant), seed), device)
    found = surface.closest_point(turned(queries, seed))
    return judged(found.distance - _flat_distance(queries, outline), found.triangle_id < 0, queries)


def _flat_distance(points: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance (N,) to a triangle in the plane z = 0 that winds counter-clockwise."""
    within = np.ones(len(points), bool)
    nearest = np.full(len(points), np.inf)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along, apart = b - a, points - a
        within &= along[0] * apart[:, 1] >= along[1] * apart[:, 0]
        share = np.clip(apart @ along / (along @ along), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(apart - share[:, None] * along, axis=1))
    return np.where(within, np.abs(points[:, 2]), nearest)


@SWEEPS.add(
    "mesh.Surface.signed_distance",
    "sizes of the mesh",
    "signed_distance_origin",
    "distance from the origin [sizes of the mesh]",
    powers(0, 14),
    last=1e9,
    error=1e-6,
    statement="Distances have an error of at most 1e-6 of the mesh's size, and signs are right for points "
    "1e-5 sizes from the surface, up to 1e9 sizes from the origin.",
)
def _signed_at(offset: float, device: Any, seed: int = 0) -> Judgement:
    known, away = _known(seed), offset * OBLIQUE
    found = surface_of(moved(known.mesh, away), device).signed_distance(known.queries + away).distance
    return judged(np.abs(found) - known.distance, (found < 0.0) != known.inside, known.queries)


@size_sweeps(
    SWEEPS,
    "signed_distance",
    "mesh.Surface.signed_distance",
    (*powers(0, 70, 10), *powers(80, 90, 10)),
    (*powers(0, -70, -10), *powers(-80, -90, -10)),
    "Signed distances have",
)
def _signed_sized(scale: float, device: Any, seed: int = 0) -> Judgement:
    known = _known(seed)
    found = surface_of(scaled(known.mesh, scale), device).signed_distance(known.queries * scale).distance
    return judged(np.abs(found) / scale - known.distance, (found < 0.0) != known.inside, known.queries)


@SWEEPS.add(
    "mesh.Surface.signed_distance",
    "relative",
    "signed_distance_afar",
    "distance of the queries [sizes of the mesh]",
    (*powers(0, 8, 4), 1e16, *powers(40, 120, 40), 1e150, 1e160),
    last=1e150,
    error=4e-15,
    statement="Distances have a relative error of at most 4e-15, and points outside have the right sign, up "
    "to 1e150 from the mesh.",
)
def _signed_from_afar(distance: float, device: Any, seed: int = 0) -> Judgement:
    """Distances of far queries; errors are relative to the distance."""
    mesh = _torus(seed)
    queries = unit_vectors(FAR_QUERIES, np.random.default_rng(seed)) * distance
    found = surface_of(mesh, device).signed_distance(queries, sign="winding").distance
    expected = np.full(FAR_QUERIES, distance)
    if distance < POINT_LIKE:
        expected = reference.closest_point(mesh.vertices, mesh.faces, queries).distance
    return judged(np.abs(found) / expected - 1.0, found < 0.0, queries)


@SWEEPS.add(
    "mesh.Surface.signed_distance",
    "lengths of the plate",
    "signed_distance_thin_walls",
    "thickness of a plate [its length]",
    powers(-1, -17, -1),
    last=lambda device: 1e-11 if on_gpu(device) else 1e-14,
    error=4e-15,
    statement="The two sides of a wall are distinguished down to a thickness of 1e-14 of the mesh's size, on "
    "a GPU of 1e-11.",
)
def _signed_within(thickness: float, device: Any, seed: int = 0) -> Judgement:
    """Points inside a plate and as many outside, equally near to its faces, away from its rim."""
    rng = np.random.default_rng(seed)
    queries = rng.uniform(-0.45, 0.45, (QUERIES, 3))
    inside = rng.random(QUERIES) < 0.5
    height = np.where(inside, 0.5 - DEPTH, 0.5 + DEPTH) * thickness
    queries[:, 2] = height * rng.choice([-1.0, 1.0], QUERIES)
    surface = surface_of(rotated(thin_plate(thickness), seed), device)
    found = surface.signed_distance(turned(queries, seed)).distance
    return judged(np.abs(found) - DEPTH * thickness, (found < 0.0) != inside, queries)
