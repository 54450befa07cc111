"""Log of the demo's steps, and the closing table."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

from geokit.accuracy.report.table import write_rows
from geokit.cli._program.console import note, step
from geokit.core.files import atomic_path

__all__ = ["COLUMNS", "DemoLog", "Entry"]

COLUMNS = ("step", "count", "items", "seconds", "rate [1/s]", "largest error", "reference")


@dataclasses.dataclass
class Entry:
    """One row of the closing table.

    Attributes:
        step: Name of the step.
        items: Kind of items that were processed.
        count: Number of items.
        seconds: Wall time of the step alone, without its reference.
        error: Largest deviation from the reference; None if nothing was compared.
        reference: The reference of the comparison.
        left_out: Reason why the step did not run, or "".
    """

    step: str
    items: str
    count: int = 0
    seconds: float = 0.0
    error: float | None = None
    reference: str = ""
    left_out: str = ""

    def cells(self) -> tuple[str, ...]:
        if self.left_out:
            return (self.step, "", self.items, "", "", "", f"left out: {self.left_out.partition(' (')[0]}")
        rate = self.count / self.seconds if self.seconds > 0.0 else 0.0
        error = "" if self.error is None else ("0 (bit for bit)" if self.error == 0.0 else f"{self.error:.2e}")
        return (self.step, f"{self.count:,}", self.items, f"{self.seconds:.3f}", _short(rate), error, self.reference)


class DemoLog:
    """Collects entries and shows each step while it runs."""

    def __init__(self, *, quiet: bool) -> None:
        self.entries: list[Entry] = []
        self.quiet = quiet

    @contextlib.contextmanager
    def step(self, title: str, items: str) -> Iterator[Entry]:
        entry = Entry(title, items)
        with step(title, quiet=self.quiet, lines=True) as shown:
            started = time.perf_counter()
            yield entry
            entry.seconds = time.perf_counter() - started
            shown.result = f"{entry.count:,} {items}"
        self.entries.append(entry)

    def leave_out(self, title: str, items: str, reason: str) -> None:
        self.entries.append(Entry(title, items, left_out=reason))
        if not self.quiet:
            note(f"{title}: left out: {reason.partition(' (')[0]}; geokit doctor says more")

    def write(self, folder: Path) -> None:
        """Write the table as summary.csv, with plain numbers, and as summary.md."""
        names = [field.name for field in dataclasses.fields(Entry)]
        write_rows(folder / "summary.csv", names, map(dataclasses.astuple, self.entries))
        lines = ["| " + " | ".join(COLUMNS) + " |", "|---|---:|---|---:|---:|---:|---|"]
        lines += ["| " + " | ".join(entry.cells()) + " |" for entry in self.entries]
        with atomic_path(folder / "summary.md") as part:
            part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _short(rate: float) -> str:
    for size, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if rate >= size:
            return f"{rate / size:.3g}{suffix}"
    return f"{rate:.3g}"
