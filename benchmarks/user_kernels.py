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
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import geokit as gk
from benchmarks import raw_kernels, scenes
from benchmarks.gpu_timing import device_median

wp.set_module_options({"enable_backward": False, "fuse_fp": False})
RUNS = 5
# Mean number of neighbors within the radius of the rows about neighbors.
NEIGHBORS = 30


# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
@wp.kernel(cuda_max_registers=80)
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


@wp.kernel(cuda_max_registers=80)
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


@wp.kernel(cuda_max_registers=48)
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


@wp.kernel(cuda_max_registers=48)
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


class Row(NamedTuple):
    """What is asked, its kernel, what that takes, the kinds of its answers, the call, and raw warp's launch."""

    what: str
    kernel: Any
    given: list[Any]
    kinds: list[Any]
    call: Callable[[], Any]
    raw: Callable[[], Any] | None = None


def launched(kernel: Any, given: list[Any], kind: Any, count: int, device: wp.Device) -> Callable[[], None]:
    out = wp.empty(count, dtype=kind, device=device)
    return lambda: wp.launch(kernel, count, inputs=given, outputs=[out], device=device)


def asked(name: str, count: int, device: wp.Device) -> Iterator[Row]:
    scene, rng = scenes.SCENES[name](), np.random.default_rng(0)
    surface = gk.mesh.Surface(scene.mesh, device=device)
    handle, (lower, upper) = surface.on_kernel(), scene.mesh.bounds
    vertices = wp.array(scene.mesh.vertices, dtype=wp.vec3, device=device)
    faces = wp.array(scene.mesh.faces.reshape(-1), dtype=wp.int32, device=device)
    mesh = wp.Mesh(points=vertices, indices=faces, bvh_constructor="sah", bvh_leaf_size=1)

    def there(rows: Any, kind: Any = wp.vec3d) -> wp.array:
        return wp.array(rows, dtype=kind, device=device)

    def in_order(rows: np.ndarray) -> np.ndarray:
        return rows[gk.points.NeighborGrid(rows, device="cpu").on_kernel().cells.index.numpy()]

    on = gk.mesh.sample_surface(scene.mesh, count, seed=0).points
    near = on + rng.normal(0.0, 0.005 * scene.mesh.diagonal, on.shape)
    far = rng.uniform(lower - 0.25 * (upper - lower), upper + 0.25 * (upper - lower), (count, 3))
    for where, points in (
        ("near", near),
        ("near, in order", in_order(near)),
        ("far", far),
        ("far, in order", in_order(far)),
    ):
        rows = there(points)
        given, kinds = [handle, rows], [wp.float64, wp.vec3d]
        raw = launched(raw_kernels.raw_closest_kernel, [mesh.id, there(points, wp.vec3)], wp.float32, count, device)

        def closest(rows: wp.array = rows) -> Any:
            found = surface.closest_point(rows)
            return found.distance, found.points

        def signed(rows: wp.array = rows) -> Any:
            found = surface.signed_distance(rows)
            return found.distance, found.points

        yield Row(f"closest, {where}", closest_kernel, given, kinds, closest, raw)
        if where == "near, in order":
            yield Row(f"signed, {where}", signed_kernel, given, kinds, signed)
    for kind, rays in scenes.ray_sets(scene, gk.mesh.Surface(scene.mesh, device="cpu"), count).items():
        ray, narrow = [there(rows) for rows in rays], [there(rows, wp.vec3) for rows in rays]
        given, many = [handle, *ray], len(rays[0])
        raw = launched(raw_kernels.raw_ray_kernel, [mesh.id, *narrow], wp.float32, many, device)
        yield Row(
            f"first hit, {kind}",
            hit_kernel,
            given,
            [wp.float64, wp.int32],
            lambda ray=ray: surface.raycast(*ray)[:2],
            raw,
        )
        raw = launched(raw_kernels.raw_any_hit_kernel, [mesh.id, *narrow], wp.bool, many, device)
        yield Row(f"any hit, {kind}", occluded_kernel, given, [wp.bool], lambda ray=ray: [surface.occluded(*ray)], raw)
    volume = gk.volume.from_mesh(scene.mesh, voxel_size=scene.mesh.diagonal / 400, half_width=8.0, interior="keep")
    given, rows = [volume.on_kernel(device), there(near)], there(near)
    raw = launched(raw_kernels.raw_sample_kernel, [volume.id(device), there(near, wp.vec3)], wp.float32, count, device)
    yield Row("sample", sample_kernel, given, [wp.float64], lambda: [volume.sample(rows, order=1, device=device)], raw)
    yield Row("gradient", gradient_kernel, given, [wp.vec3d], lambda: [volume.gradient(rows, order=1, device=device)])
    cloud = there(on)
    grid = gk.points.NeighborGrid(cloud, device=device)
    radius = grid.radius * (NEIGHBORS / max(float(grid.count(cloud).numpy().mean()), 1.0)) ** 0.5
    grid = gk.points.NeighborGrid(cloud, radius, device=device)
    raw = launched(
        raw_kernels.raw_count_in_order_kernel, [grid.id, there(on, wp.vec3), radius], wp.int32, count, device
    )
    given = [grid.on_kernel(), cloud, wp.float64(radius)]
    yield Row("neighbors", count_kernel, given, [wp.int32], lambda: [grid.count(cloud)], raw)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--device", default=None)
    parser.add_argument(
        "--scenes", nargs="+", choices=list(scenes.SCENES), default=["lobes", "part", "terrain", "hall"]
    )
    options = parser.parse_args()
    device = wp.get_device(options.device)
    print(f"{device.name}, warp {wp.__version__}, {options.count:,} rows, ns a row; times of the call and of raw warp")
    print(f"{'':32} {'kernel':>9} {'call':>9} {'raw warp':>9} {'/call':>6} {'/raw':>6}")
    for name in options.scenes:
        for row in asked(name, options.count, device):
            count = len(row.given[1])  # a picture has about as many rays as it should
            out = [wp.empty(count, dtype=kind, device=device) for kind in row.kinds]

            def run(row: Row = row, out: Any = out, count: int = count) -> None:
                wp.launch(row.kernel, count, inputs=row.given, outputs=out, device=device)

            inside, call = seconds_of(run, device), seconds_of(row.call, device)
            raw = seconds_of(row.raw, device) if row.raw else np.nan
            equal = all(
                np.array_equal(one.numpy(), other.numpy(), equal_nan=one.dtype is not wp.bool)
                for one, other in zip(out, row.call(), strict=True)
            )
            times = " ".join(f"{1e9 * seconds / count:9.2f}" for seconds in (inside, call, raw))
            ratios = f"{call / inside:6.2f} {raw / inside:6.2f}"
            print(f"{name + ', ' + row.what:32} {times} {ratios} {'equal' if equal else 'DIFFERENT'}", flush=True)


if __name__ == "__main__":
    main()
