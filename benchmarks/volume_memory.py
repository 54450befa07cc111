"""Peak host memory of steps with volumes, against the size of what they make: ``python -m benchmarks.volume_memory``.

Each step runs in a process of its own, once as a warm-up on a small input and once measured: peak memory of the process
minus the memory held before. Linux only.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from benchmarks import inputs

# Allowed memory: a multiple of the result, plus a constant for libraries and pools.
FACTOR, CONSTANT = 2.5, 200 << 20
SMALL = 64


def held(what: str) -> int:
    """``VmRSS`` or ``VmHWM`` of this process [bytes]."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(what):
            return int(line.split()[1]) << 10
    raise RuntimeError(f"/proc/self/status has no {what}")


def size_of(result: Any) -> int:
    """Bytes of a volume, a mesh, an array, a file, or several."""
    if isinstance(result, (list, tuple)):
        return sum(map(size_of, result))
    if isinstance(result, np.ndarray):
        return int(result.nbytes)
    if isinstance(result, Path):
        return result.stat().st_size
    if hasattr(result, "vertices"):
        return int(result.vertices.nbytes + result.faces.nbytes)
    return int(result.info.byte_count) if hasattr(result, "info") else 0


def steps(resolution: int, folder: Path) -> dict[str, Callable[[], Callable[[], Any]]]:
    """By name: a function that prepares the inputs and returns the step itself."""
    volume = gk.volume
    mesh = inputs.bunny_of(190_000)
    voxel = float((mesh.bounds[1] - mesh.bounds[0]).max()) / resolution
    center = mesh.bounds.mean(axis=0)

    def level_set() -> Any:
        return volume.from_mesh(mesh, voxel, device="cpu")

    def with_level_set(step: Callable[[Any], Any]) -> Callable[[], Callable[[], Any]]:
        def prepare() -> Callable[[], Any]:
            made = level_set()
            return lambda: step(made)

        return prepare

    def saved(name: str) -> Path:
        path = folder / name
        volume.save(path, level_set())
        return path

    def written(made: Any, name: str) -> Path:
        volume.save(folder / name, made)
        return folder / name

    def loading(name: str) -> Callable[[], Callable[[], Any]]:
        def prepare() -> Callable[[], Any]:
            path = saved(name)
            return lambda: volume.load(path)

        return prepare

    def sphere(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - center, axis=1) - 0.4 * resolution * voxel

    bounds = np.stack([center - 0.5 * resolution * voxel, center + 0.5 * resolution * voxel])
    points = mesh.vertices
    return {
        "from_mesh": lambda: level_set,
        "from_function": lambda: lambda: volume.from_function(sphere, bounds, voxel),
        "from_points": lambda: lambda: volume.from_points(points, 3.0 * voxel, voxel_size=voxel, device="cpu"),
        "to_dense": with_level_set(lambda made: volume.to_dense(made, device="cpu").values),
        "quantize fp8": with_level_set(lambda made: volume.quantize(made, "fp8")),
        "save .nvdb": with_level_set(lambda made: written(made, "out.nvdb")),
        "save .vdb": with_level_set(lambda made: written(made, "out.vdb")),
        "load .nvdb": loading("in.nvdb"),
        "load .vdb": loading("in.vdb"),
        "union": with_level_set(lambda made: volume.union(made, made)),
        "offset": with_level_set(lambda made: volume.offset(made, voxel)),
        "smooth": with_level_set(lambda made: volume.smooth(made)),
        "renormalize": with_level_set(lambda made: volume.renormalize(made)),
        "resample": with_level_set(lambda made: volume.resample(made, voxel_size=0.8 * voxel)),
        "gradient_field": with_level_set(lambda made: volume.gradient_field(made)),
        "segment": with_level_set(lambda made: volume.segment(made)),
        "mesh.from_volume": with_level_set(lambda made: gk.mesh.from_volume(made, device="cpu")),
        "mesh.from_volume, openvdb": with_level_set(lambda made: gk.mesh.from_volume(made, method="openvdb")),
    }


def measured(name: str, resolution: int, folder: str, pipe: Any) -> None:
    # Libraries, pools and compiled kernels are loaded before the measurement.
    steps(SMALL, Path(folder))[name]()()
    step = steps(resolution, Path(folder))[name]()
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak starts anew
    before = held("VmRSS")
    result = step()
    pipe.send((size_of(result), held("VmHWM") - before))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=512)
    parser.add_argument("--only", nargs="+", help="names of steps")
    arguments = parser.parse_args()
    print("| step | result MiB | peak MiB | allowed MiB | met |\n|---|---:|---:|---:|---|")
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.only or steps(SMALL, Path(folder)):
            mine, theirs = context.Pipe(duplex=False)
            process = context.Process(target=measured, args=(name, arguments.resolution, folder, theirs))
            process.start()
            theirs.close()
            try:
                size, peak = mine.recv()
            except EOFError:
                print(f"| {name} | failed, see the error output | | | |", flush=True)
                continue
            finally:
                process.join()
            allowed = FACTOR * size + CONSTANT
            cells = " | ".join(f"{n / 2**20:.0f}" for n in (size, peak, allowed))
            print(f"| {name} | {cells} | {'met' if peak <= allowed else 'NOT met'} |", flush=True)
    sys.exit(0)


if __name__ == "__main__":
    main()
