"""Operations under limits of address space: the right end, and a need that is near the peak."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from tests.support.effort import of_all
from tests.support.limits.memory_runs import faults

# 20 limits, and all operations: an hour.
LIMITS = os.environ.get("GEOKIT_MEMORY_LIMITS", of_all("1", "3"))
SECONDS = 1800 if int(LIMITS) <= 3 else 20_000


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc")
def test_operations_under_limits() -> None:
    # By default every sixth function, in the form that does most, under one limit.
    part, *least = (6, 30, 3) if int(LIMITS) == 1 else (1, 130, 16)
    settings = (
        {"SCALE": "0.1", "ONCE": "1" if part > 1 else "", "PART": f"0/{part}"}
        if int(LIMITS) <= 3
        else {"ALL": "1", "SCALE": "0.5", "WARM": "1"}
    )
    done = subprocess.run(
        [sys.executable, "-m", "tests.support.limits.memory_runs", "limits", LIMITS],
        capture_output=True,
        text=True,
        timeout=SECONDS,
        # Stacks and arenas of more threads would count as a need of these small operations.
        env={**os.environ, **settings, "GEOKIT_THREADS": "2"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert len(rows) > least[0] * int(LIMITS)
    assert sum(row["end"] == "refused" for row in rows) > least[1] * int(LIMITS)
    assert faults(rows) == []
