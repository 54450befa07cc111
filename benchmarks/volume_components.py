"""Connected components side by side with SciPy: ``python -m benchmarks.volume_components [--size N] [--out FILE]``.

Random masks of N^3 voxels; SciPy labels the dense array, geokit the sparse mask, each ready for it. Both number of
components and their sizes are compared. A last row splits many balls whose bands meet into volumes; it has no peer.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

import geokit as gk
from benchmarks.measure import Asked, Bar, Case, Peer, Report, Table, in_process
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher

SHARES = (0.02, 0.1, 0.3, 0.5)


def scipy_sizes(states: np.ndarray) -> Asked:
    def read(found: Any) -> np.ndarray:
        return np.sort(np.bincount(found[0].ravel())[1:])[::-1]

    return Asked(lambda: ndimage.label(states), read)


def labeling(report: Report, size: int) -> None:
    for share in SHARES:
        states = np.random.default_rng(0).random(3 * (size,)) < share
        mask = gk.volume.from_dense(states, voxel_size=1.0, grid_type="mask")
        count = gk.volume.connected_components(mask, device="cpu").count
        report.case(
            Case(
                f"label {size}^3, {share:.0%} of the voxels, {count:,} components",
                states.size,
                lambda mask=mask: gk.volume.connected_components(mask, device="cpu"),
                [Peer("scipy.ndimage.label", lambda states=states: scipy_sizes(states))],
                size=1.0,
                bars=(Bar(1 / 3),),
                read=lambda found: found.voxel_counts,
            )
        )


def balls(along: int, gap: float) -> Any:
    spacing = 12.0 + gap

    def distance(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - spacing * np.round(points / spacing), axis=1) - 6.0

    reach = 0.5 * spacing * along
    return gk.volume.from_function(distance, [[-reach] * 3, [reach] * 3], 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=256, help="voxels along an edge of a mask")
    parser.add_argument("--out", type=Path, help="also write the report there")
    arguments = parser.parse_args()
    table = Table(arguments.out)
    table.add(f"{processor_name()}, {launcher.thread_count()} threads; medians of pairs.\n")
    table.begin()
    in_process(table, f"label {arguments.size}^3", labeling, arguments.size)
    table.end()
    for gap in (8.0, 4.0):
        volume = balls(7, gap)
        gk.volume.segment(volume, device="cpu")
        start = time.perf_counter()
        count = len(gk.volume.segment(volume, device="cpu"))
        each = (time.perf_counter() - start) / count
        table.add(f"segment, balls of 6 voxels, {gap:.0f} voxels apart: {count} volumes, {1e3 * each:.2f} ms each")


if __name__ == "__main__":
    main()
