"""Small .vdb files, read by forks of a process that has OpenVDB ready; see geokit/formats/reader/server.py.

The worker program reads large ones: its limits of memory are tighter, and its results are not copied.
"""

from __future__ import annotations

import importlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.reader import process as reader_process
from geokit.native._failures import raise_failure

# Address space of Python, the libraries and their threads.
RESERVED_BYTES = 1 << 30
# NanoVDB's boundary.
ALIGNMENT = 32


def read(
    path: Path, names: list[str], time_limit: float, memory_limit: int
) -> tuple[dict[str, Any], list[NDArray[np.uint8]]]:
    """Descriptions of the file and its grids, and the buffers, which are to be checked.

    Raises:
        FileFormatError: The file is damaged, or reading it exceeded a limit.
        WorkerError: The process did not start, or was killed from outside.
        InputError, UnsupportedGridError: As :func:`geokit.native.read_vdb`.
    """
    request = reader_process.request_of(path, "grids", memory_limit, names)
    request["memory"] = memory_limit + RESERVED_BYTES
    facts, arrays = reader_process.ask(path, __name__, request, time_limit, "restore it from its source")
    if "error" in facts:
        raise_failure(facts["error"], str(path))
    return facts, [_aligned(array) for _, array in arrays]


def _aligned(array: NDArray[np.uint8]) -> NDArray[np.uint8]:
    room = np.empty(array.size + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    room[start : start + array.size] = array
    return room[start : start + array.size]


def prepare() -> None:
    """Load the extension."""
    importlib.import_module("geokit.native._bridge")


def read_grids(path: Path, names: list[str]) -> tuple[Any, list[tuple[str, NDArray[np.uint8]]]]:
    """What the process answers: the extension's JSON, which may hold an error, and the buffers."""
    extension = importlib.import_module("geokit.native._bridge")
    try:
        output, buffers = extension.read(os.fsencode(path), names)
    except extension.BridgeError as error:
        output, buffers = error.args[0], []
    return json.loads(output.decode("utf-8", "surrogateescape")), [("", buffer) for buffer in buffers]
