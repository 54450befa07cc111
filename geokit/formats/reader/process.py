"""Reading files with other libraries, in a separate process.

Those libraries expect valid files. On damaged ones some hang, some exit or crash the process, some allocate whatever
size the file claims, and most print. A process with a time limit and a memory limit turns each of these into one named
error. Each file has a process of its own, a fork of one that has the library ready; see server.py.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import in_one_line
from geokit.core.memory.available_memory import available_host
from geokit.errors import FileAccessError, FileFormatError, GeokitError, MissingDependencyError, WorkerError
from geokit.formats.file_content.body import Body, FileMaterial
from geokit.formats.reader import server as reader_server
from geokit.formats.reader.warnings import warn_of
from geokit.formats.reader.worker import DATA, HEAD_SIZE

# The process has its libraries ready; the slowest reader (ASCII .msh) takes 0.4 s for a megabyte.
BASE_SECONDS = 15.0
SECONDS_PER_MEGABYTE = 2.0
# Address space, not resident memory: the libraries and their threads alone map 2 GiB.
LIBRARY_BYTES = 4 << 30
# The content of a file, the same amount again in columns, and copies in the library and in the output.
COPIES = 4

# Answers without arrays are no longer than this, whatever the limit.
LONGEST_ERROR = 1 << 16

# Signals that no reader gets for what it does: those of the system when memory runs out, of users, of batch systems.
FROM_OUTSIDE = {"SIGKILL", "SIGTERM", "SIGINT", "SIGHUP"}

Named = list[tuple[str, NDArray[Any]]]


def read_mesh(
    path: Path, module: str, limit: int, folders: Sequence[Path] | None, options: Mapping[str, float] | None = None
) -> list[Body]:
    """Run ``read_mesh(path)`` of a module in a new process and return its bodies.

    Args:
        path: The file.
        module: Full name of the module that reads it.
        limit: Largest size of the content in bytes.
        folders: Folders of referenced files besides the file's own; None if the module takes none.
        options: ``tolerance`` of curved faces, number of the time ``step``; those that are given.
    Raises:
        FileAccessError: The file refers to one outside these folders.
        FileFormatError: The reader rejected the file, crashed, or exceeded its time or memory limit.
        MissingDependencyError: The reader's library is not installed.
        WorkerError: The process did not start, or was killed from outside.
    """
    request = request_of(path, "mesh", limit, None if folders is None else [str(folder) for folder in folders])
    request["options"] = dict(options or {})
    facts, arrays = ask(path, module, request, reading_seconds(path), "export it again")
    bodies, rest = [], iter(arrays)
    for fact in facts:
        (_, points), (_, counts), (_, indices) = (next(rest) for _ in range(3))
        fact |= {"points": points.reshape(-1, 3), "counts": counts, "indices": indices.ravel()}
        fact |= {kind: dict(next(rest) for _ in range(fact[kind])) for kind in DATA}
        fact["materials"] = tuple(
            FileMaterial(name, color and tuple(color), image, bytes(next(rest)[1]), cutoff)
            for name, color, image, cutoff in fact["materials"]
        )
        if fact["transform"] is not None:
            fact["transform"] = np.asarray(fact["transform"], np.float64)
        fact |= {"groups": tuple(map(tuple, fact["groups"])), "notes": tuple(fact["notes"])}
        bodies.append(Body(**fact))
    return bodies


def read_points(path: Path, module: str, limit: int) -> tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]]:
    """Run ``read_points(path)`` of a module in a new process and return its points and arrays.

    Args:
        path: The file.
        module: Full name of the module that reads it.
        limit: Largest size of the content in bytes.
    Raises:
        FileFormatError: The reader rejected the file, crashed, or exceeded its time or memory limit.
        MissingDependencyError: The reader's library is not installed.
        WorkerError: The process did not start, or was killed from outside.
    """
    request = request_of(path, "points", limit)
    _, arrays = ask(path, module, request, reading_seconds(path), "get a whole copy")
    (_, points), *data = arrays
    return points, dict(data)


def read_grids(path: Path, module: str, limit: int, names: list[str]) -> tuple[Any, Named]:
    """Run ``read_grids(path, names)`` of a module in a new process.

    Args:
        path: The file.
        module: Full name of the module that reads it.
        limit: Largest size of the content in bytes.
        names: What the module is to read.
    Returns:
        What the module says of the content, and arrays by name, in order.
    Raises:
        FileAccessError, FileFormatError, MissingDependencyError, WorkerError: As :func:`read_mesh`.
    """
    return ask(path, module, request_of(path, "grids", limit, names), reading_seconds(path), "export it again")


def reading_seconds(path: Path) -> float:
    """How long a file may take to read: its reader is stopped then."""
    return BASE_SECONDS + SECONDS_PER_MEGABYTE * path.stat().st_size / 1e6


def request_of(path: Path, content: str, limit: int, names: list[str] | None = None) -> dict[str, Any]:
    """What :func:`ask` takes, with the memory that libraries need."""
    memory = LIBRARY_BYTES + min(COPIES * limit, available_host())
    return {"content": content, "path": str(path.resolve()), "names": names, "limit": limit, "memory": memory}


def ask(path: Path, module: str, request: dict[str, Any], seconds: float, advice: str) -> tuple[Any, Named]:
    """Have a module read a file in a new process.

    Args:
        path: The file, for messages.
        module: Full name of the module.
        request: What :class:`geokit.formats.reader.worker.Request` holds, but for the time and the environment.
        seconds: Time that it may take.
        advice: What to do about a damaged file.
    Returns:
        What the module says of the content, and arrays by name, in order.
    Raises:
        FileAccessError, FileFormatError, MissingDependencyError, WorkerError: As :func:`read_mesh`.
    """
    if not hasattr(os, "fork"):
        raise WorkerError(
            f"{path}: is read in a fork of a process, which this system does not make; pass trusted=True to read it in "
            "this one, if you trust the file"
        )
    limit = request["limit"]
    too_late = f"{path}: not read after {seconds:.0f} s, its reader was stopped; the file is damaged, {advice}"
    too_large = FileFormatError(
        f"{path}: needs more memory than its size explains ({limit / 2**30:.3g} GiB); the file is "
        f"damaged, {advice}, or raise memory_limit (--memory-limit)"
    )
    try:
        with reader_server.exchange(module, request, seconds) as found:
            # A damaged file may have changed what the process says, so the sizes are checked here too.
            (size,) = HEAD_SIZE.unpack(found.receive(HEAD_SIZE.size).tobytes())
            if size > limit + LONGEST_ERROR:
                raise too_large
            answer = json.loads(found.receive(size).tobytes())
            if "arrays" in answer:
                need = sum(np.dtype(kind).itemsize * math.prod(shape) for _, kind, shape in answer["arrays"])
                if need > limit:
                    raise too_large
                arrays = _arrays(answer["arrays"], found.receive(need))
    except reader_server.TimeExpired:
        raise FileFormatError(too_late) from None
    except reader_server.Ended as end:
        raise _ended(path, end, too_late, advice) from None
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise FileFormatError(f"{path}: its reader gave a wrong answer ({error}); {advice}") from None
    if "arrays" in answer:
        warn_of(path, map(str, answer.get("warnings", ())))
        return answer["facts"], arrays
    if "missing" in answer:
        raise MissingDependencyError(answer["missing"])
    if "access" in answer:
        raise FileAccessError(f"{path}: {in_one_line(answer['access'], LONGEST_ERROR)}")
    if "error" in answer:
        raise FileFormatError(f"{path}: {in_one_line(answer['error'], LONGEST_ERROR)}")
    if "memory" in answer:
        raise too_large
    reason = in_one_line(str(answer.get("reason")))
    raise FileFormatError(f"{path}: cannot be read ({reason}); the file is damaged or not what its name says, {advice}")


def killed(path: Path, name: str) -> WorkerError:
    """The error of a process that a signal of FROM_OUTSIDE ended."""
    return WorkerError(
        f"{path}: the process that reads it was killed from outside ({name}), perhaps for want of memory; read the "
        "file again"
    )


def _ended(path: Path, end: reader_server.Ended, too_late: str, advice: str) -> GeokitError:
    """What it means that the process ended before its answer was complete."""
    if isinstance(end.reason, int):
        name = reader_server.status_name(end.reason)
    else:
        name = end.reason or "its server was killed"
    if not end.started:
        return WorkerError(
            f"{path}: the process that reads it did not start ({name}); free memory, or raise its limits (ulimit -a), "
            "and read the file again"
        )
    if not isinstance(end.reason, int) or name in FROM_OUTSIDE:
        return killed(path, name)
    if name == "SIGALRM":
        return FileFormatError(too_late)
    if end.reason < 0:
        return FileFormatError(f"{path}: crashed its reader ({name}); the file is damaged, {advice}")
    return FileFormatError(f"{path}: its reader ended without an answer ({name}); {advice}")


def _arrays(listed: list[Any], payload: NDArray[np.uint8]) -> Named:
    payload.flags.writeable = False
    arrays, at = [], 0
    for name, kind, shape in listed:
        array = np.frombuffer(payload, kind, math.prod(shape), at).reshape(shape)
        at += array.nbytes
        arrays.append((name, array))
    return arrays
