"""Operations on volumes that run as kernels, on a GPU against the CPU: equal answers, and times.

Resampling and the differential operators; run with ``python -m benchmarks.gpu_volumes_operations``. Needs a GPU and the
OpenVDB extension for the results' grids; without the extension only the kernels are compared.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from benchmarks.catalog.float_grids import build_float_grid
from geokit.core import launcher
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.sampling import differential_kernels as kernels
from geokit.volume.tree.leaves import LEAF_VOXELS, leaves_of

REPEATS = 5


@wp.kernel
def raw_gradient_kernel(
    volume: wp.uint64,
    origins: wp.array(dtype=wp.vec3i),
    inverse: wp.float32,
    out_gradient: wp.array(dtype=wp.vec3f),
):
    """Central differences with warp's own look-ups, as a user would write them."""
    n = wp.tid()
    o = origins[n >> 9]
    i = o[0] + ((n >> 6) & 7)
    j = o[1] + ((n >> 3) & 7)
    k = o[2] + (n & 7)
    half = 0.5 * inverse
    out_gradient[n] = wp.vec3f(
        (wp.volume_lookup_f(volume, i + 1, j, k) - wp.volume_lookup_f(volume, i - 1, j, k)) * half,
        (wp.volume_lookup_f(volume, i, j + 1, k) - wp.volume_lookup_f(volume, i, j - 1, k)) * half,
        (wp.volume_lookup_f(volume, i, j, k + 1) - wp.volume_lookup_f(volume, i, j, k - 1)) * half,
    )


def sphere_volume(radius: float, half_width: float = 3.0) -> SparseVolume:
    """A sphere's level set of unit voxels."""
    reach = int((radius + half_width) // 8) + 1
    steps = 8 * np.arange(-reach, reach)
    origins = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    # The diagonal of a leaf is below 12.2 voxels: other leaves hold no voxel of the band.
    middle = np.linalg.norm(origins + 3.5, axis=1)
    origins = origins[np.abs(middle - radius) < 6.1 + half_width].astype(np.int32)
    offsets = np.stack(np.unravel_index(np.arange(LEAF_VOXELS), (8, 8, 8)), axis=1)
    distance = np.linalg.norm(origins[:, None, :] + offsets, axis=2) - radius
    buffer = build_float_grid(
        origins,
        np.clip(distance, -half_width, half_width).astype(np.float32),
        np.abs(distance) < half_width,
        background=half_width,
        transform=np.eye(4),
        name="sphere",
        grid_class="level set",
        signed_fill=True,
    )
    return SparseVolume(buffer, info_of(buffer))


def timed(run: Callable[[], Any], device: Any) -> float:
    """Least time of some runs [ms], after one untimed run."""
    run()
    best = np.inf
    for _ in range(REPEATS):
        wp.synchronize_device(device)
        begin = time.perf_counter()
        run()
        wp.synchronize_device(device)
        best = min(best, time.perf_counter() - begin)
    return best * 1e3


def launch_operator(volume: SparseVolume, kernel: Any, dtype: Any, alias: str) -> tuple[np.ndarray, float]:
    """Result and time of a differential kernel on all leaves."""
    device = launcher.resolve_device(alias)
    leaves = leaves_of(volume)
    count = len(leaves.origins) * LEAF_VOXELS
    out = wp.zeros(count, dtype=dtype, device=device)
    inputs = [
        wp.uint64(volume.id(device)),
        wp.array(leaves.origins, dtype=wp.vec3i, device=device),
        wp.array(leaves.masks, dtype=wp.uint8, device=device),
        wp.mat33d(*np.eye(3).ravel().tolist()),
    ]
    milliseconds = timed(lambda: launcher.launch(kernel, count, inputs, [out], device), device)
    return out.numpy(), milliseconds


def check_differential(volume: SparseVolume, alias: str) -> list[tuple[str, str, float, float]]:
    """Name, difference, CPU and GPU time of each operator."""
    rows = []
    for name, kernel, dtype in (
        ("gradient", kernels.gradient_kernel, wp.vec3d),
        ("laplacian", kernels.laplacian_kernel, wp.float64),
    ):
        first, cpu = launch_operator(volume, kernel, dtype, "cpu")
        second, gpu = launch_operator(volume, kernel, dtype, alias)
        rows.append((name, f"{np.abs(first - second).max():.1e}", cpu, gpu))
    return rows


def check_raw_gradient(volume: SparseVolume, alias: str) -> float:
    """Time of the gradient with warp's own look-ups in float32 [ms]."""
    device = launcher.resolve_device(alias)
    leaves = leaves_of(volume)
    count = len(leaves.origins) * LEAF_VOXELS
    out = wp.zeros(count, dtype=wp.vec3f, device=device)
    inputs = [wp.uint64(volume.id(device)), wp.array(leaves.origins, dtype=wp.vec3i, device=device), wp.float32(1.0)]
    return timed(lambda: wp.launch(raw_gradient_kernel, dim=count, inputs=inputs, outputs=[out], device=device), device)


def check_resample(volume: SparseVolume, alias: str) -> tuple[str, str, float, float] | None:
    """The whole of resample() on both devices; None without the OpenVDB extension."""
    from geokit import native
    from geokit.volume._resample import resample

    if not native.available():
        return None
    buffers, times = [], []
    for name in ("cpu", alias):
        device = launcher.resolve_device(name)
        result: list[SparseVolume] = []

        def run(result=result, name=name) -> None:
            result.append(resample(volume, voxel_size=0.7, device=name))

        times.append(timed(run, device))
        buffers.append(result[-1].nanovdb)
    return (
        "resample to 0.7 voxel, whole call",
        str(int((buffers[0] != buffers[1]).sum())) + " bytes",
        times[0],
        times[1],
    )


def main(out: Callable[[str], Any] = print) -> None:
    """Print a table; a line instead where there is no GPU."""
    gpus = launcher.cuda_devices()
    if not gpus:
        out("no CUDA device")
        return
    volume = sphere_volume(200.0)
    out(f"{volume.info.active_voxel_count} active voxels on {wp.get_device(gpus[0]).name}\n")
    out("| operation | largest difference to the CPU | CPU [ms] | GPU [ms] |\n| --- | --- | --- | --- |")
    for row in [*check_differential(volume, gpus[0]), check_resample(volume, gpus[0])]:
        if row is not None:
            out(f"| {row[0]} | {row[1]} | {row[2]:.2f} | {row[3]:.3f} |")
    out(f"\nGradient with warp's own look-ups, float32: {check_raw_gradient(volume, gpus[0]):.3f} ms")


if __name__ == "__main__":
    main()
