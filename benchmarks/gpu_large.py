"""Inputs as large as they come: ``python -m benchmarks.gpu_large [PART ...] [--device cpu] [--out FILE]``.

Surfaces of 10, 32 and 98 million triangles, clouds of 100 and 400 million points, and bands up to the largest grid:
seconds, and the memory that they take. On a GPU the answers of the middle surface are compared with those of the CPU.
What is refused is printed with its message. Absolute times are meaningful only with the name of the GPU.
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks import inputs
from geokit.core.memory.available_memory import available

# Cells along each side of a terrain that is 20 wide; two triangles each.
SIDES = {"10 M": 2236, "32 M": 4000, "98 M": 7000}
COMPARED = "32 M"
AROUND = (3000, 3000)  # cells of a torus for bands, two triangles each
VOXELS = (1000, 2000, 5000, 10_000)  # across it
WIDTH = 20.0
ASKED = 10_000_000
COMPARED_POINTS = 400_000


class Report:
    """Rows of a table, printed as they are found."""

    def __init__(self, device: Any) -> None:
        self.lines = [
            f"{device.name if device.is_cuda else 'cpu'}",
            "",
            "| what | seconds | memory |",
            "|---|---:|---:|",
        ]
        self._device = device
        print("\n".join(self.lines), flush=True)

    def note(self, what: str, seconds: float | str = "", memory: float | str = "") -> None:
        cells = [f"{value:.3g}" if isinstance(value, float) else value for value in (seconds, memory)]
        self.lines.append(f"| {what} | {cells[0]} | {cells[1]} |")
        print(self.lines[-1], flush=True)

    def timed(self, what: str, ask: Callable[..., Any], *given: Any, repeat: int = 0, **options: Any) -> Any:
        """Note the least time of a call, of ``repeat`` after the first; a refusal is noted with its words."""
        gc.collect()
        before = self._free()
        best, found = float("inf"), None
        try:
            for _ in range(repeat + 1):
                found = None
                wp.synchronize()
                start = time.perf_counter()
                found = ask(*given, **options)
                wp.synchronize()
                best = min(best, time.perf_counter() - start)
        except gk.GeokitError as error:
            self.note(f"{what}: refused: {type(error).__name__}: {error}")
            return None
        self.note(what, best, f"{(before - self._free()) / 2**30:.1f} GiB" if self._device.is_cuda else "")
        return found

    def _free(self) -> int:
        return available(self._device) if self._device.is_cuda else 0


def terrain(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of hills of several sizes over a square."""
    axis = np.linspace(0.0, WIDTH, cells + 1)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    z = (
        np.sin(1.3 * x) * np.cos(0.9 * y)
        + 0.1 * np.sin(11.0 * x + 3.0 * y)
        + 0.003 * np.cos(170.0 * x) * np.sin(150 * y)
    )
    at = (np.arange(cells, dtype=np.int32)[:, None] * np.int32(cells + 1) + np.arange(cells, dtype=np.int32)).ravel()
    faces = np.empty((2 * cells * cells, 3), np.int32)
    faces[0::2] = np.stack([at, at + (cells + 1), at + (cells + 2)], axis=1)
    faces[1::2] = np.stack([at, at + (cells + 2), at + 1], axis=1)
    return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), faces


def surfaces(report: Report, device: Any) -> None:
    points = np.random.default_rng(0).uniform([0, 0, -1.5], [WIDTH, WIDTH, 1.5], (ASKED, 3))
    asked = wp.array(points, dtype=wp.vec3d, device=device)
    downwards = wp.array(np.tile([0.1, 0.05, -1.0], (ASKED, 1)), dtype=wp.vec3d, device=device)
    for name, cells in SIDES.items():
        mesh = gk.mesh.TriangleMesh(*terrain(cells))
        surface = report.timed(f"Surface of {mesh.face_count:,} triangles", gk.mesh.Surface, mesh, device=device)
        if surface is None:
            continue
        report.timed(f"{name}: {ASKED:,} closest points", surface.closest_point, asked, repeat=3)
        report.timed(f"{name}: {ASKED:,} first hits", surface.raycast, asked, downwards, repeat=3)
        if name == COMPARED and device.is_cuda:
            compare(report, mesh, surface, points[:COMPARED_POINTS])
        del surface, mesh


def bands(report: Report, device: Any) -> None:
    mesh = inputs.bumpy_torus(*AROUND)
    surface = gk.mesh.Surface(mesh, device=device)
    width = float((mesh.bounds[1] - mesh.bounds[0]).max())
    report.timed("signs prepared", surface.signed_distance, mesh.vertices[:1], sign="pseudonormal")
    for voxels in VOXELS:
        what = f"band of {mesh.face_count:,} triangles at 1/{voxels}"
        band = report.timed(what, gk.volume.from_mesh, surface, width / voxels, sign="pseudonormal")
        if band is not None:
            report.note(f"... {band.info.active_voxel_count:,} voxels", "", f"{band.info.byte_count / 2**30:.2f} GiB")


def compare(report: Report, mesh: Any, surface: Any, points: np.ndarray) -> None:
    """Answers of the GPU beside the CPU's, near the surface too."""
    on_cpu = report.timed("the same on the CPU", gk.mesh.Surface, mesh, device="cpu")
    near = surface.closest_point(points[: len(points) // 2]).points
    near = near + np.random.default_rng(1).normal(size=near.shape) * 10.0 ** np.random.default_rng(2).uniform(
        -9, -2, (len(near), 1)
    )
    points = np.concatenate([points, near])
    one, other = surface.closest_point(points), on_cpu.closest_point(points)
    report.note(
        f"closest points: triangles that differ, of {len(points):,}", str((one.triangle_id != other.triangle_id).sum())
    )
    report.note("... distances that differ", str((one.distance != other.distance).sum()))
    first = time.perf_counter()
    one = surface.signed_distance(points, sign="pseudonormal")
    report.note("first signed distance on the GPU", time.perf_counter() - first)
    other = on_cpu.signed_distance(points, sign="pseudonormal")
    report.note("signed distances by pseudonormals that differ", str((one.distance != other.distance).sum()))
    directions = np.random.default_rng(3).normal(size=points.shape)
    one, other = surface.raycast(points, directions), on_cpu.raycast(points, directions)
    report.note("first hits: triangles that differ", str((one.triangle_id != other.triangle_id).sum()))
    hit = one.triangle_id >= 0
    report.note("... largest difference of t / width", float(np.abs(one.t[hit] - other.t[hit]).max() / WIDTH))
    boxes = points[:20_000], points[:20_000] + 0.01
    one, other = surface.overlapping(*boxes), on_cpu.overlapping(*boxes)
    same = all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
    report.note("overlaps of 20,000 boxes are the same", str(same))
    one, other = surface.winding_number(points), on_cpu.winding_number(points)
    distance = on_cpu.closest_point(points).distance
    apart = np.abs(one - other)
    for reach in (0.0, 1e-8, 1e-7, 1e-6, 1e-5):
        far = distance >= reach * WIDTH
        report.note(f"winding numbers: largest difference from {reach:g} widths away on", float(apart[far].max()))


def clouds(report: Report, device: Any) -> None:
    for count in (100_000_000, 400_000_000) if device.is_cuda else (10_000_000, 100_000_000):
        name = f"{count // 1_000_000} M points"
        side = (count / 30.0 * 4.18879) ** (1.0 / 3.0)  # 30 within a distance of 1
        points: Any = wp.empty(count, dtype=wp.vec3f, device=device)
        wp.launch(scattered_kernel, count, [float(side)], [points], device=device)
        grid = report.timed(f"{name}: grid", gk.points.NeighborGrid, points, 1.0, device=device)
        if grid is None:
            continue
        report.timed(f"{name}: count", grid.count, repeat=2)
        report.timed(f"{name}: 8 nearest, with the tree", grid.knn, k=8)
        report.timed(f"{name}: 8 nearest", grid.knn, k=8)
        if count <= 100_000_000:
            report.timed(f"{name}: 32 nearest", grid.knn, k=32)
            report.timed(f"{name}: normals of 16", gk.points.normals, points, orientation="none", device=device)
        report.timed(f"{name}: all neighbors at once", grid.radius_search)
        del grid, points


@wp.kernel
def scattered_kernel(side: float, out_points: wp.array(dtype=wp.vec3f)):
    i = wp.tid()
    state = wp.rand_init(7, i)
    out_points[i] = side * wp.vec3f(wp.randf(state), wp.randf(state), wp.randf(state))


PARTS = {"surfaces": surfaces, "bands": bands, "clouds": clouds}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; by default all")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    device = wp.get_device(options.device)
    report = Report(device)
    for part in options.parts or PARTS:
        PARTS[part](report, device)
    if options.out:
        options.out.write_text("\n".join(report.lines) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
