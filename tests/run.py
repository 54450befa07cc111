"""Runs the tests as ``./dev test`` does: ``python -m tests.run [-m EXPRESSION]``.

Most run side by side, since half of their time is spent in Python, on one core; then those that depend on the machine
(marker ``process``), one at a time; then what failed once more, alone. What passes then fails by chance: the last lines
name it, so that it is mended next.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

# More failures than these are no chance.
MOST_BY_CHANCE = 12
# Files with tests that depend on the machine: to collect all others takes longer than half of these tests.
PROCESS = [str(path) for path in sorted(Path("tests").rglob("test_*.py")) if "mark.process" in path.read_text("utf-8")]
PASSED = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)


def run(arguments: list[str], failed: Path | None = None) -> int:
    environment = dict(os.environ)
    environment.pop("GEOKIT_TEST_FAILED", None)
    # Each of hundreds of processes would compile the package anew, and each worker the tests.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    if failed is not None:
        environment["GEOKIT_TEST_FAILED"] = str(failed)
    return subprocess.run([sys.executable, "-m", "pytest", *arguments], env=environment).returncode


def main(expression: str = "") -> int:
    both = f" and ({expression})" if expression else ""
    with tempfile.TemporaryDirectory(prefix="tests-") as folder:
        failed = Path(folder, "failed.txt")
        codes = [run(["-n", "logical", "--dist", "worksteal", "-m", f"not process{both}"], failed)]
        # An interrupt, or a worker that died while it collected, is no test that failed.
        if codes[0] in (*PASSED, pytest.ExitCode.TESTS_FAILED):
            codes.append(run(["-m", f"process{both}", *PROCESS], failed))
        bad = [code for code in codes if code not in PASSED]
        if not bad:
            return 0
        names = failed.read_text(encoding="utf-8").splitlines() if failed.exists() else []
        if set(bad) != {pytest.ExitCode.TESTS_FAILED} or not 0 < len(names) <= MOST_BY_CHANCE:
            return bad[0]
        print(f"\nonce more, alone: {len(names)} tests that failed", flush=True)
        code = run([f"@{failed}"])
    if code:
        return code
    print("\nflaky, passed the second time; mend these next:", *names, sep="\n  ", flush=True)
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m tests.run")
    parser.add_argument("-m", dest="expression", default="", help="which tests, as for pytest")
    sys.exit(main(parser.parse_args().expression))
