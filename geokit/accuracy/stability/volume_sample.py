"""Sweeps of sampling and quantized grids: fine features, the end of the band, far positions, flat fields, few bits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.stability.fields import MIDDLE, ball, field, joined, level_set, unit_vectors
from geokit.accuracy.stability.shapes import judged
from geokit.accuracy.trials.model import Judgement, Sweeps, cases_of

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

SWEEPS = Sweeps()
Floats = NDArray[np.float64]

# Number of waves at each wavelength, with different directions and phases.
WAVES = 4
# Half the width of the fields, and the extent of their queries: no stencil reaches the end [voxels].
FIELD_REACH, ASKED = 11, 8.0
# Radius of the sphere whose queries leave the band [voxels].
BAND_RADIUS = 20.0
HALF_WIDTH = 3.0
# Points whose coordinates are exact while the grid is near the origin.
FRACTION = 2.0**-20
FAR_DIRECTION = np.array([0.6, -0.5, 0.62])
FAR_VOXEL = 0.1
# A slope that is exact in float32 at every voxel.
SLOPE = np.array([0.5, 0.25, -0.75])
# Trilinear interpolation of a distance has an error of an eighth of the sum of its second derivatives, 2 / radius
# [voxels^2].
INTERPOLATION = 0.25
# Factor on that error within which a quantized grid counts as good.
WITH_CODEC = 3.0
# Radius of the sphere whose grid meets a tolerance [voxels].
TOLERANCE_RADIUS = 30.0


# For a wave number k, errors are at most k sqrt(3) / 2 for order 0, k^2 / 8 for order 1, and 0.0642 k^3 and 0.0469 k^3
# for orders 2 and 3, the L1 norms of their Peano kernels: wavelengths of 54, 22, 11.7 and 10.5 voxels. (At order 3 long
# waves have an error of 0.016 k^3.)
@SWEEPS.add(
    "volume.sample, order={order}",
    "amplitudes",
    "sample_order_{order}_wavelength",
    "wavelength [voxels]",
    (128.0, 64.0, 48.0, 24.0, 12.0, 8.0, 4.0, 2.0),
    cases=cases_of(
        "order last error bound",
        (0, 64.0, 0.1, "5.5 / wavelength"),
        (1, 24.0, 0.01, "5 / wavelength^2"),
        (2, 12.0, 0.01, "16 / wavelength^3"),
        (3, 12.0, 0.01, "12 / wavelength^3, long waves a third of that"),
    ),
    statement="Order {order} is off by at most {error:.0%} of the amplitude of waves that are {last:g} voxels long or "
    "more ({bound}).",
)
@joined
def waves(wavelength: float, *, order: int, seed: int = 0, device: Any = None) -> Iterator[Judgement]:
    """Plane waves of amplitude 1 at random points; the first along an axis, the second along a diagonal."""
    number = 2.0 * np.pi / wavelength
    directions = np.concatenate([[[1.0, 0.0, 0.0]], np.full((1, 3), 3.0**-0.5), unit_vectors(WAVES - 2, seed)])
    random = np.random.default_rng([seed, order])
    for direction in directions:
        phase = random.uniform(0.0, 2.0 * np.pi)
        points = random.uniform(-ASKED, ASKED, (1000, 3))

        def wave(p: Floats, d: Floats = direction, phase: float = phase) -> Floats:
            return np.asarray(np.sin(number * (p @ d) + phase))

        found = field(wave, FIELD_REACH).sample(points, order=order, device=device)
        yield judged(found - wave(points), False, points)


@SWEEPS.add(
    "volume.sample, order={order}",
    "voxels",
    "sample_order_{order}_band",
    "distance from the surface [voxels], band of half width 3",
    (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0),
    cases=cases_of("order last error margin", (1, 2.0, 0.05, 1.0), (2, 0.5, 0.004, 2.5), (3, 0.5, 0.001, 2.5)),
    statement="Up to half_width - {margin:g} voxels from the surface order {order} is as accurate as in an unbounded "
    f"field ({{error:g}} voxel on a sphere of {BAND_RADIUS:g} voxels). Beyond half_width the value is half_width, at "
    "any distance from the surface.",
    logarithmic=False,
)
def band_distances(distance: float, *, order: int, seed: int = 0, device: Any = None) -> Judgement:
    """Points at a distance from a sphere, inside and outside."""
    band = level_set(ball(BAND_RADIUS), BAND_RADIUS, HALF_WIDTH)
    signed = np.where(np.arange(4000) % 2, distance, -distance)
    points = MIDDLE + unit_vectors(4000, seed) * (BAND_RADIUS + signed)[:, None]
    return judged(band.sample(points, order=order, device=device) - signed, False, points)


@SWEEPS.add(
    "volume.sample, order={order}",
    "voxels",
    "sample_order_{order}_origin",
    "distance of the grid from the origin [voxels]",
    (1.0, 1e3, 1e6, 1e9, 1e12, 1e15),
    cases=cases_of("order", (1,), (3,)),
    last=1e9,
    error=2e-6,
    statement="Up to 1e9 voxels from the origin a value is that of a point at most 2e-6 voxel away: the error is that "
    "of float64 coordinates, a few times 2^-53 of the distance.",
)
def far_values(distance: float, *, order: int, seed: int = 0, device: Any = None) -> Judgement:
    """A linear field on a grid far from the origin; errors are divided by its slope, which is nearly 1."""
    translation = distance * FAR_VOXEL * FAR_DIRECTION
    transform = np.diag([FAR_VOXEL] * 3 + [1.0])
    transform[:3, 3] = translation
    grid = field(lambda p: p @ SLOPE, FIELD_REACH, transform=transform)
    limit = int(ASKED / FRACTION)
    local = np.random.default_rng(seed).integers(-limit, limit, (2000, 3)) * FRACTION
    points = local * FAR_VOXEL + translation
    found = grid.sample(points, order=order, device=device)
    return judged(np.abs(found - local @ SLOPE) / np.linalg.norm(SLOPE), False, points)


# Half a step is half_width / (2^bits - 1), which is twice 0.25 / radius where the radius is (2^bits - 1) / 6. Up to
# ``last`` it is at most twice the interpolation error.
@SWEEPS.add(
    "volume.quantize, {codec}",
    "voxels",
    "quantize_{codec}_curvature",
    "radius of curvature [voxels], band of half width 3",
    cases=cases_of(
        "codec values last steps half_step",
        ("fp4", (1.0, 2.0, 4.0, 16.0, 64.0), 2.0, 15, HALF_WIDTH / 15),
        ("fp8", (2.0, 4.0, 8.0, 16.0, 64.0, 256.0), 16.0, 255, HALF_WIDTH / 255),
        ("fp16", (2.0, 64.0, 1024.0, 4096.0, 16384.0, 65536.0), 4096.0, 65535, HALF_WIDTH / 65535),
    ),
    error=lambda radius: WITH_CODEC * INTERPOLATION / radius,
    statement="{codec} is off by at most half_width / {steps}, {half_step:.2g} voxel of a band of half width 3, at any "
    "curvature. Up to a radius of {last:g} voxels, sampling at order 1 then has at most three times its error without "
    "quantization, 0.25 / radius.",
)
def quantized_distances(radius: float, *, codec: str, seed: int = 0, device: Any = None) -> Judgement:
    """Distances within half a voxel of a patch of a sphere, sampled from its quantized band at order 1."""
    from geokit.volume.retyped.quantize import quantize

    patch, direction, center = _patch(radius, seed)
    small = quantize(patch, codec)
    random = np.random.default_rng(seed)
    # Around the direction of the patch, over its extent.
    spread = min(1.0, 0.5 * ASKED / radius)
    toward = direction + spread * unit_vectors(4000, seed)
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    height = random.uniform(-0.5, 0.5, 4000)
    points = center + toward * (radius + height)[:, None]
    return judged(small.sample(points, device=device) - height, False, points)


@SWEEPS.add(
    "volume.quantize, fpn",
    "tolerances",
    "quantize_fpn_tolerance",
    "tolerance [voxels], band of half width 3",
    (0.3, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6),
    last=1e-4,
    error=1.0,
    statement="A tolerance is met or refused: in a band of half width 3, fpn meets 1e-4 voxel and more, and "
    "refuses tolerances below half_width / 65535, which 16 bits a voxel cannot meet.",
)
def kept_tolerances(tolerance: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Voxels of a band that was stored with a tolerance; errors are their changes in tolerances."""
    from geokit.volume.retyped.quantize import quantize

    patch, _, _ = _patch(TOLERANCE_RADIUS, seed)
    voxels = np.random.default_rng(seed).integers(-FIELD_REACH, FIELD_REACH + 1, (4000, 3)).astype(float)
    small = quantize(patch, "fpn", tolerance=tolerance)
    before, after = (grid.sample(voxels, order=0, device=device) for grid in (patch, small))
    return judged(np.abs(after - before) / tolerance, False, voxels)


def _patch(radius: float, seed: int) -> tuple[SparseVolume, Floats, Floats]:
    """A patch of a sphere's band around the origin, the direction from its center to the patch, and the center."""
    direction = unit_vectors(1, seed)[0]
    center = MIDDLE - radius * direction
    patch = field(
        lambda p: np.clip(np.linalg.norm(p - center, axis=-1) - radius, -HALF_WIDTH, HALF_WIDTH),
        FIELD_REACH,
        background=HALF_WIDTH,
    )
    return patch, direction, center
