"""Reading files with other libraries, in a separate process.

Those libraries expect valid files. On damaged ones some hang, some exit or crash the process, some allocate whatever
size the file claims, and most print. A process with a time limit and a memory limit turns each of these into one named
error, and the user's process neither waits for the imports nor keeps the libraries in memory.
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
from numpy.typing import NDArray

from geokit.errors import FileFormatError, MissingDependencyError
from geokit.formats.body import Body

__all__ = ["read_mesh", "read_points"]

# A start-up time plus a generous time per megabyte: the slowest reader (ASCII .msh) takes 0.4 s for one.
BASE_SECONDS = 30.0
SECONDS_PER_MEGABYTE = 2.0
# Address space, not resident memory: the libraries and their threads alone map 2 GiB.
MESH_BYTES = 6 << 30
POINT_BYTES = 4 << 30
# Compressed mesh files expand up to about a hundredfold.
MESH_GROWTH = 100
# The content of a point file, the same amount again in columns, and another copy in the output.
POINT_COPIES = 4

# The first entry of sys.path is the working folder here, and the user's files must not shadow modules.
_START = "import sys; sys.path[0] = sys.argv[1]; from geokit.formats.reader_worker import main; main()"

Named = list[tuple[str, NDArray[Any]]]


def read_mesh(path: Path, module: str) -> list[Body]:
    """Run ``geokit.formats.<module>.read_mesh(path)`` in a new process and return its bodies.

    Raises:
        FileFormatError: The reader rejected the file, crashed, or exceeded its time or memory limit.
        MissingDependencyError: The reader's library is not installed.
    """
    memory = MESH_BYTES + MESH_GROWTH * path.stat().st_size
    facts, arrays = _read(path, module, "mesh", memory, "export it again")
    bodies = []
    for at, fact in enumerate(facts):
        (_, points), (_, counts), (_, indices) = arrays[3 * at : 3 * at + 3]
        matrix = None if fact["transform"] is None else np.asarray(fact["transform"], np.float64)
        groups = tuple((name, first, count) for name, first, count in fact["groups"])
        bodies.append(
            Body(points.reshape(-1, 3), counts, indices.ravel(), fact["name"], matrix, fact["clockwise"], groups)
        )
    return bodies


def read_points(
    path: Path, module: str, content_bytes: int
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]]:
    """Run ``geokit.formats.<module>.read_points(path)`` in a new process and return its points and arrays.

    Args:
        path: The file.
        module: Name of the module that reads it.
        content_bytes: Upper bound of the content's size in bytes.
    Raises:
        FileFormatError: The reader rejected the file, crashed, or exceeded its time or memory limit.
        MissingDependencyError: The reader's library is not installed.
    """
    memory = POINT_BYTES + POINT_COPIES * content_bytes
    _, arrays = _read(path, module, "points", memory, "get a whole copy")
    (_, points), *data = arrays
    return points, dict(data)


def _read(path: Path, module: str, content: str, memory: int, advice: str) -> tuple[Any, Named]:
    """Output of the process: its JSON object, and arrays by name, in order."""
    seconds = BASE_SECONDS + SECONDS_PER_MEGABYTE * path.stat().st_size / 1e6
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", _START, str(root), module, content, str(path.resolve()), str(memory)]
    # Backtraces of libraries in Rust take seconds to write and are never shown, so they are turned off.
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry),
        "RUST_BACKTRACE": "0",
    }
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds, env=environment)
    except subprocess.TimeoutExpired:
        raise FileFormatError(
            f"{path}: not read after {seconds:.0f} s, its reader was stopped; the file is damaged, {advice}"
        ) from None
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        raise FileFormatError(f"{path}: crashed its reader ({name}); the file is damaged, {advice}")
    head, _, payload = done.stdout.partition(b"\n")
    try:
        answer = json.loads(head)
    except ValueError:
        last = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:] or ["no message"]
        raise FileFormatError(f"{path}: its reader ended without an answer ({last[0][:200]}); {advice}") from None
    if "missing" in answer:
        raise MissingDependencyError(answer["missing"])
    if "error" in answer:
        raise FileFormatError(f"{path}: {answer['error']}")
    if "memory" in answer:
        raise FileFormatError(f"{path}: needs more memory than its size explains; the file is damaged, {advice}")
    if "reason" in answer:
        raise FileFormatError(
            f"{path}: cannot be read ({answer['reason']}); the file is damaged or not what its name says, {advice}"
        )
    return answer["facts"], _arrays(answer["arrays"], memoryview(payload))


def _arrays(listed: list[Any], payload: memoryview) -> Named:
    arrays, at = [], 0
    for name, kind, shape in listed:
        array = np.frombuffer(payload, kind, int(np.prod(shape)), at).reshape(shape)
        at += array.nbytes
        arrays.append((name, array))
    return arrays
