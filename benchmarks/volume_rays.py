"""Rays through a level set beside NanoVDB's ZeroCrossing: ``python -m benchmarks.volume_rays [--out FILE]``.

Both walk the same NanoVDB buffer, that of the bunny of 195,200 triangles. ZeroCrossing (nanovdb/util/HDDA.h) is built
here with the compiler's best flags; it gets float32 rays, tells t to about a voxel and no normal. geokit gets float64
rays and gives t, points and normals of the interpolant's crossing; the search for the blocks that hold crossings, once
for each isovalue, is timed apart. Before anything is timed, geokit's hits are compared with the first change of sign
among samples every sixteenth of a voxel.
"""

from __future__ import annotations

import argparse
import ctypes
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from benchmarks import inputs
from benchmarks.compiled import compiled
from benchmarks.measure import Report, Row, Table, in_process, paired
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher
from geokit.volume._integrate import integrate
from geokit.volume._raycast import raycast
from geokit.volume.rays import crossing_blocks

TRIANGLES = 195_200
RESOLUTIONS = (128, 256, 512)
RAYS = 400_000
# Rays compared with samples, and the number of samples in a voxel.
CHECKED, FINE = 1000, 16
LEAST_RATIO = 1.2


def level_set(resolution: int) -> Any:
    mesh = inputs.bunny_of(TRIANGLES)
    size = float((mesh.bounds[1] - mesh.bounds[0]).max())
    return gk.volume.from_mesh(mesh, size / resolution, device="cpu")


def random_rays(volume: Any, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from all around through points of the band's bounding box, representable in float32."""
    rng = np.random.default_rng(seed)
    lower, upper = volume.info.world_bounds
    away = rng.normal(size=(count, 3))
    size = np.linalg.norm(upper - lower)
    origins = (lower + upper) / 2 + size * away / np.linalg.norm(away, axis=1, keepdims=True)
    return _prepared(origins, rng.uniform(lower, upper, (count, 3)) - origins)


def camera_rays(volume: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays of a square picture, row by row."""
    lower, upper = volume.info.world_bounds
    side = round(count**0.5)
    x, y = (np.linspace(lower[a], upper[a], side) for a in (0, 1))
    grid = np.stack(np.meshgrid(x, y, indexing="xy"), axis=-1).reshape(-1, 2)
    middle = (lower + upper) / 2
    eye = middle + np.array([0.0, 0.0, 1.5 * np.linalg.norm(upper - lower)])
    targets = np.concatenate([grid, np.full((len(grid), 1), middle[2])], axis=1)
    return _prepared(np.tile(eye, (len(grid), 1)), targets - eye)


def _prepared(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return inputs.in_float32(origins), inputs.in_float32(unit)


KINDS: dict[str, Callable[[Any, int], tuple[np.ndarray, np.ndarray]]] = {"random": random_rays, "camera": camera_rays}


def zero_crossing(volume: Any, origins: np.ndarray, directions: np.ndarray) -> Callable[[], np.ndarray]:
    """The peer, built and ready; calls return t, inf for misses."""
    peer = compiled("zero_crossing")
    starts, towards = (np.ascontiguousarray(rows, np.float32) for rows in (origins, directions))
    out = np.empty(len(starts), np.float32)
    arrays = (volume.nanovdb, starts, towards, out)
    count, threads = ctypes.c_long(len(starts)), ctypes.c_int(launcher.thread_count())

    def run() -> np.ndarray:
        buffer, start, toward, result = (ctypes.c_void_p(array.ctypes.data) for array in arrays)
        peer.zero_crossing(buffer, start, toward, count, threads, result)
        return out

    return run


def passed_over(volume: Any, origins: np.ndarray, directions: np.ndarray, t: np.ndarray) -> int:
    """Number of the first CHECKED rays whose samples change sign before t by more than a sample's distance."""
    voxel = float(volume.info.voxel_size[0])
    lower, upper = volume.info.world_bounds
    size = float(np.linalg.norm(upper - lower))
    steps = np.arange(int(2 * size / voxel * FINE)) * voxel / FINE + 0.25 * size
    missed = 0
    for o, d, found in zip(origins[:CHECKED], directions[:CHECKED], t[:CHECKED], strict=True):
        along = steps[steps < min(found - voxel / FINE, steps[-1] + 1.0)]
        value = volume.sample(o + along[:, None] * d, device="cpu")
        missed += bool((value <= 0.0).any())
    return missed


def rays(report: Report, resolution: int, kind: str) -> None:
    volume = level_set(resolution)
    origins, directions = KINDS[kind](volume, RAYS)
    voxel = float(volume.info.voxel_size[0])
    hits = raycast(volume, origins, directions, device="cpu")
    found = np.isfinite(hits.t)
    value = np.abs(volume.sample(hits.points[found], device="cpu")).max() / voxel
    missed = passed_over(volume, origins, directions, hits.t)
    report.line(
        f"{resolution}^3, {kind}: {found.mean():.0%} hit; values at hits {value:.1e} voxel at most; "
        f"{missed} of {CHECKED} rays changed sign before"
    )
    name = f"level-set rays {resolution}^3, {kind}"
    if missed or value > 1e-9:
        report.row(Row(name, note="crossings are missed: not timed"))
        return
    peer = zero_crossing(volume, origins, directions)
    theirs = peer().astype(np.float64)
    both = found & np.isfinite(theirs)
    apart = np.abs(theirs[both] - hits.t[both]) / voxel
    mine, other = paired(lambda: raycast(volume, origins, directions, device="cpu"), peer)
    shown = [f"{len(origins) / seconds / 1e6:.3f}" for seconds in (mine, other)]
    note = (
        f"apart by {np.median(apart):.1f} voxel in the median, 1% by more than {np.quantile(apart, 0.99):.1f}; "
        f"hits that only geokit has {int((found & ~np.isfinite(theirs)).sum())}, only the peer "
        f"{int((~found & np.isfinite(theirs)).sum())}"
    )
    met = "met" if other / mine >= LEAST_RATIO else "NOT met"
    report.row(Row(name, shown[0], "ZeroCrossing", shown[1], other / mine, f"{LEAST_RATIO:g}", met, note))


def preparation(report: Report, resolution: int) -> None:
    """Extra time of the first call with an isovalue, rays without blocks, and light through fog."""
    volume = level_set(resolution)
    origins, directions = random_rays(volume, RAYS)
    raycast(volume, origins, directions, device="cpu")
    seconds = []
    for _ in range(3):
        crossing_blocks.known_blocks(volume).clear()
        start = time.perf_counter()
        raycast(volume, origins[:1], directions[:1], device="cpu")
        few = time.perf_counter() - start
        start = time.perf_counter()
        raycast(volume, origins, directions, device="cpu")
        first = time.perf_counter() - start
        start = time.perf_counter()
        raycast(volume, origins, directions, device="cpu")
        seconds.append((few, first - (time.perf_counter() - start)))
    few, more = np.median(seconds, axis=0)
    report.line(f"{resolution}^3: one ray {few * 1e3:.2f} ms; blocks of an isovalue {more * 1e3:.0f} ms, once")
    fog = volume_of_fog(resolution)
    integrate(fog, origins[:1000], directions[:1000], extinction=10.0, device="cpu")
    start = time.perf_counter()
    integrate(fog, origins, directions, extinction=10.0, device="cpu")
    report.line(f"{resolution}^3: transmittance {len(origins) / (time.perf_counter() - start) / 1e6:.3f} M rays/s")


def volume_of_fog(resolution: int) -> Any:
    """The bunny's band as fog: densest at the surface."""
    from benchmarks.catalog.float_grids import build_float_grid
    from geokit.volume.model.sparse_volume import SparseVolume
    from geokit.volume.nanovdb.header import TREE_OFFSET, info_of, tree_header

    volume = level_set(resolution)
    begin = TREE_OFFSET + int(tree_header(volume.nanovdb)["node_offset"][0])
    count = int(tree_header(volume.nanovdb)["node_count"][0])
    leaves = volume.nanovdb[begin : begin + 2144 * count].reshape(count, 2144)
    values = leaves[:, 96:].copy().view(np.float32)
    reach = float(volume.info.background)
    buffer = build_float_grid(
        leaves[:, :12].copy().view(np.int32) & ~7,
        1.0 - np.abs(values) / np.float32(reach),
        np.abs(values) < np.float32(reach),
        background=0.0,
        transform=volume.info.transform,
        name="density",
        grid_class="fog volume",
        signed_fill=False,
    )
    return SparseVolume(buffer, info_of(buffer))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolutions", type=int, nargs="+", default=RESOLUTIONS, help="voxels along the longest side")
    parser.add_argument("--out", type=Path, help="also write the report there")
    arguments = parser.parse_args()
    table = Table(arguments.out)
    table.add(f"{processor_name()}, {launcher.thread_count()} threads; {RAYS:,} rays, {TRIANGLES:,} triangles.\n")
    table.begin()
    for resolution in arguments.resolutions:
        for kind in KINDS:
            in_process(table, f"rays, {resolution}^3, {kind}", rays, resolution, kind)
        in_process(table, f"rays, {resolution}^3: preparation", preparation, resolution)
    table.end()


if __name__ == "__main__":
    main()
