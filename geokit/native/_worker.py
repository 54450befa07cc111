"""Runs the worker process that reads untrusted .vdb files."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.base.interrupts import child_process
from geokit.core.base.private_folder import temporary_parent
from geokit.core.base.system import limits
from geokit.errors import FileAccessError, FileFormatError
from geokit.formats.reader.process import FROM_OUTSIDE, killed
from geokit.formats.reader.server import status_name
from geokit.native._metadata import raw

# A compressed .vdb becomes a NanoVDB buffer several times its size. If shared memory has less than this times the file
# size free, the buffers go through a folder on disk from the start.
_EXPANSION = 8

# The kernel's CPU time limit is a second line of defense behind the wall clock. It counts all threads, so it must allow
# for a run that keeps this many of them busy.
_MAX_THREADS = 8

# Version of the format that OpenVDB 13 writes: that of OpenVDB 10 with one more type of grids, which names itself.
LAST_VERSION = 225
_MAGIC = b" BDV\0\0\0\0"


def warn_of_version(path: Path) -> None:
    """Warn of a file whose format has a later version than those known, which is read as if it had the last of them."""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        head = file.read(len(_MAGIC) + 4)
        version = int.from_bytes(head[len(_MAGIC) :], "little")
        if head.startswith(_MAGIC) and version > LAST_VERSION:
            warn(
                f"{path}: its format has version {version}, {LAST_VERSION} is the last that geokit knows; compare what "
                "is read with the program that wrote it, or save it with an older OpenVDB"
            )


def spool_folders(file_size: int) -> list[str]:
    """Parent folders for the worker's results, best first: shared memory if it has room, then the temporary folder."""
    folders = [temporary_parent()]
    with contextlib.suppress(OSError):
        if shutil.disk_usage("/dev/shm").free > _EXPANSION * file_size and os.access("/dev/shm", os.W_OK):
            folders.insert(0, "/dev/shm")
    return folders


def map_file(path: str, size: int) -> NDArray[np.uint8]:
    """Map a file into memory without a copy; the bytes stay valid when the file is deleted."""
    with open(path, "r+b") as file:
        return np.frombuffer(mmap.mmap(file.fileno(), size), dtype=np.uint8)


def refuse_small_files(path: Path, memory_limit: int) -> None:
    """Refuse a file whose voxels did not fit into a file, if the worker may write no larger ones.

    Raises:
        FileAccessError: The system's limit on the size of files is below the worker's own.
    """
    soft, hard = limits("FSIZE")
    if hard < memory_limit:
        raise FileAccessError(
            f"{path}: its voxels go through a file, which may have no more than {soft} bytes here (ulimit -f); raise "
            "that limit, or pass trusted=True for a file you trust"
        )


def run_worker(
    worker: Path, verb: str, path: Path, arguments: Sequence[str], *, time_limit: float, memory_limit: int
) -> dict[str, Any]:
    """Run the worker and return its JSON, which may hold an error.

    Raises:
        FileFormatError: The worker crashed, timed out, or wrote anything but JSON.
        WorkerError: It was killed from outside.
    """
    cpu_seconds = int(time_limit * min(os.cpu_count() or 1, _MAX_THREADS)) + 2
    command: list[str | bytes] = [str(worker), verb, str(memory_limit), str(cpu_seconds), os.fsencode(path)]
    with child_process(
        command + [raw(argument) for argument in arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            output, _ = process.communicate(timeout=time_limit)
        except subprocess.TimeoutExpired:
            raise FileFormatError(
                f"{path}: reading took more than {time_limit:g} s and was stopped; the file is damaged, or pass a "
                "larger time_limit"
            ) from None
    return _parse(path, output, process.returncode)


def _parse(path: Path, output: bytes, status: int) -> dict[str, Any]:
    if status in (0, 1):
        with contextlib.suppress(ValueError):
            result = json.loads(output.decode("utf-8", "surrogateescape"))
            if isinstance(result, dict) and ("grids" in result if status == 0 else "error" in result):
                return result
    name = status_name(status)
    if name in FROM_OUTSIDE:
        raise killed(path, name)
    what = f"signal {name}" if status < 0 else name
    raise FileFormatError(
        f"{path}: damaged: OpenVDB crashed on it, in a separate process ({what}); restore the file from its source"
    )
