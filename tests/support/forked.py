"""Work in a forked process, so that what ends it ends nothing else."""

from __future__ import annotations

import json
import os
import select
import signal
from collections.abc import Callable
from typing import IO, Any

__all__ = ["forked"]


def forked(work: Callable[[], Any], seconds: float, output: IO[bytes] | None = None) -> tuple[Any, int]:
    """What ``work`` returns in a forked process, by way of JSON, and the exit code of that process.

    Args:
        work: What is done.
        seconds: The process is killed where it used under 1 % of a processor for this time. One that hangs does so, one
            on a busy machine does not; to bound its work is up to ``work``.
        output: File for what it prints.
    Returns:
        (result, exit code); the result is None if the process ended without one.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        if output is not None:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
        try:
            os.write(writer, json.dumps(work()).encode())
        finally:
            os._exit(0)
    os.close(writer)
    used = -1.0
    while not (ready := select.select([reader], [], [], seconds)[0]) and used < (now := _processor_seconds(child)):
        used = now + 0.01 * seconds
    text = os.read(reader, 1 << 16) if ready else b""
    os.close(reader)
    if not text:
        os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return (json.loads(text) if text else None), code


def _processor_seconds(process: int) -> float:
    with open(f"/proc/{process}/stat", encoding="ascii") as file:
        user, system = file.read().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
