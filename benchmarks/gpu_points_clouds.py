"""Normals, density, outliers and clusters on a GPU beside the CPU, and beside brute force; part of the GPU checks.

Run with ``python -m benchmarks.gpu_points_clouds``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from benchmarks.gpu_timing import wall_median
from geokit.points._cluster import cluster
from geokit.points._density import density
from geokit.points._normals import normals
from geokit.points._outliers import outliers

COMPARED, BRUTE, MANY = 200_000, 50_000, 4_000_000
RUNS = 5


@wp.kernel
def brute_density_kernel(points: wp.array(dtype=wp.vec3d), radius: wp.float64, out_density: wp.array(dtype=wp.float64)):
    """Baseline as a warp user would write it first: all pairs of points, with Wendland's kernel."""
    i = wp.tid()
    p = points[i]
    total = wp.float64(0.0)
    for j in range(points.shape[0]):
        q = wp.length(points[j] - p) / radius
        if q < wp.float64(1.0):
            u = wp.float64(1.0) - q
            total += u * u * u * u * (wp.float64(1.0) + wp.float64(4.0) * q)
    out_density[i] = total * wp.float64(21.0) / (wp.float64(2.0) * wp.float64(wp.pi) * radius * radius * radius)


def ball(count: int) -> np.ndarray:
    """Points of a sphere's surface, in random order."""
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def blobs(count: int) -> np.ndarray:
    """Nine tenths in fifty blobs, one tenth anywhere."""
    random = np.random.default_rng(1)
    centers = random.random((50, 3))
    many = count * 9 // 10
    near = centers[random.integers(0, 50, many)] + random.normal(size=(many, 3)) * 0.03
    return np.concatenate([near, random.random((count - many, 3))])


def cases(count: int) -> dict[str, tuple[np.ndarray, Callable[[Any, str], Any]]]:
    """Name, points, and the call on points on a device."""
    near = 0.014 * (200_000 / count) ** (1 / 3)
    patch = 8.0 / np.sqrt(count)
    surface, crowd = ball(count), blobs(count)
    return {
        "normals, k = 16, no signs": (surface, lambda p, d: normals(p, orientation="none", device=d)),
        "normals, k = 16, propagated": (surface, lambda p, d: normals(p, device=d)),
        "normals, radius, no signs": (surface, lambda p, d: normals(p, radius=patch, orientation="none", device=d)),
        "density, count": (crowd, lambda p, d: (density(p, radius=near, device=d),)),
        "density, cubic spline": (crowd, lambda p, d: (density(p, radius=near, kernel="cubic_spline", device=d),)),
        "density, wendland c2": (crowd, lambda p, d: (density(p, radius=near, kernel="wendland_c2", device=d),)),
        "density, poly6": (crowd, lambda p, d: (density(p, radius=near, kernel="poly6", device=d),)),
        "outliers, statistical": (crowd, lambda p, d: (outliers(p, device=d),)),
        "outliers, radius": (
            crowd,
            lambda p, d: (outliers(p, method="radius", radius=near, minimum_count=9, device=d),),
        ),
        "clusters": (crowd, lambda p, d: (cluster(p, radius=near, device=d),)),
    }


def check_clouds(out: Callable[[str], None], device: str = "cuda:0") -> None:
    """Differing rows between the two devices, from NumPy arrays, and their largest difference."""
    out(f"| {COMPARED} points | rows that differ | largest difference | NaN |")
    out("|---|---:|---:|---:|")
    for name, (points, ask) in cases(COMPARED).items():
        differ, apart, bad = 0, 0.0, 0
        for found, wanted in zip(ask(points, device), ask(points, "cpu"), strict=True):
            other = found != wanted
            differ = max(differ, int((other if other.ndim == 1 else other.any(axis=1)).sum()))
            apart = max(apart, float(np.abs(found.astype(np.float64) - wanted.astype(np.float64)).max()))
            bad += int(np.isnan(found.astype(np.float64)).sum())
        out(f"| {name} | {differ} | {apart:.2g} | {bad} |")


def time_clouds(out: Callable[[str], None], device: str = "cuda:0") -> None:
    """Seconds from warp arrays on the device to warp arrays there, structures built included."""
    out(f"| {MANY} points in random order | ms | M points/s |")
    out("|---|---:|---:|")
    for name, (points, ask) in cases(MANY).items():
        there = wp.array(points, dtype=wp.vec3d, device=device)
        seconds = wall_median(lambda there=there, ask=ask: ask(there, device), RUNS)
        out(f"| {name} | {seconds * 1e3:.1f} | {MANY / seconds / 1e6:.1f} |")


def time_brute_force(out: Callable[[str], None], device: str = "cuda:0") -> None:
    """Density of few points against a kernel over all pairs; equality of the answers is checked first."""
    points, radius = blobs(BRUTE), 0.022
    there = wp.array(points, dtype=wp.vec3d, device=device)
    result = wp.empty(BRUTE, dtype=wp.float64, device=device)

    def brute() -> None:
        wp.launch(brute_density_kernel, BRUTE, [there, wp.float64(radius)], [result], device=device)

    def ours() -> Any:
        return density(there, radius=radius, kernel="wendland_c2", device=device)

    brute()
    np.testing.assert_allclose(ours().numpy(), result.numpy(), rtol=1e-12)
    theirs, seconds = wall_median(brute, RUNS), wall_median(ours, RUNS)
    out(f"| {BRUTE} points, wendland c2 | ms |")
    out("|---|---:|")
    out(f"| all pairs, raw warp | {theirs * 1e3:.2f} |")
    out(f"| density, grid included | {seconds * 1e3:.2f} ({theirs / seconds:.1f} times as fast) |")


def main(out: Callable[[str], None] = print) -> None:
    check_clouds(out)
    out("")
    time_clouds(out)
    out("")
    time_brute_force(out)


if __name__ == "__main__":
    main()
