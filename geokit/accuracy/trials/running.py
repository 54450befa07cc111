"""Helpers shared by trials and sweeps: transfers, judgements, memory, progress, trials that could not be prepared."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.trials.model import Judgement, Trial
from geokit.core.base.late_warp import wp

Floats = NDArray[np.float64]

# Shorter runs [s] need no estimate.
PATIENCE = 2.0


def send(points: Floats, device: Any) -> Any:
    """Points on the device, so that transfers are not timed."""
    return wp.array(points, dtype=wp.vec3d, device=device)


def on_host(answer: Any) -> Floats:
    """An answer as a NumPy array, from any container."""
    return np.asarray(answer.numpy() if hasattr(answer, "numpy") else answer, np.float64)


def without_warnings(call: Callable[[], Any]) -> Any:
    """Result of the call, with its warnings suppressed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return call()


def judged(errors: Any, positions: Floats, wrong: Any = None) -> Judgement:
    """A Judgement: answers that are not finite count as wrong, and errors of wrong answers are 0."""
    errors = np.abs(np.asarray(errors, np.float64))
    wrong = ~np.isfinite(errors) if wrong is None else np.asarray(wrong, bool) | ~np.isfinite(errors)
    return Judgement(np.where(wrong, 0.0, errors), wrong, positions)


def angles(a: Floats, b: Floats) -> Floats:
    """Angles between vectors (N, 3) [degrees], NaN if one is zero."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))
    return np.where(lengths > 0.0, angle, np.nan)


def unit(rows: Floats) -> Floats:
    """Vectors (..., 3) of length 1; zero where they are zero."""
    length = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.asarray(rows / np.where(length > 0.0, length, 1.0))


def setting_of(parameters: Mapping[str, Any]) -> str:
    """Parameters as a user would type them."""
    return ", ".join(f"{name}={value!r}" for name, value in parameters.items())


def failed(method: str, parameters: Mapping[str, Any], error: Exception) -> Trial:
    """A trial that could not be prepared: it raises when run, so that the others of its chart are still made."""

    def run() -> Any:
        raise error

    def judge(_: Any) -> Judgement:
        raise error

    return Trial(method, setting_of(parameters), run, judge, 0, 0, dict(parameters))


def held_bytes(*things: Any) -> int:
    """Bytes of all warp arrays reachable through attributes, warp structs and tuples; each is counted once.

    Memory behind a warp handle (the tree of a ``wp.Mesh``, the cells of a ``wp.HashGrid``) is not included.
    """
    sizes: dict[int, int] = {}
    seen: set[int] = set()
    waiting = list(things)
    while waiting:
        thing = waiting.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(thing, wp.array):
            if thing.ptr:
                sizes[thing.ptr] = max(sizes.get(thing.ptr, 0), thing.capacity)
        elif isinstance(thing, (tuple, list)):
            waiting.extend(thing)
        elif isinstance(getattr(thing, "__dict__", None), dict) and not isinstance(thing, type):
            # Warp's own objects reference all of warp.
            is_warp = type(thing).__module__.partition(".")[0] == "warp"
            parts = vars(thing).values()
            waiting.extend(part for part in parts if isinstance(part, wp.array) or not is_warp)
    return sum(sizes.values())


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
