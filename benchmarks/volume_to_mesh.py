"""Isosurfaces beside OpenVDB's volumeToMesh: ``python -m benchmarks.volume_to_mesh [--out FILE]``.

Level sets of the bunny, half width 3. The peer is cpp/volume_to_mesh.cpp, compiled here: volumeToMesh alone, on a
FloatGrid that is ready in memory, timed inside C++, without any conversion; geokit's time is that of
``mesh.from_volume`` from call to NumPy arrays. Before anything is timed, the numbers of vertices and faces of surface
nets are compared, which must be the same. Then edges: how far a cube's are off, by method.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from benchmarks import inputs
from benchmarks.compiled import program
from benchmarks.measure import Report, Row, Table, in_process
from benchmarks.volume_from_mesh import stages
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher

TRIANGLES = 195_200
RESOLUTIONS = (256, 512)
METHODS = ("surface_nets", "marching_cubes", "dual_contouring")
RUNS, WARM = 9, 2
# TBB's threads and ours keep spinning for a while.
PAUSE = 0.02
# Required ratio of surface nets to OpenVDB.
LEAST_RATIO = 1.0


class OpenVdb:
    """A process that meshes one grid on each request."""

    def __init__(self, volume: Any, folder: Path, runs: int) -> None:
        path = folder / "grid.vdb"
        gk.volume.save(path, volume)
        command = [
            str(program("volume_to_mesh", "openvdb", "tbb")),
            str(path),
            "0",
            "0",
            str(launcher.thread_count()),
            str(runs),
        ]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self) -> tuple[float, int, int]:
        """Seconds, points and quads."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        seconds, points, triangles, quads = self._process.stdout.readline().split()
        assert int(triangles) == 0
        return float(seconds), int(points), int(quads)


def bunny_volume(resolution: int) -> Any:
    mesh = inputs.bunny_of(TRIANGLES)
    return gk.volume.from_mesh(mesh, float((mesh.bounds[1] - mesh.bounds[0]).max()) / resolution, device="cpu")


def surfaces(report: Report, resolution: int) -> None:
    volume = bunny_volume(resolution)
    for method in METHODS:
        with tempfile.TemporaryDirectory() as folder:
            peer = OpenVdb(volume, Path(folder), RUNS)
            seconds: tuple[list[float], list[float]] = ([], [])
            for _ in range(RUNS):
                time.sleep(PAUSE)
                start = time.perf_counter()
                mesh = gk.mesh.from_volume(volume, method=method, device="cpu")
                seconds[0].append(time.perf_counter() - start)
                time.sleep(PAUSE)
                theirs, points, quads = peer.run()
                seconds[1].append(theirs)
        name = f"{method} {resolution}^3"
        same = (len(mesh.vertices), len(mesh.faces)) == (points, 2 * quads)
        if method == "surface_nets" and not same:
            note = f"{len(mesh.vertices)} vertices for {points}, {len(mesh.faces)} faces for {2 * quads}: not timed"
            report.row(Row(name, peer="OpenVDB", note=note))
            continue
        ours, other = (statistics.median(row[WARM:]) for row in seconds)
        rates = [f"{count / spent / 1e6:.2f}" for count, spent in ((len(mesh.faces), ours), (2 * quads, other))]
        note = f"{ours * 1e3:.0f} ms against {other * 1e3:.0f} ms; {len(mesh.faces):,} triangles for {2 * quads:,}"
        row = Row(name, rates[0], "OpenVDB", rates[1], other / ours, note=note)
        if method == "surface_nets":
            row.bar, row.met = f"{LEAST_RATIO:g}", "met" if other / ours >= LEAST_RATIO else "NOT met"
        report.row(row)


def shares(report: Report, resolution: int) -> None:
    """Share of the time by kernel; the rest is Python, scans and memory."""
    volume = bunny_volume(resolution)
    for method in METHODS:
        gk.mesh.from_volume(volume, method=method, device="cpu")
        with stages() as spent:
            start = time.perf_counter()
            gk.mesh.from_volume(volume, method=method, device="cpu")
            whole = time.perf_counter() - start
        spent["elsewhere"] = whole - sum(spent.values())
        largest = sorted(spent.items(), key=lambda item: -item[1])[:8]
        text = ", ".join(f"{name} {part / whole:.0%}" for name, part in largest)
        report.line(f"{method} {resolution}^3, share of {whole * 1e3:.0f} ms: {text}")


def rotated_cube(first: float, second: float) -> Any:
    """A cube of edge 1 turned about z, then about x, by angles in radians."""
    corners = np.array(list(np.ndindex(2, 2, 2)), float) - 0.5
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    c, s, e, f = np.cos(first), np.sin(first), np.cos(second), np.sin(second)
    turn = np.array([[1, 0, 0], [0, e, -f], [0, f, e]]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return gk.mesh.TriangleMesh(corners @ turn.T + [0.013, 0.007, 0.019], faces)


def edges(report: Report) -> None:
    """Distance of a cube's edges from the meshes of its exact level set, 32 voxels along an edge."""
    voxel = 1 / 32
    for name, angles in (("square to the grid", (0.0, 0.0)), ("turned", (0.4, 0.7)), ("turned otherwise", (0.2, 1.1))):
        cube = rotated_cube(*angles)
        volume = gk.volume.from_mesh(cube, voxel, device="cpu")
        corners = cube.vertices
        pairs = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]
        along = np.linspace(0, 1, 400)[:, None]
        points = np.concatenate([corners[a] * (1 - along) + corners[b] * along for a, b in pairs])
        solid = gk.mesh.Surface(cube, device="cpu")
        for method in (*METHODS, "openvdb"):
            mesh = gk.mesh.from_volume(volume, method=method, device="cpu")
            off = gk.mesh.Surface(mesh, device="cpu").closest_point(points).distance / voxel
            vertices = solid.closest_point(mesh.vertices).distance / voxel
            report.line(
                f"cube {name}, {method}: edges off by {off.max():.2f} voxel at most, "
                f"{np.sqrt((off**2).mean()):.3f} rms; vertices by {vertices.max():.2f}, "
                f"{np.sqrt((vertices**2).mean()):.3f} rms"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolutions", type=int, nargs="+", default=RESOLUTIONS, help="voxels along the longest side")
    parser.add_argument("--out", type=Path, help="also write the report there")
    arguments = parser.parse_args()
    table = Table(arguments.out)
    table.add(f"{processor_name()}, {launcher.thread_count()} threads; rates are millions of triangles per second.\n")
    table.begin()
    for resolution in arguments.resolutions:
        for task in (surfaces, shares):
            in_process(table, f"isosurface, {resolution}^3: {task.__name__}", task, resolution)
    in_process(table, "edges of a cube", edges)
    table.end()


if __name__ == "__main__":
    main()
