"""Steps that no interrupt divides, and processes that none leaves behind.

A handler of a signal, such as that of Ctrl-C, may raise its exception at every call of the main thread, also between a
function that has started something and the statement that would keep what it returns.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import Any

# How often work that must not be left half done is tried while interrupts come.
ATTEMPTS = 5


@contextlib.contextmanager
def signals_held() -> Iterator[None]:
    """Let handlers of signals wait until the end of the block, which is short.

    Threads other than the main one run no handlers, so nothing is done there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: dict[int, FrameType | None] = {}
    replaced: list[tuple[int, Any]] = []
    try:
        for number in signal.valid_signals():
            handler = signal.getsignal(number)
            if callable(handler):
                replaced.append((number, handler))
                signal.signal(number, lambda number, frame: came.update({number: frame}))
        yield
    finally:
        interrupt = None
        while replaced:
            try:
                signal.signal(*replaced[-1])
                replaced.pop()
            except BaseException as error:  # of a handler that is back already
                interrupt = error
        try:
            if interrupt is not None:
                raise interrupt
            for late, frame in came.items():
                handler = signal.getsignal(late)
                if callable(handler):
                    handler(late, frame)
        finally:
            del interrupt  # its traceback holds this frame


@contextlib.contextmanager
def child_process(command: Sequence[str | bytes], **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A process that has ended when the block has, also after an interrupt.

    Args:
        command: As for ``subprocess.Popen``.
        options: The same.
    Raises:
        OSError: It cannot be started.
    """
    started: list[subprocess.Popen[bytes]] = []
    try:
        with signals_held():
            started.append(subprocess.Popen(command, **options))
        yield started[0]
    finally:
        # As in private_folder(): without a function around it, since an interrupt may come as that is entered.
        interrupt, left = None, ATTEMPTS
        while left:
            try:
                for process in started:
                    _end(process)
                left = 0
            except BaseException as error:
                interrupt, left = error, left - 1
        try:
            if interrupt is not None:
                raise interrupt
        finally:
            del interrupt  # its traceback holds this frame


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process, if it has not, and close its pipes.

    The methods of ``Popen`` take a lock, which an interrupt may have left taken.
    """
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()
    if process.returncode is None and not hasattr(os, "waitid"):
        process.kill()
        process.wait()
    elif process.returncode is None:
        try:
            # Only a process that was not waited for keeps its number.
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            os.kill(process.pid, signal.SIGKILL)
            status = os.waitstatus_to_exitcode(os.waitpid(process.pid, 0)[1])
        except ChildProcessError:
            status = -signal.SIGKILL
        process.returncode = status
