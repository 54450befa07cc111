"""Queries inside of a kernel beside the calls: ``python -m benchmarks.user_kernels [--count N] [--device D]``.

One launch of a kernel that asks :mod:`geokit.kernels` once an item, and the call for the same rows, whose answers must
have the same bits. On a CPU both are processor time, as warp has one thread and the call has all; on a GPU they are by
the device's clock.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks import scenes
from benchmarks.gpu_timing import device_median

wp.set_module_options({"enable_backward": False, "fuse_fp": False})
RUNS = 5
# Mean number of neighbors within the radius of the rows about neighbors.
NEIGHBORS = 30


# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
@wp.kernel
def closest_kernel(
    surface: gk.kernels.Surface,
    points: wp.array(dtype=wp.vec3d),
    out_distance: wp.array(dtype=wp.float64),
    out_point: wp.array(dtype=wp.vec3d),
):
    i = wp.tid()
    found = gk.kernels.closest_point(surface, points[i])
    out_distance[i] = found.distance
    out_point[i] = found.point


@wp.kernel
def signed_kernel(
    surface: gk.kernels.Surface,
    points: wp.array(dtype=wp.vec3d),
    out_distance: wp.array(dtype=wp.float64),
    out_point: wp.array(dtype=wp.vec3d),
):
    i = wp.tid()
    found = gk.kernels.signed_distance(surface, points[i])
    out_distance[i] = found.distance
    out_point[i] = found.point


@wp.kernel
def hit_kernel(
    surface: gk.kernels.Surface,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    out_t: wp.array(dtype=wp.float64),
    out_triangle: wp.array(dtype=int),
):
    i = wp.tid()
    hit = gk.kernels.raycast(surface, origins[i], directions[i])
    out_t[i] = hit.t
    out_triangle[i] = hit.triangle_id


@wp.kernel
def occluded_kernel(
    surface: gk.kernels.Surface,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    out_occluded: wp.array(dtype=wp.bool),
):
    i = wp.tid()
    out_occluded[i] = gk.kernels.occluded(surface, origins[i], directions[i])


@wp.kernel
def sample_kernel(
    volume: gk.kernels.SparseVolume, points: wp.array(dtype=wp.vec3d), out_value: wp.array(dtype=wp.float64)
):
    i = wp.tid()
    out_value[i] = gk.kernels.sample(volume, points[i])


@wp.kernel
def gradient_kernel(
    volume: gk.kernels.SparseVolume, points: wp.array(dtype=wp.vec3d), out_gradient: wp.array(dtype=wp.vec3d)
):
    i = wp.tid()
    out_gradient[i] = gk.kernels.gradient(volume, points[i])


@wp.kernel
def count_kernel(
    grid: gk.kernels.NeighborGrid, points: wp.array(dtype=wp.vec3d), radius: wp.float64, out_count: wp.array(dtype=int)
):
    i = gk.kernels.sorted_point(grid, wp.tid())
    count = int(0)
    near = gk.kernels.first_neighbor(grid, points[i], radius)
    while near.index >= 0:
        count += 1
        near = gk.kernels.next_neighbor(grid, near)
    out_count[i] = count


def seconds_of(run: Callable[[], Any], device: wp.Device) -> float:
    if device.is_cuda:
        return device_median(run, RUNS)
    seconds = []
    for _ in range(RUNS):
        start = time.process_time()
        run()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds)


def asked(name: str, count: int, device: wp.Device) -> Iterator[tuple[str, Any, list[Any], list[Any], Callable]]:
    """What is asked, its kernel, what that takes, the kinds of its answers, and the call for them."""
    scene, rng = scenes.SCENES[name](), np.random.default_rng(0)
    surface = gk.mesh.Surface(scene.mesh, device=device)
    handle, (lower, upper) = surface.on_kernel(), scene.mesh.bounds

    def there(rows: Any) -> wp.array:
        return wp.array(rows, dtype=wp.vec3d, device=device)

    on = gk.mesh.sample_surface(scene.mesh, count, seed=0).points
    near = there(on + rng.normal(0.0, 0.005 * scene.mesh.diagonal, on.shape))
    far = there(rng.uniform(lower - 0.25 * (upper - lower), upper + 0.25 * (upper - lower), (count, 3)))
    points = [wp.float64, wp.vec3d]
    for where, rows in (("near", near), ("far", far)):
        yield (
            f"closest, {where}",
            closest_kernel,
            [handle, rows],
            points,
            lambda rows=rows: (found := surface.closest_point(rows)) and (found.distance, found.points),
        )
    yield (
        "signed, near",
        signed_kernel,
        [handle, near],
        points,
        lambda: (found := surface.signed_distance(near)) and (found.distance, found.points),
    )
    for kind, rays in scenes.ray_sets(scene, gk.mesh.Surface(scene.mesh, device="cpu"), count).items():
        ray = [there(rows) for rows in rays]
        yield (
            f"first hit, {kind}",
            hit_kernel,
            [handle, *ray],
            [wp.float64, wp.int32],
            lambda ray=ray: surface.raycast(*ray)[:2],
        )
        yield f"any hit, {kind}", occluded_kernel, [handle, *ray], [wp.bool], lambda ray=ray: [surface.occluded(*ray)]
    volume = gk.volume.from_mesh(scene.mesh, voxel_size=scene.mesh.diagonal / 400, half_width=8.0)
    there_too = volume.on_kernel(device)
    yield (
        "sample",
        sample_kernel,
        [there_too, near],
        [wp.float64],
        lambda: [volume.sample(near, order=1, device=device)],
    )
    yield (
        "gradient",
        gradient_kernel,
        [there_too, near],
        [wp.vec3d],
        lambda: [volume.gradient(near, order=1, device=device)],
    )
    cloud = there(on)
    grid = gk.points.NeighborGrid(cloud, device=device)
    radius = wp.float64(grid.radius * (NEIGHBORS / max(float(grid.count(cloud).numpy().mean()), 1.0)) ** 0.5)
    grid = gk.points.NeighborGrid(cloud, float(radius), device=device)
    yield "neighbors", count_kernel, [grid.on_kernel(), cloud, radius], [wp.int32], lambda: [grid.count(cloud)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--device", default=None)
    parser.add_argument(
        "--scenes", nargs="+", choices=list(scenes.SCENES), default=["lobes", "part", "terrain", "hall"]
    )
    options = parser.parse_args()
    device = wp.get_device(options.device)
    print(f"{device.name}, warp {wp.__version__}, {options.count:,} rows, ns a row")
    for name in options.scenes:
        for what, kernel, given, kinds, call in asked(name, options.count, device):
            count = len(given[1])  # a picture has about as many rays as it should
            out = [wp.empty(count, dtype=kind, device=device) for kind in kinds]

            def run(kernel: Any = kernel, given: Any = given, out: Any = out, count: int = count) -> None:
                wp.launch(kernel, count, inputs=given, outputs=out, device=device)

            inside, outside = seconds_of(run, device), seconds_of(call, device)
            equal = all(
                np.array_equal(one.numpy(), other.numpy(), equal_nan=one.dtype is not wp.bool)
                for one, other in zip(out, call(), strict=True)
            )
            times = f"{1e9 * inside / count:9.1f} {1e9 * outside / count:9.1f} {outside / inside:6.2f}"
            print(f"{name + ', ' + what:32} {times} {'equal' if equal else 'DIFFERENT'}", flush=True)


if __name__ == "__main__":
    main()
