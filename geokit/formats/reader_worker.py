"""Worker of :mod:`geokit.formats.reader_process`: reads one file and writes its content to standard output.

The output is a line of JSON, then the bytes of the arrays that it lists. Standard library only, so that the process
waits for no import other than the reader's own library.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import resource
import sys
from pathlib import Path
from typing import Any

from geokit.errors import FileFormatError
from geokit.formats.body import Body

__all__ = ["main"]

Named = list[tuple[str, Any]]

# Type codes of the struct module, which buffers use, mapped to NumPy's code of the kind.
_KINDS = {**dict.fromkeys("efd", "f"), **dict.fromkeys("bhilqn", "i"), **dict.fromkeys("BHILQN", "u"), "?": "b"}


def main() -> None:
    """Arguments: root of the package, module, "mesh" or "points", the file, the limit of address space in bytes."""
    _, module, content, path, limit = sys.argv[1:]
    # Output that libraries print must not mix with the result, neither from Python nor from below it.
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (int(limit), resource.RLIM_INFINITY))
    buffers: list[Any] = []
    try:
        reader = importlib.import_module(f"geokit.formats.{module}")
        if content == "mesh":
            facts, arrays = _mesh(reader.read_mesh(Path(path)))
        else:
            facts, arrays = _points(*reader.read_points(Path(path)))
        listed = []
        for name, array in arrays:
            kind, shape, buffer = _described(array)
            listed.append((name, kind, shape))
            buffers.append(buffer)
        head: dict[str, Any] = {"facts": facts, "arrays": listed}
    except FileFormatError as error:
        head = {"error": str(error).removeprefix(f"{path}: ")}
    except ImportError as error:
        head = {"missing": str(error)}
    except MemoryError:
        head = {"memory": True}
    except (Exception, SystemExit) as error:
        head = {"reason": re.sub(r"\s+", " ", f"{type(error).__name__}: {error}").strip()[:300]}
    answer.write(json.dumps(head).encode() + b"\n")
    for buffer in buffers if "arrays" in head else ():
        answer.write(buffer)
    answer.flush()
    # Some libraries crash in their own teardown after reading a damaged file, when the result is already written.
    os._exit(0)


def _mesh(bodies: list[Body]) -> tuple[Any, Named]:
    facts: list[dict[str, Any]] = []
    arrays: Named = []
    for body in bodies:
        matrix = None if body.transform is None else [list(map(float, row)) for row in body.transform]
        facts.append({"name": body.name, "transform": matrix, "clockwise": bool(body.clockwise), "groups": body.groups})
        arrays += [("points", body.points), ("counts", body.counts), ("indices", body.indices)]
    return facts, arrays


def _points(points: Any, data: dict[str, Any]) -> tuple[Any, Named]:
    return None, [("", points), *data.items()]


def _described(array: Any) -> tuple[str, tuple[int, ...], Any]:
    """NumPy's name of the type, the shape, and the bytes in C order."""
    view = memoryview(array)
    # For NumPy arrays the dtype says more than the buffer's format.
    kind: str = array.dtype.str if hasattr(array, "dtype") else f"{_KINDS[view.format[-1]]}{view.itemsize}"
    return kind, tuple(view.shape or ()), view if view.c_contiguous else view.tobytes()
