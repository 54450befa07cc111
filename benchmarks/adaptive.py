"""Adaptive fields against uniform grids of the same tolerance: ``python -m benchmarks.adaptive [MESH ...]``.

The uniform grid has the largest voxels among those tried (a fifteenth of an octave apart, plus those of the adaptive
field's levels, on its lattice) whose trilinear interpolant keeps the tolerance on the same points on which the adaptive
field's error is measured: fresh points on faces, edges and corners and up to the tolerance from them. Its band is as
narrow as the interpolant allows. Both hold floats. A grid that does not fit in memory is counted, not made, and the
time is that of the finest grid that fits.

Timed points are uniform over the surface, up to the tolerance from it, in random order, NumPy float64.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import geokit as gk
from benchmarks import inputs
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher
from geokit.volume._adaptive import AdaptiveSDF, adaptive_from_mesh
from geokit.volume.adaptive.build import build_band_level
from geokit.volume.adaptive.cells import CORNERS, CellLattice, cells_of, keys_of
from geokit.volume.adaptive.check import check_points
from geokit.volume.adaptive.level_placement import float_grid_bytes
from geokit.volume.adaptive.level_sizes import band_lattice
from geokit.volume.band.tiles import near_tiles

SAMPLES = Path(__file__).resolve().parents[1] / "data" / "samples"
MESHES = {
    "bracket": lambda: gk.mesh.load(SAMPLES / "bracket.obj"),
    "bunny": inputs.bunny,
    "torus": lambda: gk.mesh.load(SAMPLES / "torus.ply"),
}
# Seed of points that adaptive_from_mesh does not draw.
FRESH = 4321
STEP = 2.0 ** (-1.0 / 15.0)
LARGEST_GRID = 1.2e9
RUNS = 9


class Uniform(NamedTuple):
    """The grid of one voxel size that keeps a tolerance."""

    voxels: CellLattice
    error: float
    byte_count: int


def errors_of(lattice: CellLattice, points: np.ndarray, exact: np.ndarray) -> float:
    """Largest error of the interpolant of exact float32 voxels of one size."""
    index = (points - lattice.origin) / lattice.size
    cell = np.floor(index).astype(np.int64)
    fraction = index - cell
    keys, rows = np.unique(keys_of((cell[:, None] + CORNERS).reshape(-1, 3)), return_inverse=True)
    values = lattice.distances(cells_of(keys))[0].astype(np.float32).astype(np.float64)[rows].reshape(-1, 8)
    for axis in range(3):
        half = values.shape[1] // 2
        values = values[:, :half] + (values[:, half:] - values[:, :half]) * fraction[:, axis, None]
    return float(np.abs(values[:, 0] - exact).max())


def uniform_of(lattice: CellLattice, field: AdaptiveSDF, points: np.ndarray, exact: np.ndarray) -> Uniform:
    tolerance, corner = lattice.within, lattice.surface.bounds[0]
    tried = []
    for number in range(120):
        size = 64.0 * tolerance * STEP**number
        # Index 0 is where the band begins, at a whole multiple of the voxel size, as in from_mesh.
        tried.append((size, (np.floor((corner - tolerance) / size) - 3.0) * size))
    tried += [(size, corner - size * (np.ceil(tolerance / size) + 3.0)) for size in field.voxel_sizes]
    few = np.random.default_rng(1).permutation(len(points))[:4000]
    for size, origin in sorted(tried, key=lambda pair: -pair[0]):
        voxels = CellLattice(lattice.surface, lattice.sign, origin, size, tolerance)
        if errors_of(voxels, points[few], exact[few]) <= tolerance:
            error = errors_of(voxels, points, exact)
            if error <= tolerance:
                return Uniform(voxels, error, float_grid_bytes(near_tiles_of(voxels)))
    raise RuntimeError("no voxel size keeps the tolerance")


def near_tiles_of(lattice: CellLattice) -> np.ndarray:
    tiles = near_tiles(band_lattice(lattice))
    return tiles.coordinates.numpy()[: len(tiles.keys)].astype(np.int64)


def time_ratio(field: AdaptiveSDF, volume: gk.volume.SparseVolume, points: np.ndarray) -> tuple[float, float, float]:
    """Median of paired ratios, and both rates [M/s]."""
    calls = (lambda: field.sample(points, device="cpu"), lambda: volume.sample(points, order=1, device="cpu"))
    for call in calls:
        call()
    times = np.empty((RUNS, 2))
    for run in range(RUNS):
        for which, call in enumerate(calls):
            begin = time.perf_counter()
            call()
            times[run, which] = time.perf_counter() - begin
    rates = len(points) / np.median(times, axis=0) / 1e6
    return float(np.median(times[:, 0] / times[:, 1])), float(rates[0]), float(rates[1])


def report(name: str, share: float, count: int) -> str:
    mesh = MESHES[name]()
    longest = float((mesh.bounds[1] - mesh.bounds[0]).max())
    tolerance = share * longest
    surface = gk.mesh.Surface(mesh, device="cpu")
    begin = time.perf_counter()
    field = adaptive_from_mesh(surface, tolerance)
    seconds = time.perf_counter() - begin
    lattice = CellLattice(surface, surface._method("auto"), mesh.bounds[0], tolerance, tolerance)
    points, exact = check_points(lattice, FRESH)
    error = float(np.abs(field.sample(points, device="cpu") - exact).max())
    uniform = uniform_of(lattice, field, points, exact)
    fits = uniform.byte_count <= LARGEST_GRID
    shrunk = 1.0 if fits else (uniform.byte_count / LARGEST_GRID) ** 0.5
    volume = build_band_level(replace(uniform.voxels, size=uniform.voxels.size * shrunk), name)
    byte_count = volume.info.byte_count if fits else uniform.byte_count
    on = gk.mesh.sample_surface(mesh, count, seed=7).points
    moved = np.random.default_rng(8).uniform(-0.577, 0.577, on.shape) * tolerance
    ratio, rate, uniform_rate = time_ratio(field, volume, np.random.default_rng(9).permutation(on + moved))
    cells = [
        *(name, f"{share:g}", field.level_count, f"{field.voxel_sizes[0] / tolerance:.2f}", f"{error / tolerance:.3f}"),
        *(
            f"{field.byte_count / 1e6:.2f}",
            f"{uniform.voxels.size / tolerance:.2f}",
            f"{uniform.error / tolerance:.3f}",
        ),
        *(f"{byte_count / 1e6:.2f}{'' if fits else ' (counted)'}", f"**{byte_count / field.byte_count:.2f}**"),
        *(f"{rate:.1f}", f"{uniform_rate:.1f}", f"**{ratio:.2f}**", f"{seconds:.1f}"),
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", default=list(MESHES), help=", ".join(MESHES))
    parser.add_argument("--tolerances", type=float, nargs="+", default=(1e-3, 1e-4), help="shares of the longest edge")
    parser.add_argument("--points", type=int, default=2_000_000, help="points of a call")
    parser.add_argument("--out", type=Path, help="also write the report there")
    arguments = parser.parse_args()
    lines = [
        f"{processor_name()}, {launcher.thread_count()} threads; {arguments.points:,} points a call; sizes and errors "
        "in tolerances, MB of float grids, M samples a second, medians of pairs.\n",
        "| mesh | tolerance | levels | largest voxel | error | MB | uniform voxel | its error | its MB | memory ratio "
        "| M/s | its M/s | time ratio | made in [s] |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for line in lines:
        print(line, flush=True)
    for name in arguments.meshes:
        for share in arguments.tolerances:
            lines.append(report(name, share, arguments.points))
            print(lines[-1], flush=True)
    if arguments.out:
        arguments.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
