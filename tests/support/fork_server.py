"""Scripts in processes that are forks of one process, which has imported what takes the time and done nothing else."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType

__all__ = ["ForkServer"]

ROOT = Path(__file__).resolve().parents[2]
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
