"""Which tests are slow by their file, their order, where the time goes, and stacks of processes that a signal ended.

GEOKIT_TEST_SEED is a number by which modules, and the tests in each, are put into another order. GEOKIT_TEST_FAILED is
a file to which the names of failed tests are added.
"""

from __future__ import annotations

import collections
import faulthandler
import gc
import itertools
import os
import random
import shutil
import signal
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path

import hypothesis
import pytest

from tests.support.effort import ALL

FOLDER = "GEOKIT_TEST_STACKS"
STACKS = pytest.StashKey[int]()
HAS_THREADS = pytest.StashKey[bool]()
# Files named by the time that their tests take.
SLOWEST = 60


# The same examples every time: a rare one that fails is found by everything, and stops no change by chance.
hypothesis.settings.register_profile("tests", derandomize=not ALL, deadline=None)
hypothesis.settings.load_profile("tests")


# After pytest's own, which writes to stderr in the midst of everything.
@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    # A shell starts what runs in its background with interrupts ignored, and so would be every process of the tests.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if not hasattr(config, "workerinput"):
        os.environ[FOLDER] = tempfile.mkdtemp(prefix="stacks-")
    config.stash[STACKS] = os.open(Path(os.environ[FOLDER], f"{os.getpid()}.txt"), os.O_CREAT | os.O_WRONLY)
    faulthandler.enable(file=config.stash[STACKS])


# Of what is collected nothing is given back: looking at it again and again took a third of the time, and half a second
# of every gc.collect() of a test.
@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


# Before the marks decide which tests are run.
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        # Sweeps over parameters and damaged files: many tests that say one thing.
        if item.path.stem.endswith(("_stability", "_envelope")) or item.get_closest_marker("process"):
            item.add_marker(pytest.mark.slow)
    if seed := os.environ.get("GEOKIT_TEST_SEED"):
        order = random.Random(seed)
        order.shuffle(items)
        # A module stays together: what it prepares once is prepared once.
        place = {path: order.random() for path in dict.fromkeys(item.path for item in items)}
        items.sort(key=lambda item: place[item.path])


# After pytest has taken down what the test had.
@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Fail the test that starts jax, whose threads any test that forks later would meet."""
    # Importing it starts none.
    started = getattr(sys.modules.get("jax._src.xla_bridge"), "_backends", None)
    if started and not item.config.stash.get(HAS_THREADS, False):
        item.config.stash[HAS_THREADS] = True
        pytest.fail("a test with jax runs in a process of its own, as tests/core/gradients/test_jax.py does")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, exitstatus: int) -> None:
    if hasattr(terminalreporter.config, "workerinput"):
        return
    if os.environ.get("CI"):
        _say_where_time_goes(terminalreporter)
    if file := os.environ.get("GEOKIT_TEST_FAILED"):
        reports = [*terminalreporter.stats.get("failed", []), *terminalreporter.stats.get("error", [])]
        names = {report.nodeid for report in reports}
        with open(file, "a", encoding="utf-8") as out:
            out.writelines(f"{name}\n" for name in sorted(names))
    # Some tests end processes on purpose.
    if exitstatus == 0:
        return
    for path in sorted(Path(os.environ[FOLDER]).iterdir()):
        if text := path.read_text(errors="replace"):
            terminalreporter.section(f"stacks of process {path.stem}")
            terminalreporter.write(text[:8000] + "\n")


def _say_where_time_goes(terminal: pytest.TerminalReporter) -> None:
    seconds: collections.Counter[str] = collections.Counter()
    for report in itertools.chain.from_iterable(terminal.stats.values()):
        if isinstance(report, pytest.TestReport):
            seconds[report.nodeid.partition("::")[0]] += report.duration
    terminal.section(f"seconds by file, {seconds.total():.0f} on all cores together")
    for file, time in seconds.most_common(SLOWEST):
        terminal.write_line(f"{time:7.1f}  {file}")


@pytest.hookimpl(tryfirst=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    faulthandler.enable()
    os.close(config.stash[STACKS])
    if not hasattr(config, "workerinput"):
        shutil.rmtree(os.environ.pop(FOLDER), ignore_errors=True)
