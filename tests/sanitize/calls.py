"""The public calls that the sanitizers watch: rows of benchmarks/answers.py that together reach every CPU kernel."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks import answers

NAMES = frozenset(Path(__file__).with_name("calls.txt").read_text(encoding="utf-8").split())


def rows(folder: Path) -> Iterator[answers.Row]:
    """The calls; files that they write go to ``folder``.

    Raises:
        ValueError: benchmarks/answers.py no longer has one of them.
    """
    given, left = answers.Inputs("cpu", folder), set(NAMES)
    for family in answers.FAMILIES:
        for row in family(given):
            if row.name in left:
                left.remove(row.name)
                yield row
    if left:
        raise ValueError(f"benchmarks/answers.py has no rows {', '.join(sorted(left))}")
