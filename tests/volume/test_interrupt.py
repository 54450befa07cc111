"""Ctrl-C ends OpenVDB's smoothing and its fields of meshes, and the next call works."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

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
method, grid_class = sys.argv[1:]
values = np.linalg.norm(np.indices((160, 160, 160)) - 80.0, axis=0).astype(np.float32) - 60.0
whole = volume.from_dense(np.clip(values, -3, 3), voxel_size=1.0, background=3.0, grid_class=grid_class)
part = volume.from_dense(np.clip(values[:16], -3, 3), voxel_size=1.0, background=3.0, grid_class=grid_class)
volume.smooth(part, method)
print("begins", flush=True)
try:
    volume.smooth(whole, method, width=2, iterations=10000)
except KeyboardInterrupt:
    print("interrupted", flush=True)
    volume.smooth(part, method)
    print("works", flush=True)
"""
# Much longer than an answer takes, much shorter than the operation.
LIMIT_SECONDS = 60


@pytest.mark.parametrize(
    ("method", "grid_class"),
    [*((method, "level set") for method in LEVEL_SET_METHODS), *((method, "fog volume") for method in FIELD_METHODS)],
)
def test_smooth(method, grid_class):
    with subprocess.Popen(
        [sys.executable, "-c", CODE, method, grid_class], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout.readline() == "begins\n"
            time.sleep(1.0)
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=LIMIT_SECONDS)
        finally:
            process.kill()
    assert out.split() == ["interrupted", "works"], err
    assert process.returncode == 0


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
