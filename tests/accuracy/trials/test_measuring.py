"""The harness: times, memory and errors of a trial, the front, choices by tolerance, and the table."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
import time

import numpy as np
import pytest

from geokit.accuracy import Chart, Judgement, Measurement, Trial, front, knee, measure, read_table, write_table
from geokit.accuracy.report.html import choices
from geokit.accuracy.report.pareto import front_of, tolerance_steps
from geokit.accuracy.report.table import COLUMNS
from geokit.accuracy.trials.measuring import peak_bytes
from geokit.accuracy.trials.results import grouped
from geokit.core import launcher
from geokit.errors import FileAccessError, FileFormatError, InputError

CHART = Chart("toy", "A toy", "world", "queries", list)
MIB = 1 << 20


def trial(errors, wrong=None, *, run=lambda: None, count=100) -> Trial:
    table = np.asarray(errors, dtype=np.float64)
    flags = np.zeros(len(table), dtype=bool) if wrong is None else np.asarray(wrong, dtype=bool)
    return Trial("method", "setting=1", run, lambda answer: Judgement(table, flags), count, 7, {"setting": 1})


def row(method="m", *, seconds=1.0, error=0.0, wrong=0.0, device="cpu", setting="s") -> Measurement:
    """A measurement of one answer a call."""
    return Measurement(
        chart="toy", subject="thing", method=method, setting=setting, device=device, seconds=seconds, spread=0.0,
        rate=1.0 / seconds, peak_bytes=1, byte_count=2, checked=100, max_error=error, rms_error=error,
        p999_error=error, wrong_share=wrong, unit="world",
    )  # fmt: skip


def measured(errors, wrong=None) -> Measurement:
    return measure(trial(errors, wrong), CHART, "thing", "cpu", quick=True)


# Errors.


def test_errors_are_those_of_right_answers():
    found = measured([3.0, 4.0, 1e9, 0.0], [False, False, True, False])
    assert (found.max_error, found.wrong_share, found.checked) == (4.0, 0.25, 4)
    assert found.rms_error == pytest.approx(math.sqrt(25.0 / 3.0), rel=1e-15)
    assert (found.chart, found.subject, found.method, found.device) == ("toy", "thing", "method", "cpu")
    assert (found.byte_count, found.unit, dict(found.parameters)) == (7, "world", {"setting": 1})
    assert found.judgement is not None


def test_the_percentile_is_an_error_that_occurred():
    errors = np.arange(10_001.0)
    assert measured(errors).p999_error == 9990.0
    # Two of a thousand are above it, one is not: the percentile sees the two.
    assert measured([0.0] * 998 + [1.0] * 2).p999_error == 1.0
    assert measured([0.0] * 999 + [1.0] * 2).max_error == 1.0


def test_squares_neither_overflow_nor_vanish():
    assert measured([1e200, 0.0, 0.0, 0.0]).rms_error == pytest.approx(5e199, rel=1e-12)
    assert measured([1e-200, 0.0, 0.0, 0.0]).rms_error == pytest.approx(5e-201, rel=1e-12)
    assert measured([0.0, 0.0]).rms_error == 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_an_answer_that_is_no_number_is_not_right(bad):
    found = measured([1.0, bad])
    assert found.max_error == math.inf
    assert found.rms_error == math.inf


def test_no_right_answer_leaves_no_error():
    found = measured([0.0, 0.0], [True, True])
    assert found.wrong_share == 1.0
    assert all(math.isnan(value) for value in (found.max_error, found.rms_error, found.p999_error))


def test_judges_that_cannot_be_used():
    with pytest.raises(InputError, match="checked no answer"):
        measured([])
    with pytest.raises(InputError, match="error 1 is negative"):
        measured([0.0, -1.0])
    with pytest.raises(InputError, match=r"errors \(2,\) and wrong \(1,\)"):
        measured([0.0, 1.0], [True])
    # A wrong answer has no error, negative or not.
    assert measured([0.0, -1.0], [False, True]).max_error == 0.0


# Times and memory.


@pytest.mark.slow
def test_time_is_that_of_a_call():
    calls: list[float] = []

    def run():
        calls.append(time.perf_counter())
        # The first call, as one that compiles, and the second, in which memory is measured, do not count.
        time.sleep(0.2 if len(calls) <= 2 else 0.02)

    found = measure(trial([0.0], run=run, count=10), CHART, "thing", "cpu", quick=True)
    assert len(calls) >= 5
    assert 0.02 <= found.seconds < 0.2
    assert found.rate == 10 / found.seconds


def test_peak_memory_counts_what_a_call_takes_and_gives_back():
    device = launcher.resolve_device("cpu")

    def run():
        return np.ones(64 * MIB // 8)[:1].copy()

    run()
    assert 60 * MIB < peak_bytes(run, device) < 80 * MIB
    assert peak_bytes(lambda: None, device) < 4 * MIB
    # Memory held before the call does not count.
    held = np.ones(64 * MIB // 8)
    assert peak_bytes(lambda: held[0], device) < 4 * MIB


# The front.


def test_front_by_hand():
    seconds = [1.0, 2.0, 3.0, 4.0, 0.5, 2.0]
    errors = [1e-1, 1e-3, 1e-2, 0.0, math.nan, 1e-3]
    assert front(seconds, errors).tolist() == [0, 1, 3]
    assert front([], []).tolist() == []
    assert front([1.0], [math.nan]).tolist() == []
    # A hundredth less is not worth the time, but many hundredths one after another are.
    errors = [1.0, 0.995, 0.985, 0.98]
    assert front([1.0, 2.0, 3.0, 4.0], errors).tolist() == [0, 1, 2, 3]
    assert front([1.0, 2.0, 3.0, 4.0], errors, resolution=0.01).tolist() == [0, 2]
    with pytest.raises(InputError, match="seconds"):
        front([1.0], [1.0, 2.0])


def test_front_is_what_nothing_beats():
    random = np.random.default_rng(0)
    for _ in range(50):
        # Few different values, so that many are equal.
        seconds, errors = random.integers(1, 9, (2, 40)).astype(float)
        found = set(front(seconds, errors).tolist())
        for i in range(40):
            beats = (seconds <= seconds[i]) & (errors <= errors[i]) & ((seconds < seconds[i]) | (errors < errors[i]))
            twin = (seconds == seconds[i]) & (errors == errors[i])
            assert (i in found) == (not beats.any() and i == int(np.argmax(twin)))


def test_wrong_answers_are_not_on_the_front_of_errors():
    rows = [row(seconds=1.0, error=1e-9, wrong=0.01), row(seconds=2.0, error=1e-6), row(seconds=3.0, error=1e-7)]
    assert front_of(rows, "error") == [1, 2]
    assert front_of(rows[:1], "error") == [0]
    # Where every row has some, the most careful ones.
    rows = [row(seconds=1.0, error=1e-9, wrong=0.01), row(seconds=2.0, error=1e-6, wrong=0.001)]
    assert front_of(rows, "error") == [1]
    assert front_of(rows, "wrong") == [0, 1]
    # An answer that is not a number is none.
    assert front_of([row(seconds=1.0, error=math.inf), row(seconds=2.0, error=1.0)], "error") == [1]
    assert front_of([row(error=math.nan, wrong=1.0)], "error") == []
    assert front_of([], "error") == []


def test_settings_that_answer_another_question_are_on_no_front():
    def asked(seconds: float, error: float, **parameters: float):
        return dataclasses.replace(row(str(parameters), seconds=seconds, error=error), parameters=parameters)

    # A short search radius leaves most queries without an answer, and is fast.
    near = asked(0.1, 0.0, max_distance=0.04)
    rows = [near, asked(1.0, 1e-6, max_distance=math.inf), asked(2.0, 0.0, max_distance=math.inf)]
    assert front_of(rows, "error") == [1, 2]
    assert near not in [choice.row for choice in choices(rows, "error")]
    few = [asked(0.1, 0.0, k=1), asked(1.0, 0.0, k=8), asked(0.2, 0.0, k=8, radius=0.1), asked(2.0, 0.0, k=8)]
    assert front_of(few, "wrong") == [1]
    # A radius alone is a resolution.
    thin = [asked(1.0, 1e-2, radius=1.0), asked(2.0, 1e-3, radius=0.5)]
    assert front_of(thin, "error") == [0, 1]


def test_calls_compare_where_answers_are_not_as_many():
    # Ten times the triangles in five times the time.
    rows = [row("coarse", seconds=1.0, error=1e-1), row("fine", seconds=0.5, error=1e-2)]
    rows[1] = dataclasses.replace(rows[1], seconds=5.0)
    assert front_of(rows, "error") == [1]
    assert front_of(rows, "error", per_call=True) == [0, 1]
    assert [group.per_call for group in grouped(rows)] == [True]
    assert [c.row.method for c in choices(rows, "error", per_call=True) if c.row] == ["coarse", "fine"]
    assert [c.row.method for c in choices(rows, "error") if c.row] == ["fine", "fine"]
    same = [row(seconds=1.0), row(seconds=2.0), row(seconds=1e-3, device="cuda:0")]
    same[2] = dataclasses.replace(same[2], rate=1e6)
    assert [group.per_call for group in grouped(same)] == [False]


def test_knee():
    # Ten times slower for half a decade, then again ten times for five: the second is not worth its price.
    assert knee([1.0, 1.2, 100.0], [1.0, 1e-5, 1e-6]) == 1
    assert knee([1.0], [0.0]) == 0
    assert knee([1.0, 10.0], [math.inf, 0.0]) in (0, 1)
    with pytest.raises(InputError):
        knee([], [])


def test_tolerances_tell_settings_apart():
    assert tolerance_steps([2e-3, 5e-6, 0.0, math.inf, math.nan]) == [1e-2, 1e-3, 1e-4, 1e-5]
    assert tolerance_steps([1e-3]) == [1e-3]
    assert tolerance_steps([0.0]) == []


def test_what_to_choose():
    rows = [
        row("quick", seconds=1.0, error=2e-3),
        row("fine", seconds=5.0, error=2e-5),
        row("exact", seconds=9.0, error=0.0),
        row("leaky", seconds=0.1, error=1e-8, wrong=0.001),
        row("slow", seconds=20.0, error=1e-5, device="cuda:0"),
    ]
    found = [(c.device, c.tolerance, c.row.method if c.row else None) for c in choices(rows, "error")]
    assert found == [
        *(("cpu", step, "quick") for step in (1e-2,)),
        *(("cpu", step, "fine") for step in (1e-3, 1e-4)),
        *(("cpu", step, "exact") for step in (1e-5, 1e-6, 1e-7, 1e-8, 0.0)),
        *(("cuda:0", step, "slow") for step in (1e-2, 1e-3, 1e-4, 1e-5)),
        *(("cuda:0", step, None) for step in (1e-6, 1e-7, 1e-8, 0.0)),
    ]
    shares = choices([row("a", seconds=1.0, wrong=0.05), row("b", seconds=2.0)], "wrong")
    assert [(c.tolerance, c.row.method) for c in shares if c.row] == [(0.1, "a"), (0.0, "b")]


# The table.


def test_the_table_is_read_back_bit_for_bit(tmp_path):
    rows = [
        row('a "quoted", name', seconds=1.0 / 3.0, error=5e-324, setting="voxel_size=0.1, codec='fp8'\nsecond line"),
        row("b", seconds=1e-9, error=math.inf, wrong=0.1),
    ]
    target = write_table(rows, tmp_path / "results.csv")
    assert read_table(target) == rows
    assert target.read_text().splitlines()[0] == ",".join(COLUMNS)
    assert "judgement" not in COLUMNS
    found = measure(
        Trial("m", "s", lambda: None, lambda a: Judgement(np.ones(2), np.zeros(2, dtype=bool)), 3, 0,
              {"size": np.float64(0.1), "shape": (1, 2), "array": np.arange(2), "kind": "x"}),
        CHART, "thing", "cpu", quick=True)  # fmt: skip
    write_table([found], target)
    (again,) = read_table(target)
    assert again.parameters == {"size": 0.1, "shape": [1, 2], "array": [0, 1], "kind": "x"}
    assert again.seconds == found.seconds


def test_a_row_without_errors_is_read_back(tmp_path):
    write_table([row(error=math.nan, wrong=1.0)], tmp_path / "results.csv")
    assert math.isnan(read_table(tmp_path / "results.csv")[0].max_error)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("chart,", "card,", 1), "line 1 is not the header"),
        (lambda text: "", "line 1 is not the header"),
        (lambda text: text + "a,b\n", "line 3 has 2 cells"),
        (lambda text: text.replace("thing,m,s,cpu,1.0", "thing,m,s,cpu,much"), "line 2 holds what is not a number"),
        (lambda text: text.replace("{}", "{"), "line 2 holds what is not a number"),
        (lambda text: text.replace("thing", "\udcff"), "not CSV"),
    ],
)
def test_damaged_tables(tmp_path, change, message):
    target = write_table([row()], tmp_path / "results.csv")
    target.write_bytes(change(target.read_text()).encode("utf-8", "surrogateescape"))
    with pytest.raises(FileFormatError, match=message):
        read_table(target)


def test_a_missing_table(tmp_path):
    with pytest.raises(FileAccessError, match="no such file"):
        read_table(tmp_path / "results.csv")


def test_the_package_is_light():
    heavy = ("warp", "vtk", "vtkmodules", "pyvista", "matplotlib", "scipy", "PIL")
    code = f"import sys, geokit.accuracy; print(sorted(set(sys.modules) & set({heavy!r})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_are_there():
    from geokit import accuracy

    assert all(getattr(accuracy, name) is not None for name in accuracy.__all__)
    assert list(accuracy.__all__) == sorted(accuracy.__all__) == dir(accuracy)
    assert callable(accuracy.run)
    assert callable(accuracy.measure)
