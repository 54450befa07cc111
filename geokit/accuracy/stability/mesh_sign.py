"""Sweeps of inside/outside tests: holes, flips, copies, overlaps, and points next to the surface."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.stability.mesh_questions import judged, on_gpu, powers, surface_of
from geokit.accuracy.stability.shapes import (
    copied_faces,
    flipped_faces,
    icosphere,
    join,
    moved,
    rotated,
    sphere_distance,
    torus,
    without_cap,
    without_faces,
)
from geokit.accuracy.trials.model import Envelope, Judgement, Sweep
from geokit.mesh.model.triangle_mesh import TriangleMesh

__all__ = ["sign_sweeps"]

POINTS = 2000
# Points closer to the true sphere are not checked: between it and its facets either answer is right [radii].
FACETS = 0.02
# Edge of the box from which points are drawn [diameters]: about an eighth of them are inside.
BOX = 1.5
# Scale factor on the edges of triangles that must not touch each other.
SHRUNK = 0.999
# Share of wrong answers that counts as nearly none: about two of 2000 points are wrong by chance; four times that.
FEW = 0.005


def _asked(mesh: TriangleMesh, points: NDArray[np.float64], inside: Any, sign: str, device: Any) -> Judgement:
    found = surface_of(mesh, device).contains(points, sign=sign)
    return judged(np.zeros(len(points)), found != inside, points)


def _asked_of_sphere(mesh: TriangleMesh, sign: str, device: Any, seed: int) -> Judgement:
    """Points around the unit sphere from which the mesh was made."""
    points = np.random.default_rng(seed).uniform(-BOX, BOX, (POINTS, 3))
    distance = sphere_distance(points)
    clear = np.abs(distance) > FACETS
    return _asked(mesh, points[clear], distance[clear] < 0.0, sign, device)


def _hole(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    return _asked_of_sphere(without_cap(rotated(icosphere(3), seed), share), sign, device, seed)


def _holes(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    return _asked_of_sphere(without_faces(icosphere(3), share, seed), sign, device, seed)


def _flips(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    return _asked_of_sphere(flipped_faces(icosphere(3), share, seed), sign, device, seed)


def _flips_of_soup(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    """Separate triangles: none has a neighbor that could determine its winding."""
    mesh = flipped_faces(icosphere(3), share, seed)
    corners = mesh.vertices[mesh.faces]
    middle = corners.mean(axis=1, keepdims=True)
    shrunk = (middle + SHRUNK * (corners - middle)).reshape(-1, 3)
    soup = TriangleMesh(shrunk, np.arange(len(shrunk)).reshape(-1, 3))
    return _asked_of_sphere(soup, sign, device, seed)


def _copies(share: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    return _asked_of_sphere(copied_faces(icosphere(3), share, seed), sign, device, seed)


def _overlap(depth: float, sign: str, device: Any, seed: int = 0) -> Judgement:
    """Two unit spheres that overlap by this depth."""
    apart = 2.0 - depth
    points = np.random.default_rng(seed).uniform((-BOX, -BOX, -BOX), (BOX, BOX, BOX + apart), (POINTS, 3))
    distances = np.stack([sphere_distance(points), sphere_distance(points - [0.0, 0.0, apart])])
    clear = (np.abs(distances) > FACETS).all(axis=0)
    mesh = join(icosphere(3), moved(icosphere(3), (0.0, 0.0, apart)))
    return _asked(mesh, points[clear], (distances[:, clear] < 0.0).any(axis=0), sign, device)


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


def sign_sweeps(device: Any) -> list[Sweep]:
    """Sweeps of :meth:`Surface.contains`, whose signs are those of :meth:`Surface.signed_distance`, on this device."""
    return [
        *_near_sweeps(device),
        *_hole_sweeps(device),
        *_flip_sweeps(device),
        *_copy_sweeps(device),
        *_overlap_sweeps(device),
    ]


def _sweep(
    name: str,
    sign: str,
    parameter: str,
    values: tuple[float, ...],
    ask: Callable[..., Judgement],
    envelope: tuple[float, float, str],
    device: Any,
    logarithmic: bool = True,
) -> Sweep:
    last, wrong_share, statement = envelope
    method = f'mesh.Surface.contains(sign="{sign}")'
    asked = partial(ask, sign=sign, device=device)
    kept = Envelope(last, 0.0, wrong_share, statement)
    return Sweep(f"{name}_{sign}", method, parameter, "none", values, asked, kept, logarithmic)


def _near_sweeps(device: Any) -> list[Sweep]:
    return [
        _sweep(
            "sign_near_surface",
            sign,
            "distance from the surface [radii of the torus]",
            (*powers(-2, -14, -4), *powers(-15, -18, -1)),
            _near,
            (
                # Winding numbers on a GPU are accurate to 0.02: this close to the surface either side of 1/2 occurs.
                1e-6 if sign == "winding" and on_gpu(device) else 1e-14,
                0.0,
                f"On a clean mesh the {name} is right for points 1e-14 sizes from the surface and farther{further}.",
            ),
            device,
        )
        for sign, name, further in (
            ("pseudonormal", "pseudonormal", ""),
            ("winding", "winding number", ", on a GPU 1e-6"),
            ("parity", "vote of rays", ""),
        )
    ]


def _hole_sweeps(device: Any) -> list[Sweep]:
    one, many = "share of the area that one hole removes", "share of the area that many small holes remove"
    shares = (0.01, 0.03, 0.1, 0.2, 0.3, 0.5)
    more = (*shares, 0.7)
    half = "of the points in 1.5 times the box on the wrong side"
    return [
        _sweep(
            "sign_hole",
            "winding",
            one,
            shares,
            _hole,
            (0.1, 0.03, f"With a hole of 10% of a sphere's area the winding number leaves under 3% {half}."),
            device,
        ),
        _sweep(
            "sign_hole",
            "pseudonormal",
            one,
            shares,
            _hole,
            (0.1, 0.02, f"With a hole of 10% of a sphere's area pseudonormals leave under 2% {half}."),
            device,
        ),
        _sweep(
            "sign_hole",
            "parity",
            one,
            shares,
            _hole,
            (0.1, 0.07, f"With a hole of 10% of a sphere's area a vote of rays leaves under 7% {half}."),
            device,
        ),
        _sweep(
            "sign_holes",
            "winding",
            many,
            more,
            _holes,
            (0.2, FEW, f"With small holes of 20% of the area in total the winding number leaves under 0.5% {half}."),
            device,
        ),
        _sweep(
            "sign_holes",
            "parity",
            many,
            more,
            _holes,
            (0.03, FEW, f"With small holes of 3% of the area in total a vote of rays leaves under 0.5% {half}."),
            device,
        ),
    ]


def _flip_sweeps(device: Any) -> list[Sweep]:
    shares = (0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6)
    parameter, soup = "share of the faces that are flipped", "share of the faces that are flipped, in a soup"
    return [
        _sweep(
            "sign_flips",
            "auto",
            parameter,
            shares[::2],
            _flips,
            (0.6, 0.0, "Faces of a closed mesh may have any winding, which is corrected first: no failure found."),
            device,
            logarithmic=False,
        ),
        _sweep(
            "sign_soup_flips",
            "winding",
            soup,
            shares,
            _flips_of_soup,
            (
                0.1,
                0.015,
                "If 10% of triangles that share no vertices are flipped, the winding number is wrong for under 1.5% "
                "of the points; if 40% are flipped, for nearly all points inside.",
            ),
            device,
            logarithmic=False,
        ),
        _sweep(
            "sign_soup_flips",
            "pseudonormal",
            soup,
            shares,
            _flips_of_soup,
            (
                0.01,
                0.06,
                "Among triangles that share no vertices a flipped one reverses the pseudonormal for all points "
                "nearest to it: 1% of flips gives under 6% of wrong signs.",
            ),
            device,
            logarithmic=False,
        ),
        _sweep(
            "sign_soup_flips",
            "parity",
            soup,
            shares,
            _flips_of_soup,
            (
                0.6,
                FEW,
                "A vote of rays does not depend on the winding of faces: no failure found, at gaps of 0.1% of an edge.",
            ),
            device,
            logarithmic=False,
        ),
    ]


def _copy_sweeps(device: Any) -> list[Sweep]:
    shares, parameter = (0.01, 0.03, 0.1, 0.3, 0.6, 1.0), "share of the faces that are there twice"
    return [
        _sweep(
            "sign_copies",
            "winding",
            parameter,
            shares,
            _copies,
            (1.0, FEW, "Duplicate faces do not affect the winding number: no failure found."),
            device,
        ),
        _sweep(
            "sign_copies",
            "parity",
            parameter,
            shares,
            _copies,
            (0.03, FEW, "Duplicate faces act as holes in a vote of rays: 3% of them give under 0.5% of wrong signs."),
            device,
        ),
    ]


def _overlap_sweeps(device: Any) -> list[Sweep]:
    depths, parameter = (0.0, 0.01, 0.1, 0.3, 0.5, 1.0), "depth of two unit spheres in each other"
    return [
        _sweep(
            "sign_overlap",
            "winding",
            parameter,
            depths,
            _overlap,
            (1.0, 0.0, "Overlapping bodies do not affect the winding number: no failure found."),
            device,
            logarithmic=False,
        ),
        _sweep(
            "sign_overlap",
            "pseudonormal",
            parameter,
            depths,
            _overlap,
            (
                0.01,
                FEW,
                "Where bodies overlap, pseudonormals give wrong signs: for under 0.5% of the points around spheres "
                "that overlap by 0.01 radii, 1% at 0.1 radii.",
            ),
            device,
            logarithmic=False,
        ),
        _sweep(
            "sign_overlap",
            "parity",
            parameter,
            depths,
            _overlap,
            (
                0.1,
                FEW,
                "Where two bodies overlap, a vote of rays says outside: for under 0.5% of the points around spheres "
                "that overlap by 0.1 radii.",
            ),
            device,
            logarithmic=False,
        ),
    ]
