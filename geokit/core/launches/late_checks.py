"""Checks of what kernels found, which wait for a GPU: made at the end of a call, while the host has other work.

A query launches its kernels, hands their results on, and then waits for the flags that they raise. A caller who has
more to do for the same call gathers these checks, so that the host does it while the GPU is at work.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType

from geokit.core.base.late_warp import wp


class _Thread(threading.local):
    waiting: list[Callable[[], None]] | None = None


_thread = _Thread()


def later(check: Callable[[], None], device: "wp.Device") -> None:
    """Make a check now; or at the end of :class:`AtEnd` if this thread is within one and a GPU is at work."""
    if _thread.waiting is None or device.is_cpu:
        check()
    else:
        _thread.waiting.append(check)


class AtEnd:
    """A context that makes the checks of the queries within it at its end; not those of a query that failed."""

    __slots__ = ("_before", "_checks")

    def __enter__(self) -> None:
        self._before = _thread.waiting
        self._checks: list[Callable[[], None]] = []
        _thread.waiting = self._checks

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _thread.waiting = self._before
        if kind is None:
            for check in self._checks:
                check()
