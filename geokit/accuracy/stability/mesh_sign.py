"""Sweeps of inside/outside tests: holes, flips, copies, overlaps, and points next to the surface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.stability.shapes import (
    copied_faces,
    flipped_faces,
    icosphere,
    join,
    judged,
    moved,
    on_gpu,
    powers,
    rotated,
    sphere_distance,
    surface_of,
    torus,
    without_cap,
    without_faces,
)
from geokit.accuracy.trials.model import Judgement, Sweeps, cases_of
from geokit.mesh.model.triangle_mesh import TriangleMesh

SWEEPS = Sweeps()

POINTS = 2000
# Points closer to the true sphere are not checked: between it and its facets either answer is right [radii].
FACETS = 0.02
# Edge of the box from which points are drawn [diameters]: about an eighth of them are inside.
BOX = 1.5
# Scale factor on the edges of triangles that must not touch each other.
SHRUNK = 0.999
# Share of wrong answers that counts as nearly none: about two of 2000 points are wrong by chance; four times that.
FEW = 0.005
# Shares of the area that are missing.
HOLES = (0.01, 0.03, 0.1, 0.2, 0.3, 0.5)
# What statements have in common.
FARTHER = "is right for points 1e-14 sizes from the surface and farther"
HALF = "of the points in 1.5 times the box on the wrong side"


def by_sign(
    name: str,
    parameter: str,
    values: tuple[float, ...],
    promises: Mapping[str, tuple[Any, float, str]],
    logarithmic: bool = True,
) -> Callable[[Callable[..., Judgement]], Callable[..., Judgement]]:
    """Decorator that adds a sweep for each method of signs, whose name the function takes as ``sign``.

    A promise is the last value, the share of wrong answers and the statement.
    """
    cases = cases_of("sign last wrong_share statement", *((sign, *promise) for sign, promise in promises.items()))
    method = 'mesh.Surface.contains(sign="{sign}")'
    return SWEEPS.add(method, "none", f"{name}_{{sign}}", parameter, values, cases=cases, logarithmic=logarithmic)


def _asked(mesh: TriangleMesh, points: NDArray[np.float64], inside: Any, sign: str, device: Any) -> Judgement:
    found = surface_of(mesh, device).contains(points, sign=sign)
    return judged(0.0, found != inside, points)


def _asked_of_sphere(mesh: TriangleMesh, sign: str, device: Any, seed: int) -> Judgement:
    """Points around the unit sphere from which the mesh was made."""
    points = np.random.default_rng(seed).uniform(-BOX, BOX, (POINTS, 3))
    distance = sphere_distance(points)
    clear = np.abs(distance) > FACETS
    return _asked(mesh, points[clear], distance[clear] < 0.0, sign, device)


@by_sign(
    "sign_near_surface",
    "distance from the surface [radii of the torus]",
    (*powers(-2, -14, -4), *powers(-15, -18, -1)),
    {
        "pseudonormal": (1e-14, 0.0, f"On a clean mesh the pseudonormal {FARTHER}."),
        # Winding numbers on a GPU are accurate to 0.02: this close to the surface either side of 1/2 occurs.
        "winding": (
            lambda device: 1e-6 if on_gpu(device) else 1e-14,
            0.0,
            f"On a clean mesh the winding number {FARTHER}, on a GPU 1e-6.",
        ),
        "parity": (1e-14, 0.0, f"On a clean mesh the vote of rays {FARTHER}."),
    },
)
def _near(distance: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    """Points at this distance from a torus, on both sides of its triangles; some at edges and vertices."""
    rng = np.random.default_rng(seed)
    mesh = rotated(torus(24, 12), seed)
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=POINTS)]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    weights = rng.dirichlet(np.ones(3), POINTS)
    weights[: POINTS // 5, 0] = 0.0
    weights[POINTS // 5 : 2 * POINTS // 5, 1:] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    side = rng.choice([-1.0, 1.0], POINTS)
    points = np.einsum("nk,nkd->nd", weights, corners) + (side * distance)[:, None] * normal
    return _asked(mesh, points, side < 0.0, sign, device)


@by_sign(
    "sign_hole",
    "share of the area that one hole removes",
    HOLES,
    {
        "winding": (0.1, 0.03, f"With a hole of 10% of a sphere's area the winding number leaves under 3% {HALF}."),
        "pseudonormal": (0.1, 0.02, f"With a hole of 10% of a sphere's area pseudonormals leave under 2% {HALF}."),
        "parity": (0.1, 0.07, f"With a hole of 10% of a sphere's area a vote of rays leaves under 7% {HALF}."),
    },
)
def _hole(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    return _asked_of_sphere(without_cap(rotated(icosphere(3), seed), share), sign, device, seed)


@by_sign(
    "sign_holes",
    "share of the area that many small holes remove",
    (*HOLES, 0.7),
    {
        "winding": (
            0.2,
            FEW,
            f"With small holes of 20% of the area in total the winding number leaves under 0.5% {HALF}.",
        ),
        "parity": (
            0.03,
            FEW,
            f"With small holes of 3% of the area in total a vote of rays leaves under 0.5% {HALF}.",
        ),
    },
)
def _holes(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    return _asked_of_sphere(without_faces(icosphere(3), share, seed), sign, device, seed)


@by_sign(
    "sign_flips",
    "share of the faces that are flipped",
    (0.01, 0.1, 0.3, 0.6),
    {
        "auto": (
            0.6,
            0.0,
            "Faces of a closed mesh may have any winding, which is corrected first: no failure found.",
        )
    },
    logarithmic=False,
)
def _flips(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    return _asked_of_sphere(flipped_faces(icosphere(3), share, seed), sign, device, seed)


@by_sign(
    "sign_soup_flips",
    "share of the faces that are flipped, in a soup",
    (0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6),
    {
        "winding": (
            0.1,
            0.015,
            "If 10% of triangles that share no vertices are flipped, the winding number is wrong for under 1.5% "
            "of the points; if 40% are flipped, for nearly all points inside.",
        ),
        "pseudonormal": (
            0.01,
            0.06,
            "Among triangles that share no vertices a flipped one reverses the pseudonormal for all points "
            "nearest to it: 1% of flips gives under 6% of wrong signs.",
        ),
        "parity": (
            0.6,
            FEW,
            "A vote of rays does not depend on the winding of faces: no failure found, at gaps of 0.1% of an edge.",
        ),
    },
    logarithmic=False,
)
def _flips_of_soup(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    """Separate triangles: none has a neighbor that could determine its winding."""
    mesh = flipped_faces(icosphere(3), share, seed)
    corners = mesh.vertices[mesh.faces]
    middle = corners.mean(axis=1, keepdims=True)
    shrunk = (middle + SHRUNK * (corners - middle)).reshape(-1, 3)
    soup = TriangleMesh(shrunk, np.arange(len(shrunk)).reshape(-1, 3))
    return _asked_of_sphere(soup, sign, device, seed)


@by_sign(
    "sign_copies",
    "share of the faces that are there twice",
    (0.01, 0.03, 0.1, 0.3, 0.6, 1.0),
    {
        "winding": (1.0, FEW, "Duplicate faces do not affect the winding number: no failure found."),
        "parity": (
            0.03,
            FEW,
            "Duplicate faces act as holes in a vote of rays: 3% of them give under 0.5% of wrong signs.",
        ),
    },
)
def _copies(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    return _asked_of_sphere(copied_faces(icosphere(3), share, seed), sign, device, seed)


@by_sign(
    "sign_overlap",
    "depth of two unit spheres in each other",
    (0.0, 0.01, 0.1, 0.3, 0.5, 1.0),
    {
        "winding": (1.0, 0.0, "Overlapping bodies do not affect the winding number: no failure found."),
        "pseudonormal": (
            0.01,
            FEW,
            "Where bodies overlap, pseudonormals give wrong signs: for under 0.5% of the points around spheres "
            "that overlap by 0.01 radii, 1% at 0.1 radii.",
        ),
        "parity": (
            0.1,
            FEW,
            "Where two bodies overlap, a vote of rays says outside: for under 0.5% of the points around spheres "
            "that overlap by 0.1 radii.",
        ),
    },
    logarithmic=False,
)
def _overlap(depth: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    """Two unit spheres that overlap by this depth."""
    apart = 2.0 - depth
    points = np.random.default_rng(seed).uniform((-BOX, -BOX, -BOX), (BOX, BOX, BOX + apart), (POINTS, 3))
    distances = np.stack([sphere_distance(points), sphere_distance(points - [0.0, 0.0, apart])])
    clear = (np.abs(distances) > FACETS).all(axis=0)
    mesh = join(icosphere(3), moved(icosphere(3), (0.0, 0.0, apart)))
    return _asked(mesh, points[clear], (distances[:, clear] < 0.0).any(axis=0), sign, device)
