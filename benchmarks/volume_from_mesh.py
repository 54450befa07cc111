"""Narrow bands beside OpenVDB's meshToVolume: ``python -m benchmarks.volume_from_mesh [--out FILE]``.

Both make a NanoVDB buffer of a level set, half width 3, from the bunny of 195,200 triangles. OpenVDB starts from the
arrays of the mesh. geokit is timed from an existing Surface, which also answers other queries, and from the mesh alone,
including its tree and the proof that it is clean. Before timing, geokit's distances are compared with
``Surface.closest_point`` at active voxels; the error of OpenVDB is printed beside them.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from benchmarks import inputs
from benchmarks.measure import Report, Row, Table, in_process, paired
from geokit import native
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher

TRIANGLES = 195_200
RESOLUTIONS = (128, 256, 512)
# Largest difference [voxels] of an active voxel from the exact distance: float32 rounds three voxels by 2e-7.
EXACT = 1e-6
CHECKED = 200_000
# Required ratio to OpenVDB, from a Surface.
LEAST_RATIO = 3.0


def mesh_and_voxel(resolution: int) -> tuple[Any, float]:
    mesh = inputs.bunny_of(TRIANGLES)
    return mesh, float((mesh.bounds[1] - mesh.bounds[0]).max()) / resolution


def largest_error(surface: Any, volume: Any) -> tuple[float, int]:
    """Largest difference [voxels] from the exact distance at voxels of the band, and the number of voxels compared."""
    voxel = float(volume.info.voxel_size[0])
    near = inputs.near(surface.mesh, CHECKED, sigma=1.5 * voxel / float(np.ptp(surface.bounds, axis=0).max()))
    centers = np.unique(np.round(near / voxel).astype(np.int64), axis=0) * voxel
    value = volume.sample(centers, order=0, device="cpu")
    active = np.abs(value) < volume.info.background
    exact = surface.signed_distance(centers[active]).distance
    return float(np.abs(value[active] - exact).max() / voxel), int(active.sum())


def band(report: Report, resolution: int) -> None:
    mesh, voxel = mesh_and_voxel(resolution)
    surface = gk.mesh.Surface(mesh, device="cpu")
    volume = gk.volume.from_mesh(surface, voxel)
    error, count = largest_error(surface, volume)
    report.line(f"{resolution}^3: geokit is off by {error:.1e} voxel at most, at {count:,} active voxels")
    if error > EXACT:
        report.row(Row(f"narrow band {resolution}^3", note=f"off by {error:.1e} voxel: not timed"))
        return
    if not native.available():
        report.row(Row(f"narrow band {resolution}^3", peer="OpenVDB", note="the extension is not built"))
        return

    def openvdb() -> Any:
        return native.mesh_to_level_set(mesh.vertices, mesh.faces, voxel_size=voxel, half_width=3.0)

    theirs = gk.volume.from_mesh(surface, voxel, method="openvdb")
    off, _ = largest_error(surface, theirs)
    active = volume.info.active_voxel_count or 0
    for name, ours in (
        ("", lambda: gk.volume.from_mesh(surface, voxel)),
        (", from the mesh", lambda: gk.volume.from_mesh(mesh, voxel, device="cpu")),
        (", from the mesh, winding", lambda: gk.volume.from_mesh(mesh, voxel, sign="winding", device="cpu")),
    ):
        mine, other = paired(ours, openvdb)
        shown = [f"{active / seconds / 1e6:.3f}" for seconds in (mine, other)]
        note = f"{mine * 1e3:.0f} ms against {other * 1e3:.0f} ms; OpenVDB is off by {off:.2f} voxel"
        row = Row(f"narrow band {resolution}^3{name}", shown[0], "OpenVDB", shown[1], other / mine, note=note)
        if not name:
            row.bar, row.met = f"{LEAST_RATIO:g}", "met" if other / mine >= LEAST_RATIO else "NOT met"
        report.row(row)


@contextmanager
def stages() -> Iterator[dict[str, float]]:
    """Seconds of each kernel, by name, while the context lasts."""
    spent: dict[str, float] = {}
    plain = launcher.launch

    def timed(kernel: Any, *arguments: Any, **options: Any) -> None:
        start = time.perf_counter()
        plain(kernel, *arguments, **options)
        spent[kernel.key] = spent.get(kernel.key, 0.0) + time.perf_counter() - start

    launcher.launch = timed
    try:
        yield spent
    finally:
        launcher.launch = plain


def shares(report: Report, resolution: int) -> None:
    """Share of the time by kernel; the rest is Python, sorting, scans and memory."""
    mesh, voxel = mesh_and_voxel(resolution)
    surface = gk.mesh.Surface(mesh, device="cpu")
    gk.volume.from_mesh(surface, voxel)
    with stages() as spent:
        start = time.perf_counter()
        gk.volume.from_mesh(surface, voxel)
        whole = time.perf_counter() - start
    spent["elsewhere"] = whole - sum(spent.values())
    largest = sorted(spent.items(), key=lambda item: -item[1])[:9]
    report.line(
        f"{resolution}^3, share of {whole * 1e3:.0f} ms: " + ", ".join(f"{k} {s / whole:.0%}" for k, s in largest)
    )


def memory(report: Report, resolution: int) -> None:
    """Rise of the resident set while a band is made, in a process of its own; Linux only."""
    text = """
import sys
from pathlib import Path
import geokit as gk
from benchmarks.volume_from_mesh import mesh_and_voxel

def peak():
    return next(int(line.split()[1]) for line in Path("/proc/self/status").open() if line.startswith("VmHWM"))

mesh, voxel = mesh_and_voxel(int(sys.argv[1]))
surface = gk.mesh.Surface(mesh, device="cpu")
gk.volume.from_mesh(surface, 16 * voxel)
Path("/proc/self/clear_refs").write_text("5")
before = peak()
volume = gk.volume.from_mesh(surface, voxel)
print(peak() - before, volume.info.byte_count)
"""
    if not Path("/proc/self/clear_refs").exists():
        return
    output = subprocess.run([sys.executable, "-c", text, str(resolution)], capture_output=True, text=True, check=True)
    more, size = (int(number) for number in output.stdout.split()[-2:])
    report.line(f"{resolution}^3: resident size rises by {more >> 10} MiB for a grid of {size >> 20} MiB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolutions", type=int, nargs="+", default=RESOLUTIONS, help="voxels along the longest side")
    parser.add_argument("--out", type=Path, help="also write the report there")
    arguments = parser.parse_args()
    table = Table(arguments.out)
    table.add(f"{processor_name()}, {launcher.thread_count()} threads; {TRIANGLES:,} triangles; medians of pairs.\n")
    table.begin()
    for resolution in arguments.resolutions:
        for task in (band, shares, memory):
            in_process(table, f"narrow band, {resolution}^3: {task.__name__}", task, resolution)
    table.end()


if __name__ == "__main__":
    main()
