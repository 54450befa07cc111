"""Use an installed wheel: queries, .vdb files, the worker, and other wheels with an OpenMP and a TBB of their own.

``python try_wheel.py [torch] [open3d]`` installs and loads those that are named; test_wheel.sh runs this file.
"""

from __future__ import annotations

import importlib
import subprocess
import sys
import time

import numpy as np

import geokit as gk

BESIDE = sys.argv[1:]
POINTS = np.random.default_rng(0).uniform(-1.5, 1.5, (200_000, 3))


def work() -> tuple[bytes, dict[str, float]]:
    """Answers of geokit and seconds of each step, the fastest of three."""
    mesh = gk.mesh.load("data/samples/torus.ply")
    surface = gk.mesh.Surface(mesh)
    steps = {
        "signed_distance": lambda: surface.signed_distance(POINTS).distance,
        "from_mesh, OpenVDB": lambda: gk.volume.from_mesh(surface, voxel_size=0.01, method="openvdb").to_dense().values,
        "load .vdb": lambda: gk.volume.load("data/samples/torus.vdb").to_dense().values,
        "union": lambda: (lambda volume: gk.volume.union(volume, volume).to_dense().values)(
            gk.volume.load("data/samples/torus.vdb")
        ),
    }
    answers, seconds = [], {}
    for name, step in steps.items():
        answers.append(step().tobytes())
        times = []
        for _ in range(3):
            start = time.perf_counter()
            assert step().tobytes() == answers[-1]
            times.append(time.perf_counter() - start)
        seconds[name] = min(times)
    return b"".join(answers), seconds


volume = gk.volume.load("data/samples/torus.vdb")
gk.volume.save("again.vdb", volume)
assert gk.volume.load("again.vdb").to_dense().values.tobytes() == volume.to_dense().values.tobytes()
print("a .vdb file is read, written and read again, bit for bit")
before, alone = work()
for name in BESIDE:
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", name], check=True)
    module = importlib.import_module(name)
    # Their threads start, beside those of geokit.
    if name == "torch":
        matrix = module.rand(1000, 1000)
        assert float((matrix @ matrix).sum()) > 0
    if name == "open3d":
        cloud = module.geometry.PointCloud(module.utility.Vector3dVector(POINTS[:20_000]))
        cloud.estimate_normals()
    print(f"beside {name} {module.__version__}")
after, beside = work()
assert after == before
for name in alone:
    print(f"{name:20} {1e3 * alone[name]:8.1f} ms" + (f", then {1e3 * beside[name]:8.1f} ms" if BESIDE else ""))
