"""Quantized grids and volumes from arrays, points and functions, side by side: ``python -m benchmarks.volume_codecs``.

Answers are compared first; then both sides run in turn and the ratio is that of the medians. Peers are programs of
OpenVDB's packages (nanovdb_convert, vdb_tool, pyopenvdb for the system's Python), left out where they are not
installed. ``--memory`` measures peaks of memory instead, as benchmarks.volume_memory does.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import importlib
import json
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import inputs
from geokit.accuracy.trials.machine import processor_name
from geokit.volume import from_mesh, load, save
from geokit.volume._dense import from_dense, to_dense
from geokit.volume._from_function import from_function
from geokit.volume._from_points import from_points
from geokit.volume.nanovdb.file import read
from geokit.volume.retyped.quantize import quantize

RUNS = 3
SYSTEM_PYTHON = "/usr/bin/python3"
# Codecs, and the tolerance [half widths of the band] where one is needed.
CODECS = {"float": None, "fp16": None, "fp8": None, "fp4": None, "fpn": 1e-3}

PYOPENVDB = """
import json, sys, time
import numpy as np, pyopenvdb as vdb
values = np.load(sys.argv[1])
grid = vdb.FloatGrid(float(sys.argv[2]))
times = [[], []]
out = np.empty_like(values)
for _ in range(int(sys.argv[3])):
    grid.clear()
    start = time.perf_counter()
    grid.copyFromArray(values)
    middle = time.perf_counter()
    grid.copyToArray(out)
    times[0].append(middle - start)
    times[1].append(time.perf_counter() - middle)
print(json.dumps({"times": times, "same": bool((out == values).all()), "active": grid.activeVoxelCount()}))
"""


def timed(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def in_turn(ours: Callable[[], Any], theirs: Callable[[], Any]) -> tuple[float, float]:
    """Medians of both sides, run in turn after a warm-up."""
    ours(), theirs()
    pairs = [(timed(ours), timed(theirs)) for _ in range(RUNS)]
    mine, other = zip(*pairs, strict=True)
    return statistics.median(mine), statistics.median(other)


def row(task: str, ours: float, peer: str, theirs: float, note: str) -> None:
    print(f"| {task} | {1e3 * ours:.0f} | {peer} | {1e3 * theirs:.0f} | {theirs / ours:.2f} | {note} |", flush=True)


def level_set(resolution: int) -> Any:
    mesh = inputs.bunny_of(190_000)
    return from_mesh(mesh, float((mesh.bounds[1] - mesh.bounds[0]).max()) / resolution, device="cpu")


def sizes(volume: Any) -> None:
    """Memory, error and sampling time of each codec."""
    voxel = float(volume.info.voxel_size[0])
    rng = np.random.default_rng(0)
    box = volume.info.index_bounds
    active = to_dense(volume, device="cpu").values
    near = np.argwhere(np.abs(active) < volume.info.background)[:: max(1, active.size // 10_000_000)] + box[0]
    points = (near[rng.permutation(len(near))] + rng.uniform(-0.5, 0.5, (len(near), 3))) * voxel
    print("\n| codec | MiB | bytes of the float grid | largest error [voxels] | quantize ms | sample M/s |")
    print("|---|---:|---:|---:|---:|---:|")
    for codec, share in CODECS.items():
        tolerance = None if share is None else share * volume.info.background
        small = quantize(volume, codec, tolerance=tolerance)
        spent = statistics.median(
            timed(lambda c=codec, t=tolerance: quantize(volume, c, tolerance=t)) for _ in range(3)
        )
        small.sample(points, device="cpu")
        sampled = statistics.median(timed(lambda s=small: s.sample(points, device="cpu")) for _ in range(3))
        error = small.info.metadata["geokit:achieved_error"] / voxel
        size, share_of_float = small.info.byte_count / 2**20, small.info.byte_count / volume.info.byte_count
        rate = len(points) / sampled / 1e6
        print(
            f"| {codec} | {size:.1f} | {share_of_float:.0%} | {error:.2g} | {1e3 * spent:.0f} | {rate:.1f} |",
            flush=True,
        )


def against_nanovdb_convert(volume: Any, folder: Path) -> None:
    if not shutil.which("nanovdb_convert"):
        return
    save(folder / "x.vdb", volume)
    for codec, flags in {"fp8": ["--fp8"], "fp16": ["--fp16"], "float": []}.items():

        def theirs(flags: list[str] = flags) -> None:
            command = ["nanovdb_convert", "-f", "-c", "full", *flags, folder / "x.vdb", folder / "theirs.nvdb"]
            subprocess.run(command, check=True, capture_output=True)

        def ours(codec: str = codec) -> None:
            save(folder / "ours.nvdb", quantize(load(folder / "x.vdb"), codec))

        ours(), theirs()
        mine, other = (read(folder / f"{name}.nvdb")[0].buffer for name in ("ours", "theirs"))
        differ = int((mine[736:] != other[736:]).sum())
        times = in_turn(ours, theirs)
        row(f".vdb to {codec} .nvdb, files included", times[0], "nanovdb_convert", times[1], f"{differ} bytes differ")


def against_pyopenvdb(volume: Any, folder: Path) -> None:
    box = to_dense(volume, device="cpu")
    values, background = np.ascontiguousarray(box.values), float(volume.info.background)
    np.save(folder / "values.npy", values)
    command = [SYSTEM_PYTHON, "-c", PYOPENVDB, folder / "values.npy", str(background), str(RUNS)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return
    theirs = json.loads(done.stdout)

    def ours() -> Any:
        return from_dense(values, voxel_size=1.0, background=background)

    made = ours()
    same = made.info.active_voxel_count == theirs["active"] and theirs["same"]
    back = to_dense(made, bounds=[[0, 0, 0], np.array(values.shape) - 1], device="cpu").values
    note = f"{values.size / 1e6:.0f} M voxels; same active voxels: {same}; same values: {np.array_equal(back, values)}"
    spent = statistics.median(timed(ours) for _ in range(RUNS))
    row("from_dense", spent, "pyopenvdb copyFromArray", statistics.median(theirs["times"][0]), note)
    whole = [[0, 0, 0], np.array(values.shape) - 1]
    spent = statistics.median(timed(lambda: to_dense(made, bounds=whole, device="cpu")) for _ in range(RUNS))
    row("to_dense", spent, "pyopenvdb copyToArray", statistics.median(theirs["times"][1]), "")


def against_points2ls(folder: Path) -> None:
    if not shutil.which("vdb_tool"):
        return
    mesh = inputs.bunny_of(190_000)
    points = np.asarray(mesh.vertices, np.float32)
    voxel = float((mesh.bounds[1] - mesh.bounds[0]).max()) / 256
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    with open(folder / "points.ply", "w", encoding="ascii") as file:
        file.write(header + "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n")
        np.savetxt(file, points, fmt="%.9g")
    base = ["vdb_tool", "-read", folder / "points.ply"]
    build = [*base, "-points2ls", f"voxel={voxel}", "radius=2", "width=3"]
    done = subprocess.run([*build, "-write", folder / "points.vdb"], capture_output=True, text=True)
    if done.returncode or not (folder / "points.vdb").exists():
        return

    def ours() -> Any:
        return from_points(points, 2.0 * voxel, voxel_size=voxel, device="cpu")

    made, other = ours(), load(folder / "points.vdb")
    there = other.info.index_bounds[0] * other.info.voxel_size + other.info.transform[:3, 3]
    shift = there / voxel - np.round(there / voxel)
    difference = "voxels lie elsewhere"
    if np.abs(shift).max() < 1e-3:
        box = made.info.index_bounds
        mine, their = (to_dense(v, bounds=box, device="cpu").values for v in (made, other))
        both = (np.abs(mine) < made.info.background) & (np.abs(their) < other.info.background * 0.999)
        difference = f"differs by up to {np.abs(mine - their)[both].max() / voxel:.2g} voxels"
    reading = statistics.median(timed(lambda: subprocess.run(base, capture_output=True)) for _ in range(3))
    mine, theirs = in_turn(ours, lambda: subprocess.run(build, capture_output=True))
    row(
        f"from_points, {len(points)} balls of 2 voxels",
        mine,
        "vdb_tool points2ls, less reading",
        theirs - reading,
        difference,
    )


def against_dense_evaluation(resolution: int) -> None:
    def ring(points: np.ndarray) -> np.ndarray:
        return np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.35, points[:, 2]) - 0.1

    bounds = np.array([[-0.5] * 3, [0.5] * 3])
    voxel = 1.0 / resolution
    index = np.arange(int(np.ceil(-0.5 / voxel)), int(np.floor(0.5 / voxel)) + 1)

    def dense() -> np.ndarray:
        out = np.empty((len(index),) * 3, np.float32)
        plane = np.stack(np.meshgrid(index, index, indexing="ij"), axis=-1).reshape(-1, 2) * voxel
        for i, x in enumerate(index):
            points = np.column_stack([np.full(len(plane), x * voxel), plane])
            out[i] = np.clip(ring(points), -3.0 * voxel, 3.0 * voxel).reshape(out.shape[1:])
        return out

    made = from_function(ring, bounds, voxel)
    found = to_dense(made, bounds=[[index[0]] * 3, [index[-1]] * 3], device="cpu").values
    mine, theirs = in_turn(lambda: from_function(ring, bounds, voxel), dense)
    row(
        f"from_function, {resolution}^3",
        mine,
        "NumPy at every voxel",
        theirs,
        f"same: {np.array_equal(found, dense())}",
    )


def memory_steps(resolution: int, folder: Path) -> dict[str, Callable[[], Callable[[], Any]]]:
    """As in benchmarks.volume_memory: by name, a function that prepares the inputs and returns the step itself."""

    def with_level_set(step: Callable[[Any], Any]) -> Callable[[], Callable[[], Any]]:
        def prepare() -> Callable[[], Any]:
            made = level_set(resolution)
            return lambda: step(made)

        return prepare

    def prepared_dense() -> Callable[[], Any]:
        box = to_dense(level_set(resolution), device="cpu")
        background = 3.0 * float(np.abs(box.transform[0, 0]))
        return lambda: from_dense(box.values, transform=box.transform, background=background, grid_class="level set")

    def prepared_points() -> Callable[[], Any]:
        mesh = inputs.bunny_of(190_000)
        voxel = float((mesh.bounds[1] - mesh.bounds[0]).max()) / resolution
        return lambda: from_points(mesh.vertices, 2.0 * voxel, voxel_size=voxel, device="cpu")

    def prepared_function() -> Callable[[], Any]:
        def ball(points: np.ndarray) -> np.ndarray:
            return np.linalg.norm(points, axis=1) - 0.45

        return lambda: from_function(ball, [[-0.5] * 3, [0.5] * 3], 1.0 / resolution)

    def written(made: Any) -> Path:
        save(folder / "out.nvdb", made, codec="zip")
        return folder / "out.nvdb"

    return {
        "from_dense": prepared_dense,
        "to_dense": with_level_set(lambda made: to_dense(made, device="cpu").values),
        "from_function": prepared_function,
        "from_points": prepared_points,
        "quantize fp8": with_level_set(lambda made: quantize(made, "fp8")),
        "quantize by tolerance": with_level_set(lambda made: quantize(made, tolerance=1e-3 * made.info.background)),
        "floats of fp8": lambda: (lambda small: lambda: quantize(small, "float"))(
            quantize(level_set(resolution), "fp8")
        ),
        "save with metadata": with_level_set(written),
    }


def memory(resolution: int) -> None:
    benchmark = importlib.import_module("benchmarks.volume_memory")
    context = benchmark.multiprocessing.get_context("spawn")
    print("| step | result MiB | peak MiB | allowed MiB | met |\n|---|---:|---:|---:|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in memory_steps(64, Path(folder)):
            mine, theirs = context.Pipe(duplex=False)
            process = context.Process(target=measured, args=(name, resolution, folder, theirs))
            process.start()
            theirs.close()
            size, peak = mine.recv()
            process.join()
            allowed = benchmark.FACTOR * size + benchmark.CONSTANT
            cells = " | ".join(f"{n / 2**20:.0f}" for n in (size, peak, allowed))
            print(f"| {name} | {cells} | {'met' if peak <= allowed else 'NOT met'} |", flush=True)


def measured(name: str, resolution: int, folder: str, pipe: Any) -> None:
    benchmark = importlib.import_module("benchmarks.volume_memory")
    memory_steps(64, Path(folder))[name]()()
    step = memory_steps(resolution, Path(folder))[name]()
    # Free the results of the preparation that the step does not use.
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak starts anew
    before = benchmark.held("VmRSS")
    result = step()
    pipe.send((benchmark.size_of(result), benchmark.held("VmHWM") - before))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--memory", action="store_true")
    arguments = parser.parse_args()
    if arguments.memory:
        memory(arguments.resolution)
        return
    volume = level_set(arguments.resolution)
    print(f"{processor_name()}; a level set of {arguments.resolution} voxels across, medians of {RUNS} runs\n")
    print("| task | geokit ms | peer | peer ms | ratio | answers |\n|---|---:|---|---:|---:|---|")
    with tempfile.TemporaryDirectory() as folder:
        against_nanovdb_convert(volume, Path(folder))
        against_pyopenvdb(volume, Path(folder))
        against_points2ls(Path(folder))
    against_dense_evaluation(arguments.resolution)
    sizes(volume)


if __name__ == "__main__":
    main()
