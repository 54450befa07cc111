"""Ctrl-C ends every call of OpenVDB while it works, gives its memory back, and the next call works."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from geokit import native

pytestmark = [
    pytest.mark.process,
    pytest.mark.slow,
    pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB"),
    pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX"),
]

# Each call is made with a signal after each of several shares of the time that it takes alone. The memory that is held
# afterwards is compared with that after the first two rounds: the system's allocator keeps some.
CODE = """
import ctypes, gc, os, resource, signal, sys, time
import numpy as np
import geokit as gk
from geokit import native
from geokit.native import operations
from geokit.points import PointCloud

folder = sys.argv[1]
mesh = gk.mesh.sphere(1.0, segments=100)
vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
size = 0.02
field = lambda x, step=size: native.mesh_to_level_set(vertices + [x, 0, 0], faces, voxel_size=step, half_width=3.0)
a, b = field(0.0), field(0.3)
grid = [native.VdbGrid(a, {})]
cloud = PointCloud(np.random.default_rng(0).random((200_000, 3)))
native.write_vdb(f"{folder}/a.vdb", grid)
gk.points.save(f"{folder}/points.vdb", cloud)
CALLS = {
    "mesh_to_level_set": lambda: field(0.0),
    "volume_to_mesh": lambda: native.volume_to_mesh(a),
    "volume_to_mesh adaptive": lambda: native.volume_to_mesh(a, adaptivity=0.5),
    "csg": lambda: operations.csg(a, b, "union"),
    "smooth_csg": lambda: operations.smooth_csg(a, b, "difference", 2 * size),
    "smooth": lambda: operations.smooth(a, method="mean_curvature", width=1, iterations=1, voxel_size=size),
    "measure": lambda: operations.measure(a, size),
    "write_vdb": lambda: native.write_vdb(f"{folder}/b.vdb", grid),
    "read_vdb": lambda: native.read_vdb(f"{folder}/a.vdb", trusted=True),
    "save points": lambda: gk.points.save(f"{folder}/c.vdb", cloud),
    "load points": lambda: gk.points.load(f"{folder}/points.vdb", trusted=True),
}

def resident():
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    with open("/proc/self/statm") as fields:
        return int(fields.read().split()[1]) * resource.getpagesize() >> 20

def handler(*_):
    signal.setitimer(signal.ITIMER_REAL, 0)
    raise KeyboardInterrupt

signal.signal(signal.SIGALRM, handler)
for name, call in CALLS.items():
    begin = time.monotonic()
    call()
    whole = time.monotonic() - begin
    ended, held = 0, []
    for round in range(4):
        for share in (0.05, 0.2, 0.35, 0.5, 0.65, 0.8):
            try:
                signal.setitimer(signal.ITIMER_REAL, share * whole)
                call()
                signal.setitimer(signal.ITIMER_REAL, 0)
            except KeyboardInterrupt:
                ended += 1
        held.append(resident())
    call()
    print(f"{name}: {ended} {min(held[2:]) - max(held[:2])}", flush=True)
print(sorted(os.listdir(folder)))
"""
# Much longer than all of it takes.
LIMIT_SECONDS = 600
# Of 24 calls some may be done before their signal comes, and a signal may come in Python's own code.
LEAST_ENDED = 3
# Grids of these calls take 4 MiB, their trees more: what each of the last 12 interrupts left would be seen.
MOST_MIB = 4


def test_every_call(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(tmp_path)], capture_output=True, text=True, timeout=LIMIT_SECONDS
    )
    assert done.returncode == 0, done.stderr
    *lines, files = done.stdout.splitlines()
    for line in lines:
        ended, grown = map(int, line.rpartition(": ")[2].split())
        assert ended >= LEAST_ENDED, line
        assert grown <= MOST_MIB, line
    # Nothing half-written is left.
    assert files == str(["a.vdb", "b.vdb", "c.vdb", "points.vdb"])
