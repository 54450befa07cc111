"""Neighbors of points that move: ``python -m benchmarks.moving [--count N] [--device cpu] [--out FILE]``.

Points of three kinds move with constant velocities, uniform up to a share of the radius in each step: the worst case
for lists with a skin, which last longest where points turn. A run is STEPS steps from the first lists on; times are for
one step, with all lists that are made, the first ones too. Ways that follow the points have the best of SKINS. Points
are sorted by cell, as particle programs keep them; ``--random`` leaves them in random order.

- fresh: a new NeighborGrid, and its lists of neighbors with distances (CSR, by index).
- exact: ``update`` and the same lists of a grid with a skin. They are compared with the fresh ones, bit for bit.
- candidates: ``update`` and ``candidates``, for kernels that compare distances themselves.
- vesin: a full list with distances. pysplashsurf: lists of indices, without distances; not periodic. Both search anew.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import clouds
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher
from geokit.points import NeighborGrid

SKINS = (0.1, 0.2, 0.4)
# Largest motion in a step [radii].
MOTIONS = (0.01, 0.03, 0.1)
STEPS, RUNS = 20, 2
KINDS = (("uniform", None), ("clustered", None), ("uniform", (1.0, 1.0, 1.0)))


# Of all threads together with --cpu-time.
clock = time.perf_counter


def by_cell(points: np.ndarray, radius: float) -> np.ndarray:
    return points[np.lexsort(np.floor(points / radius).T)].copy()


def way(points: np.ndarray, motion: float) -> list[np.ndarray]:
    """Positions of STEPS steps, and of the begin."""
    random = np.random.default_rng(5)
    velocity = random.normal(size=points.shape)
    velocity *= random.random((len(points), 1)) ** (1 / 3) / np.linalg.norm(velocity, axis=1)[:, None]
    return [points + velocity * (motion * k) for k in range(STEPS + 1)]


def step_seconds(make: Callable[[np.ndarray], Callable[[np.ndarray], Any]], steps: list[np.ndarray]) -> float:
    """Time of a step, the least of RUNS runs, after one of two steps."""
    found = []
    for run in range(RUNS + 1):
        step = make(steps[0])
        start = clock()
        for points in steps[1 : STEPS + 1 if run else 3]:
            step(points)
        found.append((clock() - start) / STEPS)
    return min(found[1:])


def follow(search: Callable[[NeighborGrid], Any], **options: Any) -> Callable[[np.ndarray], Any]:
    def make(points: np.ndarray) -> Any:
        grid = NeighborGrid(points, **options)

        def step(points: np.ndarray) -> Any:
            grid.update(points)
            return search(grid)

        return step

    return make


def vesin(radius: float, cell: Any) -> Callable[[np.ndarray], Any]:
    from vesin import NeighborList

    search = NeighborList(cutoff=radius, full_list=True)
    box = np.zeros((3, 3)) if cell is None else np.diag(cell)
    return lambda points: search.compute(points, box, periodic=cell is not None, quantities="ijd", copy=False)


def splashsurf(radius: float) -> Callable[[np.ndarray], Any]:
    import pysplashsurf

    def step(points: np.ndarray) -> Any:
        box = pysplashsurf.Aabb3d.from_points(points)
        return pysplashsurf.neighborhood_search_spatial_hashing_parallel(points, box, radius)

    return step


def row(kind: str, cell: Any, motion: float, count: int, device: str, is_random: bool) -> str:
    points, radius = clouds.SHAPES[kind](count)
    steps = way(points if is_random else by_cell(points, radius), motion * radius)
    given: dict[str, Any] = {"radius": radius, "periodic": cell, "device": device}

    def fresh(points: np.ndarray) -> Any:
        return NeighborGrid(points, **given).radius_search()

    for one, other in zip(follow(NeighborGrid.radius_search, skin=0.2 * radius, **given)(steps[0])(steps[1]),
                          fresh(steps[1]), strict=True):  # fmt: skip
        assert np.array_equal(one, other)
    base = step_seconds(lambda _: fresh, steps)
    cells = [f"{kind}{'' if cell is None else ', periodic'}", f"{motion:g}", f"{1e3 * base:.1f}"]
    for search in (NeighborGrid.radius_search, NeighborGrid.candidates):
        times = {s: step_seconds(follow(search, skin=s * radius, **given), steps) for s in SKINS}
        best = min(times, key=times.__getitem__)
        cells.append(f"{1e3 * times[best]:.1f} ({base / times[best]:.2f}, skin {best:g})")
    for make in (lambda: vesin(radius, cell), lambda: splashsurf(radius) if cell is None else None):
        try:
            peer = make()
            cells.append("-" if peer is None else f"{1e3 * step_seconds(lambda _, peer=peer: peer, steps):.1f}")
        except ImportError:
            cells.append("not installed")
    return f"| {' | '.join(cells)} |"


def version(name: str) -> str:
    try:
        return f"{name} {importlib.metadata.version(name)}"
    except importlib.metadata.PackageNotFoundError:
        return f"{name} -"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--random", action="store_true", help="points in random order")
    parser.add_argument("--out", type=Path, help="also write the table there")
    parser.add_argument("--cpu-time", action="store_true", help="time of all threads, for a machine that is shared")
    options = parser.parse_args()
    if options.cpu_time:
        global clock
        clock = time.process_time
    lines = [
        f"{processor_name()}, {launcher.thread_count()} threads, {options.device}; {options.count:,} points; "
        f"{version('vesin')}, {version('pysplashsurf')}; ms a step, and how many times as fast as fresh\n",
        "| points | motion [radii] | fresh | exact | candidates | vesin | pysplashsurf |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    print("\n".join(lines), flush=True)
    for kind, cell in KINDS:
        for motion in MOTIONS:
            lines.append(row(kind, cell, motion, options.count, options.device, options.random))
            print(lines[-1], flush=True)
    if options.out:
        options.out.write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
