"""Measurement: answers are compared first, then geokit and a peer run in turn; a ratio is that of the medians.

Each task runs in a process of its own, so that a peer that crashes or hangs costs one row: the task is restarted
without it. Rows are sent to the parent as they are measured; required ratios are checked at the end of a task.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import statistics
import sys
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

# Tolerance for peers whose answers may be float32: half a millionth of the size.
SAME = 5e-7
# Share of rays, rounded up to a whole one, that may hit another surface: at silhouettes float32 decides either way.
SILHOUETTES = 1e-5
# Closer to the surface than this share of the size, rounding determines the sign.
SIGNED = 1e-6
# A peer with a smaller share of right signs is not timed; the share is printed.
SIGNS = 0.999
RUNS = 5
# Runs of calls that take longer than this many seconds: they vary little, and warm-up hardly affects the first.
FEWER_RUNS = ((6.0, 2), (2.0, 3))
# Pause for OpenMP's threads, which keep spinning and would occupy cores of the next call.
PAUSE = 0.02
# Small calls are timed in batches, so that the clock's overhead and the first call's cold caches do not count.
BATCHES, BATCH = 40, 25
# Time-out of a silent peer [s].
PATIENCE = 1200.0
# Exit code of a task that failed by itself, not because of a peer.
FAILED = 70

HEADER = (
    "| task | geokit M/s | peer | peer M/s | ratio | bar | met | largest difference |\n"
    "|---|---:|---|---:|---:|---:|---|---|"
)


class Asked(NamedTuple):
    """A prepared peer: the timed call, and the conversion of its answer to an array afterwards."""

    run: Callable[[], Any]
    read: Callable[[Any], np.ndarray] = np.asarray


class Peer(NamedTuple):
    """A peer by name; ``make`` prepares it, untimed. ``same`` is its tolerance if its magnitudes are known to be
    off."""

    name: str
    make: Callable[[], Asked]
    same: float | None = None


class Bar(NamedTuple):
    """Required ratio to the best of the peers whose names start with one of ``names``; without names, of all peers."""

    least: float
    peers: tuple[str, ...] = ()


@dataclass
class Case:
    """One question to geokit and its peers.

    Attributes:
        task: Text of the first column.
        count: Queries (or triangles) of a call, for the rates.
        ours: geokit's call.
        peers: Peers that answer the same question.
        size: Length to which differences are relative.
        kind: "distance", "signed" or "hit" (also for yes and no): how answers are compared.
        bars: The required ratios.
        read: Converts our answer to an array.
        units: Factors on answers before comparison, such as lengths of directions.
        same: Largest relative difference of a right answer.
        small: Whether the time of a call is printed in microseconds.
    """

    task: str
    count: int
    ours: Callable[[], Any]
    peers: list[Peer]
    size: float
    kind: str = "distance"
    bars: tuple[Bar, ...] = ()
    read: Callable[[Any], np.ndarray] = np.asarray
    units: Any = 1.0
    same: float = SAME
    small: bool = False


@dataclass
class Row:
    """One line of the table; cells are text, the ratio is kept for the required ratios."""

    task: str
    ours: str = "-"
    peer: str = "-"
    theirs: str = "-"
    ratio: float | None = None
    bar: str = ""
    met: str = ""
    note: str = ""

    def __str__(self) -> str:
        ratio = "-" if self.ratio is None else f"{self.ratio:.2f}"
        cells = (self.task, self.ours, self.peer, self.theirs, ratio, self.bar, self.met, self.note)
        return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


@dataclass
class Table:
    """Lines of one report, printed as they come and written together; notes and other tables follow at the end."""

    path: Path | None = None
    lines: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    header: str = HEADER

    def add(self, line: object) -> None:
        self.lines.append(str(line))
        print(line, flush=True)
        if self.path:
            self.path.write_text("\n".join(self.lines) + "\n", encoding="utf-8")

    def begin(self) -> None:
        for line in self.header.splitlines():
            self.add(line)

    def end(self) -> None:
        for line in ["", *self.notes] if self.notes else []:
            self.add(line)
        self.notes = []


def paired(ours: Callable[[], Any], theirs: Callable[[], Any], small: bool = False) -> tuple[float, float]:
    """Median seconds of a call of each, run in turn so that a slow phase of the machine affects both; the first warms
    up.

    Small calls run in batches, without pauses between them.
    """
    seconds: tuple[list[float], list[float]] = ([], [])
    repeat, runs, warm = (BATCH, BATCHES, 1) if small else (1, RUNS, 1)
    while len(seconds[0]) < runs + warm:
        for call, record in zip((ours, theirs), seconds, strict=True):
            if not small:
                time.sleep(PAUSE)
            start = time.perf_counter()
            for _ in range(repeat):
                call()
            record.append((time.perf_counter() - start) / repeat)
        if len(seconds[0]) == 1:
            longest = max(seconds[0][0], seconds[1][0])
            runs, warm = next(((fewer, 0) for limit, fewer in FEWER_RUNS if longest > limit), (runs, warm))
    return statistics.median(seconds[0][warm:]), statistics.median(seconds[1][warm:])


def median_seconds(call: Callable[[], Any], runs: int, pause: float = PAUSE) -> float:
    """Median seconds of a call, after one that warms up."""
    call()
    seconds = []
    for _ in range(runs):
        time.sleep(pause)
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def compared(case: Case, ours: np.ndarray, theirs: np.ndarray, same: float) -> tuple[bool, str]:
    """Whether the answers agree, and the table's text about it."""
    if np.shape(ours) != np.shape(theirs):
        return False, f"shape {np.shape(theirs)} for {np.shape(ours)}"
    a, b = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    signs = ""
    if case.kind == "signed":
        far = np.abs(a) > SIGNED * case.size
        equal = float((np.signbit(a) == np.signbit(b))[far].mean()) if far.any() else 1.0
        signs = f", {equal:.4%} of signs equal"
        if equal < SIGNS:
            return False, signs[2:]
        a, b = np.abs(a), np.abs(b)
    apart = np.full(len(a), np.inf)
    apart[a == b] = 0.0
    both = np.isfinite(a) & np.isfinite(b)
    between = np.abs(np.subtract(a, b, where=both, out=np.zeros(len(a)))) * case.units
    apart[both] = between[both] / case.size
    others = int((apart > same).sum())
    if case.kind != "hit":
        return others == 0, f"{apart.max(initial=0.0):.1e}{signs}"
    note = f"{apart[apart <= same].max(initial=0.0):.1e}"
    return others <= math.ceil(SILHOUETTES * len(a)), f"{note}, {others} of {len(a):,} elsewhere" if others else note


def against(case: Case, answer: np.ndarray, peer: Peer) -> Row:
    """One row: the peer made, its answer compared, both timed."""
    try:
        asked = peer.make()
        found = asked.read(asked.run())
    except ImportError as error:
        return Row(case.task, peer=peer.name, note=f"not installed: {error.name or error}")
    except Exception as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        return Row(case.task, peer=peer.name, note=f"{type(error).__name__}: {reason}")
    right, note = compared(case, answer, found, peer.same or case.same)
    if not right:
        return Row(case.task, peer=peer.name, note=f"{note}: disagrees, not timed")
    mine, theirs = paired(case.ours, asked.run, case.small)
    shown = (f"{s * 1e6:.1f} us" if case.small else f"{case.count / s / 1e6:.3f}" for s in (mine, theirs))
    return Row(case.task, next(shown), peer.name, next(shown), theirs / mine, note=note)


def judge(rows: list[Row], bars: Iterable[Bar]) -> None:
    """Write each required ratio, and whether it is met, into the row of the best peer that it applies to."""
    for bar in bars:
        named = [row for row in rows if not bar.peers or row.peer.startswith(bar.peers)]
        timed = [row for row in named if row.ratio is not None]
        if not timed:
            peers = ", ".join(bar.peers) or "any peer"
            rows.append(Row(rows[0].task, bar=f"{bar.least:g}", met="open", note=f"not measured against {peers}"))
            continue
        best = min(timed, key=lambda row: row.ratio or 0.0)
        best.bar = ", ".join(filter(None, (best.bar, f"{bar.least:g}")))
        best.met = ", ".join(filter(None, (best.met, "met" if (best.ratio or 0.0) >= bar.least else "NOT met")))


class Report:
    """Receiver of a task's cases, rows and lines: sent through a pipe if there is one, else kept.

    Args:
        send: Takes the events: ("case", task, bars), ("begin", task, peer), ("row", row), ("line", text).
        done: Cases and peers, as (task, peer), that have a row already.
    """

    def __init__(self, send: Callable[[tuple], None], done: Iterable[tuple[str, str]] = ()) -> None:
        self.send = send
        self.done = set(done)

    def case(self, case: Case) -> None:
        self.send(("case", case.task, case.bars))
        todo = [peer for peer in case.peers if (case.task, peer.name) not in self.done]
        if not todo:
            return
        answer = case.read(case.ours())
        for peer in todo:
            self.send(("begin", case.task, peer.name))
            self.send(("row", against(case, answer, peer)))

    def row(self, row: Row) -> None:
        if (row.task, row.peer) not in self.done:
            self.send(("case", row.task, ()))
            self.send(("row", row))

    def line(self, text: str) -> None:
        self.send(("line", text))


@dataclass
class Gathered:
    """The parent's record of one task."""

    rows: dict[str, list[Row]] = field(default_factory=dict)
    bars: dict[str, tuple[Bar, ...]] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    current: tuple[str, str] | None = None

    def take(self, event: tuple) -> None:
        what, *rest = event
        if what == "case":
            self.rows.setdefault(rest[0], [])
            self.bars[rest[0]] = rest[1]
        elif what == "begin":
            self.current = (rest[0], rest[1])
        elif what == "row":
            self.rows[rest[0].task].append(rest[0])
            self.current = None
        else:
            self.lines.append(rest[0])

    def gone(self, reason: str) -> bool:
        """Add a row for the peer during which the process died; False if there was none."""
        if self.current is None:
            return False
        task, peer = self.current
        self.take(("row", Row(task, peer=peer, note=reason)))
        return True

    def report(self, table: Table) -> None:
        for task, rows in self.rows.items():
            if rows:
                judge(rows, self.bars[task])
            for row in rows:
                table.add(row)
        table.notes.extend(self.lines)


def in_process(table: Table, name: str, task: Callable[..., None], *arguments: Any) -> None:
    """Run ``task(report, *arguments)`` in a process of its own, restarted as long as peers crash it."""
    gathered = Gathered()
    while True:
        # Lines are printed once the tables are complete, because a restarted task sends them again.
        gathered.lines.clear()
        done = [(row.task, row.peer) for rows in gathered.rows.values() for row in rows]
        reason, own = _attempt(gathered, task, done, arguments)
        if reason is None:
            break
        if own or not gathered.gone(reason):
            gathered.take(("case", name, ()))
            gathered.take(("row", Row(name, note=f"{reason}; see the error output")))
            break
    gathered.report(table)


def _attempt(gathered: Gathered, task: Callable[..., None], done: list, arguments: tuple) -> tuple[str | None, bool]:
    """None if the task ran to its end, else a description of its failure; and whether the task itself caused it."""
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(theirs, task, done, arguments))
    process.start()
    theirs.close()
    reason = None
    try:
        while mine.poll(PATIENCE):
            event = mine.recv()
            gathered.take(event)
            if event[0] == "begin":
                print(f"... {event[1]}: {event[2]}", file=sys.stderr, flush=True)
        reason = f"no answer in {PATIENCE:.0f} s"
    except EOFError:
        process.join()
    finally:
        if process.is_alive():
            process.kill()
        process.join()
    if reason is None and process.exitcode:
        ended = f"signal {-process.exitcode}" if process.exitcode < 0 else f"exit code {process.exitcode}"
        reason = f"the process ended with {ended}"
    return reason, process.exitcode == FAILED


def _child(pipe: Connection, task: Callable[..., None], done: list, arguments: tuple) -> None:
    # Output of peers must not appear in the table.
    os.dup2(2, 1)
    try:
        task(Report(pipe.send, done), *arguments)
    except Exception:
        traceback.print_exc()
        os._exit(FAILED)
    pipe.close()
    # Skip the clean-up of peers' threads and libraries, some of which crash at exit.
    os._exit(0)
