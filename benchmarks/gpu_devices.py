"""Queries on all GPUs in one call against the first one alone, for arrays on a GPU and on the host.

Run with ``python -m benchmarks.gpu_devices [--rows N]``. Needs two GPUs; with torch its tensors are asked too. Before
they are timed, answers are compared bit by bit, and after each call the current device must be what it was.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks.gpu_timing import wall_median
from geokit.core import launcher

RUNS = 7
ALL = launcher.ALL_GPUS
ONE = "cuda:0"
Query = Callable[[Any, Any], Any]


def on_host(value: Any) -> np.ndarray:
    return np.asarray(value.numpy() if isinstance(value, wp.array) else value.cpu() if hasattr(value, "cpu") else value)


def require_equal(found: Any, expected: Any, what: str) -> None:
    """Raise unless all fields have the same values; NaN is the same as NaN."""
    pairs = zip(*(one if isinstance(one, tuple) else (one,) for one in (found, expected)), strict=True)
    for a, b in pairs:
        if not np.array_equal(on_host(a), on_host(b), equal_nan=on_host(a).dtype.kind == "f"):
            raise AssertionError(f"{what}: the GPUs together answer otherwise than the first alone")


def queries() -> dict[str, dict[str, Query]]:
    """By name the query of points and directions, on all GPUs and on one."""
    mesh = gk.mesh.torus(segments=1024, tube_segments=512)
    cloud = gk.mesh.sample_surface(mesh, 2_000_000, seed=1).points
    volume = gk.volume.from_mesh(mesh, voxel_size=0.005)
    found: dict[str, dict[str, Query]] = {}
    for device in (ALL, ONE):
        surface = gk.mesh.Surface(mesh, device=device)
        grid = gk.points.NeighborGrid(cloud, 0.01, device=device)
        made: dict[str, Query] = {
            "closest point": lambda points, _, surface=surface: surface.closest_point(points),
            "raycast": lambda points, directions, surface=surface: surface.raycast(points, directions),
            "count neighbors": lambda points, _, grid=grid: grid.count(points),
            "sample, order 1": lambda points, _, device=device: volume.sample(points, order=1, device=device),
            "sample, order 3": lambda points, _, device=device: volume.sample(points, order=3, device=device),
        }
        for name, query in made.items():
            found.setdefault(name, {})[device] = query
    return found


def containers(arrays: Sequence[np.ndarray]) -> dict[str, tuple[Any, ...]]:
    """The arrays on the host and on the first GPU."""
    found: dict[str, tuple[Any, ...]] = {"host": tuple(arrays)}
    try:
        import torch
    except ImportError:
        found["GPU (warp)"] = tuple(wp.array(array, dtype=wp.float64, device=ONE) for array in arrays)
    else:
        found["GPU (torch)"] = tuple(torch.from_numpy(array).to(ONE) for array in arrays)
    return found


def main(out: Callable[[str], None], rows: int) -> None:
    gpus = launcher.cuda_devices()
    out(f"{len(gpus)} x {wp.get_device(ONE).name}; {rows:,} rows, float64\n")
    out(f"| query | arrays | {ONE}: ms | {ALL}: ms | times as fast |")
    out("|---|---|---:|---:|---:|")
    random = np.random.default_rng(0)
    given = containers([random.uniform(-1.5, 1.5, (rows, 3)), random.normal(size=(rows, 3))])
    for name, query in queries().items():
        for kind, (points, directions) in given.items():
            wp.get_device(ONE).make_current()
            expected = query[ONE](points, directions)
            wp.get_device(gpus[-1]).make_current()
            require_equal(query[ALL](points, directions), expected, f"{name}, {kind}")
            current = wp.get_cuda_device().alias
            if current != gpus[-1]:
                raise AssertionError(f"{name}, {kind}: {gpus[-1]} was the current device, now {current}")
            one, together = (
                wall_median(lambda ask=query[device], a=points, b=directions: ask(a, b), RUNS, warm=2)
                for device in (ONE, ALL)
            )
            out(f"| {name} | {kind} | {one * 1e3:.2f} | {together * 1e3:.2f} | {one / together:.2f} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=8_000_000)
    main(print, parser.parse_args().rows)
