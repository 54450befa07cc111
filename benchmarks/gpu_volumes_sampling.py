"""Trilinear samples on a GPU beside raw warp, and the same on the CPU; part of benchmarks.gpu_volumes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks.gpu_timing import device_median
from benchmarks.volume_sampling import level_set, raw_sample_kernel
from geokit.core import launcher

POINTS = 50_000_000
CHECKED = 1_000_000
RUNS = 7


@wp.kernel
def near_kernel(
    first: int, seed: int, corners: wp.array(dtype=wp.vec3), sigma: float, out_points: wp.array(dtype=wp.vec3)
):
    i = first + wp.tid()
    state = wp.rand_init(seed, i)
    face = wp.randi(state, 0, corners.shape[0] / 3)
    a = wp.randf(state)
    b = wp.randf(state)
    if a + b > 1.0:
        a = 1.0 - a
        b = 1.0 - b
    point = corners[3 * face] * (1.0 - a - b) + corners[3 * face + 1] * a + corners[3 * face + 2] * b
    out_points[i] = point + sigma * wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))


@wp.kernel
def widened_kernel(first: int, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3d)):
    i = first + wp.tid()
    out[i] = wp.vec3d(points[i])


def median(run: Callable[[], Any]) -> float:
    return device_median(run, RUNS)


def copy_rate(device: wp.Device) -> float:
    """Bytes a second that a copy on the device reads and writes."""
    source = wp.zeros(1 << 28, dtype=wp.float32, device=device)
    target = wp.empty_like(source)
    return 2 * source.size * 4 / median(lambda: wp.copy(target, source))


def main(out: Callable[[str], None]) -> None:
    device = wp.get_device("cuda:0")
    copied = copy_rate(device)
    out(f"{device.name}; {POINTS:,} points in random order; a copy moves {copied / 1e12:.2f} TB/s\n")
    out("| grid | points | what | geokit G/s | warp G/s | ratio | share of copy bandwidth | CPU and GPU differ |")
    out("|---|---|---|---:|---:|---:|---:|---:|")
    for resolution in (256, 512, 1024):
        volume, mesh = level_set(resolution)
        corners = wp.array(mesh.vertices[mesh.faces.ravel()], dtype=wp.vec3, device=device)
        sigma = float(volume.info.voxel_size[0])
        points = wp.empty(POINTS, dtype=wp.vec3, device=device)
        launcher.launch(near_kernel, POINTS, [7, corners, sigma], [points], device)
        raw_out = wp.empty(POINTS, dtype=wp.float32, device=device)
        handle = wp.uint64(volume.id(device))

        def raw(points=points, raw_out=raw_out, handle=handle):
            launcher.launch(raw_sample_kernel, POINTS, [handle, points], [raw_out], device)

        raw_time = median(raw)
        wide = wp.empty(POINTS, dtype=wp.vec3d, device=device)
        launcher.launch(widened_kernel, POINTS, [points], [wide], device)
        few = points.numpy()[:CHECKED].astype(np.float64)
        for kind, rows, bytes_each in (("float32", points, 16), ("float64", wide, 32)):
            for what, function in (("value", gk.volume.sample), ("gradient", gk.volume.gradient)):
                time = median(lambda function=function, volume=volume, rows=rows: function(volume, rows, device=device))
                on_cpu = function(volume, few, device="cpu")
                on_gpu = function(volume, few, device=device)
                moved = bytes_each * (1.0 if what == "value" else 1.5) * POINTS / time / copied
                ratio = f"{raw_time / time:.2f}" if what == "value" else ""
                raw_rate = f"{POINTS / raw_time / 1e9:.1f}" if what == "value" else ""
                out(
                    f"| {resolution}^3 | {kind} | {what} | {POINTS / time / 1e9:.1f} | {raw_rate} | {ratio} | "
                    f"{moved:.0%} | {np.abs(on_cpu - on_gpu).max():.1e} |"
                )


if __name__ == "__main__":
    main(print)
