"""Narrow bands on a GPU beside OpenVDB, and beside the CPU, on that machine's cores; part of benchmarks.gpu_volumes.

The machine need not have OpenVDB: GEOKIT_OPENVDB_BAND names the library made of cpp/openvdb_band.cpp, with OpenVDB's
own libraries beside it (LD_LIBRARY_PATH). Without it only geokit's two paths are compared.
"""

from __future__ import annotations

import ctypes
import math
import os
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks import inputs
from benchmarks.compiled import compiled
from benchmarks.gpu_timing import mesh_medians, wall_median
from geokit.core import launcher

TRIANGLES = 190_000
RESOLUTIONS = (256, 512, 1024, 2048)
RUNS = 5
# Surfaces of larger bands have a thousand times as many triangles as a figure needs.
LARGEST_MESHED = 1024


class OpenVdb:
    """OpenVDB's band of a mesh and its surface, timed inside the library.

    Raises:
        ImportError, OSError: OpenVDB is not available.
    """

    def __init__(self) -> None:
        named = os.environ.get("GEOKIT_OPENVDB_BAND")
        library = ctypes.CDLL(named) if named else compiled("openvdb_band", "openvdb", "tbb")
        pointer, count = ctypes.c_void_p, ctypes.c_int64
        self._band, self._surface = library.openvdb_band, library.openvdb_surface
        self._band.restype = self._surface.restype = ctypes.c_double
        floats = (ctypes.c_double, ctypes.c_float)
        self._band.argtypes = [pointer, count, pointer, count, *floats, ctypes.c_int, pointer]
        self._surface.argtypes = [ctypes.c_int, pointer]

    def band(self, mesh: Any, voxel: float) -> float:
        """Seconds of the band, which is kept for ``surface``."""
        vertices = np.ascontiguousarray(mesh.vertices, np.float64)
        faces = np.ascontiguousarray(mesh.faces, np.int32)
        active = np.zeros(1, np.int64)
        arrays = (vertices.ctypes.data, len(vertices), faces.ctypes.data, len(faces))
        return float(self._band(*arrays, voxel, 3.0, launcher.thread_count(), active.ctypes.data))

    def surface(self, threads: int) -> tuple[float, int]:
        """Seconds of the surface of the last band, and its number of quads."""
        quads = np.zeros(1, np.int64)
        return float(self._surface(threads, quads.ctypes.data)), int(quads[0])


def openvdb() -> OpenVdb | None:
    try:
        return OpenVdb()
    except (ImportError, OSError) as error:
        print(f"without OpenVDB: {error}", flush=True)
        return None


def median(run: Callable[[], Any]) -> float:
    return wall_median(run, RUNS)


def main(out: Callable[[str], None] = print, device: str = "cuda:0") -> None:
    peer = openvdb()
    mesh = inputs.bunny_of(TRIANGLES)
    size = float((mesh.bounds[1] - mesh.bounds[0]).max())
    surfaces = {where: gk.mesh.Surface(mesh, device=where) for where in (device, "cpu")}
    for surface in surfaces.values():
        surface.sign_method  # noqa: B018 - prepared, as for any other query
    out(f"{wp.get_device(device).name}, {launcher.thread_count()} CPU threads; {len(mesh.faces):,} triangles\n")
    heads = "GPU ms | CPU ms | CPU / GPU | OpenVDB ms | OpenVDB / GPU | OpenVDB / CPU"
    out(f"| what | active voxels | {heads} |")
    out("|---|---:|---:|---:|---:|---:|---:|---:|")
    meshed = []
    for resolution in RESOLUTIONS:
        voxel = size / resolution
        volumes = {where: gk.volume.from_mesh(surfaces[where], voxel) for where in surfaces}
        bands = {where: median(lambda w=where, v=voxel: gk.volume.from_mesh(surfaces[w], v)) for where in surfaces}
        theirs = statistics.median(peer.band(mesh, voxel) for _ in range(4)) if peer else math.nan
        out(row(f"band {resolution}^3", volumes[device].info.active_voxel_count, bands, device, theirs))
        if resolution <= LARGEST_MESHED:
            meshed.append(surface_row(f"{resolution}^3", volumes, device, peer))
    threads = ", ".join(f"{count} threads" for count in peer_threads())
    out(f"\nSurface nets beside OpenVDB's volumeToMesh with {threads}; its times over ours on the GPU, and in NumPy.\n")
    heads = "GPU, there ms | in NumPy ms | CPU ms | OpenVDB ms | OpenVDB / there | OpenVDB / in NumPy"
    out(f"| surface | triangles | OpenVDB's | {heads} |")
    out("|---|---:|---:|---:|---:|---:|---:|---|---|")
    for line in meshed:
        out(line)


def peer_threads() -> list[int]:
    return sorted({min(2, launcher.thread_count()), launcher.thread_count()})


def surface_row(what: str, volumes: dict[str, Any], device: str, peer: OpenVdb | None) -> str:
    """The surface of OpenVDB's last band against geokit's: synchronized on the GPU, in NumPy arrays, and on the CPU."""
    there, in_numpy, on_cpu = mesh_medians(lambda d: gk.mesh.from_volume(volumes[d], device=d), device, RUNS)
    faces = gk.mesh.from_volume(volumes[device], device=device).face_count
    theirs, quads = [], 0
    for threads in peer_threads() if peer else []:
        runs = [peer.surface(threads) for _ in range(RUNS)]
        theirs.append(statistics.median(seconds for seconds, _ in runs))
        quads = runs[0][1]
    cells = [what, f"{faces:,}", f"{2 * quads:,}", f"{1e3 * there:.2f}", f"{1e3 * in_numpy:.2f}", f"{1e3 * on_cpu:.1f}"]
    cells.append(", ".join(f"{1e3 * seconds:.1f}" for seconds in theirs))
    cells += [", ".join(f"{seconds / ours:.1f}" for seconds in theirs) for ours in (there, in_numpy)]
    return f"| {' | '.join(cells)} |"


def row(what: str, count: int | None, seconds: dict[str, float], device: str, theirs: float) -> str:
    gpu, cpu = seconds[device], seconds["cpu"]
    cells = [f"{1e3 * gpu:.2f}", f"{1e3 * cpu:.1f}", f"{cpu / gpu:.1f}"]
    cells += [f"{1e3 * theirs:.1f}", f"{theirs / gpu:.1f}", f"{theirs / cpu:.1f}"]
    return f"| {what} | {count:,} | {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
