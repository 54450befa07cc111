"""Forks: work in one, so that what ends it ends nothing else; scripts in forks of one process that has imported."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import IO, Any

__all__ = ["ForkServer", "forked"]

ROOT = Path(__file__).resolve().parents[2]


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


MOST = 1 << 17

# A request is JSON, with pipes for what is printed; the answer is the exit code. A fork finds the environment and the
# streams that a new process would find.
_SERVER = f"""
import atexit, json, os, socket, sys, tempfile, traceback
server = socket.socket(fileno=int(sys.argv[1]))
exec(sys.argv[2])
while True:
    data, streams, _, _ = socket.recv_fds(server, {MOST}, 2)
    if not data:
        break
    script, words, environment = json.loads(data)
    process = os.fork()
    if process:
        for stream in streams:
            os.close(stream)
        server.send(b"%d" % os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]))
        continue
    server.close()
    for number, stream in enumerate(streams, 1):
        os.dup2(stream, number)
        os.close(stream)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:0] = [folder for folder in environment.get("PYTHONPATH", "").split(os.pathsep) if folder]
    sys.argv = ["-c", *words]
    tempfile.tempdir = None
    code = 0
    try:
        exec(compile(script, "<script>", "exec"), {{"__name__": "__main__"}})
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else bool(error.code)
    except BaseException:
        traceback.print_exc()
        code = 1
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
"""


class ForkServer:
    """Runs scripts one after the other, each in a fork of a process.

    Args:
        imports: What that process runs once. It may import, and must start no threads and read no environment.
    """

    def __init__(self, imports: str) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._server = subprocess.Popen(
                [sys.executable, "-W", "ignore", "-c", _SERVER, str(theirs.fileno()), imports],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd=ROOT,
            )

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        self._server.wait()

    def run(
        self, script: str, *words: object, environment: Mapping[str, object] | None = None
    ) -> subprocess.CompletedProcess[str]:
        """What ``python -c script words ...`` does where ``environment`` is added to that of this process."""
        given = {**os.environ, **{name: str(value) for name, value in (environment or {}).items()}}
        told = [str(word) for word in words]
        pipes = [os.pipe() for _ in range(2)]
        try:
            socket.send_fds(self._socket, [json.dumps([script, told, given]).encode()], [end for _, end in pipes])
        finally:
            for _, end in pipes:
                os.close(end)
        with ThreadPoolExecutor(2) as pool:
            out, err = pool.map(_read, [start for start, _ in pipes])
        return subprocess.CompletedProcess(["-c", *told], int(self._socket.recv(64)), out, err)


def _read(pipe: int) -> str:
    with open(pipe, encoding="utf-8", errors="replace") as file:
        return file.read()
