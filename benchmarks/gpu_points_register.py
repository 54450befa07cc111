"""Downsampling, registration and comparison of clouds on a GPU: the CPU's answers, and times against plain kernels.

Run with ``python -m benchmarks.gpu_points_register``. Needs a GPU; numpy, warp and geokit, nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks.gpu_timing import wall_median
from geokit.points._compare import chamfer, hausdorff
from geokit.points._downsample import downsample
from geokit.points._register import register

# Squares are rounded one by one, as in geokit, so that ties are the same here.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

REPEATS = 5


@wp.kernel
def raw_farthest_kernel(
    points: wp.array(dtype=wp.vec3d),
    taken: wp.array(dtype=wp.int32),
    step: int,
    squared: wp.array(dtype=wp.float64),
    out_best: wp.array(dtype=wp.float64),
):
    """Squared distances after one more point, and their largest: the usual loop, without the index."""
    i = wp.tid()
    d = points[i] - points[taken[step]]
    s = wp.min(squared[i], wp.dot(d, d))
    squared[i] = s
    wp.atomic_max(out_best, step, s)


@wp.kernel
def raw_pick_kernel(
    squared: wp.array(dtype=wp.float64),
    best: wp.array(dtype=wp.float64),
    step: int,
    out_taken: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    if squared[i] == best[step]:
        wp.atomic_min(out_taken, step + 1, i)


@wp.kernel
def raw_nearest_kernel(
    points: wp.array(dtype=wp.vec3d), others: wp.array(dtype=wp.vec3d), out_distance: wp.array(dtype=wp.float64)
):
    """Nearest distance by all pairs."""
    i = wp.tid()
    least = wp.float64(wp.inf)
    for j in range(others.shape[0]):
        d = points[i] - others[j]
        least = wp.min(least, wp.dot(d, d))
    out_distance[i] = wp.sqrt(least)


def raw_farthest(points: wp.array, count: int) -> np.ndarray:
    """Greedy farthest points with two launches a point, all points in each."""
    n = len(points)
    squared = wp.full(n, wp.inf, dtype=wp.float64)
    best = wp.full(count, -1.0, dtype=wp.float64)
    taken = wp.full(count + 1, np.iinfo(np.int32).max, dtype=wp.int32)
    taken[:1].zero_()
    for step in range(count):
        wp.launch(raw_farthest_kernel, n, [points, taken, step, squared, best])
        wp.launch(raw_pick_kernel, n, [squared, best, step, taken])
    return taken.numpy()[:count]


def ellipsoid(count: int) -> tuple[np.ndarray, np.ndarray]:
    points = np.random.default_rng(0).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    axes = np.array([1.0, 0.7, 0.45])
    normals = points / axes
    return points * axes, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def pose() -> np.ndarray:
    """Half a degree about each axis (Cayley's formula), and a shift."""
    s = np.array([[0.0, -0.01, 0.008], [0.01, 0.0, -0.006], [-0.008, 0.006, 0.0]])
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.solve(np.eye(3) - s, np.eye(3) + s)
    matrix[:3, 3] = [0.004, -0.003, 0.002]
    return matrix


def once(run: Callable[[], Any]) -> tuple[Any, float]:
    """A result and its seconds, after one untimed run."""
    run()
    start = time.perf_counter()
    found = run()
    return found, time.perf_counter() - start


def row(out: Callable[[str], None], what: str, same: str, host: float, device: float, raw: float | None) -> None:
    against = "" if raw is None else f"{1000 * raw:.2f} ms ({raw / device:.1f}x)"
    out(f"| {what} | {same} | {1000 * host:.1f} ms | {1000 * device:.2f} ms | {against} |")


def check_downsample(out: Callable[[str], None]) -> None:
    random = np.random.default_rng(1)
    kinds = {
        "uniform": random.random((1_000_000, 3)),
        "lattice": random.integers(0, 60, (300_000, 3)).astype(float) / 60.0,
        "clusters": random.random((50, 3))[random.integers(0, 50, 300_000)] + random.normal(size=(300_000, 3)) * 1e-3,
    }
    for name, points in kinds.items():
        given = wp.array(points, dtype=wp.vec3d, device="cuda:0")
        for choice in ({"voxel_size": 0.02}, {"voxel_size": 0.5}, {"count": 2000}, {"radius": 0.02}, {"radius": 0.2}):
            host, host_seconds = once(lambda p=points, c=choice: downsample(p, **c, device="cpu"))
            run = lambda p=given, c=choice: downsample(p, **c, device="cuda:0")  # noqa: E731
            found = run()
            equal = [np.array_equal(a.numpy(), b) for a, b in zip(found, host, strict=True)]
            raw = None
            if "count" in choice and name == "uniform":
                taken = raw_farthest(given, 2000)
                equal.append(np.array_equal(taken, host.indices))
                raw = wall_median(lambda p=given: raw_farthest(p, 2000), 1)
            method, value = next(iter(choice.items()))
            label = f"{name} {len(points)}, {method} {value}, {len(host.indices)} left"
            row(out, label, "equal bits" if all(equal) else f"DIFFERENT {equal}", host_seconds,
                wall_median(run, REPEATS), raw)  # fmt: skip


def check_compare(out: Callable[[str], None]) -> None:
    random = np.random.default_rng(2)
    a, b = random.random((100_000, 3)), random.random((100_000, 3))
    left, right = (wp.array(x, dtype=wp.vec3d, device="cuda:0") for x in (a, b))
    distance = wp.empty(len(a), dtype=wp.float64, device="cuda:0")

    def raw() -> None:
        for one, other in ((left, right), (right, left)):
            wp.launch(raw_nearest_kernel, len(one), [one, other, distance], device="cuda:0")

    raw_seconds = wall_median(raw, 1)
    for compare in (chamfer, hausdorff):
        host, host_seconds = once(lambda c=compare: c(a, b, device="cpu"))
        found = compare(left, right, device="cuda:0")
        same = "equal bits" if found == host else f"DIFFERENT {found} {host}"
        run = lambda c=compare: c(left, right, device="cuda:0")  # noqa: E731
        row(out, f"{compare.__name__} 100,000 x 100,000", same, host_seconds, wall_median(run, REPEATS), raw_seconds)


def check_register(out: Callable[[str], None]) -> None:
    points, normals = ellipsoid(500_000)
    matrix = pose()
    target = points @ matrix[:3, :3].T + matrix[:3, 3]
    target += np.random.default_rng(3).normal(size=target.shape) * 0.001
    planes = normals @ matrix[:3, :3].T
    for method in ("point_to_plane", "point_to_point"):
        options: dict[str, Any] = {"method": method, "max_distance": 0.1, "max_iterations": 10, "tolerance": 1e-300}

        def run(device: str, options: dict[str, Any] = options) -> Any:
            return register(points, target, target_normals=planes, **options, device=device)

        host, host_seconds = once(lambda run=run: run("cpu"))
        found = run("cuda:0")
        off = float(np.abs(found.transform - host.transform).max())
        seconds = wall_median(lambda run=run: run("cuda:0"), REPEATS)
        row(out, f"{method}, 500,000 points, 10 steps", f"{off:.1e} apart", host_seconds, seconds, None)


def check_targets(out: Callable[[str], None]) -> None:
    points, _ = ellipsoid(200_000)
    around, across = np.meshgrid(np.arange(256), np.arange(129), indexing="ij")
    a, b = 2.0 * np.pi * around / 256.0, np.pi * across / 128.0
    grid = np.stack([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)], axis=-1) * [1.0, 0.7, 0.45]
    corner = np.arange(256 * 129).reshape(256, 129)
    right = np.roll(corner, -1, axis=0)
    low, high = (corner[:, :-1], right[:, :-1]), (corner[:, 1:], right[:, 1:])
    faces = np.concatenate([np.stack([low[0], high[0], low[1]], -1), np.stack([low[1], high[0], high[1]], -1)]).reshape(
        -1, 3
    )
    mesh = gk.mesh.TriangleMesh(grid.reshape(-1, 3), faces)
    inverse = np.linalg.inv(pose())
    source = points @ inverse[:3, :3].T + inverse[:3, 3]
    sdf = gk.volume.from_mesh(mesh, 0.02, half_width=4.0, sign="winding", device="cpu")
    for name in ("surface", "level set"):
        targets = {
            device: gk.mesh.Surface(mesh, device=device) if name == "surface" else sdf for device in ("cpu", "cuda:0")
        }

        def run(device: str, targets: dict[str, Any] = targets) -> Any:
            return register(source, targets[device], max_iterations=10, tolerance=1e-300, device=device)

        host, host_seconds = once(lambda run=run: run("cpu"))
        off = float(np.abs(run("cuda:0").transform - host.transform).max())
        seconds = wall_median(lambda run=run: run("cuda:0"), REPEATS)
        row(out, f"{name}, 200,000 points, 10 steps", f"{off:.1e} apart", host_seconds, seconds, None)


def main(out: Callable[[str], None] = print) -> None:
    """Prints a table; a row that says DIFFERENT is a defect."""
    wp.init()
    out("| what | against the CPU | CPU | GPU | plain kernels on the GPU |\n|---|---|---|---|---|")
    check_downsample(out)
    check_compare(out)
    check_register(out)
    check_targets(out)


if __name__ == "__main__":
    main()
