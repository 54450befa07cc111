"""Converts many files in one ``geokit convert`` and watches the process.

``python -m tests.support.limits.long_runs 10000``

Prints as JSON how far its memory grew after the first tenth, and what it had open or left behind.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.catalog.mesh_catalog import icosphere, moved
from geokit.core.base.private_folder import LOCK
from geokit.mesh import save

__all__ = ["convert_many"]

# Formats that geokit reads itself, and one that a worker process reads: every hundredth file.
KINDS, FOREIGN = ("obj", "stl", "off"), "glb"
STRAY = (Path("/dev/shm"), Path(tempfile.gettempdir()))
WATCH_SECONDS = 0.2


def convert_many(count: int, folder: Path, *, jobs: int = 1) -> dict[str, Any]:
    """Convert ``count`` files in ``folder``; every hundredth is damaged, another is read by a worker.

    Returns:
        Exit code, files made, resident memory after a tenth of the files and at most later [bytes], open files after a
        tenth and at the end, child processes at most, and what is left: processes, shared memory, temporary files.
    """
    sources = list(_written(count, folder))
    out = folder / "out"
    before = _strays()
    command = [sys.executable, "-m", "geokit", "convert", *map(str, sources)]
    command += ["--out-dir", str(out), "--to", "ply", "--jobs", str(jobs)]
    with open(folder / "said", "wb") as said:
        process = subprocess.Popen(command, stdout=said, stderr=said)
        seen: list[tuple[int, int, int, set[int]]] = []
        while process.poll() is None:
            with contextlib.suppress(OSError, ValueError):
                done = len(os.listdir(out)) if out.is_dir() else 0
                seen.append((done, _resident(process.pid), _open_files(process.pid), _children(process.pid)))
            time.sleep(WATCH_SECONDS)
    warm = [row for row in seen if row[0] >= count / 10]
    workers: set[int] = set().union(*(row[3] for row in seen))
    return {
        "exit": process.returncode,
        "made": len(os.listdir(out)),
        "warm_bytes": warm[0][1],
        "most_bytes": max(row[1] for row in warm),
        "last_bytes": warm[-1][1],
        "open_files": [warm[0][2], max(row[2] for row in warm)],
        "most_children": max(len(row[3]) for row in seen),
        "workers": len(workers),
        "left_processes": sorted(worker for worker in workers if Path(f"/proc/{worker}").exists()),
        "left_files": sorted(_strays() - before),
    }


def _written(count: int, folder: Path) -> list[Path]:
    first = {}
    for kind in (*KINDS, FOREIGN):
        first[kind] = folder / f"first.{kind}"
        save(first[kind], moved(icosphere(2), (1.0, 2.0, 3.0)))
    made = []
    for number in range(count):
        kind = FOREIGN if number % 100 == 50 else KINDS[number % len(KINDS)]
        content = first[kind].read_bytes()
        path = folder / f"file{number}.{kind}"
        path.write_bytes(content[: len(content) // 2] if number % 100 == 99 else content)
        made.append(path)
    return made


def _strays() -> set[str]:
    """Folders of geokit that no living process has locked."""
    return {str(path) for folder in STRAY for path in folder.glob(".geokit*") if not _is_in_use(path)}


def _is_in_use(path: Path) -> bool:
    try:
        lock = os.open(path / LOCK, os.O_RDWR)
    except OSError:
        return True  # removed meanwhile
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(lock)
    return False


def _resident(process: int) -> int:
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _open_files(process: int) -> int:
    return len(os.listdir(f"/proc/{process}/fd"))


def _children(process: int) -> set[int]:
    found: set[int] = set()
    for other in filter(str.isdecimal, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            parent = Path(f"/proc/{other}/stat").read_text(errors="replace").rpartition(")")[2].split()[1]
            if int(parent) == process:
                found.add(int(other))
    return found


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        print(json.dumps(convert_many(int(sys.argv[1]), Path(place), jobs=int((sys.argv[2:] or ["1"])[0]))))
