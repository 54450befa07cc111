"""Narrow bands on a GPU beside OpenVDB, and beside the CPU, on that machine's cores; part of benchmarks.gpu_volumes.

The machine need not have OpenVDB: GEOKIT_OPENVDB_BAND names the library made of cpp/openvdb_band.cpp, with OpenVDB's
own libraries beside it (LD_LIBRARY_PATH). Without it only geokit's two paths are compared.
"""

from __future__ import annotations

import ctypes
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks import inputs
from benchmarks.compiled import compiled
from geokit import _launch

TRIANGLES = 190_000
RESOLUTIONS = (256, 512, 1024, 2048)
RUNS = 5


def openvdb_band() -> Callable[[Any, float], tuple[float, int]] | None:
    """Seconds and active voxels of OpenVDB's band of a mesh; None where OpenVDB is not to be had."""
    named = os.environ.get("GEOKIT_OPENVDB_BAND")
    try:
        function = (ctypes.CDLL(named) if named else compiled("openvdb_band", "openvdb", "tbb")).openvdb_band
    except (ImportError, OSError) as error:
        print(f"without OpenVDB: {error}", flush=True)
        return None
    pointer, count = ctypes.c_void_p, ctypes.c_int64
    function.restype = ctypes.c_double
    function.argtypes = [pointer, count, pointer, count, ctypes.c_double, ctypes.c_float, ctypes.c_int, pointer]

    def run(mesh: Any, voxel: float) -> tuple[float, int]:
        vertices = np.ascontiguousarray(mesh.vertices, np.float64)
        faces = np.ascontiguousarray(mesh.faces, np.int32)
        active = np.zeros(1, np.int64)
        arrays = (vertices.ctypes.data, len(vertices), faces.ctypes.data, len(faces))
        taken = function(*arrays, voxel, 3.0, _launch.thread_count(), active.ctypes.data)
        return taken, int(active[0])

    return run


def median(run: Callable[[], Any], runs: int = RUNS) -> float:
    run()
    seconds = []
    for _ in range(runs):
        wp.synchronize()
        start = time.perf_counter()
        run()
        wp.synchronize()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def main(out: Callable[[str], None] = print, device: str = "cuda:0") -> None:
    peer = openvdb_band()
    mesh = inputs.bunny_of(TRIANGLES)
    size = float((mesh.bounds[1] - mesh.bounds[0]).max())
    surfaces = {where: gk.mesh.Surface(mesh, device=where) for where in (device, "cpu")}
    for surface in surfaces.values():
        surface.sign_method  # noqa: B018 - prepared, as for any other query
    out(f"{wp.get_device(device).name}, {_launch.thread_count()} CPU threads; {len(mesh.faces):,} triangles\n")
    out("| band | active voxels | GPU ms | CPU ms | CPU / GPU | OpenVDB ms | OpenVDB / GPU | OpenVDB / CPU |")
    out("|---|---:|---:|---:|---:|---:|---:|---:|")
    for resolution in RESOLUTIONS:
        voxel = size / resolution
        volume = gk.volume.from_mesh(surfaces[device], voxel)
        on_gpu = median(lambda voxel=voxel: gk.volume.from_mesh(surfaces[device], voxel))
        on_cpu = median(lambda voxel=voxel: gk.volume.from_mesh(surfaces["cpu"], voxel), 3)
        cells = ["-", "-", "-"]
        if peer:
            peer(mesh, voxel)
            theirs = statistics.median(peer(mesh, voxel)[0] for _ in range(3))
            cells = [f"{1e3 * theirs:.1f}", f"{theirs / on_gpu:.1f}", f"{theirs / on_cpu:.1f}"]
        out(
            f"| {resolution}^3 | {volume.info.active_voxel_count:,} | {1e3 * on_gpu:.2f} | {1e3 * on_cpu:.1f} | "
            f"{on_cpu / on_gpu:.1f} | {' | '.join(cells)} |"
        )


if __name__ == "__main__":
    main()
