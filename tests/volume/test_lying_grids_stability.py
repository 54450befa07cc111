"""Grids that pass every structural check and lie: each operation answers or refuses by name, in seconds and 1 GiB."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from geokit import native
from tests.support.effort import of_all
from tests.support.lying_grids import SOURCES
from tests.support.lying_runs import TRIED, operations_on

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="each case runs in a forked process"),
    pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB"),
]


@pytest.mark.parametrize("source", of_all(["level set"], list(SOURCES)))
def test_every_operation_ends_by_itself(source):
    # One thread: a forked process has no others.
    run = subprocess.run(
        [sys.executable, "-m", "tests.support.lying_runs", source],
        cwd=ROOT,
        env={**os.environ, "GEOKIT_THREADS": "1", "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
        timeout=3600,
    )
    *bad, counts = run.stdout.splitlines() or [run.stderr]
    assert not bad, "\n".join(bad)
    found = json.loads(counts)
    assert found["answered"] + found["refused"] == sum(len(operations_on(number)) for number in range(len(TRIED)))
    assert found["answered"] > found["refused"] / 2
