"""Interrupts every public function at random calls within it, and asks it again.

python -m tests.support.limits.interrupt_runs [COUNT] [SEED] [NAME ...]   # a JSON line for each function

Nothing may be left of it (files, processes, more handles than MOST_HANDLES), and the next call, in another thread, must
give its answer within HANG_SECONDS. Long functions are interrupted a fourth as often.
"""

from __future__ import annotations

import faulthandler
import functools
import gc
import hashlib
import json
import os
import random
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.interrupts import calls_of, children, interrupted
from tests.support.public_calls import Call, Scene, public_calls

__all__ = ["faults", "runs"]

HANG_SECONDS = 90.0
# One between two statements of Python's own library may leave a handle until the process ends.
MOST_HANDLES = 2
# Processes that were ended are gone a moment later, and so are folders in memory of what else runs here.
END_SECONDS = 3.0
LONG_SECONDS = 2.0
MEMORY_FOLDER = Path("/dev/shm")


def digest(value: Any) -> str:
    """A short name of an answer: its numbers, texts and what they are in."""
    found = hashlib.sha256()

    def add(part: Any) -> None:
        found.update(type(part).__name__.encode())
        if isinstance(part, np.ndarray):
            found.update(f"{part.dtype}{part.shape}".encode())
            found.update(np.ascontiguousarray(part).tobytes() if part.dtype != object else repr(part).encode())
        elif isinstance(part, str | bytes | int | float | Path | None):
            found.update(repr(part).encode())
        elif isinstance(part, dict):
            add(list(part.items()))
        elif isinstance(part, list | tuple):
            for one in part:
                add(one)
        elif hasattr(part, "numpy") and hasattr(part, "dtype"):
            add(part.numpy())
        else:
            for name in ("nanovdb", "vertices", "faces", "points", "data"):
                if isinstance(getattr(part, name, None), np.ndarray | dict):
                    add(getattr(part, name))

    add(value)
    return found.hexdigest()[:16]


def outcome(call: Call) -> str:
    try:
        return digest(call())
    except Exception as error:
        return f"{type(error).__name__}: {error}"[:200]


def outcome_in_thread(call: Call) -> str:
    found: list[str] = []
    thread = threading.Thread(target=lambda: found.append(outcome(call)), daemon=True)
    thread.start()
    thread.join(HANG_SECONDS)
    if not found:
        faulthandler.dump_traceback()
    return found[0] if found else "no answer"


def _left(folder: Path) -> set[str]:
    """Temporary files in a folder and in memory, those of other processes among the last."""
    shared = MEMORY_FOLDER.glob(".geokit*") if MEMORY_FOLDER.is_dir() else ()
    return {str(path) for path in (*folder.rglob(".geokit*"), *folder.rglob("tmp*"), *shared)}


def _handles() -> int:
    return len(os.listdir("/proc/self/fd"))


def _after(call: Call, number: int, folder: Path, answer: str | None) -> list[str]:
    """What is wrong after an interrupt at the call of a number."""
    gc.collect()
    files, processes, handles = _left(folder), children(), _handles()
    wrong = []
    try:
        interrupted(number, call)
    except Exception as error:
        wrong.append(f"raised {type(error).__name__}: {error}"[:200])
    gc.collect()
    more, begun = _left(folder) - files, children() - processes
    end = time.monotonic() + END_SECONDS
    while (more or begun) and time.monotonic() < end:
        time.sleep(0.02)
        more, begun = more & _left(folder), begun & children()
    if more:
        wrong.append(f"left {sorted(more)}")
    if begun:
        wrong.append("left a process")
    if _handles() - handles > MOST_HANDLES:
        wrong.append(f"left {_handles() - handles} handles")
    found = outcome_in_thread(call)
    if found != answer and (answer is not None or found == "no answer"):
        wrong.append(f"then {found}, not {answer}")
    return wrong


def runs(count: int, seed: int, names: Sequence[str] = (), part: tuple[int, int] = (0, 1)) -> Iterator[dict[str, Any]]:
    """For each public function how many interrupts of how many calls were tried, and what was wrong after each.

    Args:
        count: Interrupts of each function.
        seed: Of the choice among its calls.
        names: Functions; all if empty.
        part: Which of how many parts of them.
    """
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root)
        tempfile.tempdir = str(folder)
        try:
            for call in list(public_calls(Scene(folder)))[part[0] :: part[1]]:
                if names and call.name.partition("(")[0] not in names:
                    continue
                # The first time compiles kernels and fills caches.
                outcome(call)
                start = time.monotonic()
                answers = {outcome(call), outcome(call)}
                calls = calls_of(functools.partial(outcome, call))
                long = time.monotonic() - start > 3 * LONG_SECONDS
                tried = rng.sample(range(calls), min(max(1, count // 4) if long else count, calls))
                # Answers that name a time, or depend on which thread was first, have nothing to be compared with.
                answer = answers.pop() if len(answers) == 1 else None
                wrong = {number: _after(call, number, folder, answer) for number in tried}
                yield {
                    "name": call.name,
                    "calls": calls,
                    "tried": len(tried),
                    "compared": answer is not None,
                    "wrong": {number: what for number, what in wrong.items() if what},
                }
        finally:
            tempfile.tempdir = None


def faults(rows: Sequence[dict[str, Any]]) -> list[str]:
    return [f"{row['name']}, call {number}: {what}" for row in rows for number, what in row["wrong"].items()]


def main(*words: str) -> int:
    warnings.simplefilter("ignore")
    faulthandler.enable()
    numbers = [int(word) for word in words if word.isdecimal()]
    count, seed = (*numbers, *(6, 0)[len(numbers) :])
    part, parts = (int(word) for word in os.environ.get("PART", "0/1").split("/"))
    found = []
    for row in runs(count, seed, [word for word in words if not word.isdecimal()], (part, parts)):
        found.append(row)
        print(json.dumps(row), flush=True)
    for line in faults(found):
        print(f"FAULT {line}", flush=True)
    return min(len(faults(found)), 1)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
