"""Random points near a mesh's faces, edges and vertices, with exact distances, to check a field."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.adaptive.cells import CellLattice
from geokit.volume.tolerance.zone import rounding_of

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# Points of a round: as many along edges as on faces, and half as many at vertices, because interpolants are worst on
# creases. On meshes of tiny faces the three kinds hardly differ.
FACE_POINTS = 100_000
EDGE_POINTS = 100_000
CORNER_POINTS = 50_000
DRAWN_POINTS = FACE_POINTS + EDGE_POINTS + CORNER_POINTS


class CheckPoints(NamedTuple):
    """Points (N, 3) [world] no farther than ``within`` from the surface, and their exact signed distances (N,)."""

    points: NDArray[np.float64]
    distance: NDArray[np.float64]


def check_points(lattice: CellLattice, seed: int) -> CheckPoints:
    """Random points of the zone around a mesh, different for each seed.

    Half of them are moved by up to ``within`` from the surface in a random direction, half lie on it.
    """
    random = np.random.default_rng(seed)
    mesh = lattice.surface.mesh
    corners = mesh.vertices[mesh.faces]
    on = np.concatenate([_on_faces(corners, random), _on_edges(corners, random), _at_corners(mesh, random)])
    directions = random.normal(size=on.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    length = lattice.within * np.maximum(random.uniform(-1.0, 1.0, len(on)), 0.0)
    points = on + directions * length[:, None]
    distance = np.asarray(lattice.surface.signed_distance(points, sign=lattice.sign).distance)
    # Rounding puts points at the zone's limit outside it; with a zone of no width, nearly all.
    kept = np.abs(distance) <= lattice.within + rounding_of(lattice.surface.bounds)
    return CheckPoints(points[kept], distance[kept])


def _on_faces(corners: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.float64]:
    """Random points, uniform over the area."""
    a, b, c = corners.transpose(1, 0, 2)
    chosen = _drawn(np.linalg.norm(np.cross(b - a, c - a), axis=1), FACE_POINTS, random)
    u, v = np.sqrt(random.uniform(size=FACE_POINTS))[:, None], random.uniform(size=FACE_POINTS)[:, None]
    return np.asarray(a[chosen] * (1.0 - u) + b[chosen] * (u * (1.0 - v)) + c[chosen] * (u * v))


def _on_edges(corners: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.float64]:
    """Random points, uniform along the faces' edges."""
    start = corners.reshape(-1, 3)
    end = np.roll(corners, -1, axis=1).reshape(-1, 3)
    chosen = _drawn(np.linalg.norm(end - start, axis=1), EDGE_POINTS, random)
    t = random.uniform(size=(EDGE_POINTS, 1))
    return np.asarray(start[chosen] * (1.0 - t) + end[chosen] * t)


def _at_corners(mesh: TriangleMesh, random: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(mesh.vertices[random.choice(mesh.faces.reshape(-1), CORNER_POINTS)])


def _drawn(weight: NDArray[np.float64], count: int, random: np.random.Generator) -> NDArray[np.int64]:
    """Random rows with probabilities proportional to ``weight``."""
    total = np.cumsum(weight)
    return np.minimum(np.searchsorted(total, random.uniform(0.0, total[-1], count), side="right"), len(weight) - 1)
