"""Scripts in processes that are forks of one process, which has imported what takes the time and done nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

__all__ = ["ForkServer"]

ROOT = Path(__file__).resolve().parents[2]

# Each request is a line of JSON; the answer is the exit code. A fork finds the environment as a new process would.
_SERVER = """
import atexit, json, os, sys, tempfile, traceback
exec(sys.argv[1])
for line in sys.stdin:
    script, words, environment, out, err = json.loads(line)
    process = os.fork()
    if process:
        print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
        continue
    for number, path in ((1, out), (2, err)):
        os.dup2(os.open(path, os.O_WRONLY), number)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:0] = [folder for folder in environment.get("PYTHONPATH", "").split(os.pathsep) if folder]
    sys.argv = ["-c", *words]
    tempfile.tempdir = None
    code = 0
    try:
        exec(compile(script, "<script>", "exec"), {"__name__": "__main__"})
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
        self._server = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", _SERVER, imports],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=ROOT,
        )

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.__exit__(kind, error, trace)

    def run(
        self, script: str, *words: object, environment: Mapping[str, object] | None = None
    ) -> subprocess.CompletedProcess[str]:
        """What ``python -c script words ...`` does where ``environment`` is added to that of this process."""
        given = {**os.environ, **{name: str(value) for name, value in (environment or {}).items()}}
        told = [str(word) for word in words]
        with tempfile.NamedTemporaryFile("r") as out, tempfile.NamedTemporaryFile("r") as err:
            assert self._server.stdin is not None
            assert self._server.stdout is not None
            self._server.stdin.write(json.dumps([script, told, given, out.name, err.name]) + "\n")
            self._server.stdin.flush()
            code = int(self._server.stdout.readline())
            return subprocess.CompletedProcess(["-c", *told], code, out.read(), err.read())
