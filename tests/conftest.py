"""Which tests are slow by their file, and stacks: where a signal ends a process, they are printed after all else."""

from __future__ import annotations

import faulthandler
import os
import shutil
import tempfile
from pathlib import Path

import pytest

FOLDER = "GEOKIT_TEST_STACKS"
STACKS = pytest.StashKey[int]()


# After pytest's own, which writes to stderr in the midst of everything.
@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        os.environ[FOLDER] = tempfile.mkdtemp(prefix="stacks-")
    config.stash[STACKS] = os.open(Path(os.environ[FOLDER], f"{os.getpid()}.txt"), os.O_CREAT | os.O_WRONLY)
    faulthandler.enable(file=config.stash[STACKS])


# Sweeps over parameters and damaged files: many tests that say one thing.
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.stem.endswith(("_stability", "_envelope")):
            item.add_marker(pytest.mark.slow)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, exitstatus: int) -> None:
    # Some tests end processes on purpose.
    if exitstatus == 0:
        return
    for path in sorted(Path(os.environ[FOLDER]).iterdir()):
        if text := path.read_text(errors="replace"):
            terminalreporter.section(f"stacks of process {path.stem}")
            terminalreporter.write(text[:8000] + "\n")


@pytest.hookimpl(tryfirst=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    faulthandler.enable()
    os.close(config.stash[STACKS])
    if not hasattr(config, "workerinput"):
        shutil.rmtree(os.environ.pop(FOLDER), ignore_errors=True)
