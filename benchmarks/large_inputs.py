"""A hundred million queries of two million triangles, and their memory: ``python -m benchmarks.large_inputs``.

Closest points, signed distances and first hits of points and rays in NumPy arrays; some answers are compared with those
of the same queries alone. ``--device-memory`` first occupies all but this much of a GPU's memory, to emulate a smaller
GPU.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

import geokit as gk
from benchmarks import inputs

AROUND = 1448  # 2 * 1448 * 724 triangles
COMPARED = 1000
CHUNK = 1 << 22


def filled(count: int, make, *arguments) -> np.ndarray:
    """``make(rng, size)`` in chunks, so that making the inputs takes no more memory than the measured call."""
    rng, out = np.random.default_rng(0), np.empty((count, 3))
    for first in range(0, count, CHUNK):
        out[first : first + CHUNK] = make(rng, min(CHUNK, count - first), *arguments)
    return out


def peak_host() -> float:
    """Peak resident memory of the process [GiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def occupied(device: wp.Device, rest: float) -> wp.array | None:
    """An array that leaves ``rest`` GiB of the device free."""
    if device.is_cpu or not rest:
        return None
    return wp.empty(int(device.free_memory - rest * 2**30) // 64, dtype=wp.mat44, device=device)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--queries", type=int, default=100_000_000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--device-memory", type=float, default=0.0, help="GiB left free on a GPU")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    device = wp.get_device(options.device)
    kept = occupied(device, options.device_memory)
    taken = 0 if kept is None else 64 * len(kept)
    mesh = inputs.bumpy_torus(AROUND, AROUND // 2)
    lower, upper = mesh.bounds
    count = options.queries
    points = filled(count, lambda rng, size: lower + rng.random((size, 3)) * (upper - lower))
    start = time.perf_counter()
    surface = gk.mesh.Surface(mesh, device=device)
    built = time.perf_counter() - start
    name = device.name if device.is_cuda else "cpu"
    lines = [f"{len(mesh.faces):,} triangles, {count:,} queries, {name}; Surface in {built:.2f} s", ""]
    lines += ["| query | seconds | M/s | host GiB at most | device GiB at most | reports | bytes that differ alone |"]
    lines += ["|---|---:|---:|---:|---:|---:|---:|"]
    pick = np.linspace(0, count - 1, COMPARED).astype(int)
    middle = (lower + upper) / 2

    def measured(task: str, query, *tables: np.ndarray) -> None:
        reports: list[int] = []
        start = time.perf_counter()
        found = query(*tables, progress=lambda done, total: reports.append(done))
        seconds = time.perf_counter() - start
        alone = query(*(table[pick] for table in tables))
        differ = sum(
            int(np.count_nonzero(a[pick].view(np.uint8) != b.view(np.uint8))) for a, b in zip(found, alone, strict=True)
        )
        high = "-" if device.is_cpu else f"{(wp.get_mempool_used_mem_high(device) - taken) / 2**30:.2f}"
        lines.append(
            f"| {task} | {seconds:.1f} | {count / seconds / 1e6:.2f} | {peak_host():.1f} | {high} | {len(reports)} "
            f"| {differ} |"
        )
        print(lines[-1], flush=True)

    print(lines[0], flush=True)
    measured("closest point", surface.closest_point, points)
    measured("signed distance", surface.signed_distance, points)
    directions = points - middle
    measured("first hit", surface.raycast, points, directions)
    if options.out:
        options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
