"""The granular scene on a CPU without rendering: frames per second against the overlap of grains, and against threads.

python -m benchmarks.granular [--grains 5000] [--threads 1 2 4 8]
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from geokit.core import launcher

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

OVERLAPS = (0.01, 0.02, 0.03, 0.05)
# Frames for settling the grains, and frames that are timed.
WARM, TIMED = 60, 30


def scene_of(count: int, device: str, overlap: float = OVERLAPS[-1]) -> tuple[Any, int, float]:
    """A stirred bowl, its steps in a frame of 1/60 s, and its inner radius [m]."""
    import granular

    scene, size = granular.stirred_bowl(count, granular.soft_grains(count, overlap), device=device)
    steps = 2 * int(np.ceil(1.0 / 120.0 / scene.step))
    scene.step = 1.0 / 60.0 / steps
    return scene, steps, size


def row_of(count: int, overlap: float, threads: int) -> str:
    os.environ["GEOKIT_THREADS"] = str(threads)
    scene, steps, _ = scene_of(count, "cpu", overlap)
    for _ in range(WARM):
        scene.advance(steps)
    times = []
    for _ in range(TIMED):
        start = time.perf_counter()
        scene.advance(steps)
        times.append(time.perf_counter() - start)
    apart = gk.points.NeighborGrid(scene.x.numpy(), 2.0 * scene.w.radius, device="cpu").pairs().distance
    overlaps = 100.0 * np.quantile(2.0 - apart / scene.w.radius, [0.5, 0.99, 1.0])
    cells = [f"{overlap:g}", str(threads), f"{scene.w.stiffness:.0f}", str(steps), f"{1.0 / np.median(times):.1f}"]
    return "| " + " | ".join([*cells, *(f"{value:.1f}" for value in overlaps)]) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grains", type=int, default=5000)
    parser.add_argument("--threads", type=int, nargs="+", default=[launcher.thread_count()])
    given = parser.parse_args()
    print("| --overlap | threads | k [N/m] | steps a frame | frames/s | overlap [% of r]: median | 99% | most |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    for threads in given.threads:
        for overlap in OVERLAPS if threads == given.threads[-1] else OVERLAPS[-1:]:
            print(row_of(given.grains, overlap, threads), flush=True)


if __name__ == "__main__":
    main()
