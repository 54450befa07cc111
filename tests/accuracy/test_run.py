"""A run over real charts: what is measured, what fails, and that a method made worse on purpose is noticed."""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.accuracy import (
    Chart,
    Judgement,
    Measurement,
    Results,
    Subject,
    Trial,
    _run,
    default_subjects,
    run,
)
from geokit.accuracy.charts import mesh_setup
from geokit.accuracy.report.pareto import front_of
from geokit.errors import InputError, UnsupportedGridError

run_module = importlib.import_module("geokit.accuracy._run")

SPHERE = Subject("sphere", mesh=mesh_catalog.icosphere(2))
SIZE = SPHERE.mesh.diagonal
CLOUD = Subject("cloud", points=np.random.default_rng(0).random((50, 3)))
# One of a thousand answers is made worse, by this share of the size.
SHARE, SHIFT = 1e-3, 1e-6
COUNT = 4000
# Far more than a call takes.
SLEEP = 0.25


def toy(name: str, trials: Callable[[], Any], vertical: Any = "error") -> Chart:
    return Chart(name, name, "world", "queries", trials, vertical)


def trial(method: str, answer: Callable[[], Any] = lambda: 0.0, wrong: bool = False) -> Trial:
    return Trial(method, "", answer, lambda a: Judgement(np.array([float(a)]), np.array([wrong])), 1)


@pytest.fixture
def charts(monkeypatch):
    """Have every subject's charts made by a function."""

    def use(*makers: Callable[[Subject, Any, bool], list[Chart]]) -> None:
        monkeypatch.setattr(run_module, "_makers", lambda subject: list(makers))

    return use


# What is measured.


def test_rows_come_in_order_with_what_the_charts_ask(charts):
    asked: list[tuple[str, Any, bool]] = []

    def make(subject, device, quick):
        asked.append((subject.name, device, quick))
        return [toy("a", lambda: [trial("one"), trial("two")]), toy("b", lambda: [trial("three")], "wrong")]

    charts(make)
    said: list[str] = []
    found = run([SPHERE, CLOUD, CLOUD], devices=["cpu", "cpu"], quick=True, progress=said.append)
    assert isinstance(found, Results)
    assert [(row.subject, row.chart, row.method) for row in found] == [
        (subject, chart, method)
        for subject in ("sphere", "cloud", "cloud (2)")
        for chart, method in (("a", "one"), ("a", "two"), ("b", "three"))
    ]
    assert asked == [(name, "cpu", True) for name in ("sphere", "cloud", "cloud (2)")]
    assert [found.charts[name].vertical for name in ("a", "b")] == ["error", "wrong"]
    assert list(found.subjects) == ["sphere", "cloud", "cloud (2)"]
    assert found.failures == []
    assert len(said) == 9
    assert "one" in said[0]


def test_charts_can_be_chosen(charts):
    charts(lambda subject, device, quick: [toy(name, lambda: [trial("m")]) for name in ("a", "b", "c")])
    assert [row.chart for row in run([SPHERE], devices=["cpu"], quick=True, charts=["c", "a"])] == ["a", "c"]
    assert [row.chart for row in run([SPHERE], devices=["cpu"], quick=True, charts="b")] == ["b"]
    with pytest.raises(InputError, match=r"no 'd' .* use one of a, b, c"):
        run([SPHERE], devices=["cpu"], charts=["a", "d"])


def test_what_one_trial_holds_is_gone_before_the_next(charts):
    alive = 0

    class Held:
        def __init__(self):
            nonlocal alive
            alive += 1
            assert alive == 1

        def __del__(self):
            nonlocal alive
            alive -= 1

    def make() -> Iterator[Trial]:
        for number in range(3):
            held = Held()
            run = (lambda kept: lambda: 0.0 if kept else 1.0)(held)
            del held
            yield trial(str(number), run)
            del run

    charts(lambda subject, device, quick: [toy("a", make)])
    assert len(run([SPHERE], devices=["cpu"], quick=True)) == 3


@pytest.mark.parametrize(
    ("subjects", "options", "message"),
    [
        ([], {}, "subjects: empty"),
        ([Subject("none")], {}, "holds 0 things"),
        ([SPHERE._replace(points=np.zeros((1, 3)))], {}, "holds 2 things"),
        ([SPHERE], {"devices": []}, "devices: empty"),
        ([SPHERE], {"devices": ["cuda:99"]}, "cuda:99"),
    ],
)
def test_refusals(subjects, options, message):
    with pytest.raises(InputError, match=message):
        run(subjects, **options)


# What fails.


def test_a_failure_is_kept_and_the_run_goes_on(charts):
    def fail(message):
        def answer():
            raise RuntimeError(message)

        return answer

    def half():
        yield trial("first")
        raise ValueError("no more trials")

    def not_at_all():
        raise ValueError("no trials")

    def broken_maker(subject, device, quick):
        raise UnsupportedGridError("not a kind")

    def no_judge(answer):
        return Judgement(np.zeros(0), np.zeros(0, dtype=bool))

    empty = dataclasses.replace(trial("empty"), judge=no_judge)
    charts(
        broken_maker,
        lambda subject, device, quick: [
            toy("a", lambda: [trial("bad", fail("broken\n  down")), empty, trial("good")]),
            toy("b", half),
            toy("c", not_at_all),
            toy("d", lambda: [trial("last")]),
        ],
    )
    found = run([SPHERE], devices=["cpu"], quick=True)
    assert [(row.chart, row.method) for row in found] == [("a", "good"), ("b", "first"), ("d", "last")]
    assert [(f.chart, f.method, f.message) for f in found.failures] == [
        ("", "", "UnsupportedGridError: not a kind"),
        ("a", "bad", "RuntimeError: broken down"),
        ("a", "empty", "InputError: empty (): the judge checked no answer; give it at least one"),
        ("b", "", "ValueError: no more trials"),
        ("c", "", "ValueError: no trials"),
    ]


def test_an_interrupt_ends_the_run(charts):
    def interrupt():
        raise KeyboardInterrupt

    charts(lambda subject, device, quick: [toy("a", lambda: [trial("a", interrupt)])])
    with pytest.raises(KeyboardInterrupt):
        run([SPHERE], devices=["cpu"])


# Worse on purpose.


@pytest.fixture
def mesh_chart(monkeypatch, charts):
    """One of geokit's own charts, each trial whose method is named followed by what is made of it."""
    from geokit.accuracy.charts.makers import mesh_charts

    monkeypatch.setattr(mesh_setup, "COUNTS", {"cpu": (COUNT, COUNT), "cuda": (COUNT, COUNT)})

    def measured(name: str, method: str, change: Callable[[Trial], Trial]) -> dict[str, Measurement]:
        def make(subject, device, quick):
            (chart,) = (chart for chart in mesh_charts(subject, device, quick) if chart.name == name)

            def both() -> Iterator[Trial]:
                first = next(t for t in chart.trials() if t.method == method)
                yield first
                yield dataclasses.replace(change(first), method="worse")

            return [dataclasses.replace(chart, trials=both)]

        charts(make)
        found = run([SPHERE], devices=["cpu"], quick=True)
        assert found.failures == []
        return {"good" if row.method == method else row.method: row for row in found}

    return measured


def some(count: int) -> np.ndarray:
    """A thousandth of the rows."""
    return np.random.default_rng(3).choice(count, size=int(SHARE * count), replace=False)


def with_answer(change: Callable[[Any], Any]) -> Callable[[Trial], Trial]:
    return lambda found: dataclasses.replace(found, run=lambda: change(found.run()))


def in_equal_time(rows: dict[str, Measurement]) -> list[Measurement]:
    """Both with one time: what is tested is that the answers alone decide."""
    return [rows["good"], dataclasses.replace(rows["worse"], seconds=rows["good"].seconds, rate=rows["good"].rate)]


def test_answers_moved_by_a_millionth_are_noticed(mesh_chart):
    import warp as wp

    def moved(answer):
        distance = answer.distance.numpy().copy()
        distance[some(len(distance))] += SHIFT * SIZE
        return answer._replace(distance=wp.array(distance, dtype=wp.float64, device="cpu"))

    rows = mesh_chart("closest_point", "closest_point, float64", with_answer(moved))
    assert rows["good"].max_error < 1e-14 * SIZE
    assert rows["worse"].max_error == pytest.approx(SHIFT * SIZE, rel=1e-6)
    assert rows["worse"].checked * SHARE >= 1.0
    assert rows["worse"].wrong_share == 0.0
    assert front_of(in_equal_time(rows), "error") == [0]


def test_hits_lost_are_noticed(mesh_chart):
    import warp as wp

    def lost(answer):
        found = answer.triangle_id.numpy().copy()
        found[some(len(found))] = -1
        return answer._replace(triangle_id=wp.array(found, dtype=wp.int32, device="cpu"))

    rows = mesh_chart("closest_point", "closest_point, float64", with_answer(lost))
    assert rows["good"].wrong_share == 0.0
    assert 0.0 < rows["worse"].wrong_share < 10 * SHARE
    # The errors of the others are as small: only the wrong answers keep it off the front.
    assert rows["worse"].max_error <= rows["good"].max_error
    assert front_of(in_equal_time(rows), "error") == [0]


def test_signs_flipped_are_noticed(mesh_chart):
    import warp as wp

    def flipped(answer):
        inside = answer.numpy().copy()
        rows = some(len(inside))
        inside[rows] = ~inside[rows]
        return wp.array(inside, dtype=wp.bool, device="cpu")

    rows = mesh_chart("sign", "contains, pseudonormal", with_answer(flipped))
    assert rows["good"].wrong_share == 0.0
    assert 0.0 < rows["worse"].wrong_share < 10 * SHARE
    assert front_of(in_equal_time(rows), "wrong") == [0]


@pytest.mark.slow
def test_a_method_made_slower_leaves_the_front(mesh_chart):
    def slower(found: Trial) -> Trial:
        def run():
            time.sleep(SLEEP)
            return found.run()

        return dataclasses.replace(found, run=run)

    rows = mesh_chart("closest_point", "closest_point, float64", slower)
    assert rows["worse"].seconds > SLEEP
    assert rows["worse"].max_error == rows["good"].max_error
    assert front_of([rows["worse"], rows["good"]], "error") == [1]


# Default subjects.


def test_default_subjects_are_of_every_kind():
    for quick in (False, True):
        found = default_subjects(quick=quick)
        kinds = ["mesh" if s.mesh is not None else "volume" if s.volume is not None else "points" for s in found]
        assert set(kinds) == {"mesh", "volume", "points"}
        assert len({subject.name for subject in found}) == len(found)
        assert (len(found) == 3) == quick


def test_without_the_samples_there_are_made_ones(monkeypatch, tmp_path):
    monkeypatch.setattr(_run, "SAMPLES", tmp_path)
    mesh, volume, points = default_subjects()
    assert mesh.mesh is not None
    assert volume.volume is not None
    assert points.points is not None
    from geokit.mesh import audit

    report = audit(mesh.mesh)
    assert report.watertight
    assert report.oriented
    # Wound outward.
    enclosed = np.linalg.det(mesh.mesh.vertices[mesh.mesh.faces]).sum() / 6.0
    assert enclosed == pytest.approx(2.0 * np.pi**2 * 0.16, rel=0.01)
    radius = np.hypot(np.hypot(points.points[:, 0], points.points[:, 1]) - 1.0, points.points[:, 2])
    np.testing.assert_allclose(radius, 0.4, rtol=1e-12)
    # Evenly over the area: the outer half of the ring has 1/2 + 0.4 / pi of it.
    outer = (np.hypot(points.points[:, 0], points.points[:, 1]) > 1.0).mean()
    assert outer == pytest.approx(0.5 + 0.4 / np.pi, abs=0.02)
    inside = volume.volume.sample(np.array([[1.0, 0.0, 0.0], [1.45, 0.0, 0.0]]))
    assert inside[0] < 0.0 < inside[1]
