"""Point files that other libraries read (.vtp, .laz), read in a process of their own.

VTK and the decompressor of .laz take sizes in a damaged file at their word, and end the process when memory for them
cannot be had. Behind a process with a time and a memory limit that is one named error.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError

__all__ = ["read_in_process"]

# A start, and a generous share for each megabyte of the file, ten of content where it is compressed.
BASE_SECONDS = 30.0
SECONDS_PER_MEGABYTE = 2.0
# Address space, not resident memory: the libraries and their threads map 2 GiB.
BASE_BYTES = 4 << 30
# The content, as many bytes again in columns, and once more on their way out.
COPIES = 4

# The first entry of sys.path is the working folder here: the user's files must not shadow modules.
_START = "import sys; sys.path[0] = sys.argv[1]; from geokit.formats.points_reader_worker import main; main()"


def read_in_process(
    path: Path, reader: str, plain_bytes: int
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]]:
    """Points and arrays as ``geokit.formats.<reader>.read_here(path)`` returns them, from a new process.

    Args:
        path: The file.
        reader: Which module reads it.
        plain_bytes: How large its content may be.
    Raises:
        FileFormatError: The file was refused, or crashed the process, or went past its time or memory limit.
    """
    seconds = BASE_SECONDS + SECONDS_PER_MEGABYTE * path.stat().st_size / 1e6
    memory = BASE_BYTES + COPIES * plain_bytes
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", _START, str(root), reader, str(path.resolve()), str(memory)]
    # Nobody reads the backtraces, which take seconds to write.
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry),
        "RUST_BACKTRACE": "0",
    }
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds, env=environment)
    except subprocess.TimeoutExpired:
        raise FileFormatError(
            f"{path}: not read after {seconds:.0f} s, its reader was stopped; the file is damaged, get a whole copy"
        ) from None
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        raise FileFormatError(f"{path}: crashed its reader ({name}); the file is damaged, get a whole copy")
    head, _, body = done.stdout.partition(b"\n")
    try:
        answer = json.loads(head)
    except ValueError:
        last = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:] or ["no message"]
        raise FileFormatError(
            f"{path}: its reader ended without an answer ({last[0][:200]}); get a whole copy"
        ) from None
    if "error" in answer:
        raise FileFormatError(f"{path}: {answer['error']}")
    arrays, at = {}, 0
    for name, dtype, shape in answer["arrays"]:
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(body, dtype, count, at).reshape(shape)
        at += arrays[name].nbytes
    return arrays.pop(""), arrays
