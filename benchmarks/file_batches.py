"""Time of a small file in a batch: the first, each further one, and one that is trusted, beside trimesh alone.

``python -m benchmarks.file_batches [--count N]``. Files are boxes of 12 triangles, grids a band around one. The tenth
part of times under which a tenth of files stay tells how much of the rest is due to other work of the machine.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from geokit import native
from geokit.formats.table import FORMATS, extensions
from geokit.native import _openvdb

CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
BOX = gk.mesh.TriangleMesh(CORNERS, np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]]), name="box")


def row(name: str, load: Callable[[], Any], count: int) -> None:
    """Print the first time, and the tenth part and the median of the others."""
    times = []
    for _ in range(count + 1):
        start = time.perf_counter()
        load()
        times.append(1e3 * (time.perf_counter() - start))
    low, middle = np.percentile(times[1:], [10, 50])
    print(f"| {name} | {times[0]:.0f} | {low:.2f} | {middle:.2f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    count = parser.parse_args().count
    print("| a small file [ms] | first | a tenth is under | median |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for kind in extensions("mesh", "w"):
            if FORMATS[kind].process:
                path = Path(folder) / f"a{kind}"
                gk.mesh.save(path, BOX)
                row(kind, lambda path=path: gk.mesh.load(path), count)
                row(f"{kind}, trusted", lambda path=path: gk.mesh.load(path, trusted=True), count)
        import trimesh

        row(".glb, trimesh alone", lambda: trimesh.load_scene(Path(folder) / "a.glb", process=False), count)
        if native.available():
            path = Path(folder) / "a.vdb"
            gk.volume.save(path, gk.volume.from_mesh(BOX, 0.1, device="cpu"))
            row(".vdb, one at a time", lambda: gk.volume.load(path), _openvdb.FIRST_FILES - 1)
            row(".vdb", lambda: gk.volume.load(path), count)
            row(".vdb, trusted", lambda: gk.volume.load(path, trusted=True), count)


if __name__ == "__main__":
    main()
