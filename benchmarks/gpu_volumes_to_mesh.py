"""Isosurfaces on a GPU: equality with the CPU, and times; part of benchmarks.gpu_volumes.

Needs no OpenVDB: the level sets are rippled spheres, made here. The peer is warp's marching cubes, which needs a dense
float32 field; its time does not include making that field. "There" means a mesh that stays on the GPU, synchronized.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.gpu_timing import mesh_medians, wall_median
from geokit.core import launcher
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of

METHODS = ("surface_nets", "marching_cubes", "dual_contouring")
HALF_WIDTH = 3.0
RUNS = 7


def rippled_sphere(resolution: int) -> SparseVolume:
    """Approximate level set of a rippled sphere, ``resolution`` voxels across, in voxel units."""
    radius = resolution / 2 - 4.0
    count = resolution // 8
    tiles = np.stack(np.meshgrid(*3 * [np.arange(-count // 2, count // 2, dtype=np.int32)], indexing="ij"), axis=-1)
    tiles = tiles.reshape(-1, 3)
    # A tile reaches 7 voxels from its center, the ripple two, the band three.
    near = np.abs(np.linalg.norm(8 * tiles + 3.5, axis=1) - radius) < 12.0
    origins = 8 * tiles[near]
    voxels = np.array(list(np.ndindex(8, 8, 8)), np.float32)
    values = np.empty((len(origins), 512), np.float32)
    for first in range(0, len(origins), 2000):
        p = origins[first : first + 2000, None].astype(np.float32) + voxels
        ripple = np.sin(p[..., 0] * 0.21) * np.sin(p[..., 1] * 0.17) * np.sin(p[..., 2] * 0.19)
        values[first : first + 2000] = np.linalg.norm(p, axis=-1) - radius + 2.0 * ripple
    buffer = build_float_grid(
        origins,
        np.clip(values, -HALF_WIDTH, HALF_WIDTH),
        np.abs(values) < HALF_WIDTH,
        background=HALF_WIDTH,
        transform=np.diag([0.01, 0.01, 0.01, 1.0]),
        name="rippled sphere",
        grid_class="level set",
        signed_fill=True,
    )
    return SparseVolume(buffer, info_of(buffer))


def median(run: Callable[[], Any]) -> float:
    return wall_median(run, RUNS, warm=2)


def check_same(volume: SparseVolume, device: Any) -> list[str]:
    """A row for each method with the differences between the CPU's mesh and the GPU's."""
    rows = []
    for method in METHODS:
        cpu, gpu = (gk.mesh.from_volume(volume, method=method, device=d) for d in ("cpu", device))
        if len(cpu.vertices) != len(gpu.vertices) or len(cpu.faces) != len(gpu.faces):
            rows.append(f"{method}: {len(cpu.vertices)} vertices for {len(gpu.vertices)}: NOT the same")
            continue
        off = float(np.abs(cpu.vertices - gpu.vertices).max() / volume.info.voxel_size[0])
        faces = int((cpu.faces != gpu.faces).any(axis=1).sum())
        report = gk.mesh.audit(gpu)
        rows.append(
            f"{method}: {len(cpu.faces):,} triangles, vertices differ by {off:.1e} voxel, other triangles {faces}, "
            f"{report.boundary_edge_count} boundary and {report.non_manifold_edge_count} non-manifold edges"
        )
    return rows


def check_noise(device: Any) -> list[str]:
    """The rows of :func:`check_same` for a field without any smoothness: all cases occur, tiles included.

    A tenth of the voxels are inactive, where the surface has boundary edges.
    """
    rng = np.random.default_rng(11)
    blocks = np.array(list(np.ndindex(4, 4, 4)), np.int32)
    blocks = 8 * blocks[rng.random(len(blocks)) < 0.7] - 16
    values = rng.normal(size=(len(blocks), 512)).astype(np.float32)
    buffer = build_float_grid(
        blocks,
        values,
        rng.random(values.shape) < 0.9,
        background=-1.0,
        transform=np.eye(4),
        name="noise",
        grid_class="unknown",
        signed_fill=False,
    )
    return check_same(SparseVolume(buffer, info_of(buffer)), device)


def gpu_stages(volume: SparseVolume, method: str, device: Any) -> str:
    """Share of the time by kernel, each synchronized; the rest is Python, scans, memory and the download."""
    spent: dict[str, float] = {}
    plain = launcher.launch

    def timed(kernel: Any, *arguments: Any, **options: Any) -> None:
        wp.synchronize_device(device)
        start = time.perf_counter()
        plain(kernel, *arguments, **options)
        wp.synchronize_device(device)
        spent[kernel.key] = spent.get(kernel.key, 0.0) + time.perf_counter() - start

    launcher.launch = timed
    try:
        start = time.perf_counter()
        gk.mesh.from_volume(volume, method=method, device=device)
        whole = time.perf_counter() - start
    finally:
        launcher.launch = plain
    spent["elsewhere"] = whole - sum(spent.values())
    largest = sorted(spent.items(), key=lambda item: -item[1])[:8]
    return f"{whole * 1e3:.1f} ms: " + ", ".join(f"{name} {part / whole:.0%}" for name, part in largest)


def dense_cubes(volume: SparseVolume, resolution: int, device: Any) -> float:
    """Seconds of warp's marching cubes on the dense field; its mesh stays on the device, as float32."""
    n = resolution
    places = np.arange(-n // 2, n // 2)
    field = np.empty((n, n, n), np.float32)
    for row, x in enumerate(places):
        yz = np.stack(np.meshgrid([x], places, places, indexing="ij"), axis=-1).reshape(-1, 3)
        field[row] = volume.sample(yz * 0.01, order=0, device=device).reshape(n, n)
    values = wp.array(field, dtype=wp.float32, device=device)
    from warp.geometry import IsoSurfaceMarchingCubes

    return median(lambda: IsoSurfaceMarchingCubes.extract(values, 0.0))


def main(out: Callable[[str], None]) -> None:
    device = wp.get_device("cuda:0")
    out(f"{device.name}; {launcher.thread_count()} CPU threads\n")
    for row in check_noise(device):
        out(f"noise, {row}")
    out("\n| field | method | triangles | GPU, there ms | in NumPy ms | CPU ms | CPU / in NumPy | warp's dense ms |")
    out("|---|---|---:|---:|---:|---:|---:|---:|")
    notes = []
    for resolution in (256, 512):
        volume = rippled_sphere(resolution)
        notes += [f"{resolution}^3, {row}" for row in check_same(volume, device)]
        raw = dense_cubes(volume, resolution, device)
        for method in METHODS:
            times = mesh_medians(lambda d, m=method: gk.mesh.from_volume(volume, method=m, device=d), device, RUNS)  # noqa: B023
            faces = gk.mesh.from_volume(volume, method=method, device=device).face_count
            there, in_numpy, on_cpu = (1e3 * seconds for seconds in times)
            out(
                f"| {resolution}^3 | {method} | {faces:,} | {there:.2f} | {in_numpy:.2f} | {on_cpu:.1f} | "
                f"{on_cpu / in_numpy:.1f} | {raw * 1e3:.2f} |"
            )
            notes.append(f"{resolution}^3, {method}, {gpu_stages(volume, method, device)}")
    out("")
    for note in notes:
        out(note)


if __name__ == "__main__":
    main(print)
