"""Small files, a recipe for them, and batches in processes that can be killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[3]
CORNER = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 {}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
RECIPE = '[[step]]\nverb = "convert"\noutput = "{stem}.off"\n'
# A file of this name kills the process that opens it.
POISON = "poison.obj"
_HOOK = f"""
import builtins, os, runpy, signal, sys
# One of the system or of a coverage tool, which this one hides.
for folder in sys.path[1:]:
    other = os.path.join(folder, "sitecustomize.py")
    if os.path.isfile(other) and other != __file__:
        runpy.run_path(other)
        break
_open = builtins.open
def open(file, *more, **options):
    if str(file).endswith({POISON!r}):
        os.kill(os.getpid(), signal.SIGKILL)
    return _open(file, *more, **options)
builtins.open = open
"""


@pytest.fixture
def corners(tmp_path: Path) -> Callable[..., list[Path]]:
    """Makes so many tetrahedra."""

    def make(count: int, folder: str = "in") -> list[Path]:
        (tmp_path / folder).mkdir(exist_ok=True)
        paths = [tmp_path / folder / f"corner{number:03}.obj" for number in range(count)]
        for number, path in enumerate(paths):
            path.write_text(CORNER.format(1 + number))
        return paths

    return make


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "recipe.toml"
    path.write_text(RECIPE)
    return path


class Batch:
    """A batch in a process of its own."""

    def __init__(self, arguments: tuple[object, ...], hook: Path) -> None:
        paths = os.pathsep.join([str(hook), str(ROOT), *filter(None, sys.path)])
        self.process = subprocess.Popen(
            [sys.executable, "-m", "geokit", "batch", *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": paths},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.communicate(timeout=60)

    def end(self) -> subprocess.CompletedProcess[str]:
        printed, told = self.process.communicate(timeout=240)
        return subprocess.CompletedProcess([], self.process.returncode, printed, told)


@pytest.fixture
def start(tmp_path: Path) -> Callable[..., Batch]:
    """Starts ``geokit batch`` with some arguments."""
    hook = tmp_path / "hook"
    hook.mkdir()
    (hook / "sitecustomize.py").write_text(_HOOK)
    return lambda *arguments: Batch(arguments, hook)


def records_in(manifest: Path) -> list[dict[str, Any]]:
    """The records of a manifest, each of another input."""
    records = [json.loads(line) for line in manifest.read_text().splitlines(keepends=True)[1:] if line.endswith("\n")]
    assert max(Counter(record["input"] for record in records).values(), default=1) == 1
    return records


@pytest.fixture(name="records_in")
def _records_in() -> Callable[[Path], list[dict[str, Any]]]:
    return records_in
