"""Helpers shared by the trials of all charts: transfers, judgements, and trials that could not be prepared."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.trials.model import Judgement, Trial

__all__ = ["angles", "failed", "judged", "on_host", "send", "setting_of", "unit", "without_warnings"]

Floats = NDArray[np.float64]


def send(points: Floats, device: Any) -> Any:
    """Points on the device, so that transfers are not timed."""
    import warp as wp

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
