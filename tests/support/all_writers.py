"""Saves with every writer of geokit into one folder, and prints a line of JSON for each: for tests of failing disks.

Run as ``python -m tests.support.all_writers FOLDER HOW``. HOW is "limits" to write each file whole and then under
limits on the size of files, "vanished" to remove the folder before each save, or "plain". If a writer ends the
process, lines are missing. With HOW "killed NAME ...", only the writers of these names save again and again, and are
killed some time after a third save has begun.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from geokit import mesh, points, render, volume
from geokit.cli._results import deliver
from geokit.formats.blocks.points import KINDS
from geokit.formats.table import FORMATS, SPARSE
from tests.support.effort import of_all, spread

__all__ = ["OLD", "holds", "place", "writers"]

OLD = b"the old file"
SIDE = 80


def writers() -> dict[str, Callable[[Path], object]]:
    """Writers by the name of the file that they write; each writes more than 64 KiB."""
    rng = np.random.default_rng(7)
    cells = np.arange((SIDE - 1) * SIDE).reshape(SIDE - 1, SIDE)[:, :-1].ravel()
    faces = np.concatenate([cells[:, None] + [0, 1, SIDE], cells[:, None] + [1, SIDE + 1, SIDE]])
    surface = mesh.TriangleMesh(rng.random((SIDE * SIDE, 3)), faces)
    cloud = rng.random((10000, 3))
    grid = volume.from_dense(rng.random((32, 32, 32), np.float32), voxel_size=0.1, background=0.0)
    scan = Path(tempfile.mkdtemp()) / "scan.ply"
    atexit.register(shutil.rmtree, scan.parent)
    points.save(scan, cloud)
    found: dict[str, Callable[[Path], object]] = {}
    for kind, row in FORMATS.items():
        if "w" in row.mesh:
            found[f"mesh{kind}"] = lambda path: mesh.save(path, surface)
        if "w" in row.points:
            for encoding in row.encodings or (None,):
                name = f"points{encoding or ''}{kind}"
                found[name] = lambda path, encoding=encoding: points.save(path, cloud, encoding=encoding)
        if kind in KINDS:
            # Once with files beside the target, else into the target alone.
            size = 0.001 if kind == ".ply" else None
            found[f"processed{kind}"] = lambda path, size=size: points.process_file(scan, path, voxel_size=size)
        # A USD stage has a second file of its own writer, .vdb.
        if "w" in row.volume and kind not in (".usd", ".usda", ".usdc"):
            own = "zip" if kind in (".nii.gz", ".zarr") else "none"
            codecs = ("none", "zip", "blosc") if kind in SPARSE else (own,)
            for codec in codecs:
                found[f"volume_{codec}{kind}"] = lambda path, codec=codec: volume.save(path, grid, codec=codec)
    found["figure.png"] = lambda path: render.image(path, rng.random((300, 400)))
    found["answers.npz"] = lambda path: deliver(cloud, {}, {}, path, json=False)
    found["answers.csv"] = lambda path: deliver(cloud, {}, {}, path, json=False)
    return found


def parts(target: Path) -> list[Path]:
    """The files that a writer makes: a .zarr is a folder, an .mhd has a second file."""
    if target.suffix == ".mhd":
        return [target, target.with_suffix(".raw")]
    return [target / ".zgroup"] if target.suffix == ".zarr" else [target]


def _content(part: Path, content: bytes) -> bytes:
    """An .mhd names the file with its voxels, which would be another's otherwise."""
    return content + f"\nElementDataFile = {part.stem}.raw\n".encode() if part.suffix == ".mhd" else content


def place(target: Path, content: bytes) -> None:
    """Put a file, or what stands for one, where a writer will write."""
    shutil.rmtree(target, ignore_errors=True)
    for part in parts(target):
        part.parent.mkdir(exist_ok=True)
        part.write_bytes(_content(part, content))


def holds(target: Path, content: bytes) -> bool:
    """Whether that is there still, and nothing more."""
    more = [path for path in target.rglob("*") if path.name != ".zgroup"] if target.is_dir() else []
    return not more and all(part.is_file() and part.read_bytes() == _content(part, content) for part in parts(target))


def _report(name: str, target: Path, limit: int | None, known: set[str], write: Callable[[Path], object]) -> None:
    try:
        write(target)
        outcome = "written"
    except Exception as error:
        outcome = f"{type(error).__name__}: {error}"
    kept = holds(target, OLD)
    left = [path.name for path in target.parent.iterdir() if path.name not in known] if target.parent.is_dir() else []
    print(json.dumps({"name": name, "limit": limit, "outcome": outcome, "kept": kept, "left": left}), flush=True)


def _main(folder: Path, how: str) -> None:
    listed = writers()
    known = {part.relative_to(folder).parts[0] for name in listed for part in parts(folder / name)}
    # Of what a format does not hold.
    warnings.simplefilter("ignore")
    for name, write in listed.items():
        target = folder / name
        if how == "vanished":
            shutil.rmtree(folder, ignore_errors=True)
        if how != "limits":
            _report(name, target, None, known, write)
            continue
        with contextlib.redirect_stdout(None):
            write(target)
        written = target.rglob("*") if target.is_dir() else parts(target)
        size = max(path.stat().st_size for path in written)
        place(target, OLD)
        # A .3mf holds random identifiers, a .usdz names of files and padding, and pictures are rendered anew: sizes
        # differ from save to save.
        least = {".3mf": 64, ".usdz": 1024, ".png": 1 << 14}.get(target.suffix, 1)
        for limit in of_all((0, 4096, size - least), (0, 1, 4096, size // 2, size - 4096, size - least)):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            _report(name, target, limit, known, write)
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def _sizes(target: Path) -> list[tuple[str, int]]:
    files = sorted(target.rglob("*")) if target.is_dir() else [target]
    return [(str(file.relative_to(target)), file.stat().st_size) for file in files]


def _ended(process: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def _save(write: Callable[[Path], object], target: Path) -> None:
    """Once, in a fork: a process that has written is not forked."""
    if not (process := os.fork()):
        write(target)
        os._exit(0)
    assert _ended(process) == 0


def _kill(target: Path, write: Callable[[Path], object]) -> None:
    _save(write, target)
    whole = _sizes(target)
    for round_ in spread(range(6), 3):
        begun, say = os.pipe()
        if not (process := os.fork()):
            while True:
                os.write(say, b".")
                write(target)
        os.close(say)
        for _ in range(3):
            os.read(begun, 1)
        os.close(begun)
        time.sleep(0.004 * round_)
        os.kill(process, signal.SIGKILL)
        code, kept = _ended(process), _sizes(target) == whole
        _save(write, target)
        line = {"name": target.name, "ended": code, "kept": kept, "left": os.listdir(target.parent)}
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    if sys.argv[2] == "killed":
        made = writers()
        for name in sys.argv[3:]:
            of_name = Path(sys.argv[1], f"of {name}")
            of_name.mkdir()
            _kill(of_name / name, made[name])
    else:
        _main(Path(sys.argv[1]), sys.argv[2])
