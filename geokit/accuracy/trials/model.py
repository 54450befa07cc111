"""Data model of charts and sweeps: subjects, trials, judgements and measurements."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from inspect import signature
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.volume.model.sparse_volume import SparseVolume


class Subject(NamedTuple):
    """An object to measure on; exactly one of ``mesh``, ``volume`` and ``points`` is not None.

    Attributes:
        name: Name of the file or of the sample.
        mesh: Triangles.
        volume: A scalar grid.
        points: Positions (N, 3) float64 [world].
    """

    name: str
    mesh: TriangleMesh | None = None
    volume: SparseVolume | None = None
    points: NDArray[np.float64] | None = None


class Judgement(NamedTuple):
    """Comparison of answers with a float64 reference.

    Attributes:
        errors: Deviation of each checked answer from the reference, shape (M,), not negative [unit of the chart].
        wrong: Answers of a different kind than the reference, shape (M,) bool: outside instead of inside, a miss
            instead of a hit, a missing neighbor. Their errors do not count.
        positions: Position of each query [world], shape (M, 3); None if there is nothing to draw.
    """

    errors: NDArray[np.float64]
    wrong: NDArray[np.bool_]
    positions: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Trial:
    """One method with one setting, with everything prepared that is not part of the timed call.

    Attributes:
        method: The function, with its variant: "closest_point, float64".
        setting: The parameters as a user would type them: "voxel_size=0.01, order=3, codec='fp8'".
        run: The timed call.
        judge: Compares the result of ``run`` with the reference; not timed.
        count: Number of answers of one call, for the rate.
        byte_count: Memory of the prepared structures: the tree, the grid.
        parameters: The setting by name, for the table.
    """

    method: str
    setting: str
    run: Callable[[], object]
    judge: Callable[[Any], Judgement]
    count: int
    byte_count: int = 0
    parameters: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class Chart:
    """Methods that answer one question about one subject.

    Attributes:
        name: Identifier, also of the figure's file: "closest_point".
        title: The question: "Closest point on the surface".
        unit: Unit of the errors: "world", "degrees", "relative".
        answers: What the rate counts: "queries", "triangles", "voxels".
        trials: Makes the trials one after another; each one's data is freed before the next is made.
        vertical: The quantity charted against time: the errors, or the share of wrong answers.
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
        chart, subject, method, setting, device: Names of what was measured.
        seconds: Median time of a call [s].
        spread: Interquartile range of the times over their median.
        rate: Answers per second.
        peak_bytes: Largest increase of memory during a call.
        byte_count: Memory of the prepared structures.
        checked: Number of answers compared with the reference.
        max_error, rms_error, p999_error: Of the answers that are not wrong; the last is the 99.9th percentile [unit].
        wrong_share: Share of the checked answers that are wrong, 0 to 1.
        unit: Unit of the errors.
        parameters: The setting by name.
        judgement: The underlying comparison; kept for pictures, not written to the table.
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
    parameters: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    judgement: Judgement | None = field(default=None, repr=False, compare=False)


class Envelope(NamedTuple):
    """Range of a sweep within which a method keeps its promise.

    Attributes:
        last: Last value of the sweep's parameter at which the promise holds; sweeps run towards failure.
        error: Largest error up to there [unit of the sweep], or a function of the parameter.
        wrong_share: Largest share of wrong answers up to there.
        statement: The promise in a sentence.
    """

    last: float
    error: float | Callable[[float], float]
    wrong_share: float
    statement: str


@dataclass(frozen=True)
class Sweep:
    """A series of trials of one method towards failure.

    Attributes:
        name: Identifier, also of the figure's file: "closest_point_origin".
        method: The public function: "mesh.Surface.closest_point".
        parameter: The varied parameter, with its unit: "distance from the origin [sizes of the mesh]".
        unit: Unit of the errors.
        values: Values of the parameter, from harmless to failing.
        ask: Runs the method at a value and compares its answers with a float64 reference.
        envelope: The promise.
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


def cases_of(names: str, *rows: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Cases for :meth:`Sweeps.add`: the names of a table's columns, and its rows."""
    return [dict(zip(names.split(), row, strict=True)) for row in rows]


class Sweeps:
    """The sweeps of a module, in the order in which they are added."""

    def __init__(self) -> None:
        self._makers: list[Callable[[Any], Sweep]] = []

    def on(self, device: Any) -> list[Sweep]:
        """The sweeps, with methods that compute on a device; None for the first GPU, else the CPU."""
        return [make(device) for make in self._makers]

    def add(
        self,
        method: str,
        unit: str,
        name: str,
        parameter: str,
        values: tuple[float, ...] = (),
        /,
        *,
        cases: Iterable[Mapping[str, Any]] = ({},),
        error: float | Callable[[float], float] = 0.0,
        wrong_share: float = 0.0,
        logarithmic: bool = True,
        **promise: Any,
    ) -> Callable[[Callable[..., Judgement]], Callable[..., Judgement]]:
        """Decorator of the function that asks at a value, with keywords ``seed`` and ``device``.

        The arguments are those of :class:`Sweep` and :class:`Envelope`; ``last`` may depend on the device. Each case is
        a sweep: what the function takes besides, what texts name in braces, and arguments that differ from the others.
        """
        shared = {"values": values, "error": error, "wrong_share": wrong_share, "logarithmic": logarithmic, **promise}

        def note(ask: Callable[..., Judgement]) -> Callable[..., Judgement]:
            def make(case: Mapping[str, Any], device: Any) -> Sweep:
                facts = {**shared, **case}
                last, statement = facts["last"], facts["statement"].format(**facts)
                last = last(device) if callable(last) else last
                envelope = Envelope(last, facts["error"], facts["wrong_share"], statement)
                taken = {key: value for key, value in case.items() if key in signature(ask).parameters}
                asked, told = partial(ask, device=device, **taken), (name.format(**facts), method.format(**facts))
                return Sweep(*told, parameter, unit, facts["values"], asked, envelope, facts["logarithmic"])

            self._makers += [partial(make, case) for case in cases]
            return ask

        return note
