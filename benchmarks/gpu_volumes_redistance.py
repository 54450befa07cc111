"""Redistancing on a GPU against the CPU: bit equality and times. Needs only numpy, warp and geokit."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from geokit.volume import from_function, renormalize
from geokit.volume.level_set.operands import with_band

REPEATS = 3


def ball(radius: float) -> Any:
    return from_function(
        lambda p: np.linalg.norm(p, axis=1) - radius, [[-radius - 5] * 3, [radius + 5] * 3], 1.0, half_width=3.0
    )


def seconds(run: Callable[[], Any]) -> float:
    best = float("inf")
    for _ in range(REPEATS):
        start = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - start)
    return best


def main(out: Callable[[str], None] = print, gpu: str = "cuda:0") -> None:
    """Print a line for each operation; raises if the results of the devices differ."""
    out("| operation | active voxels | CPU [s] | GPU [s] | ratio | bytes that differ |")
    out("| --- | ---: | ---: | ---: | ---: | ---: |")
    for radius in (20.0, 120.0):
        body = ball(radius)
        for name, operation in (
            ("renormalize", lambda device, body=body: renormalize(body, device=device)),
            ("band 3 to 9", lambda device, body=body: with_band(body, 1.0, 9.0, device=device)),
        ):
            one, other = operation("cpu"), operation(gpu)
            apart = int(np.count_nonzero(one.nanovdb != other.nanovdb))
            cpu, fast = seconds(lambda op=operation: op("cpu")), seconds(lambda op=operation: op(gpu))
            out(f"| {name} | {one.info.active_voxel_count:,} | {cpu:.3f} | {fast:.4f} | {cpu / fast:.1f} | {apart} |")
            if apart:
                raise AssertionError(f"{name}: {apart} bytes differ between {gpu} and the CPU")


if __name__ == "__main__":
    main()
