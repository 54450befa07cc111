"""Interrupts at every call of a block: where Python looks for signals."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

__all__ = ["calls_of", "children", "interrupted", "interrupts"]

TESTS = str(Path(__file__).resolve().parents[1])


class _Interrupt:
    """Sends SIGINT at the call of a given number: as a function of Python is entered, or as one of C has returned."""

    def __init__(self, number: int, files: tuple[str, ...]) -> None:
        self.left, self.files = number, files

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        name = frame.f_code.co_filename
        if event not in ("call", "c_return") or name.startswith(TESTS):
            return
        if self.files and not name.endswith(self.files):
            return
        self.left -= 1
        if self.left < 0:
            sys.setprofile(None)
            signal.raise_signal(signal.SIGINT)


def interrupted(number: int, block: Callable[[], object], files: tuple[str, ...] = ()) -> bool:
    """Run a block and interrupt it at the call of a number, counted from 0 in files whose names end so.

    Returns:
        Whether there were so many calls.
    """
    interrupt = _Interrupt(number, files)
    try:
        sys.setprofile(interrupt)
        block()
    except KeyboardInterrupt:
        pass
    finally:
        sys.setprofile(None)
    return interrupt.left < 0


def calls_of(block: Callable[[], object]) -> int:
    """How many calls there are in a block at which it can be interrupted."""
    counter = _Interrupt(sys.maxsize, ())
    sys.setprofile(counter)
    try:
        block()
    finally:
        sys.setprofile(None)
    return sys.maxsize - counter.left


def interrupts(
    block: Callable[[], object], files: tuple[str, ...] = (), *, first: int = 0, step: int = 1
) -> Iterator[int]:
    """Interrupt a block at each call in turn; yields the number of the call after each."""
    for number in itertools.count(first, step):
        if not interrupted(number, block, files):
            return
        yield number


def children() -> set[int]:
    """Processes of this one that run, or were not waited for."""
    found: set[int] = set()
    for task in os.listdir("/proc/self/task"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread that has ended
            found |= set(map(int, Path("/proc/self/task", task, "children").read_text().split()))
    return found
