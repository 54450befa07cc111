"""What a worker of a batch runs: it has files done by a process of its own, which may crash or be killed.

One thread has one process, which is kept for the next files. On a cluster the thread is one of a Dask worker.
"""

from __future__ import annotations

import contextlib
import errno
import importlib.metadata
import json
import os
import platform
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from functools import cache
from pathlib import Path
from typing import Any

import geokit
from geokit.core.base.system import UNLIMITED, limits
from geokit.errors import WorkerError
from geokit.formats.reader.server import Ended

# A file whose process ends this often is set aside.
TRIES = 3
REMEDY = "give fewer --jobs, or raise the limit of processes (ulimit -u), and run the same command again"
# How often the memory of a process is looked at [s].
LOOK = 0.05
# The first entry of sys.path is the working folder here, and the user's files must not shadow modules.
_START = "import sys; sys.path[0] = sys.argv[1]; from geokit.cli._batches.task import main; main()"

_mine = threading.local()
_all: weakref.WeakSet[_Process] = weakref.WeakSet()


@cache
def versions() -> dict[str, str]:
    """What must be the same on all machines for the same answers."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"geokit": geokit.__version__, "warp": importlib.metadata.version("warp-lang"), "python": python}


def unstarted(error: BaseException) -> str:
    """What to tell where the machine gave no process or thread, and no file is to blame; "" for other errors."""
    refused = isinstance(error, OSError) and error.errno == errno.EAGAIN
    refused |= isinstance(error, Ended) and not error.started
    # Where the address space is limited, it may be what the file needs.
    if type(error) is RuntimeError and limits("AS")[0] == UNLIMITED:
        refused = "can't start new thread" in str(error)
    reason = getattr(error, "strerror", getattr(error, "reason", error))
    return f"a process or thread cannot be started ({reason}); {REMEDY}" if refused else ""


def about_here(staging: str) -> dict[str, Any]:
    """The versions of this machine, whether it may write to the folder of the batch, and its address on a cluster."""
    worker = ""
    if "distributed" in sys.modules:
        with contextlib.suppress(ValueError):  # not on a cluster
            worker = sys.modules["distributed"].get_worker().address
    return {
        "versions": versions(),
        "host": socket.gethostname(),
        "sees": os.access(staging, os.W_OK | os.X_OK),
        "worker": worker,
    }


def set_aside(source: str, reason: str) -> dict[str, Any]:
    """The record of a file that its workers do not survive."""
    message = f"{source}: {reason}; it is set aside"
    return {"input": source, "status": "set aside", "error": {"type": "WorkerError", "message": message}}


def end_processes() -> None:
    """End all processes of this one, in the middle of their work if need be; no more are started."""
    for process in list(_all):
        process.closed = True
        if process.running is not None:
            _kill(process.running)


def run_files(batch: dict[str, Any], sources: list[str]) -> list[dict[str, Any]]:
    """Run the steps of a batch on some files.

    Args:
        batch: "steps", "staging", "versions", "memory" [bytes] and "seconds" or None, "threads".
        sources: Paths of the files.
    Returns:
        A record of each file; its status is "refused" where this machine has other versions than the batch.
    """
    here = about_here(batch["staging"])
    if here["versions"] != batch["versions"] or not here["sees"]:
        return [{"input": source, "status": "refused", **here} for source in sources]
    process = getattr(_mine, "process", None)
    if process is None:
        process = _mine.process = _Process(batch["threads"])
    return [{**process.run(batch, source), "worker": here["worker"]} for source in sources]


class _Process:
    """A process that runs jobs one after the other, and is started again when it has ended."""

    def __init__(self, threads: int) -> None:
        paths = os.pathsep.join(os.path.abspath(entry) for entry in sys.path if entry)
        usual = {"GEOKIT_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}
        self.environment = {**usual, **os.environ, "PYTHONPATH": paths}
        self.running: subprocess.Popen[bytes] | None = None
        self.closed = False
        _all.add(self)

    def __del__(self) -> None:
        self.stop()

    def stop(self) -> None:
        """End the process, and those that it started."""
        ended, self.running = self.running, None
        if ended is not None:
            with contextlib.suppress(OSError), ended:  # waits for it, and closes its pipes
                _kill(ended)

    def run(self, batch: dict[str, Any], source: str) -> dict[str, Any]:
        """The record of a file."""
        job = {"steps": batch["steps"], "staging": batch["staging"], "input": source}
        end = error = ""
        for _ in range(0 if self.closed else TRIES):
            if self.running is not None and self.running.poll() is not None:
                self.stop()  # it was idle for long
            if self.running is None:
                command = [sys.executable, "-c", _START, str(Path(geokit.__file__).parents[1])]
                # A session of its own, so that processes that it starts end with it.
                pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "start_new_session": True}
                try:
                    self.running = subprocess.Popen(command, env=self.environment, **pipes)  # type: ignore[call-overload]
                except OSError as refused:  # no file is to blame
                    raise WorkerError(f"a process cannot be started ({refused.strerror}); {REMEDY}") from refused
                if self.closed:  # since it was looked at; nobody else ends this process
                    self.stop()
                    break
            answer, end, error = self._ask(json.dumps(job).encode() + b"\n", batch["memory"], batch["seconds"])
            if answer:
                return dict(json.loads(answer))
            self.stop()
            if error or self.closed:
                break
        else:
            return set_aside(source, f"{end} in {TRIES} tries")
        told = {"type": error or "WorkerError", "message": f"{source}: {end}"}
        return {"input": source, "status": "failed", "error": told}

    def _ask(self, line: bytes, memory: int | None, seconds: float | None) -> tuple[bytes, str, str]:
        """The answer to a job, or why there is none, and the type of that error if it is the file's."""
        running = self.running
        assert running is not None
        assert running.stdin is not None
        assert running.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            running.stdin.write(line)
            running.stdin.flush()
        start, limited = time.monotonic(), memory is not None or seconds is not None
        while limited and not select.select([running.stdout], [], [], LOOK)[0]:
            used = 0 if memory is None else _resident(running.pid)
            if memory is not None and used > memory:
                why = f"needs more than the {memory >> 20} MiB of --task-memory (it has {used >> 20} MiB); raise it"
                return b"", f"{why}, or choose a larger voxel size", "DeviceMemoryError"
            if seconds is not None and time.monotonic() - start > seconds:
                why = f"takes more than the {seconds:g} s of --task-seconds; raise it, or mend the file"
                return b"", why, "WorkerError"
        answer = running.stdout.readline()
        if answer.endswith(b"\n"):
            return answer, "", ""
        code = running.wait()
        reason = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        return b"", f"its process ended by {reason}", ""


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process, and those that it started where the system knows which."""
    if not hasattr(os, "killpg"):
        return process.kill()
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def _resident(leader: int) -> int:
    """Resident memory of a process and of its children [bytes]; 0 where the system does not say."""
    total = 0
    pids = [leader]
    for pid in pids:
        with contextlib.suppress(OSError, ValueError, IndexError):
            total += int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            pids += map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
    return total
