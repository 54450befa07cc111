# What is measured: subjects, charts, trials.
from ._run import default_subjects as default_subjects
from .trials.model import (
    Subject as Subject,
    Chart as Chart,
    Trial as Trial,
    Judgement as Judgement,
    Measurement as Measurement,
)
from .trials.measuring import measure as measure

# A run over charts, and its results.
from ._run import run as run
from .trials.results import Results as Results, ChartInfo as ChartInfo, Failure as Failure
from .report.table import read_table as read_table, write_table as write_table
from .report.pareto import front as front, knee as knee
from .report.folder import write_report as write_report

# Sweeps towards failure.
from .trials.model import Sweep as Sweep, Envelope as Envelope
from .stability.follow_sweeps import (
    sweeps as sweeps,
    follow as follow,
    Outcome as Outcome,
    write_stability as write_stability,
)
