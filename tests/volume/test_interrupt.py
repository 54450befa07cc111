"""Ctrl-C ends OpenVDB's smoothing, and the next call works."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from geokit import native
from geokit.volume._filters import FIELD_METHODS, LEVEL_SET_METHODS

pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB"),
    pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX"),
]

# 10,000 iterations take an hour; an answer to Ctrl-C is due between two pieces of one.
CODE = """
import sys
import numpy as np
from geokit import volume
values = np.linalg.norm(np.indices((160, 160, 160)) - 80.0, axis=0).astype(np.float32) - 60.0
for words in sys.argv[1:]:
    method, grid_class = words.split(",")
    whole = volume.from_dense(np.clip(values, -3, 3), voxel_size=1.0, background=3.0, grid_class=grid_class)
    part = volume.from_dense(np.clip(values[:16], -3, 3), voxel_size=1.0, background=3.0, grid_class=grid_class)
    volume.smooth(part, method)
    try:
        print("begins", flush=True)
        volume.smooth(whole, method, width=2, iterations=10000)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
        volume.smooth(part, method)
        print("works", flush=True)
"""
ALL = [*((method, "level set") for method in LEVEL_SET_METHODS), *((method, "fog volume") for method in FIELD_METHODS)]
# Of processor time: by then it smooths.
BEGUN_SECONDS = 0.3
# Much longer than an answer takes, much shorter than the operation.
LIMIT_SECONDS = 60


def _processor_seconds(process):
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_smooth():
    with subprocess.Popen(
        [sys.executable, "-c", CODE, *map(",".join, ALL)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        # One that does not answer is ended, and its output with it.
        watch = threading.Timer(LIMIT_SECONDS * len(ALL), process.kill)
        watch.start()
        try:
            for pair in ALL:
                assert process.stdout.readline() == "begins\n", pair
                begin = _processor_seconds(process.pid)
                while _processor_seconds(process.pid) < begin + BEGUN_SECONDS:
                    assert process.poll() is None
                    time.sleep(0.01)
                process.send_signal(signal.SIGINT)
                assert [process.stdout.readline() for _ in range(2)] == ["interrupted\n", "works\n"], pair
            _, err = process.communicate(timeout=LIMIT_SECONDS)
        finally:
            watch.cancel()
            process.kill()
    assert process.returncode == 0, err
