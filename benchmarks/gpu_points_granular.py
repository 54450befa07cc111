"""The granular scene on a GPU without rendering: frames per second, overlap, and a breakdown of the time.

The folder named by $OUT gets the grains' positions of the last frame, as .npz.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

import geokit as gk
from benchmarks.gpu_timing import device_median
from benchmarks.granular import scene_of

COUNTS = (5_000, 100_000, 400_000)
# Frames for settling the grains and capturing the graphs, and frames that are timed.
WARM, TIMED = 60, 60


def row_of(count: int, out: Path | None) -> str:
    import granular

    scene, steps, size = scene_of(count, "cuda:0")
    for _ in range(WARM):
        scene.advance(steps)
    wp.synchronize()
    start = time.perf_counter()
    for _ in range(TIMED):
        scene.advance(steps)
    wp.synchronize()
    rate = TIMED / (time.perf_counter() - start)
    positions = scene.x.numpy()
    apart = gk.points.NeighborGrid(positions, 2.0 * scene.w.radius, device="cuda:0").pairs().distance
    energy = 0.5 * scene.w.mass * float(np.sum(scene.v.numpy().astype(np.float64) ** 2))
    lost = int(np.sum(np.linalg.norm(positions, axis=1) > 1.5 * size))
    w = scene.w
    reach = (2.0 + granular.SKIN) * w.radius + w.range

    def grid() -> None:
        scene.grid.build(scene.x, reach)

    lists = scene._list(0)[1]
    given = 0, 1, scene.xs, scene.vs, w, scene.angle, scene.step, *scene.lists, scene.clear
    step = scene.team.record(granular.step_kernel, count, given)
    parts = [1e6 * device_median(run, 20) for run in (grid, lists, step)]
    if out is not None:
        np.savez(out / f"granular_{count}.npz", x=positions, size=size, angle=w.turn * scene.time, radius=w.radius)
    captured = sorted(every for _, every in scene.frames)
    cells = [f"{count:,}", str(steps), f"{1e6 * scene.step:.0f}", f"{rate:.0f}", *(f"{part:.0f}" for part in parts)]
    cells += [str(captured), f"{2.0 - apart.min() / w.radius:.3f}", f"{2 * len(apart) / count:.2f}"]
    return "| " + " | ".join([*cells, f"{energy / count:.2e}", str(lost)]) + " |"


def same_bits() -> str:
    """Two runs on the GPU, and one on the CPU beside them."""
    ends = []
    for device in ("cuda:0", "cuda:0", "cpu"):
        scene, steps, _ = scene_of(2000, device)
        for _ in range(5):
            scene.advance(steps)
        ends.append(scene.x.numpy().copy())
    apart = float(np.abs(ends[0] - ends[2]).max())
    return f"two runs on the GPU equal: {np.array_equal(*ends[:2])}; CPU and GPU differ by {apart:.2g} m after 5 frames"


def main(out: Callable[[str], None] = print) -> None:
    """A frame of each scene goes to the folder $OUT, where there is one, to be drawn elsewhere."""
    folder = Path(os.environ["OUT"]) if "OUT" in os.environ else None
    titles = "grains, steps a frame, step length [us], frames/s, grid [us], list [us], step [us], steps a list"
    titles += ", overlap [radii], contacts, kinetic energy [J/grain], outside"
    out("| " + " | ".join(titles.split(", ")) + " |")
    out("|" + "---|" * (titles.count(", ") + 1))
    for count in COUNTS:
        out(row_of(count, folder))
    out("\n" + same_bits())


if __name__ == "__main__":
    main()
