"""Sweeps of distances between meshes, repairs and audits: tolerances, flips, slivers, position."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.stability.shapes import (
    OBLIQUE,
    box,
    flipped_faces,
    icosphere,
    join,
    judged,
    moved,
    powers,
    rotated,
    sliver_fan,
    without_cap,
)
from geokit.accuracy.trials.model import Judgement, Sweeps, cases_of
from geokit.mesh.model.triangle_mesh import TriangleMesh

SWEEPS = Sweeps()

FAN = 24
# Two boxes at the ends of a plate: the farthest point of the plate lies halfway between them, away from any vertex.
GAP = 2.3
# Distance of duplicate corners [shortest edges].
NOISE = 1e-3


def _plate_and_ends() -> tuple[TriangleMesh, TriangleMesh, float]:
    """A plate between two boxes, and its Hausdorff distance from them: half the gap, the largest distance of all."""
    half = 0.5 * GAP
    plate = box((-half, -0.2, -0.1), (half, 0.2, 0.1))
    ends = [box((x, -0.5, -0.5), (x + 0.5, 0.5, 0.5)) for x in (-half - 0.5, half)]
    return plate, join(*ends), half


@SWEEPS.add(
    "mesh.hausdorff",
    "diagonals",
    "hausdorff_tolerance",
    "tolerance [diagonals]",
    powers(-1, -15, -2),
    last=1e-11,
    error=lambda tolerance: tolerance + 1e-12,
    statement="The bounds contain the Hausdorff distance and are at most the tolerance apart, down to 1e-11 diagonals.",
)
def _hausdorff_bounds(tolerance: float, device: Any, offset: float = 0.0, seed: int = 0) -> Judgement:
    """Errors: the width of the bounds, and the distance of the true value from them, as shares of the diagonal."""
    from geokit.mesh._hausdorff import hausdorff

    plate, ends, truth = _plate_and_ends()
    plate, ends = rotated(plate, seed), rotated(ends, seed)
    size = join(plate, ends).diagonal
    away = offset * size * OBLIQUE
    a, b = moved(plate, away), moved(ends, away)
    found = hausdorff(a, b, tolerance=tolerance, samples=0, device=device)
    outside = max(found.max - truth, truth - found.upper, 0.0)
    return judged(np.array([found.upper - found.max, outside]) / size, np.zeros(2, bool))


@SWEEPS.add(
    "mesh.hausdorff",
    "diagonals",
    "hausdorff_origin",
    "distance from the origin [diagonals]",
    powers(0, 12, 2),
    last=1e8,
    error=4e-6,
    statement="Bounds requested to 1e-7 diagonals are at most 4e-6 diagonals apart up to 1e8 diagonals from the "
    "origin: they are never closer than 32 roundings of the coordinates.",
)
def _hausdorff_at(offset: float, device: Any, seed: int = 0) -> Judgement:
    return _hausdorff_bounds(1e-7, device, offset, seed)


@SWEEPS.add(
    "mesh.orient",
    "none",
    "orient_{part}",
    "share of the faces that are flipped",
    cases=cases_of(
        "part mesh values last statement",
        (
            "open",
            without_cap(icosphere(3), 0.3),
            (0.1, 0.2, 0.3, 0.4, 0.45, 0.5, 0.55, 0.6),
            0.45,
            "Open components are oriented like the majority of their faces: right while fewer than half were flipped.",
        ),
        (
            "closed",
            icosphere(3),
            (0.1, 0.3, 0.5, 0.7, 0.9, 1.0),
            1.0,
            "Closed components are oriented outward, however many faces were flipped: no failure found.",
        ),
    ),
    logarithmic=False,
)
def _oriented(share: float, mesh: TriangleMesh, device: Any, seed: int = 0) -> Judgement:
    """Faces of part of a sphere, some flipped; faces that orient leaves facing inward are wrong."""
    from geokit.mesh._repair import orient

    mended = orient(flipped_faces(mesh, share, seed)).mesh
    corners = mended.vertices[mended.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = corners.mean(axis=1)
    return judged(0.0, (normal * middle).sum(axis=1) < 0.0, middle)


@SWEEPS.add(
    "mesh.merge_vertices",
    "shortest edges",
    "merge_vertices_tolerance",
    "tolerance [shortest edges]",
    (2e-3, 1e-2, 0.1, 0.3, 0.6, 0.9, 1.1, 1.5, 2.0),
    last=0.9,
    error=2.0 * NOISE,
    statement="Vertices that belong together are merged, and no others, for tolerances between their distance and "
    "0.9 of the shortest edge.",
)
def _merged(tolerance: float, device: Any, seed: int = 0) -> Judgement:
    """Triangles with separate vertices; wrong are corners not merged with their duplicates or merged with others.

    Errors are the displacements of the corners in shortest edges, like the tolerance.
    """
    from geokit.mesh._repair import merge_vertices

    mesh = icosphere(2)
    corners = mesh.vertices[mesh.faces]
    shortest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min()
    offsets = np.random.default_rng(seed).normal(size=(corners.size // 3, 3))
    offsets *= 0.5 * NOISE * shortest / np.linalg.norm(offsets, axis=1, keepdims=True)
    soup = TriangleMesh(corners.reshape(-1, 3) + offsets, np.arange(len(offsets)).reshape(-1, 3))
    merged = merge_vertices(soup, tolerance=tolerance * shortest)
    was, became = mesh.faces.ravel(), merged.faces.ravel()
    pairs = np.unique(np.stack([was, became], axis=1), axis=0)
    apart = np.bincount(pairs[:, 0])[was] > 1
    mixed = np.bincount(pairs[:, 1])[became] > 1
    shift = np.linalg.norm(merged.vertices[became] - soup.vertices, axis=1) / shortest
    return judged(shift, apart | mixed, soup.vertices)


@SWEEPS.add(
    "mesh.audit",
    "relative",
    "audit_slivers",
    "longest edge of the triangles over their height",
    powers(0, 15),
    last=1e9,
    error=1e-6,
    statement="Aspect ratios and areas of slivers are accurate to 1e-15 times the aspect ratio, as the rounding "
    "of their coordinates allows: 1e-6 at 1e9. From 1e12 on slivers count as degenerate.",
)
def _aspects_of_slivers(aspect: float, device: Any, seed: int = 0) -> Judgement:
    """Aspect ratios and area from audit; ratios of triangles that it classifies as degenerate are wrong."""
    from geokit.mesh._audit import audit
    from geokit.mesh.topology.audit import ASPECT_QUANTILES

    found = audit(rotated(sliver_fan(FAN, aspect), seed))
    ratios = np.sort(_fan_aspects(aspect))[[round(q * (FAN - 1)) for q in ASPECT_QUANTILES]]
    finite = np.isfinite(found.aspect_ratio_quantiles)
    errors = np.where(finite, found.aspect_ratio_quantiles, 0.0) / ratios - 1.0
    return judged(np.append(errors, found.area / (0.5 * FAN / aspect) - 1.0), np.append(~finite, False))


def _fan_aspects(aspect: float) -> NDArray[np.float64]:
    low, high = np.arange(FAN) / aspect, np.arange(1, FAN + 1) / aspect
    edges = np.stack([np.hypot(1.0, low), np.hypot(1.0, high), high - low])
    # The radius of the inscribed circle is twice the area over the perimeter; twice the area is here the far edge.
    return edges.max(axis=0) * edges.sum(axis=0) / (2.0 * np.sqrt(3.0) * (high - low))
