"""Program of the processes of :mod:`geokit.formats.reader.server`: a server, and a fork of it for each file.

A fork reads a request, a line of JSON, and answers READY, the size of a text of JSON, that text, and the bytes of the
arrays that it lists. Standard library only, so that the server waits for no import other than its library.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import os
import re
import select
import signal
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypedDict

from geokit.core.base.system import limits
from geokit.errors import FileAccessError, FileFormatError
from geokit.formats.file_content.body import Body
from geokit.formats.reader.warnings import collected

# Comes before the answer once the process has started, before it opens the file.
READY = b"ready\n"
# Arrays of a body by name.
DATA = ("vertex_data", "polygon_data", "corner_data")
# The size of the answer's text, before it.
HEAD_SIZE = struct.Struct("<Q")
# A server that has had no file for so long [s] ends: it holds some 100 MB.
IDLE_SECONDS = 60.0

_PR_SET_PDEATHSIG = 1

Named = list[tuple[str, Any]]

# Type codes of the struct module, which buffers use, mapped to NumPy's code of the kind.
_KINDS = {**dict.fromkeys("efd", "f"), **dict.fromkeys("bhilqn", "i"), **dict.fromkeys("BHILQN", "u"), "?": "b"}


class Request(TypedDict):
    """What is asked.

    Args:
        content: "mesh", "points" or "grids".
        path: The file.
        names: Of a mesh: folders of referenced files, or None if the module takes no such folders. Names of grids.
        options: Of a mesh: ``tolerance`` of curved faces, number of the time ``step``; those that are given.
        limit: Largest size of the answer's arrays in bytes.
        memory: Limit of address space in bytes.
        seconds: Time that reading may take.
        environment: The caller's environment.
    """

    content: str
    path: str
    names: list[str] | None
    options: dict[str, float]
    limit: int
    memory: int
    seconds: float
    environment: dict[str, str]


def main() -> None:
    """Get the library of a module ready and leave a server behind, which takes requests on the standard input.

    The arguments are the root of the package and the name of the module.
    """
    control = socket.socket(fileno=os.dup(0))
    reader = importlib.import_module(sys.argv[2])
    # Whatever fails here fails again with the file, where it is reported.
    with contextlib.suppress(Exception, SystemExit):
        reader.prepare()
    # Not a child of the caller, which would have to wait for its end.
    if os.fork():
        os._exit(0)
    try:
        nothing = os.open(os.devnull, os.O_RDWR)
        for standard in range(3):
            os.dup2(nothing, standard)
        os.chdir("/")
        _limit("CORE", 0)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        # Collections write to pages that the forks share.
        gc.freeze()
        gc.set_threshold(100_000)
        _serve(control, reader)
    finally:
        os._exit(0)


def _serve(control: socket.socket, reader: ModuleType) -> None:
    """Hand each request to a fork until all callers have closed their ends, or none has come for a while."""
    woken, wakes = os.pipe()
    os.set_blocking(woken, False)
    os.set_blocking(wakes, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wakes, warn_on_full_buffer=False)
    readers: dict[int, int] = {}  # processes by the pipe that takes their end
    events = select.poll()
    events.register(control, select.POLLIN)
    events.register(woken, select.POLLIN)
    serving = True
    spare = _fork(reader, readers)
    while serving or readers:
        ready = events.poll(None if readers else IDLE_SECONDS * 1e3)
        if not ready and not readers:
            return
        for at, _ in ready:
            if at == woken:
                os.read(woken, 512)
            elif at != control.fileno():
                # The caller has gone. Its pipe is closed when the process has ended.
                os.kill(readers[at], signal.SIGKILL)
                events.unregister(at)
            elif not (request := socket.recv_fds(control, 1, 2))[0]:
                serving = False
                events.unregister(control)
            elif len(request[1]) < 2:  # no handles were left for them
                for end in request[1]:
                    os.close(end)
            else:
                channel, status = request[1]
                taken = _hand_over(channel, spare) or _hand_over(channel, _fork(reader, readers))
                os.close(channel)
                if taken:
                    readers[status] = taken
                    events.register(status, 0)  # reports only that the other end has closed
                else:
                    _tell(status, "no process can be started")
                spare = _fork(reader, readers)  # the next file will not wait for it
        for process, ended in _ended():
            for at in [at for at, other in readers.items() if other == process]:
                with contextlib.suppress(KeyError):
                    events.unregister(at)
                del readers[at]
                _tell(at, str(ended))


class _Waiting(NamedTuple):
    """A fork that waits for a request, and the socket that takes the request's channel."""

    process: int
    takes: socket.socket


def _fork(reader: ModuleType, readers: dict[int, int]) -> _Waiting | None:
    """Fork a process that waits for a request; None if the system has no room for it."""
    server = os.getpid()
    try:
        ours, theirs = socket.socketpair()
        process = os.fork()
    except OSError:
        return None
    if process:
        theirs.close()
        return _Waiting(process, ours)
    try:
        ours.close()
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for other in readers:
            os.close(other)
        _die_with(server)
        _, channels, *_ = socket.recv_fds(theirs, 1, 1)
        if channels:
            _answer(socket.socket(fileno=channels[0]), reader)
    finally:
        # Some libraries crash in their own teardown after reading a damaged file, when the result is already written.
        os._exit(1)


def _hand_over(channel: int, waiting: _Waiting | None) -> int:
    """Give a request to a process; 0 if there is none, or it has been killed."""
    if waiting is None:
        return 0
    try:
        with waiting.takes:
            socket.send_fds(waiting.takes, [b"f"], [channel])
    except OSError:
        return 0
    return waiting.process


def _ended() -> Iterator[tuple[int, int]]:
    """Processes that have ended, with their exit statuses."""
    with contextlib.suppress(ChildProcessError):
        while (found := os.waitpid(-1, os.WNOHANG))[0]:
            yield found[0], os.waitstatus_to_exitcode(found[1])


def _tell(status: int, text: str) -> None:
    with contextlib.suppress(OSError):  # the caller has its answer and has gone
        os.write(status, text.encode())
    os.close(status)


def _die_with(server: int) -> None:
    """End when the server is killed."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != server:
        os._exit(1)


def _answer(channel: socket.socket, reader: ModuleType) -> None:
    with channel.makefile("rb") as lines:
        request: Request = json.loads(lines.readline())
    # The system's timer ends the process also inside a library.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, request["seconds"])
    if os.environ != request["environment"]:
        os.environ.clear()
        os.environ.update(request["environment"])
    _limit("AS", request["memory"])
    channel.sendall(READY)
    head, buffers = _read(request, reader)
    text = json.dumps(head).encode()
    channel.sendall(HEAD_SIZE.pack(len(text)) + text)
    for buffer in buffers:
        channel.sendall(buffer)


def _read(request: Request, reader: ModuleType) -> tuple[dict[str, Any], list[Any]]:
    """The head of the answer, and its buffers."""
    path = Path(request["path"])
    listed, buffers = [], []
    try:
        if request["content"] == "mesh":
            # Some libraries take relative references from the working folder, not from the file's.
            os.chdir(path.parent)
        with collected() as said:
            if request["content"] == "mesh":
                names = request["names"]
                allowed = () if names is None else ([Path(folder) for folder in names],)
                facts, arrays = _mesh(reader.read_mesh(path, *allowed, **request.get("options", {})))
            elif request["content"] == "grids":
                facts, arrays = reader.read_grids(path, request["names"])
            else:
                points, data = reader.read_points(path)
                facts, arrays = None, [("", points), *data.items()]
        for name, array in arrays:
            kind, shape, buffer = _described(array)
            listed.append((name, kind, shape))
            buffers.append(buffer)
        if sum(memoryview(buffer).nbytes for buffer in buffers) > request["limit"]:
            raise MemoryError
        return {"facts": facts, "arrays": listed, "warnings": said}, buffers
    except (FileFormatError, FileAccessError) as error:
        kind = "access" if isinstance(error, FileAccessError) else "error"
        return {kind: str(error).removeprefix(f"{path}: ")}, []
    except ImportError as error:
        return {"missing": str(error)}, []
    except MemoryError:
        return {"memory": True}, []
    except (Exception, SystemExit) as error:
        return {"reason": re.sub(r"\s+", " ", f"{type(error).__name__}: {error}").strip()[:300]}, []


def _limit(kind: str, size: int) -> None:
    """Lower a limit of the process, such as that of the address space, to ``size`` bytes, if it is not lower."""
    import resource

    number = getattr(resource, f"RLIMIT_{kind}")
    resource.setrlimit(number, (min(size, *limits(kind)), resource.getrlimit(number)[1]))


def _mesh(bodies: list[Body]) -> tuple[Any, Named]:
    facts: list[dict[str, Any]] = []
    arrays: Named = []
    for body in bodies:
        # In place of what follows as arrays: how many there are.
        sent: dict[str, Any] = dict.fromkeys(("points", "counts", "indices"))
        sent |= {kind: len(getattr(body, kind)) for kind in DATA}
        sent["materials"] = [[*material[:3], material.alpha_cutoff] for material in body.materials]
        sent["transform"] = None if body.transform is None else [list(map(float, row)) for row in body.transform]
        facts.append({**body._asdict(), **sent, "clockwise": bool(body.clockwise)})
        arrays += [("points", body.points), ("counts", body.counts), ("indices", body.indices)]
        arrays += [item for kind in DATA for item in getattr(body, kind).items()]
        arrays += [("", material.texture) for material in body.materials]
    return facts, arrays


def _described(array: Any) -> tuple[str, tuple[int, ...], Any]:
    """NumPy's name of the type, the shape, and the bytes in C order."""
    view = memoryview(array)
    # For NumPy arrays the dtype says more than the buffer's format.
    kind: str = array.dtype.str if hasattr(array, "dtype") else f"{_KINDS[view.format[-1]]}{view.itemsize}"
    return kind, tuple(view.shape or ()), view if view.c_contiguous else view.tobytes()
