"""Mesh files that other libraries read, read in a process of their own.

Those readers were written for files that are sound: on damaged ones some hang, some end the process, some crash it,
and most print. Behind a process with a time and a memory limit each of these is one named error, and the user's
process neither waits for their imports nor keeps them in memory.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from geokit.errors import FileFormatError, MissingDependencyError
from geokit.formats.polygons import Body

__all__ = ["read_in_process"]

# A start plus a generous share for each megabyte: the slowest reader (ASCII .msh) takes 0.4 s for one.
_BASE_SECONDS = 30.0
_SECONDS_PER_MEGABYTE = 2.0
# Address space, not resident memory: the libraries alone map 2 GiB. Compressed files grow up to about a hundredfold.
_BASE_BYTES = 6 << 30
_BYTES_PER_BYTE = 100

# The first entry of sys.path is the working folder here: the user's files must not shadow modules.
_START = "import sys; sys.path[0] = sys.argv[1]; from geokit.formats.mesh_reader_worker import main; main()"


def read_in_process(path: Path, reader: str) -> list[Body]:
    """Bodies of a file, read by ``geokit.formats.read_<reader>`` in a new process.

    Raises:
        FileFormatError: The reader refused the file, crashed, or went past its time or memory limit.
        MissingDependencyError: The reader's library is not installed.
    """
    size = path.stat().st_size
    seconds = _BASE_SECONDS + _SECONDS_PER_MEGABYTE * size / 1e6
    memory = _BASE_BYTES + _BYTES_PER_BYTE * size
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", _START, str(root), reader, str(path.resolve()), str(memory)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds, env=environment)
    except subprocess.TimeoutExpired:
        raise FileFormatError(
            f"{path}: not read after {seconds:.0f} s, its reader was stopped; the file is damaged, export it again"
        ) from None
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        raise FileFormatError(f"{path}: crashed its reader ({name}); the file is damaged, export it again")
    header, _, payload = done.stdout.partition(b"\n")
    try:
        answer = json.loads(header)
    except ValueError:
        last = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:] or ["no message"]
        raise FileFormatError(f"{path}: its reader ended without an answer ({last[0]}); export it again") from None
    if "missing" in answer:
        raise MissingDependencyError(answer["missing"])
    if "error" in answer:
        raise FileFormatError(f"{path}: {answer['error']}")
    return _bodies(answer["bodies"], memoryview(payload))


def _bodies(headers: list[dict[str, Any]], payload: memoryview) -> list[Body]:
    bodies, at = [], 0
    for header in headers:
        arrays = []
        for dtype, count in header["arrays"]:
            arrays.append(np.frombuffer(payload, dtype, count, at))
            at += arrays[-1].nbytes
        points, counts, indices = arrays
        matrix = header["transform"]
        bodies.append(
            Body(
                points.reshape(-1, 3),
                counts,
                indices,
                name=header["name"],
                transform=None if matrix is None else np.asarray(matrix, np.float64).reshape(4, 4),
                clockwise=header["clockwise"],
            )
        )
    return bodies
