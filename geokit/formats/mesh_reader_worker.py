"""The other end of :mod:`geokit.formats.mesh_reader_process`: reads one file and writes its bodies to standard output.

Standard library only, so that the reader's own library is all that the process waits for.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import resource
import sys
from typing import Any, NamedTuple

__all__ = ["Refusal", "WireBody", "main"]


class Refusal(Exception):
    """A sentence about the file for the user: what is wrong and what to do."""


class WireBody(NamedTuple):
    """A body as plain buffers; ``arrays`` are (NumPy dtype, bytes) of points, counts and indices."""

    name: str
    arrays: tuple[tuple[str, bytes], tuple[str, bytes], tuple[str, bytes]]
    transform: list[float] | None = None
    clockwise: bool = False


def main() -> None:
    """Arguments: the root of the package, the reader's name, the file, the limit of address space in bytes."""
    _, reader, path, limit = sys.argv[1:]
    # What libraries print must not mix with the answer, in Python or below it.
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (int(limit), resource.RLIM_INFINITY))
    bodies: list[WireBody] = []
    try:
        bodies = importlib.import_module(f"geokit.formats.read_{reader}").read(path)
        header: dict[str, Any] = {"bodies": [_header(body) for body in bodies]}
    except Refusal as refusal:
        header = {"error": str(refusal)}
    except ImportError as error:
        header = {"missing": str(error)}
    except MemoryError:
        header = {"error": "needs more memory than its size explains; the file is damaged, export it again"}
    except (Exception, SystemExit) as error:
        reason = re.sub(r"\s+", " ", f"{type(error).__name__}: {error}").strip()[:300]
        header = {"error": f"cannot be read ({reason}); the file is damaged or not what its name says, export it again"}
    answer.write(json.dumps(header).encode() + b"\n")
    for body in bodies if "bodies" in header else ():
        for _, data in body.arrays:
            answer.write(data)
    answer.flush()
    # Some libraries crash in their own teardown after reading a damaged file, when the answer is already given.
    os._exit(0)


def _header(body: WireBody) -> dict[str, Any]:
    return {
        "name": body.name,
        "transform": body.transform,
        "clockwise": body.clockwise,
        "arrays": [[dtype, len(data) // int(dtype[-1])] for dtype, data in body.arrays],
    }
