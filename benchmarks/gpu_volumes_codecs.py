"""Volumes from points, dense arrays of them, and quantized grids on a GPU; part of benchmarks.gpu_volumes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from benchmarks.gpu_timing import wall_median
from geokit.core import launcher
from geokit.volume._dense import to_dense
from geokit.volume._from_points import from_points
from geokit.volume.retyped.quantize import quantize

RUNS = 5
POINTS = 200_000
SAMPLES = 5_000_000


@wp.kernel
def lookup_kernel(
    first: int, volume: wp.uint64, lower: wp.vec3i, count_y: int, count_z: int, out: wp.array(dtype=wp.float32)
):
    item = first + wp.tid()
    i = item // (count_y * count_z)
    j = (item // count_z) % count_y
    out[item] = wp.volume_lookup_f(volume, lower[0] + i, lower[1] + j, lower[2] + item % count_z)


def median(run: Callable[[], Any]) -> float:
    return wall_median(run, RUNS)


def shell(count: int) -> np.ndarray:
    points = np.random.default_rng(0).standard_normal((count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def check_points(out: Callable[[str], None], device: str) -> Any:
    points = shell(POINTS)
    volumes = [from_points(points, 0.01, voxel_size=0.005, device=d) for d in ("cpu", device)]
    same = np.array_equal(volumes[0].nanovdb, volumes[1].nanovdb)
    times = [median(lambda d=d: from_points(points, 0.01, voxel_size=0.005, device=d)) for d in ("cpu", device)]
    cells = " | ".join(f"{1e3 * t:.0f}" for t in times)
    out(f"| from_points, {POINTS:,} equal balls | {cells} | | bit for bit the same: {same} |")
    radii = np.random.default_rng(1).uniform(0.005, 0.02, POINTS)
    mixed = [from_points(points, radii, voxel_size=0.005, device=d).nanovdb for d in ("cpu", device)]
    times = [median(lambda d=d: from_points(points, radii, voxel_size=0.005, device=d)) for d in ("cpu", device)]
    cells = " | ".join(f"{1e3 * t:.0f}" for t in times)
    out(f"| from_points, balls of many sizes | {cells} | | bit for bit the same: {np.array_equal(*mixed)} |")
    return volumes[0]


def check_dense(out: Callable[[str], None], volume: Any, device: str) -> None:
    box = volume.info.index_bounds
    arrays = [to_dense(volume, device=d).values for d in ("cpu", device)]
    times = [median(lambda d=d: to_dense(volume, device=d)) for d in ("cpu", device)]
    size = [int(n) for n in box[1] - box[0] + 1]
    target = wp.get_device(device)
    raw = wp.empty(int(np.prod(size)), dtype=wp.float32, device=target)
    inputs = [wp.uint64(volume.id(device)), wp.vec3i(*(int(n) for n in box[0])), size[1], size[2]]

    def theirs() -> np.ndarray:
        launcher.launch(lookup_kernel, len(raw), inputs, [raw], target)
        return raw.numpy()

    same = np.array_equal(arrays[0], arrays[1]) and np.array_equal(theirs().reshape(size), arrays[1])
    cells = " | ".join(f"{1e3 * t:.0f}" for t in (*times, median(theirs)))
    out(f"| to_dense, {' x '.join(map(str, size))} | {cells} | bit for bit the same: {same} |")


def check_codecs(out: Callable[[str], None], volume: Any, device: str) -> None:
    voxel = float(volume.info.voxel_size[0])
    points = shell(SAMPLES) * (1.0 + voxel * np.random.default_rng(2).uniform(-1, 1, (SAMPLES, 1)))
    exact = volume.sample(points, device=device)
    for codec, tolerance in (("fp4", None), ("fp8", None), ("fp16", None), ("fpn", 1e-3 * voxel)):
        small = quantize(volume, codec, tolerance=tolerance)
        answers = [small.sample(points, device=d) for d in ("cpu", device)]
        resting = wp.array(points, dtype=wp.vec3d, device=device)
        times = [
            median(lambda s=small: s.sample(points, device="cpu")),
            median(lambda s=small, rows=resting: s.sample(rows, device=device)),
        ]
        apart, off = np.abs(answers[0] - answers[1]).max() / voxel, np.abs(answers[1] - exact).max() / voxel
        known = small.info.metadata["geokit:achieved_error"] / voxel
        cells = " | ".join(f"{1e3 * t:.1f}" for t in times)
        kept = "kept" if off <= known * (1.0 + 1e-9) + 1e-9 else "NOT kept"
        out(
            f"| sample {codec}, {SAMPLES:,} points | {cells} | | CPU and GPU differ by {apart:.1g} voxels; off by "
            f"{off:.2g}, the metadata says {known:.2g}: {kept} |"
        )


def main(out: Callable[[str], None]) -> None:
    device = "cuda:0"
    out(f"{wp.get_device(device).name}, medians of {RUNS} runs\n")
    out("| what | CPU ms | GPU ms | raw warp ms | answers |\n|---|---:|---:|---:|---|")
    volume = check_points(out, device)
    check_dense(out, volume, device)
    check_codecs(out, volume, device)


if __name__ == "__main__":
    main(print)
