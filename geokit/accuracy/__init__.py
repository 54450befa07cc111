"""Accuracy against speed: geokit's methods measured on the user's own data, and where they fail."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit._lazy import make_lazy

if TYPE_CHECKING:
    from geokit.accuracy._pareto import front, knee
    from geokit.accuracy._results import ChartInfo, Failure, Results
    from geokit.accuracy._subjects import default_subjects
    from geokit.accuracy._table import read_table, write_table
    from geokit.accuracy.measure import measure
    from geokit.accuracy.model import Chart, Envelope, Judgement, Measurement, Subject, Sweep, Trial
    from geokit.accuracy.report import write_report
    from geokit.accuracy.run import run
    from geokit.accuracy.stability import Outcome, follow, sweeps, write_stability

__all__ = [
    "Chart",
    "ChartInfo",
    "Envelope",
    "Failure",
    "Judgement",
    "Measurement",
    "Outcome",
    "Results",
    "Subject",
    "Sweep",
    "Trial",
    "default_subjects",
    "follow",
    "front",
    "knee",
    "measure",
    "read_table",
    "run",
    "sweeps",
    "write_report",
    "write_stability",
    "write_table",
]

make_lazy(
    __name__,
    {
        "Chart": "geokit.accuracy.model",
        "ChartInfo": "geokit.accuracy._results",
        "Envelope": "geokit.accuracy.model",
        "Failure": "geokit.accuracy._results",
        "Judgement": "geokit.accuracy.model",
        "Measurement": "geokit.accuracy.model",
        "Outcome": "geokit.accuracy.stability",
        "Results": "geokit.accuracy._results",
        "Subject": "geokit.accuracy.model",
        "Sweep": "geokit.accuracy.model",
        "Trial": "geokit.accuracy.model",
        "default_subjects": "geokit.accuracy._subjects",
        "follow": "geokit.accuracy.stability",
        "front": "geokit.accuracy._pareto",
        "knee": "geokit.accuracy._pareto",
        "measure": "geokit.accuracy.measure",
        "read_table": "geokit.accuracy._table",
        "run": "geokit.accuracy.run",
        "sweeps": "geokit.accuracy.stability",
        "write_report": "geokit.accuracy.report",
        "write_stability": "geokit.accuracy.stability",
        "write_table": "geokit.accuracy._table",
    },
)
