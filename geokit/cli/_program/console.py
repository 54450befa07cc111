"""Output of the commands: results on stdout, progress and notices on stderr."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from geokit.core.base.printable import printable

# What a command sets in its process for as long as it runs: undone when it ends, since others may run in that process.
at_end = contextlib.ExitStack()


def say(message: str) -> None:
    """Print a line on stdout. Names of files, and names in files, may hold what a terminal obeys: it is escaped."""
    print(printable(message), flush=True)


def note(message: str) -> None:
    """Print a notice on stderr."""
    print(f"geokit: {printable(message)}", file=sys.stderr, flush=True)


def announce_compiling() -> None:
    """Until the command ends, print a notice whenever a kernel module has to be compiled: that takes seconds."""
    from geokit.core import launcher

    said: set[str] = set()

    def listener(module: str) -> None:
        if not said:
            note(launcher.compile_notice())
        if module not in said:
            said.add(module)
            note(f"compiling {module}")

    at_end.callback(launcher.on_compile, launcher.on_compile(listener))


def print_json(value: Any) -> None:
    """Print ``value`` as JSON: arrays as lists, dataclasses as objects, infinities and NaN as null."""
    print(json.dumps(plain(value), indent=2))


def plain(value: Any) -> Any:
    """Convert ``value`` to dict, list, str, int, float, bool and None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value) if not f.name.startswith("_")}
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int)):
        return value
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def print_facts(facts: dict[str, Any], *, indent: str = "") -> None:
    """Print names and values in two columns."""
    width = max((len(name) for name in facts), default=0)
    for name, value in facts.items():
        say(f"{indent}{name:<{width}}  {shown(value)}")


def shown(value: Any, digits: int = 6) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    if hasattr(value, "tolist"):
        return shown(value.tolist(), _digits(value))
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(shown(item, digits) for item in value) + ")"
    return "none" if value is None else printable(str(value))


def _digits(corners: Any) -> int:
    """So many that corners (2, 3) of a box far from the origin show its size to six digits."""
    if getattr(corners, "shape", None) != (2, 3) or corners.dtype.kind != "f":
        return 6
    size, largest = float((corners[1] - corners[0]).max()), float(abs(corners).max())
    return 6 + math.ceil(math.log10(largest / size)) if 0.0 < size < largest < math.inf else 6


def print_table(columns: Sequence[str], rows: Sequence[Sequence[Any]], *, title: str = "") -> None:
    """Print a table on stdout, with numbers aligned to the right."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=escape(printable(title)) or None, title_justify="left", box=None, pad_edge=False, header_style="bold"
    )
    for index, column in enumerate(columns):
        numeric = all(isinstance(row[index], (int, float)) or row[index] in ("", "-") for row in rows)
        table.add_column(column, justify="right" if numeric and rows else "left", no_wrap=True)
    for row in rows:
        table.add_row(*[Text(shown(cell)) for cell in row])
    # A pipe or a file has no line width, so rows must not be wrapped.
    console = Console() if sys.stdout.isatty() else Console(width=10_000, color_system=None)
    console.print(table)


# A step that runs longer than this [s] says so, and again after twice the time.
PATIENCE = 2.0


class Step:
    """A running step; ``result`` is a short text that is printed when it ends."""

    result = ""

    def __init__(self, title: str) -> None:
        self.title, self.started, self.told = title, time.perf_counter(), PATIENCE
        self.share = 0.0
        self.show: Callable[[str], None] | None = None

    def progress(self, done: int, total: int) -> None:
        """How far the step is; for ``progress=`` of the library."""
        self.share = done / total if total else 1.0
        self.tell()

    def tell(self) -> None:
        """Say how long the step has been running and how long it may still take, if it is time to."""
        passed = time.perf_counter() - self.started
        if self.show is None or passed < self.told:
            return
        self.told = 2.0 * passed
        left = f", {100.0 * self.share:.0f}%, about {passed / self.share - passed:.0f} s left" if self.share else ""
        self.show(f"{self.title} ... {passed:.0f} s{left}")


@contextlib.contextmanager
def step(title: str, *, quiet: bool = False, lines: bool = False) -> Iterator[Step]:
    """Show on stderr that a step is running, and then how long it took.

    A step of more than two seconds says so while it runs, with the time that is left where the library knows it.

    Args:
        title: Name of the step.
        quiet: Show nothing.
        lines: Print a plain line at the end even if stderr is not a terminal.
    """
    current = Step(printable(title))
    if quiet:
        yield current
        return
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.text import Text

        # As text: a name in brackets is no style.
        status = Console(stderr=True).status(Text(f"{current.title} ..."))
        with status, _ticking(current, lambda said: status.update(Text(said))):
            yield current
    else:
        with _ticking(current, note):
            yield current
    seconds = time.perf_counter() - current.started
    if not (lines or sys.stderr.isatty()):
        return
    tail = f": {printable(current.result)}" if current.result else ""
    print(f"{current.title}{tail}  [{seconds:.2f} s]", file=sys.stderr, flush=True)


@contextlib.contextmanager
def _ticking(current: Step, show: Callable[[str], None]) -> Iterator[None]:
    """Have the step tell about itself while it runs, also where the library does not."""
    current.show, ended = show, threading.Event()

    def tick() -> None:
        while not ended.wait(PATIENCE / 4.0):
            current.tell()

    ticker = threading.Thread(target=tick, daemon=True)
    with contextlib.suppress(RuntimeError):  # without a thread for it the step runs all the same
        ticker.start()
    try:
        yield
    finally:
        ended.set()
        if ticker.ident is not None:
            ticker.join()
