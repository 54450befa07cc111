"""Processes that have a library ready and read files with it, one for each module of formats.

Importing VTK takes a second and reading a small file a millisecond. So the process that has imported the
library is kept, and forks itself for each file. What a file does to memory, working folder, handles or settings ends
with its fork, and a crash costs a fork and not an import.

    caller --- a byte, a socket and a pipe ---> server --- fork ---> reader of one file
    caller <-- the request and the answer, on the socket ----------> reader
    caller <-- how the reader ended, on the pipe --- server

The environment is that of the caller at each file, but for what the library has read of it when it was imported.

The server is shared by all threads and forked children of a process, which need no locks towards it. It ends when all
of them have, or after a while without files. It ends a reader whose caller has gone.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.forks import register_at_fork
from geokit.core.base.interrupts import child_process
from geokit.core.base.system import limits
from geokit.formats.reader import worker as reader_worker

# Importing a library takes up to 2 s on a busy machine, and much longer from a cold network folder.
START_SECONDS = 60.0
# The reader ends itself after its time; the caller stops waiting for it a little later.
GRACE_SECONDS = 5.0

# The first entry of sys.path is the working folder here, and the user's files must not shadow modules.
_START = "import sys; sys.path[0] = sys.argv[1]; from geokit.formats.reader.worker import main; main()"

# What a server was started with, and the socket on which it takes requests.
_servers: dict[str, tuple[object, socket.socket]] = {}
# Guards the servers. A fork waits for it: the child would hold the ends of sockets that are about to be passed on, and
# nobody would see the other side's end.
_lock = threading.RLock()


class Ended(Exception):
    """The process that reads the file ended before its answer was complete.

    Args:
        started: Whether it had started to read.
        reason: Its exit status as a number, negative for a signal; None if it was stopped together with its server;
            otherwise why it could not be started.
    """

    def __init__(self, started: bool, reason: int | str | None) -> None:
        super().__init__(started, reason)
        self.started, self.reason = started, reason


class TimeExpired(Exception):
    """The process that reads the file did not answer in time."""


class Exchange(NamedTuple):
    """The connection to the process that reads one file.

    Args:
        control: The server's socket.
        channel: Takes the request and gives the answer.
        status: Pipe that tells how the process ended.
        deadline: When to stop waiting, on the monotonic clock [s].
    """

    control: socket.socket
    channel: socket.socket
    status: int
    deadline: float

    def receive(self, size: int, *, started: bool = True) -> NDArray[np.uint8]:
        """The next bytes of the answer, or of what comes before it where the process has not ``started`` to read.

        Raises:
            Ended: The process has ended before them.
            TimeExpired: They did not come in time.
        """
        content = np.empty(size, np.uint8)
        at, view = 0, content.data
        while at < size:
            self._set_timeout()
            try:
                count = self.channel.recv_into(view[at:])
            except TimeoutError:
                raise TimeExpired if started else Ended(False, "its server does not answer") from None
            except OSError:  # it has ended without reading the request
                count = 0
            if not count:
                raise Ended(started, self._how_it_ended())
            at += count
        return content

    def _start(self, request: bytes) -> None:
        """Send the request, and wait until the process has started to read the file."""
        self._set_timeout()
        with contextlib.suppress(OSError):  # it has ended, which the answer tells
            self.channel.sendall(request)
        self.receive(len(reader_worker.READY), started=False)

    def _how_it_ended(self) -> int | str | None:
        told = select.poll()
        told.register(self.status, select.POLLIN)
        said = os.read(self.status, 4096).decode("utf-8", "replace") if told.poll(GRACE_SECONDS * 1e3) else ""
        try:
            return int(said) if said else None
        except ValueError:
            return said

    def _set_timeout(self) -> None:
        self.channel.settimeout(max(1e-3, self.deadline - time.monotonic()))


@contextlib.contextmanager
def exchange(module: str, request: dict[str, Any], seconds: float) -> Iterator[Exchange]:
    """Have a new process read a file, and connect to it once it has started.

    Args:
        module: Full name of the module that reads it.
        request: What :class:`geokit.formats.reader.worker.Request` holds, but for the time and the environment.
        seconds: Time that it may take.
    Raises:
        Ended: The process did not start, or ended before its answer was complete.
        TimeExpired: The answer did not come in time.
    """
    memory = min(request["memory"], *limits("AS"))
    told = {**request, "memory": memory, "seconds": seconds, "environment": _environment()}
    # The first server may have ended meanwhile, of age or killed from outside.
    for last in (False, True):
        with _passed(module, seconds + GRACE_SECONDS) as found:
            try:
                found._start(json.dumps(told).encode() + b"\n")
            except Ended as end:
                if not isinstance(end.reason, int):  # the server has gone, or can serve no more
                    _forget(module, found.control)
                if last or end.reason is not None:
                    raise
                continue
            yield found
            return


@contextlib.contextmanager
def _passed(module: str, seconds: float) -> Iterator[Exchange]:
    """Pass the ends of a new connection to the server of the module."""
    with contextlib.ExitStack() as ends:
        with _lock, contextlib.ExitStack() as theirs:
            control = _server(module)
            try:
                channel, other = socket.socketpair()
                ends.enter_context(channel)
                theirs.enter_context(other)
                # Numbers would be lost with an interrupt, and stay open: nobody would see the other side's end.
                status, told = map(io.FileIO, os.pipe(), "rw")
                ends.enter_context(status)
                theirs.enter_context(told)
            except OSError as error:
                raise Ended(False, str(error)) from None
            # The server has ended if this fails, and nobody will take the other ends.
            with contextlib.suppress(OSError):
                socket.send_fds(control, [b"f"], [other.fileno(), told.fileno()])
        yield Exchange(control, channel, status.fileno(), time.monotonic() + seconds)


def _environment() -> dict[str, str]:
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(os.path.abspath(entry) for entry in sys.path if entry),
        # Backtraces of libraries in Rust take seconds to write and are never shown.
        "RUST_BACKTRACE": "0",
        # A fork copies one thread, so no library may start more than that on import.
        "OPENBLAS_NUM_THREADS": "1",
    }


def _server(module: str) -> socket.socket:
    """The socket of the module's server, which is started if there is none for this Python and this user."""
    environment = _environment()
    key = (sys.executable, environment["PYTHONPATH"], os.geteuid(), os.getegid())
    if module in _servers:
        known, control = _servers[module]
        if known == key:
            return control
        _forget(module, control)
    control, theirs = socket.socketpair()
    control.settimeout(START_SECONDS)
    with theirs:
        try:
            _start(module, theirs, environment)
        except BaseException:
            control.close()
            raise
    _servers[module] = key, control
    return control


def _start(module: str, control: socket.socket, environment: dict[str, str]) -> None:
    """Start a server; the process that is started here forks it and ends, so that it is no child of the caller."""
    command = [sys.executable, "-c", _START, str(Path(__file__).resolve().parents[3]), module]
    try:
        with child_process(
            command,
            stdin=control.fileno(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # Ctrl-C in a terminal is for the caller
        ) as starter:
            _, said = starter.communicate(timeout=START_SECONDS)
    except subprocess.TimeoutExpired:
        raise Ended(False, f"its libraries were not imported within {START_SECONDS:.0f} s") from None
    except OSError as error:
        raise Ended(False, str(error)) from None
    if starter.returncode:
        last = said.decode("utf-8", "replace").strip().splitlines()[-1:] or ["no message"]
        raise Ended(False, f"{status_name(starter.returncode)}: {last[0][:200]}")


def status_name(status: int) -> str:
    """An exit status in words."""
    return signal.Signals(-status).name if status < 0 else f"status {status}"


def _forget(module: str, control: socket.socket) -> None:
    """Leave a server to itself; it ends when it has read the files that it has."""
    with _lock:
        if module in _servers and _servers[module][1] is control:
            del _servers[module]
        control.close()


def _forget_all() -> None:
    for module, (_, control) in list(_servers.items()):
        _forget(module, control)


atexit.register(_forget_all)
register_at_fork(before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release)
