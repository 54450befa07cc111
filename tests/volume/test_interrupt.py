"""Ctrl-C ends OpenVDB's smoothing and its fields of meshes, and the next call works."""

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


# A handler that only counts is called again and again within one call of C++.
COUNTED = """
import signal
import numpy as np
import geokit as gk
from geokit import native
mesh = gk.mesh.sphere(1.0, segments=100)
vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
calls = []
def handler(*_):
    calls.append(1)
    if len(calls) == 4:
        raise KeyboardInterrupt
native.mesh_to_level_set(vertices, faces, voxel_size=0.1, half_width=3.0)
signal.signal(signal.SIGALRM, handler)
signal.setitimer(signal.ITIMER_REAL, 0.05, 0.05)
try:
    native.mesh_to_level_set(vertices, faces, voxel_size=0.003, half_width=3.0)
except KeyboardInterrupt:
    signal.setitimer(signal.ITIMER_REAL, 0)
    print("interrupted")
    native.mesh_to_level_set(vertices, faces, voxel_size=0.1, half_width=3.0)
    print("works")
"""


def test_a_field_of_a_mesh():
    done = subprocess.run([sys.executable, "-c", COUNTED], capture_output=True, text=True, timeout=10 * LIMIT_SECONDS)
    assert done.stdout.split() == ["interrupted", "works"], done.stderr
    assert done.returncode == 0
