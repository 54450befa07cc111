"""Sweeps are run, compared with their envelopes, and written to the page with a figure each."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest

from geokit.accuracy import Envelope, Judgement, Outcome, Sweep, follow, write_stability
from geokit.accuracy.stability.follow_sweeps import inside, keeps, promised
from geokit.errors import FileAccessError, InputError, UnsupportedGridError


def judgement(error: float, wrong: int = 0, count: int = 10) -> Judgement:
    flags = np.arange(count) < wrong
    return Judgement(np.where(flags, 1e9, error), flags)


def sweep(
    name="toy", ask=lambda value: judgement(value * 0.9e-9), values=(1.0, 10.0, 100.0, 1e3), last=100.0, error=1e-7,
    wrong_share=0.0, logarithmic=True,
) -> Sweep:  # fmt: skip
    envelope = Envelope(last, error, wrong_share, "Right to 1e-7 up to 100 | and no further.")
    return Sweep(name, "mesh.toy", "badness [1|2]", "world", values, ask, envelope, logarithmic)


def test_outcomes_are_the_worst_of_the_answers():
    found = follow(sweep(ask=lambda value: judgement(value, wrong=3)))
    assert found[1] == Outcome(10.0, 10.0, 0.3)
    assert [outcome.value for outcome in follow(sweep(), (5.0,))] == [5.0]
    assert follow(sweep(ask=lambda value: judgement(math.nan)))[0].max_error == math.inf
    everything = follow(sweep(ask=lambda value: judgement(1.0, wrong=10)))[0]
    assert math.isnan(everything.max_error)
    assert everything.wrong_share == 1.0
    with pytest.raises(InputError, match="no answer was checked at 1"):
        follow(sweep(ask=lambda value: judgement(1.0, count=0)))


def test_a_refusal_is_an_outcome_and_another_error_is_not():
    def refuse(value):
        if value > 10.0:
            raise UnsupportedGridError("too\nmuch")
        return judgement(0.0)

    found = follow(sweep(ask=refuse))
    assert [outcome.refusal for outcome in found] == ["", "", *["UnsupportedGridError: too much"] * 2]
    assert not keeps(sweep(), found[-1])

    def fail(value):
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        follow(sweep(ask=fail))


def test_promises():
    plain = sweep()
    assert keeps(plain, Outcome(1.0, 1e-7, 0.0))
    assert not keeps(plain, Outcome(1.0, 1.01e-7, 0.0))
    assert not keeps(plain, Outcome(1.0, 0.0, 1e-6))
    assert not keeps(plain, Outcome(1.0, math.inf, 0.0))
    assert keeps(sweep(wrong_share=1.0), Outcome(1.0, math.nan, 1.0))
    growing = sweep(error=lambda value: 2e-9 * value)
    assert promised(growing, 50.0) == 2e-9 * 50.0
    assert [keeps(growing, outcome) for outcome in follow(growing)] == [True] * 4


def test_inside_is_up_to_the_last_value_in_the_direction_of_the_sweep():
    assert [inside(sweep(), value) for value in (1.0, 100.0, 100.1)] == [True, True, False]
    falling = sweep(values=(10.0, 1.0, 0.1), last=1.0)
    assert [inside(falling, value) for value in (10.0, 1.0, 0.1)] == [True, True, False]


@pytest.fixture(scope="module")
def kinds() -> list[Sweep]:
    """Errors that grow, that are exact, that are infinite, that are refused; axes of all kinds."""

    def refuse(value):
        if value > 10.0:
            raise UnsupportedGridError("too much | of it")
        return judgement(1e-8)

    right_or_wrong = sweep("right", ask=lambda value: judgement(0.0, wrong=int(value > 100.0)), error=0.0)
    right_or_wrong = dataclasses.replace(right_or_wrong, unit="none")
    right_or_refused = dataclasses.replace(sweep("right_or_refused", ask=refuse, last=10.0), unit="none")
    return [
        sweep(),
        sweep("exact", ask=lambda value: judgement(0.0), error=0.0),
        sweep("infinite", ask=lambda value: judgement(math.inf if value > 100.0 else 1e-9)),
        sweep("refused", ask=refuse, last=10.0),
        sweep("wrong", ask=lambda value: judgement(1e-8, wrong=int(value > 100.0) * 10)),
        sweep("broken", ask=lambda value: judgement(value)),
        sweep("linear", values=(0.0, 1.0, 2.0), last=1.0, logarithmic=False),
        sweep("from_zero", values=(0.0, 1e-3, 1.0), last=1.0),
        sweep("falling", values=(1.0, 0.1, 0.01), last=0.1, error=lambda value: 1e-9 / value),
        right_or_wrong,
        right_or_refused,
        sweep("nothing_covered", last=0.5),
    ]


@pytest.mark.slow
def test_the_page_and_its_figures(kinds, tmp_path):
    from matplotlib.image import imread

    said: list[str] = []
    page = write_stability(tmp_path / "docs", chosen=kinds, progress=said.append)
    assert page == tmp_path / "docs" / "stability.md"
    assert len(said) == len(kinds)
    text = page.read_text(encoding="utf-8")
    figures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text.replace("[1\\|2]", ""))
    assert figures == [f"figures/stability/{found.name}.png" for found in kinds]
    for name in figures:
        path = page.parent / name
        assert path.stat().st_size < 40_000
        pixels = imread(path)
        assert pixels.shape[:2] == (400, 520)
        assert 0.01 < (pixels[..., :3].min(axis=-1) < 0.7).mean() < 0.5
    # The shade of the envelope is there where something is covered, and only there.
    shades = [green(imread(page.parent / name)) for name in figures]
    assert min(shades[:-1]) > 100
    assert shades[-1] == 0
    assert text.count("**BROKEN**") == 3
    assert text.count("refused, UnsupportedGridError: too much \\| of it") == 4
    for found in kinds:
        assert f"](#{found.name})" in text
        assert f'<a id="{found.name}"></a>' in text
    rows = [line for line in text.splitlines() if line.startswith("|")]
    # A pipe inside a cell does not make another.
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in rows} == {5, 6}


def green(pixels: np.ndarray) -> int:
    red, middle, blue = (pixels[..., channel] for channel in range(3))
    return int(((middle - red > 0.08) & (middle - blue > 0.02)).sum())


@pytest.mark.slow
def test_figures_of_lines(tmp_path):
    for kind, head, mark in (("svg", b"<?xml", "!["), ("pdf", b"%PDF", "\n[")):
        page = write_stability(tmp_path, chosen=[sweep("one")], force=True, figure_format=kind)
        assert (tmp_path / f"figures/stability/one.{kind}").read_bytes().startswith(head)
        assert re.search(re.escape(mark) + rf"[^\n]*\(figures/stability/one\.{kind}\)", page.read_text())
    with pytest.raises(InputError, match="figure_format"):
        write_stability(tmp_path, chosen=[sweep("one")], force=True, figure_format="gif")


def test_a_page_is_replaced_only_with_force_and_only_whole(tmp_path):
    page = write_stability(tmp_path, chosen=[sweep()])
    before = page.read_bytes()
    with pytest.raises(InputError, match="exists already"):
        write_stability(tmp_path, chosen=[sweep()])

    def fail(value):
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError):
        write_stability(tmp_path, chosen=[sweep("other", ask=fail)], force=True)
    assert page.read_bytes() == before
    write_stability(tmp_path, chosen=[sweep("third")], force=True)
    assert b"third" in page.read_bytes()


def test_refusals(tmp_path):
    with pytest.raises(InputError, match="empty"):
        write_stability(tmp_path, chosen=[])
    with pytest.raises(InputError, match="two sweeps are called 'toy'"):
        write_stability(tmp_path, chosen=[sweep(), sweep()])
    (tmp_path / "file").write_text("")
    with pytest.raises(FileAccessError, match="cannot be made a folder"):
        write_stability(tmp_path / "file", chosen=[sweep()])
