"""Trilinear samples side by side with raw warp and NanoVDB: ``python -m benchmarks.volume_sampling [--out FILE]``.

Points are in random order. Peers get float32 points that lie ready for them; geokit is called as a user calls it, with
NumPy arrays, and its checks, its memory and its table of leaves (made by the first call) are inside its time. NanoVDB's
own accessor is compiled here, from cpp/nanovdb_sampling.cpp, where there are a compiler and its headers.
"""

from __future__ import annotations

import argparse
import ctypes
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks import inputs
from benchmarks.compiled import compiled
from benchmarks.measure import Asked, Bar, Case, Peer, Report, Table, in_process
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher

# As a share of the largest value, three voxels: peers compute index coordinates in float32, which rounds 500 by 3e-5.
SAME = 3e-5
RESOLUTIONS = (128, 256, 512)


@wp.kernel
def raw_sample_kernel(first: int, volume: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    out[i] = wp.volume_sample_f(volume, wp.volume_world_to_index(volume, points[i]), wp.Volume.LINEAR)


def level_set(resolution: int) -> tuple[Any, gk.mesh.TriangleMesh]:
    mesh = inputs.bunny_of(190_000)
    longest = float((mesh.bounds[1] - mesh.bounds[0]).max())
    return gk.volume.from_mesh(mesh, longest / resolution, device="cpu"), mesh


def points_of(volume: Any, mesh: Any, where: str, count: int) -> np.ndarray:
    """In random order: about a voxel from the surface, or anywhere in 1.5 times the box."""
    if where == "uniform":
        return inputs.uniform(mesh, count).astype(np.float32)
    voxel = float(volume.info.voxel_size[0])
    longest = float((mesh.bounds[1] - mesh.bounds[0]).max())
    return inputs.near(mesh, count, sigma=voxel / longest).astype(np.float32)


def raw_warp(volume: Any, points: np.ndarray) -> Asked:
    device = wp.get_device("cpu")
    rows = wp.array(points, dtype=wp.vec3, device=device)
    out = wp.empty(len(points), dtype=wp.float32, device=device)
    handle = wp.uint64(volume.id("cpu"))
    return Asked(
        lambda: launcher.launch(raw_sample_kernel, len(points), [handle, rows], [out], device), lambda _: out.numpy()
    )


def nanovdb(volume: Any, points: np.ndarray) -> Asked:
    function = compiled("nanovdb_sampling").sample
    function.argtypes = [ctypes.c_void_p] * 3 + [ctypes.c_int64, ctypes.c_int]
    out = np.empty(len(points), np.float32)
    addresses = [array.ctypes.data for array in (volume.nanovdb, points, out)]
    return Asked(lambda: function(*addresses, len(points), launcher.thread_count()), lambda _: out)


def sampling(report: Report, resolution: int, count: int) -> None:
    volume, mesh = level_set(resolution)
    for where in ("near the surface", "uniform"):
        points = points_of(volume, mesh, where, count)
        wide = points.astype(np.float64)
        for kind, rows in (("float32", points), ("float64", wide)):
            report.case(
                Case(
                    f"trilinear, {resolution}^3, {where}, {kind} points",
                    count,
                    lambda rows=rows: volume.sample(rows, device="cpu"),
                    [
                        Peer("warp, volume_sample_f", lambda points=points: raw_warp(volume, points)),
                        Peer("NanoVDB, SampleFromVoxels", lambda points=points: nanovdb(volume, points)),
                    ],
                    size=float(volume.info.background),
                    same=SAME,
                    bars=(Bar(2.5, ("warp",)), Bar(2.2, ("NanoVDB",))) if where != "uniform" else (),
                )
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=2_000_000, help="points of a call")
    parser.add_argument("--resolutions", type=int, nargs="+", default=RESOLUTIONS)
    parser.add_argument("--out", type=Path, help="also write the report there")
    arguments = parser.parse_args()
    table = Table(arguments.out)
    table.add(
        f"{processor_name()}, {launcher.thread_count()} threads; "
        f"{arguments.points:,} points a call; medians of pairs.\n"
    )
    table.begin()
    for resolution in arguments.resolutions:
        in_process(table, f"trilinear, {resolution}^3", sampling, resolution, arguments.points)
    table.end()


if __name__ == "__main__":
    main()
