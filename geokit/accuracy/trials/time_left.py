"""How far a long run is, for its lines of progress."""

from __future__ import annotations

import time

__all__ = ["time_left"]

# Shorter runs [s] need no estimate.
PATIENCE = 2.0


def time_left(started: float, done: int, total: int, what: str) -> str:
    """The end of a line: the parts that are done and the time for the others, if they take as long; "" at the start.

    Args:
        started: ``time.perf_counter()`` at the start of the run.
        done: Number of parts that are done.
        total: Number of all parts.
        what: What the parts are called.
    """
    passed = time.perf_counter() - started
    if passed < PATIENCE or not done:
        return ""
    return f" [{done} of {total} {what}, about {passed / done * (total - done):.0f} s left]"
