"""``mesh.wrap`` beside CGAL's alpha wrap at the same true deviation: ``python -m benchmarks.alpha_wraps [SCENE ...]``.

Alpha wrap (``generate_alpha_wrap`` of pymeshlab) does not say how far its surface is from the input. So it goes first,
at each of SETTINGS; the farthest that is found of all points of its faces (``mesh.hausdorff``) is the tolerance of
``mesh.wrap``. Times are those of the processor, of all threads together, best of RUNS; both begin and end with arrays.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import geokit as gk
from benchmarks import scenes
from geokit.mesh import TriangleMesh

# Alpha and offset, shares of the diagonal; CGAL advises an offset of a thirtieth of alpha or more.
SETTINGS = [(0.04, 0.008), (0.02, 0.004), (0.01, 0.002), (0.005, 0.001)]
RUNS = 2


def holed(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh without 5% of its faces."""
    keep = np.random.default_rng(0).random(mesh.face_count) > 0.05
    return TriangleMesh(mesh.vertices, mesh.faces[keep])


SCENES: dict[str, Callable[[], TriangleMesh]] = {
    "lobes without 5% of the faces": lambda: holed(scenes.lobes(100_000).mesh),
    "foliage": lambda: scenes.foliage(60_000).mesh,
    "part": lambda: scenes.part(60_000).mesh,
    "hall": lambda: scenes.hall(260_000).mesh,
    "terrain": lambda: scenes.terrain(60_000).mesh,
}


def by_alpha_wrap(mesh: TriangleMesh, alpha: float, offset: float) -> TriangleMesh:
    import pymeshlab

    held = pymeshlab.MeshSet()
    held.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces))
    share = pymeshlab.PercentageValue
    held.generate_alpha_wrap(alpha=share(100 * alpha), offset=share(100 * offset))
    made = held.current_mesh()
    return TriangleMesh(made.vertex_matrix(), made.face_matrix())


def best_of(call: Callable[[], Any]) -> tuple[Any, float]:
    spent, made = [], None
    for _ in range(RUNS):
        start = time.process_time()
        made = call()
        spent.append(time.process_time() - start)
    return made, min(spent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", choices=[[], *SCENES], help="all by default")
    gk.mesh.wrap(gk.mesh.box(), tolerance=0.1, device="cpu")
    print("| input, triangles | deviation, alpha wrap | faces | s | deviation, geokit | faces | s |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name in parser.parse_args().scenes or SCENES:
        mesh = SCENES[name]()
        given, size = gk.mesh.Surface(mesh, device="cpu"), np.linalg.norm(np.ptp(mesh.bounds, axis=0))
        for setting in SETTINGS:
            theirs, seconds = best_of(partial(by_alpha_wrap, mesh, *setting))
            away = gk.mesh.hausdorff(theirs, given, samples=0, device="cpu").a_to_b.max / size
            row = f"| {name}, {mesh.face_count:,} | {away:.5f} | {theirs.face_count:,} | {seconds:.1f} |"
            ours, seconds = best_of(partial(gk.mesh.wrap, mesh, tolerance=away * size, device="cpu"))
            print(row, f"{ours.deviation / size:.5f} | {ours.mesh.face_count:,} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
