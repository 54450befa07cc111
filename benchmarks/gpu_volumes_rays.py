"""Rays through volumes on a GPU beside the CPU and beside raw warp marching; part of benchmarks.gpu_volumes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from benchmarks.gpu_timing import wall_median
from benchmarks.volume_rays import camera_rays, level_set, random_rays, volume_of_fog
from geokit.core import launcher
from geokit.volume._integrate import integrate
from geokit.volume._raycast import raycast
from geokit.volume.rays import crossing_blocks

RESOLUTIONS = (256, 512)
COMPARED, RAYS = 200_000, 4_000_000
RUNS = 5


@wp.kernel
def march_kernel(
    first: int,
    volume: wp.uint64,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    start: float,
    end: float,
    step: float,
    out_t: wp.array(dtype=float),
):
    """Baseline as a warp user would write it: steps of half a voxel until the sign changes, then ten bisections;
    float32, t only."""
    i = first + wp.tid()
    t = start
    last = float(1.0)  # noqa: UP018 - a literal would be a constant of the kernel
    out_t[i] = wp.inf
    while t < end:
        p = wp.volume_world_to_index(volume, origins[i] + t * directions[i])
        value = wp.volume_sample_f(volume, p, wp.Volume.LINEAR)
        if value * last < 0.0:
            low = t - step
            high = t
            for _ in range(10):
                middle = 0.5 * (low + high)
                q = wp.volume_world_to_index(volume, origins[i] + middle * directions[i])
                if wp.volume_sample_f(volume, q, wp.Volume.LINEAR) * last < 0.0:
                    high = middle
                else:
                    low = middle
            out_t[i] = high
            return
        last = value
        t += step


def median(run: Callable[[], Any]) -> float:
    return wall_median(run, RUNS)


def check_rays(out: Callable[[str], None], device: str = "cuda:0") -> None:
    """Compares CPU and GPU: hits with and without the blocks of the isovalue, and light through fog."""
    out("| check | other hits | largest difference of t [voxels] | of normals |")
    out("|---|---:|---:|---:|")
    blocks_per_ray = crossing_blocks.BLOCKS_PER_RAY
    for resolution in RESOLUTIONS:
        volume = level_set(resolution)
        voxel = float(volume.info.voxel_size[0])
        for kind, made in (("random", random_rays), ("camera", camera_rays)):
            origins, directions = made(volume, COMPARED)
            wanted = raycast(volume, origins, directions, device="cpu")
            for name, share in (("blocks", blocks_per_ray), ("tree", 0)):
                crossing_blocks.BLOCKS_PER_RAY = share
                crossing_blocks.known_blocks(volume).clear()
                found = raycast(volume, origins, directions, device=device)
                other = np.isfinite(found.t) != np.isfinite(wanted.t)
                both = np.isfinite(found.t) & np.isfinite(wanted.t)
                apart = np.abs(found.t[both] - wanted.t[both]).max() / voxel
                turned = np.abs(found.normals[both] - wanted.normals[both]).max()
                out(f"| {resolution}^3, {kind}, {name} | {int(other.sum())} | {apart:.1e} | {turned:.1e} |")
            crossing_blocks.BLOCKS_PER_RAY = blocks_per_ray
            crossing_blocks.known_blocks(volume).clear()
        fog = volume_of_fog(resolution)
        origins, directions = random_rays(volume, COMPARED // 10)
        lights = [
            integrate(fog, origins, directions, extinction=10.0, emission=fog, device=where)
            for where in ("cpu", device)
        ]
        apart = max(float(np.abs(a - b).max()) for a, b in zip(*lights, strict=True))
        out(f"| {resolution}^3, fog: transmittance and emission | - | {apart:.1e} | - |")


def check_times(out: Callable[[str], None], device: str = "cuda:0") -> None:
    """Times on device arrays against raw marching, and the time for the blocks of an isovalue."""
    out("\n| rays | geokit M/s | raw marching M/s | ratio | blocks of an isovalue [ms] | fog M/s |")
    out("|---|---:|---:|---:|---:|---:|")
    target = launcher.resolve_device(device)
    for resolution in RESOLUTIONS:
        volume = level_set(resolution)
        fog = volume_of_fog(resolution)
        voxel = float(volume.info.voxel_size[0])
        size = float(np.linalg.norm(np.diff(volume.info.world_bounds, axis=0)))
        for kind, made in (("random", random_rays), ("camera", camera_rays)):
            origins, directions = (wp.array(a, dtype=wp.vec3d, device=target) for a in made(volume, RAYS))
            narrow = [
                wp.array(a.numpy().astype(np.float32), dtype=wp.vec3f, device=target) for a in (origins, directions)
            ]
            count = len(origins)
            ours = median(lambda o=origins, d=directions, v=volume: raycast(v, o, d, device=device))
            t = wp.empty(count, dtype=float, device=target)
            handle = wp.uint64(volume.id(target))
            inputs = [handle, *narrow, 0.25 * size, 2.0 * size, 0.5 * voxel]
            raw = median(lambda n=count, i=inputs, t=t: launcher.launch(march_kernel, n, i, [t], target))

            def from_nothing(o: Any = origins, d: Any = directions, v: Any = volume) -> Any:
                crossing_blocks.known_blocks(v).clear()
                return raycast(v, o, d, device=device)

            blocks = median(from_nothing) - ours
            light = median(lambda o=origins, d=directions, f=fog: integrate(f, o, d, extinction=10.0, device=device))
            out(
                f"| {resolution}^3, {kind} | {count / ours / 1e6:.0f} | {count / raw / 1e6:.0f} | {raw / ours:.1f} "
                f"| {blocks * 1e3:.1f} | {count / light / 1e6:.0f} |"
            )


def main(out: Callable[[str], None]) -> None:
    """Print the tables."""
    check_rays(out)
    check_times(out)
