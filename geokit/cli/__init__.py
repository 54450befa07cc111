"""The command line: one file per verb, each a thin layer over the API."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Sequence
from typing import Any

__all__ = ["main"]

INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0 is success, 1 a request that failed, 2 an invalid command line, 130 an interrupt, 141 a closed stdout. An error is
    one line on stderr; GEOKIT_DEBUG=1 adds the traceback. An interrupt ends a process whose command line this runs.
    """
    _open_streams()
    code, came = INTERRUPTED, list[int]()

    def interrupt(*at: Any) -> None:
        came.append(INTERRUPTED)
        signal.default_int_handler(*at)

    def raise_again(dropped: Any) -> None:
        # Python drops what comes within __del__. The system's timer sends it once more, when that has ended.
        if dropped.exc_type is KeyboardInterrupt:
            signal.setitimer(signal.ITIMER_REAL, 1e-3)
        else:
            sys.__unraisablehook__(dropped)

    if arguments is None:
        # Products here are small, and a limit of processes may leave no room for threads of BLAS.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, interrupt)  # libraries may catch what it raises, and go on
            if hasattr(signal, "setitimer"):
                signal.signal(signal.SIGALRM, interrupt)
                sys.unraisablehook = raise_again
    with contextlib.suppress(KeyboardInterrupt):
        from geokit.cli._program.run import run

        code = run(list(sys.argv[1:] if arguments is None else arguments))
    if came or code == INTERRUPTED:
        if arguments is None and hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)  # it need not come again
        code = INTERRUPTED
        print("geokit: interrupted", file=sys.stderr, flush=True)
        if arguments is None:
            _end(code)
    elif arguments is None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done; Python itself would die by one from here on
    return code


def _open_streams() -> None:
    """Open the null device for standard streams that are closed: else a file of data gets the number of one."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            number = os.open(os.devnull, os.O_RDWR)  # the lowest that is free
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", errors="backslashreplace", closefd=False))


def _end(code: int) -> None:
    """End the process as Python does, but take no modules down: a library that was interrupted may crash then."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
        sys.stdout.flush()
    finally:
        os._exit(code)
