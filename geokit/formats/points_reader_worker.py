"""Worker process of :mod:`geokit.formats.points_reader_process`: reads one file, writes its arrays to stdout."""

from __future__ import annotations

import importlib
import json
import os
import resource
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError

__all__ = ["main"]


def main() -> None:
    """The other end. Arguments: the root of the package, the reader, the file, the limit of address space in bytes."""
    _, reader, path, limit = sys.argv[1:]
    # What libraries print must not mix with the answer, in Python or below it.
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (int(limit), resource.RLIM_INFINITY))
    arrays: dict[str, NDArray[np.generic]] = {}
    try:
        points, data = importlib.import_module(f"geokit.formats.{reader}").read_here(Path(path))
        arrays = {"": points, **data}
        head: dict[str, object] = {"arrays": [(name, array.dtype.str, array.shape) for name, array in arrays.items()]}
    except FileFormatError as error:
        head = {"error": str(error).removeprefix(f"{path}: ")}
    except MemoryError:
        head = {"error": "needs more memory than its size explains; it is damaged, get a whole copy"}
    answer.write(json.dumps(head).encode() + b"\n")
    for array in arrays.values():
        answer.write(np.ascontiguousarray(array).data)
    answer.flush()
    # A library may crash in its own teardown after a damaged file, when the answer is already given.
    os._exit(0)
