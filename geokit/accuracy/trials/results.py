"""Results of a run: rows, chart metadata, subjects, machine and failures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

from geokit.accuracy.trials.model import Chart, Measurement, Subject


class ChartInfo(NamedTuple):
    """A chart without its trials.

    Attributes:
        name, title, unit, answers, vertical: Those of its Chart.
    """

    name: str
    title: str
    unit: str
    answers: str
    vertical: Literal["error", "wrong"]


class Failure(NamedTuple):
    """A trial or chart that could not be measured.

    Attributes:
        chart, subject, device: Where it failed; the chart is "" if a subject has no charts at all.
        method, setting: Of the trial; "" if the preparation failed.
        message: The error, with its type.
    """

    chart: str
    subject: str
    device: str
    method: str
    setting: str
    message: str


class Results(list[Measurement]):
    """Rows, in order of measurement.

    Attributes:
        charts: Metadata of each chart, by name.
        subjects: The measured subjects, by name.
        failures: Trials and charts that could not be measured.
        machine: Facts about the machine as names and values; empty if unknown.
        versions: Versions of geokit and of its dependencies, likewise.
    """

    def __init__(
        self,
        rows: Iterable[Measurement] = (),
        *,
        charts: Mapping[str, ChartInfo] | None = None,
        subjects: Mapping[str, Subject] | None = None,
        failures: Iterable[Failure] = (),
        machine: Mapping[str, str] | None = None,
        versions: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(rows)
        self.charts: dict[str, ChartInfo] = dict(charts or {})
        self.subjects: dict[str, Subject] = dict(subjects or {})
        self.failures: list[Failure] = list(failures)
        self.machine: dict[str, str] = dict(machine or {})
        self.versions: dict[str, str] = dict(versions or {})


class Group(NamedTuple):
    """The rows of one figure: one chart on one subject, on every device.

    Attributes:
        chart: Metadata of the chart.
        subject: Name of the subject.
        rows: The measurements.
        slug: Part of its file names, unique among groups.
        per_call: Whether times of calls are compared instead of times per answer: its settings give different numbers
            of answers, as finer voxels give more triangles.
    """

    chart: ChartInfo
    subject: str
    rows: list[Measurement]
    slug: str
    per_call: bool = False


def info_of(chart: Chart) -> ChartInfo:
    return ChartInfo(chart.name, chart.title, chart.unit, chart.answers, chart.vertical)


def grouped(rows: Iterable[Measurement]) -> list[Group]:
    """One group for each chart and subject, in the order of their first rows.

    Rows read from a table lack the chart's title and charted quantity: the name replaces the title, and a chart whose
    errors are all 0 or unknown while some answers are wrong shows the shares of wrong answers.
    """
    table: dict[tuple[str, str], list[Measurement]] = {}
    for row in rows:
        table.setdefault((row.chart, row.subject), []).append(row)
    known = rows.charts if isinstance(rows, Results) else {}
    groups: list[Group] = []
    slugs: set[str] = set()
    for (chart, subject), members in table.items():
        slug = _slug(f"{chart}-{subject}")
        number = 2
        while slug in slugs:
            slug = _slug(f"{chart}-{subject}-{number}")
            number += 1
        slugs.add(slug)
        info = known.get(chart) or _guessed(chart, members)
        groups.append(Group(info, subject, members, slug, _counts_differ(members)))
    return groups


def _counts_differ(rows: list[Measurement]) -> bool:
    """Whether settings on one device gave different numbers of answers; a GPU may get more queries than a CPU."""
    counts: dict[str, set[int]] = {}
    for row in rows:
        counts.setdefault(row.device, set()).add(round(row.rate * row.seconds))
    return any(len(found) > 1 for found in counts.values())


def _guessed(name: str, rows: list[Measurement]) -> ChartInfo:
    silent = all(not row.max_error > 0.0 for row in rows)
    wrong = silent and any(row.wrong_share > 0.0 for row in rows)
    return ChartInfo(name, name.replace("_", " "), rows[0].unit, "answers", "wrong" if wrong else "error")


def _slug(text: str) -> str:
    """A file name for any system: letters, digits and underscores; other runs become one dash."""
    kept = "".join(letter if letter.isascii() and (letter.isalnum() or letter == "_") else " " for letter in text)
    return "-".join(kept.lower().split())[:80] or "chart"
