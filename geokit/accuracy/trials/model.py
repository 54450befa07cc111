"""What charts and sweeps are made of: questions, the methods that answer them, and how right the answers were."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh
    from geokit.volume._model import SparseVolume

__all__ = ["Chart", "Envelope", "Judgement", "Measurement", "Subject", "Sweep", "Trial"]


class Subject(NamedTuple):
    """What methods are measured on; exactly one of ``mesh``, ``volume`` and ``points`` is not None.

    Attributes:
        name: Of the file or the sample.
        mesh: Triangles.
        volume: A scalar grid.
        points: Positions (N, 3) float64 [world].
    """

    name: str
    mesh: TriangleMesh | None = None
    volume: SparseVolume | None = None
    points: NDArray[np.float64] | None = None


class Judgement(NamedTuple):
    """Answers held against a float64 reference.

    Attributes:
        errors: How far each checked answer is from the reference, shape (M,), not negative [unit of the chart].
        wrong: Answers of another kind than the reference's, shape (M,) bool: outside for inside, a miss for a hit, a
            neighbor missing. Their errors do not count.
        positions: Where each was asked [world], shape (M, 3); None where that cannot be drawn.
    """

    errors: NDArray[np.float64]
    wrong: NDArray[np.bool_]
    positions: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Trial:
    """One method with one setting, everything prepared that is not part of the question.

    Attributes:
        method: The function, with its variant: "closest_point, float64".
        setting: What was chosen, as a reader would type it: "voxel_size=0.01, order=3, codec='fp8'".
        run: The call that is timed.
        judge: Holds what ``run`` gave against the reference; not timed.
        count: Answers of one call, for the rate.
        byte_count: Size of what was prepared: the tree, the grid.
        parameters: The setting by name, for the table.
    """

    method: str
    setting: str
    run: Callable[[], Any]
    judge: Callable[[Any], Judgement]
    count: int
    byte_count: int = 0
    parameters: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class Chart:
    """Methods that answer one question about one subject.

    Attributes:
        name: Identifier, also of the figure's file: "closest_point".
        title: The question: "Closest point on the surface".
        unit: Of the errors: "world", "degrees", "relative".
        answers: What the rate counts: "queries", "triangles", "voxels".
        trials: Makes the trials one after another, so that what one prepared is gone before the next is made.
        vertical: What the chart shows against time: the errors, or the share of wrong answers.
    """

    name: str
    title: str
    unit: str
    answers: str
    trials: Callable[[], Iterable[Trial]]
    vertical: Literal["error", "wrong"] = "error"


@dataclass(frozen=True)
class Measurement:
    """A row of the results.

    Attributes:
        chart, subject, method, setting, device: What was measured, on what.
        seconds: Median time of a call [s].
        spread: Of the times: their interquartile range over their median.
        rate: Answers a second.
        peak_bytes: Most memory that a call took beyond what was there before.
        byte_count: Size of what was prepared.
        checked: Number of answers held against the reference.
        max_error, rms_error, p999_error: Of those that are not wrong; the last is the 99.9th percentile [unit].
        wrong_share: Share of the checked answers that are wrong, 0 to 1.
        unit: Of the errors.
        parameters: The setting by name.
        judgement: What the numbers are made of; kept for pictures, not written to the table.
    """

    chart: str
    subject: str
    method: str
    setting: str
    device: str
    seconds: float
    spread: float
    rate: float
    peak_bytes: int
    byte_count: int
    checked: int
    max_error: float
    rms_error: float
    p999_error: float
    wrong_share: float
    unit: str
    parameters: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    judgement: Judgement | None = field(default=None, repr=False, compare=False)


class Envelope(NamedTuple):
    """Up to where a method keeps its promise.

    Attributes:
        last: Last value of the sweep's parameter at which the promise holds; sweeps go towards failure.
        error: Greatest error up to there [unit of the sweep], or how it follows from the parameter.
        wrong_share: Greatest share of wrong answers up to there.
        statement: The promise in a sentence, as docstrings quote it.
    """

    last: float
    error: float | Callable[[float], float]
    wrong_share: float
    statement: str


@dataclass(frozen=True)
class Sweep:
    """One method on its way towards failure.

    Attributes:
        name: Identifier, also of the figure's file: "closest_point_origin".
        method: The public function: "mesh.Surface.closest_point".
        parameter: What grows worse, with its unit: "distance from the origin [sizes of the mesh]".
        unit: Of the errors.
        values: From harmless to hopeless.
        ask: Answers at a value, judged by a float64 reference.
        envelope: What is promised.
        logarithmic: Whether the values are drawn on a logarithmic axis.
    """

    name: str
    method: str
    parameter: str
    unit: str
    values: tuple[float, ...]
    ask: Callable[[float], Judgement]
    envelope: Envelope
    logarithmic: bool = True
