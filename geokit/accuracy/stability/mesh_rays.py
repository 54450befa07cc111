"""Sweeps of rays: position, size, slivers, edges and vertices, grazing angles, starts on the surface."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.stability.fields import unit_vectors
from geokit.accuracy.stability.shapes import (
    OBLIQUE,
    box,
    icosphere,
    judged,
    moved,
    powers,
    rotated,
    scaled,
    size_sweeps,
    sliver_fan,
    surface_of,
    turned,
    unit_sized,
)
from geokit.accuracy.trials.model import Judgement, Sweeps
from geokit.mesh.model.triangle_mesh import TriangleMesh

SWEEPS = Sweeps()
of_hits = partial(SWEEPS.add, "mesh.Surface.raycast", "sizes of the mesh")
of_shares = partial(SWEEPS.add, "mesh.Surface.raycast", "lengths of the ray")
of_box_hits = partial(SWEEPS.add, "mesh.Surface.raycast", "edges of the box")

RAYS = 300
# More rays, because leaks are rare.
EDGE_RAYS = 3000
FAN = 24
# Start of the rays towards the slivers, which lie in the plane z = 0 before rotation.
START = np.array([0.3, 0.2, 1.0])
# Rays from hits inward deviate by up to this much from the face normal, before normalization.
STRAY = 0.8
# Nearer hits are on the starting face, since the other side of the box is farther [edges of the box].
OWN_FACE = 0.01
# From far beside an edge to exactly at it: the last offsets are lost when they are added.
OFFSETS = (*powers(-2, -18, -2), 1e-30)


class _Known(NamedTuple):
    """A sphere of size 1 next to the origin, unit rays from well inside it, and their hits by brute force."""

    mesh: TriangleMesh
    starts: NDArray[np.float64]
    headings: NDArray[np.float64]
    t: NDArray[np.float64]


def _sphere(seed: int) -> TriangleMesh:
    return unit_sized(rotated(icosphere(2), seed))


@lru_cache(maxsize=4)
def _known(seed: int) -> _Known:
    rng = np.random.default_rng(seed)
    mesh, starts, headings = _sphere(seed), rng.uniform(-0.1, 0.1, (RAYS, 3)), unit_vectors(RAYS, rng)
    return _Known(mesh, starts, headings, reference.first_hit(mesh.vertices, mesh.faces, starts, headings).t)


@of_hits(
    "raycast_origin",
    "distance from the origin [sizes of the mesh]",
    powers(0, 13),
    last=1e9,
    error=1e-6,
    statement="Hits have an error of at most 1e-6 of the mesh's size up to 1e9 sizes from the origin.",
)
def _hits_at(offset: float, device: Any, seed: int = 0) -> Judgement:
    """Comparison with the ideal mesh near the origin."""
    known, away = _known(seed), offset * OBLIQUE
    found = surface_of(moved(known.mesh, away), device).raycast(known.starts + away, known.headings)
    return judged(found.t - known.t, found.triangle_id < 0, known.starts)


@size_sweeps(
    SWEEPS,
    "raycast",
    "mesh.Surface.raycast",
    (*powers(0, 60, 15), *powers(70, 120, 10)),
    (*powers(0, -60, -15), *powers(-70, -120, -10)),
    "Hits have",
)
def _hits_sized(scale: float, device: Any, seed: int = 0) -> Judgement:
    known = _known(seed)
    found = surface_of(scaled(known.mesh, scale), device).raycast(known.starts * scale, known.headings)
    return judged(found.t / scale - known.t, found.triangle_id < 0, known.starts)


@of_hits(
    "raycast_afar",
    "distance of the starts [sizes of the mesh]",
    powers(0, 13),
    last=1e8,
    error=1e-6,
    statement="Rays that start up to 1e8 sizes away hit their targets, within 1e-6 of the mesh's size; from "
    "1e12 sizes they may miss the mesh.",
)
def _hits_from_afar(distance: float, device: Any, seed: int = 0) -> Judgement:
    """Rays from all sides at the centroid of a face that faces them."""
    rng = np.random.default_rng(seed)
    mesh = _sphere(seed)
    targets = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=RAYS)]].mean(axis=1)
    outward = targets / np.linalg.norm(targets, axis=1, keepdims=True)
    found = surface_of(mesh, device).raycast(targets + distance * outward, -outward)
    return judged(found.t - distance, found.triangle_id < 0, targets)


@of_shares(
    "raycast_slivers",
    "longest edge of the triangles over their height",
    powers(1, 17),
    last=1e15,
    error=1e-14,
    statement="Slivers are hit at the t of their planes, until rounding of their corners opens gaps between them.",
)
def _hits_on_slivers(aspect: float, device: Any, seed: int = 0) -> Judgement:
    """Rays at random points of a gapless fan of slivers, well away from its border."""
    rng = np.random.default_rng(seed)
    width = FAN / aspect
    x = rng.uniform(0.2, 0.9, RAYS)
    flat = np.stack([x, x * width * rng.uniform(0.1, 0.9, RAYS), np.zeros(RAYS)], axis=1)
    starts, targets = turned(flat + START, seed), turned(flat, seed)
    surface = surface_of(rotated(sliver_fan(FAN, aspect), seed), device)
    found = surface.raycast(starts, targets - starts)
    return judged(found.t - 1.0, found.triangle_id < 0, targets)


class _Aims(NamedTuple):
    """A sphere, ray starts inside it, targets on its edges and vertices, and unit vectors from there into a face."""

    mesh: TriangleMesh
    starts: NDArray[np.float64]
    places: NDArray[np.float64]
    across: NDArray[np.float64]


@lru_cache(maxsize=4)
def _aims(seed: int) -> _Aims:
    rng = np.random.default_rng(seed)
    mesh = rotated(icosphere(3), seed)
    a, b, c = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=EDGE_RAYS)]].transpose(1, 0, 2)
    # A third of the targets are vertices.
    places = a + rng.random((EDGE_RAYS, 1)) * (rng.random((EDGE_RAYS, 1)) < 0.67) * (b - a)
    across = (a + b + c) / 3.0 - places
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    starts = unit_vectors(EDGE_RAYS, rng) * rng.uniform(0.0, 0.7, (EDGE_RAYS, 1))
    return _Aims(mesh, starts, places, across)


@of_shares(
    "raycast_edges",
    "distance from the edge or vertex aimed at [radii of the sphere]",
    OFFSETS,
    last=OFFSETS[-1],
    error=1e-14,
    statement="No ray from inside a closed mesh leaks, however close to an edge or a vertex it is aimed: no "
    "failure found.",
)
def _hits_beside_edges(offset: float, device: Any, seed: int = 0) -> Judgement:
    """The sphere is convex: a target seen from inside is hit at t = 1."""
    mesh, starts, places, across = _aims(seed)
    found = surface_of(mesh, device).raycast(starts, places + offset * across - starts)
    return judged(found.t - 1.0, found.triangle_id < 0, places)


@SWEEPS.add(
    "mesh.Surface.crossing_count",
    "lengths of the ray",
    "crossing_count_edges",
    "distance from the edge or vertex aimed at [radii of the sphere]",
    OFFSETS,
    last=OFFSETS[-1],
    statement="A ray through an edge or a vertex counts one crossing, however exactly it is aimed: no failure found.",
)
def _crossings_beside_edges(offset: float, device: Any, seed: int = 0) -> Judgement:
    """A ray from inside a convex mesh crosses it once."""
    mesh, starts, places, across = _aims(seed)
    count = surface_of(mesh, device).crossing_count(starts, places + offset * across - starts)
    return judged(0.0, count != 1, places)


@of_box_hits(
    "raycast_grazing",
    "angle between ray and face [radians]",
    (1.5, *powers(-1, -17, -1)),
    last=1e-9,
    error=1e-6,
    statement="t has an error of at most 1e-15 of the mesh's size over the sine of the angle between ray and "
    "face, 1e-6 at 1e-9 radians; no hit is missed down to 1e-15 radians.",
)
def _grazing_hits(angle: float, device: Any, seed: int = 0) -> Judgement:
    """Rays towards the top of a box at this angle to it."""
    rng = np.random.default_rng(seed)
    targets = np.stack([rng.uniform(-0.1, 0.1, RAYS), rng.uniform(-0.4, 0.4, RAYS), np.full(RAYS, 0.5)], axis=1)
    distance = rng.uniform(0.2, 0.4, RAYS)
    heading = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    starts, headings = targets - distance[:, None] * heading, np.tile(heading, (RAYS, 1))
    found = surface_of(rotated(box(), seed), device).raycast(turned(starts, seed), turned(headings, seed))
    return judged(found.t - distance, found.triangle_id < 0, turned(targets, seed))


@of_box_hits(
    "raycast_t_min",
    "t_min [edges of the box]",
    powers(-1, -18, -1),
    last=1e-13,
    statement="Rays that start at a hit skip the face they start on with a t_min of 1e-13 of the mesh's size.",
)
def _hits_past_the_start(t_min: float, device: Any, seed: int = 0) -> Judgement:
    """Rays inward from rounded hits on a box; the right hit is on another side."""
    rng = np.random.default_rng(seed)
    surface = surface_of(rotated(box(), seed), device)
    outward = turned(np.eye(3)[rng.integers(3, size=RAYS)] * rng.choice([-1.0, 1.0], (RAYS, 1)), seed)
    middle = turned(rng.uniform(-0.3, 0.3, (RAYS, 3)), seed)
    starts = middle + surface.raycast(middle, outward).t[:, None] * outward
    headings = STRAY * unit_vectors(RAYS, rng) - outward
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    t = surface.raycast(starts, headings, t_min=t_min).t
    return judged(0.0, ~(np.isfinite(t) & (t > OWN_FACE)), starts)
