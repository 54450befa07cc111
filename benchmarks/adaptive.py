"""Adaptive fields against one voxel size, at the same tolerance: ``python -m benchmarks.adaptive [MESH ...]``.

One voxel size is ``from_mesh(tolerance=)``, which chooses order and codec as ``adaptive_from_mesh`` does. Errors are
those at fresh points on faces, edges and corners and up to the tolerance from them, in tolerances. ``plan`` is right if
its smaller field is the smaller one; fields of one level count as one voxel size.

Timed points are uniform over the surface, up to the tolerance from it, in random order, NumPy float64.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import geokit as gk
from benchmarks import inputs
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher
from geokit.volume.adaptive.cells import CellLattice
from geokit.volume.adaptive.check import check_points

SAMPLES = Path(__file__).resolve().parents[1] / "data" / "samples"


def ball_with_cubes() -> gk.mesh.TriangleMesh:
    """A ball of radius 1 with 20 cubes of edge 0.06 on it."""
    random = np.random.default_rng(0)
    ball = inputs.subdivided(octahedron(), 4)
    parts = [(ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True), ball.faces)]
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.03
    sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
             [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    for _ in range(20):
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        place = random.normal(size=3)
        parts.append((corners @ (turn * np.sign(np.linalg.det(turn))) + place / np.linalg.norm(place), np.array(sides)))
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [some + start for (_, some), start in zip(parts, starts, strict=False)]
    return gk.mesh.TriangleMesh(np.concatenate([v for v, _ in parts]), np.concatenate(faces), name="ball with cubes")


def octahedron() -> gk.mesh.TriangleMesh:
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return gk.mesh.TriangleMesh(vertices, faces)


MESHES = {
    "torus": lambda: gk.mesh.load(SAMPLES / "torus.ply"),
    "bunny": inputs.bunny,
    "bracket": lambda: gk.mesh.load(SAMPLES / "bracket.obj"),
    "ball with cubes": ball_with_cubes,
}
# Seed of points that adaptive_from_mesh does not draw.
FRESH = 4321
RUNS = 9


def milliseconds(call) -> float:
    call()
    times = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(times))


def report(name: str, share: float, count: int) -> str:
    mesh = MESHES[name]()
    tolerance = share * float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    surface = gk.mesh.Surface(mesh, device="cpu")
    lattice = CellLattice(surface, surface.sign_method, mesh.bounds[0], tolerance, tolerance)
    points, exact = check_points(lattice, FRESH)
    on = gk.mesh.sample_surface(mesh, count, seed=7).points
    asked = on + np.random.default_rng(8).uniform(-0.577, 0.577, on.shape) * tolerance
    cells = [name, f"{share:g}"]
    found = []
    for make in (gk.volume.adaptive_from_mesh, lambda s, t: gk.volume.from_mesh(s, tolerance=t)):
        begin = time.perf_counter()
        field = make(surface, tolerance)
        seconds = time.perf_counter() - begin
        levels = field.levels if isinstance(field, gk.volume.AdaptiveSDF) else (field,)
        error = float(np.abs(field.sample(points, device="cpu") - exact).max()) / tolerance
        found.append((sum(level.info.byte_count for level in levels), len(levels)))
        codecs = "+".join(dict.fromkeys(level.info.grid_type for level in levels))
        asking = milliseconds(lambda f=field: f.sample(asked, device="cpu"))
        cells += [f"{len(levels)}: {levels[0].info.order}, {codecs}", f"{found[-1][0] / 1e6:.2f}", f"{error:.2f}"]
        cells += [f"{seconds:.1f}", f"{asking:.1f}"]
    first = gk.volume.plan(surface, tolerance)[0]
    right = (first.method == "adaptive_from_mesh") == (found[0][1] > 1 and found[0][0] < found[1][0])
    return "| " + " | ".join([*cells, f"**{found[0][0] / found[1][0]:.2f}**", "yes" if right else "**no**"]) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", default=list(MESHES), help=", ".join(MESHES))
    parser.add_argument("--tolerances", type=float, nargs="+", default=(1e-2, 1e-3), help="shares of the diagonal")
    parser.add_argument("--points", type=int, default=200_000, help="points of a call")
    parser.add_argument("--out", type=Path, help="also write the report there")
    arguments = parser.parse_args()
    lines = [
        f"{processor_name()}, {launcher.thread_count()} threads; {arguments.points:,} points a call, medians.\n",
        "| mesh | tolerance | levels: order, codecs | MB | error | made in [s] | sample [ms] | one: order, codec | MB "
        "| error | made in [s] | sample [ms] | memory ratio | plan right |",
        "|---|---:|---|---:|---:|---:|---:|---|---:|---:|---:|---:|---:|---|",
    ]
    for line in lines:
        print(line, flush=True)
    for name in arguments.meshes:
        for share in arguments.tolerances:
            lines.append(report(name, share, arguments.points))
            print(lines[-1], flush=True)
    if arguments.out:
        arguments.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
