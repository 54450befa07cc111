"""Sweeps of rays through volumes: steep and flat fields, grazing rays, narrow bands, dense fog."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.stability.fields import MIDDLE, Field, ball, field, joined, level_set, unit_vectors
from geokit.accuracy.stability.shapes import judged
from geokit.accuracy.trials.model import Judgement, Sweeps

SWEEPS = Sweeps()
Floats = NDArray[np.float64]

# The target sphere and the distance at which rays start [voxels].
RADIUS, START = 16.0, 30.0
RAYS = 4000
# Trilinear interpolation moves the sphere's surface inward by at most 0.25 voxel^2 / radius if the cells that it
# crosses hold the whole field; half as much again for cells nearer to the center than the surface.
SURFACE = 1.5 * 0.25 / RADIUS
of_hits = partial(SWEEPS.add, "volume.raycast", "voxels", error=SURFACE)
# Aimed rays pass the center within this share of the radius.
AIMED = 0.9
# A cell's diagonal and more [voxels]: bounds the distance from the surface to the corners of the cells that it crosses.
CELL = 1.75
HALF_WIDTH = 3.0
# Half the width of the fog [voxels].
FOG_REACH = 12
# Error that integrate promises for its quadrature.
EMISSION_ERROR = 1e-9


@of_hits(
    "raycast_volume_slope",
    "slope of the field, cut off at +-3 voxels",
    (0.25, 0.5, 1.0, 1.7, 3.0, 6.0, 16.0),
    last=1.7,
    statement="Rays hit at any slope: they find the interpolant's surface, which is that of the field up to a "
    "slope of half_width / 1.75. Steeper fields are cut off within the cells that the surface crosses, and the "
    "surface is up to half a voxel off.",
)
def steep_hits(slope: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Rays at a sphere whose distance field is multiplied, then cut off."""
    distance = ball(RADIUS)
    return _hits(lambda p: slope * distance(p), HALF_WIDTH, _aimed(seed), device)


@of_hits(
    "raycast_volume_band",
    "half width of a distance field's band [voxels]",
    (6.0, 3.0, 2.0, CELL, 1.25, 1.0, 0.5),
    last=CELL,
    statement="A half width of 1.75 voxels is enough: the corners of the cells that the surface crosses are then "
    "in the band. In narrower bands hits are up to half a voxel off.",
)
def banded_hits(half_width: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Rays at a sphere whose distance field is cut off at a half width."""
    return _hits(ball(RADIUS), half_width, _aimed(seed), device)


@of_hits(
    "raycast_volume_exponent",
    "exponent of a field that is a power of the distance",
    (1.0, 1.25, 1.5, 2.0, 3.0, 5.0, 9.0),
    last=2.0,
    error=0.25,
    statement="Fields that are not distances lose no rays; only the interpolant's surface moves, by up to a "
    "quarter voxel where a field is as flat as the squared distance, by half a voxel for high powers.",
)
def power_hits(exponent: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Rays at a sphere in a field that is a signed power of the distance."""
    distance = ball(RADIUS)

    def power(points: Floats) -> Floats:
        d = distance(points)
        return np.asarray(np.sign(d) * np.abs(d) ** exponent)

    return _hits(power, HALF_WIDTH**exponent, _aimed(seed), device)


@of_hits(
    "raycast_volume_grazing",
    "angle between ray and surface [degrees], radius 16 voxels",
    (90.0, 60.0, 30.0, 10.0, 4.0, 2.0, 1.0, 0.3, 0.1),
    last=4.0,
    statement="Rays at 4 degrees or more to a surface with a radius of 16 voxels hit it; in general, rays that "
    "reach at least 0.375 voxel^2 over the radius below it do. The interpolant's surface lies at most that far "
    "inside, and shallower rays may miss it.",
)
def grazing_hits(angle: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Rays that meet a sphere at a given angle."""
    beside = RADIUS * np.cos(np.radians(angle))
    return _hits(ball(RADIUS), HALF_WIDTH, _rays(np.full(RAYS, beside), seed), device)


@of_hits(
    "raycast_volume_scale",
    "factor on a distance field and its background",
    (1.0, 1e-10, 1e-20, 1e-30, 1e-37, 1e-43, 1e-44),
    last=1e-37,
    statement="Surfaces are found at any scale that float32 represents, down to 1e-37 a voxel; below it, values "
    "lose digits and then vanish.",
)
def scaled_hits(factor: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Rays at a sphere whose distance field and background are multiplied."""
    distance = ball(RADIUS)
    return _hits(lambda p: factor * distance(p), factor * HALF_WIDTH, _aimed(seed), device)


@SWEEPS.add(
    "volume.integrate",
    "relative",
    "integrate_free_path",
    "mean free path [voxels] in fog that begins and ends within a voxel",
    (256.0, 64.0, 16.0, 4.0, 1.0, 0.25),
    last=16.0,
    error=0.07,
    statement="The integral of the interpolant is exact, but each border of a fog is known only to half a voxel: "
    "transmittances have an error of at most exp(1 / mean free path) - 1, 7 % for a mean free path of 16 voxels.",
)
@joined
def slab_transmittances(free_path: float, *, seed: int = 0, device: Any = None) -> Iterator[Judgement]:
    """Rays across slabs of uniform fog, straight and slanted; voxels with their center in the fog have its density."""
    from geokit.volume._integrate import integrate

    random = np.random.default_rng(seed)
    # Just under two voxels and just over are the thickest and the thinnest slabs that look alike.
    ends = [(-5.999, 5.999), (-6.001, 6.001), *np.sort(random.uniform(-7.0, 7.0, (4, 2)), axis=1).tolist()]
    for low, high in ends:
        inside = lambda p, low=low, high=high: ((p[..., 0] > low) & (p[..., 0] < high)).astype(float)  # noqa: E731
        fog = field(inside, FOG_REACH)
        starts = np.column_stack([np.full(50, -FOG_REACH - 2.0), random.uniform(-1.0, 1.0, (50, 2))])
        toward = np.column_stack([np.ones(50), random.uniform(-0.2, 0.2, (50, 2))])
        found = integrate(fog, starts, toward, extinction=1.0 / free_path, device=device).transmittance
        slant = np.linalg.norm(toward, axis=1)
        # Compared with a straight ray: a slanted ray passes through more of everything.
        yield judged((found * np.exp((high - low) * slant / free_path)) ** (1.0 / slant) - 1.0, False, starts)


@SWEEPS.add(
    "volume.integrate",
    "relative",
    "integrate_emission_depth",
    "optical depth of a voxel",
    (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4),
    last=1e4,
    error=EMISSION_ERROR,
    statement="Emission has a relative error of at most 1e-9 where a voxel's optical depth is 1e-3 to 1e4: no "
    "failure found.",
)
@joined
def emissions(depth: float, *, seed: int = 0, device: Any = None) -> Iterator[Judgement]:
    """Rays that start inside uniform glowing fog; a ray that also ends there sees ``1 - exp(-length)``."""
    from geokit.volume._integrate import integrate

    fog = field(lambda p: np.ones(p.shape[:-1]), FOG_REACH)
    starts = np.random.default_rng(seed).uniform(-3.0, 3.0, (100, 3))
    # Within one voxel and over several: max_distance sets the visible length.
    for length in (0.3, 6.0):
        toward = unit_vectors(len(starts), seed)
        found = integrate(fog, starts, toward, extinction=depth, emission=fog, max_distance=length, device=device)
        true = -np.expm1(-depth * length) / depth
        yield judged(found.emission / true - 1.0, False, starts)


def _aimed(seed: int) -> tuple[Floats, Floats]:
    # The square root makes the distribution uniform over the disc.
    return _rays(RADIUS * AIMED * np.sqrt(np.random.default_rng([seed, 1]).random(RAYS)), seed)


def _rays(beside: Floats, seed: int) -> tuple[Floats, Floats]:
    """Rays that pass the center at distances ``beside``."""
    toward = unit_vectors(len(beside), seed)
    across = np.cross(toward, unit_vectors(len(beside), seed + 1000))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return MIDDLE + beside[:, None] * across - START * toward, toward


def _hits(function: Field, cut: float, rays: tuple[Floats, Floats], device: Any) -> Judgement:
    """Distances of hits from the sphere; misses are wrong."""
    volume = level_set(function, RADIUS, cut)
    found = volume.raycast(*rays, device=device)
    missed = ~np.isfinite(found.t)
    points = rays[0] + np.where(missed, 0.0, found.t)[:, None] * rays[1]
    return judged(np.linalg.norm(points - MIDDLE, axis=1) - RADIUS, missed, rays[0] + START * rays[1])
