"""From a .vdb file to a volume that is ready on the device, beside ``nanovdb_convert`` and warp's reader.

``python -m benchmarks.volume_loading [--out FILE]``. geokit's worker process, its checks and, where there is one, the
copy to the GPU are inside its time; so are the peer's process and the file that it writes.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks.measure import Asked, Bar, Case, Peer, Report, Table, in_process
from benchmarks.volume_sampling import level_set, points_of
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher

RESOLUTIONS = (128, 256, 512)
CHECKED = 10_000


def through_converter(source: Path, device: Any) -> Any:
    """The way without geokit: Debian's converter writes a file, which becomes a warp.Volume."""
    target = source.with_suffix(".nvdb")
    subprocess.run(["nanovdb_convert", "-f", str(source), str(target)], check=True, capture_output=True)
    with target.open("rb") as file:
        return wp.Volume.load_from_nvdb(file, device=device)


def values_at(volume: Any, points: np.ndarray, device: Any) -> np.ndarray:
    from benchmarks.volume_sampling import raw_sample_kernel

    rows = wp.array(points, dtype=wp.vec3, device=device)
    out = wp.empty(len(points), dtype=wp.float32, device=device)
    launcher.launch(raw_sample_kernel, len(points), [wp.uint64(volume.id), rows], [out], device)
    return out.numpy()


def loading(report: Report, resolution: int, codec: str, folder: str) -> None:
    if shutil.which("nanovdb_convert") is None:
        raise RuntimeError("nanovdb_convert is not installed: Debian and Ubuntu have it in libnanovdb-tools")
    volume, mesh = level_set(resolution)
    source = Path(folder) / f"{resolution}-{codec}.vdb"
    gk.volume.save(source, volume, codec=codec)
    device = launcher.resolve_device(None)
    points = points_of(volume, mesh, "near the surface", CHECKED)

    def loaded(**options: Any) -> Any:
        ready = gk.volume.load(source, grid=volume.info.name, **options).on(device)
        wp.synchronize_device(device)
        return ready

    for name, ours in (("in a worker process", loaded), ("trusted", lambda: loaded(trusted=True))):
        report.case(
            Case(
                f".vdb ({codec}) to {device.alias}, {resolution}^3, {source.stat().st_size / 2**20:.1f} MiB, {name}",
                volume.info.active_voxel_count or 0,
                ours,
                [
                    Peer(
                        "nanovdb_convert, warp",
                        lambda: Asked(
                            lambda: through_converter(source, device), lambda made: values_at(made, points, device)
                        ),
                    )
                ],
                size=float(volume.info.background),
                bars=(Bar(1 / 1.3),),
                read=lambda made: values_at(made, points, device),
            )
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolutions", type=int, nargs="+", default=RESOLUTIONS)
    parser.add_argument("--out", type=Path, help="also write the report there")
    arguments = parser.parse_args()
    table = Table(arguments.out)
    table.add(f"{processor_name()}, {launcher.thread_count()} threads; rates in active voxels; medians of pairs.\n")
    table.begin()
    with tempfile.TemporaryDirectory() as folder:
        for resolution in arguments.resolutions:
            for codec in ("blosc", "zip"):
                in_process(table, f"loading, {resolution}^3", loading, resolution, codec, folder)
    table.end()


if __name__ == "__main__":
    main()
