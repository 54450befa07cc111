"""Sweeps of operations on level sets: slopes other than 1, sharp curvature, offsets past the center."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.stability.fields import ball, level_set, voxel_centers
from geokit.accuracy.trials.model import Judgement, Sweeps

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

# What is asked of every build of geokit, and what needs OpenVDB.
SWEEPS, WITH_OPENVDB = Sweeps(), Sweeps()
of_renormalize = partial(SWEEPS.add, "volume.renormalize", "voxels")
Floats = NDArray[np.float64]

HALF_WIDTH = 3.0
# Radius of the spheres whose fields are distorted [voxels].
RADIUS = 16.0
# Radius of the ball that is shrunk [voxels].
SHRINKING = 12.0
# Distance from the surface up to which voxels are checked [voxels], and their number.
ASKED, COUNT = 2.5, 5000
# Wave number k: a wave of slope 1 + a sin(k x) changes by a k a voxel.
WAVE_NUMBER = 0.25
# Four passes of a mean over three voxels have a variance of 4 * 2/3 voxels^2. Half of it times the curvature 2 / R is
# the shrinkage of a sphere [voxels^2].
GAUSSIAN_SHRINKS = 8.0 / 3.0


@of_renormalize(
    "renormalize_slope",
    "slope of the field, cut off at +-3 voxels",
    (0.1, 0.3, 1.0, 1.7, 3.0, 6.0, 16.0),
    last=1.7,
    error=0.02,
    statement="Uniform slopes up to half_width / 1.75 become distances with an error of at most 0.02 voxel "
    "(radius of 16 voxels). Steeper fields are cut off within the cells that the surface crosses, which hides its "
    "position.",
)
def evened_slopes(slope: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Redistancing of distances multiplied by a constant."""
    distance = ball(RADIUS)
    return _evened(distance, lambda p: slope * distance(p), RADIUS, seed, device)


@of_renormalize(
    "renormalize_uneven_slope",
    "change of the slope [1 / voxel]",
    (0.01, 0.02, 0.04, 0.08, 0.12, 0.2),
    last=0.02,
    error=0.1,
    statement="If the slope changes by up to 2 % a voxel, distances have an error of at most 0.1 voxel (at 4 % "
    "only just); at 20 % they are a voxel off.",
)
def evened_waves(change: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Redistancing of distances multiplied by a wave with mean 1."""
    distance = ball(RADIUS)
    amplitude = change / WAVE_NUMBER
    values = lambda p: distance(p) * (1.0 + amplitude * np.sin(WAVE_NUMBER * p[..., 0]))  # noqa: E731
    return _evened(distance, values, RADIUS, seed, device)


@of_renormalize(
    "renormalize_curvature",
    "radius of curvature [voxels], slope 0.7",
    (20.0, 10.0, 5.0, 2.5, 1.25, 0.6),
    last=10.0,
    error=0.02,
    statement="Distances have an error of at most 0.02 voxel around surfaces whose radius of curvature is at "
    "least 10 voxels.",
)
def evened_balls(radius: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Redistancing around balls from fields with a slope below 1."""
    distance = ball(radius)
    return _evened(distance, lambda p: 0.7 * distance(p), radius, seed, device)


@SWEEPS.add(
    "volume.offset",
    "voxels",
    "offset_radius",
    "radius of curvature that is left [voxels] of 12",
    (11.0, 10.0, 8.0, 4.0, 2.0, 1.0, 0.3),
    last=8.0,
    error=0.05,
    statement="Offsets have an error of at most 0.05 voxel if the radius of curvature is at least 8 voxels, "
    "before and after.",
)
def shrunk_balls(radius: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Distances around a ball after an inward offset."""
    from geokit.volume._morphology import offset

    body = _band(ball(SHRINKING), ball(SHRINKING), SHRINKING)
    return _judged(offset(body, radius - SHRINKING, device=device), ball(radius), radius, seed, device)


@WITH_OPENVDB.add(
    "volume.smooth, gaussian",
    "voxels",
    "smooth_gaussian_radius",
    "radius of a ball [voxels]",
    (20.0, 16.0, 12.0, 8.0, 4.0, 3.0, 2.0),
    last=8.0,
    error=0.05,
    statement="One pass of width 1 moves the surface inward by 2.7 voxel^2 over the radius of curvature, with an "
    "error of at most 0.05 voxel from a radius of 8 voxels on; balls of 2 voxels and less disappear.",
)
def smoothed_balls(radius: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Distances around smoothed balls, against balls that are smaller by the theoretical shrinkage."""
    from geokit.volume._filters import smooth

    body = _band(ball(radius), ball(radius), radius)
    left = radius - GAUSSIAN_SHRINKS / radius
    return _judged(smooth(body, "gaussian"), ball(left), radius, seed, device, asked=0.5)


def _band(distance: Any, values: Any, radius: float) -> SparseVolume:
    """The values of a volume on voxels within HALF_WIDTH of the surface."""

    def cut(points: Floats) -> Floats:
        d = distance(points)
        return np.asarray(np.where(np.abs(d) < HALF_WIDTH, values(points), np.copysign(HALF_WIDTH, d)))

    return level_set(cut, radius, HALF_WIDTH)


def _evened(distance: Any, values: Any, radius: float, seed: int, device: Any) -> Judgement:
    """Redistancing of values around a surface."""
    from geokit.volume._morphology import renormalize

    evened = renormalize(_band(distance, values, radius), device=device)
    return _judged(evened, distance, radius, seed, device)


def _judged(
    volume: SparseVolume, distance: Any, radius: float, seed: int, device: Any, asked: float = ASKED
) -> Judgement:
    """Voxels sampled near the surface; those on the wrong side by more than half a voxel are wrong."""
    centers = voxel_centers(int(np.ceil(radius)) + 4).reshape(-1, 3)
    true = distance(centers)
    near = np.flatnonzero(np.abs(true) < asked)
    near = np.random.default_rng(seed).permutation(near)[:COUNT]
    found = volume.sample(centers[near], order=0, device=device)
    wrong = (found * true[near] < 0.0) & (np.abs(true[near]) > 0.5)
    return Judgement(np.abs(found - true[near]), wrong, centers[near])
