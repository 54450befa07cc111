"""Signs on broken meshes against libigl's exact winding number: ``python -m benchmarks.sign_check [--points N]``.

The bunny is broken in each way of catalog/mesh_catalog.py. libigl's exact sum is the independent reference for
geokit and for libigl's fast winding number; only points with an exact winding number farther than 0.01 from 1/2 count.
geokit first flips faces that are wound against their neighbors, so the exact sum is taken over the mesh with these
flips. Times are those of
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import inputs
from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.mesh import Surface, TriangleMesh

# Nearer to 1/2 than this, an exact winding number decides nothing.
UNDECIDED = 0.01
# Shares of right signs below this fail.
REQUIRED = 0.9999
RUNS = 3

HEADER = (
    "| mesh | points | judged | signs right | libigl's fast right | largest error of w | libigl's "
    "| signed distance M/s | ratio to libigl | w M/s | ratio to libigl |\n"
    "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|"
)


class Row(NamedTuple):
    """One mesh and one set of points; rates in queries a second."""

    mesh: str
    points: str
    judged: int
    right: float
    peer_right: float
    error: float
    peer_error: float
    rate: float
    ratio: float
    winding_rate: float
    winding_ratio: float

    def __str__(self) -> str:
        return (
            f"| {self.mesh} | {self.points} | {self.judged:,} | {self.right:.6%} | {self.peer_right:.6%} "
            f"| {self.error:.5f} | {self.peer_error:.5f} | {self.rate / 1e6:.3f} | {self.ratio:.2f} "
            f"| {self.winding_rate / 1e6:.3f} | {self.winding_ratio:.2f} |"
        )


def as_wound(surface: Surface) -> TriangleMesh:
    """The mesh with the faces flipped that the surface treats as flipped."""
    flipped = surface._orientation.flipped
    faces = np.where(flipped[:, None], surface.mesh.faces[:, ::-1], surface.mesh.faces)
    return TriangleMesh(surface.mesh.vertices, faces, name=surface.mesh.name)


def paired(ours: Callable[[], object], theirs: Callable[[], object]) -> tuple[float, float]:
    """Median seconds of both, run in turn."""
    seconds: tuple[list[float], list[float]] = ([], [])
    for _ in range(RUNS):
        for call, record in zip((ours, theirs), seconds, strict=True):
            start = time.perf_counter()
            call()
            record.append(time.perf_counter() - start)
    return statistics.median(seconds[0]), statistics.median(seconds[1])


class Libigl:
    """libigl's trees over one mesh: its fast winding number (order 2, accuracy 2) and its distance."""

    def __init__(self, mesh: TriangleMesh) -> None:
        import igl

        self.vertices = np.ascontiguousarray(mesh.vertices)
        self.faces = np.ascontiguousarray(mesh.faces, np.int64)
        self.exact = lambda points: igl.winding_number(self.vertices, self.faces, points)
        self.tree = igl.AABB()
        self.tree.init(self.vertices, self.faces)
        self.bvh = igl.FastWindingNumberBVH()
        self.bvh.init(self.vertices, self.faces, 2)

    def winding(self, points: np.ndarray) -> np.ndarray:
        return self.bvh.winding_number(points, 2.0)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        distance = np.sqrt(self.tree.squared_distance(self.vertices, self.faces, points)[0])
        return np.where(self.winding(points) > 0.5, -distance, distance)


def check(name: str, mesh: TriangleMesh, kind: str, points: np.ndarray) -> Row:
    """Signs, winding numbers and rates on one mesh."""
    surface = Surface(mesh, device="cpu")
    peer = Libigl(as_wound(surface))
    exact = peer.exact(points)
    sure = np.abs(exact - 0.5) > UNDECIDED
    inside = exact[sure] > 0.5
    winding, peer_winding = surface.winding_number(points), peer.winding(points)
    found = surface.signed_distance(points, sign="winding").distance
    mine, theirs = paired(lambda: surface.signed_distance(points, sign="winding"), lambda: peer.signed_distance(points))
    mine_winding, theirs_winding = paired(lambda: surface.winding_number(points), lambda: peer.winding(points))
    return Row(
        mesh=name,
        points=kind,
        judged=int(sure.sum()),
        right=float(((found[sure] < 0) == inside).mean()),
        peer_right=float(((peer_winding[sure] > 0.5) == inside).mean()),
        error=float(np.abs(winding - exact).max()),
        peer_error=float(np.abs(peer_winding - exact).max()),
        rate=len(points) / mine,
        ratio=theirs / mine,
        winding_rate=len(points) / mine_winding,
        winding_ratio=theirs_winding / mine_winding,
    )


def run(mesh: TriangleMesh, count: int, names: list[str] | None = None) -> list[Row]:
    """All broken meshes, each with uniform points and with points about the surface; prints rows as they come."""
    print(HEADER, flush=True)
    rows = []
    for name in names or mesh_catalog.BROKEN:
        broken = mesh_catalog.BROKEN[name](mesh)
        for kind, points in (
            ("uniform", inputs.uniform(broken, count, seed=31)),
            ("near", inputs.near(broken, count, seed=32)),
        ):
            rows.append(check(name, broken, kind, points))
            print(rows[-1], flush=True)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which to run: {', '.join(mesh_catalog.BROKEN)}")
    parser.add_argument("--points", type=int, default=100_000, help="for each mesh and each kind of points")
    parser.add_argument("--subdivide", type=int, default=0, help="the bunny's 12,200 triangles, times 4 each")
    parser.add_argument("--out", type=Path, default=None, help="also write the table there")
    options = parser.parse_args()
    unknown = set(options.names) - set(mesh_catalog.BROKEN)
    if unknown:
        parser.error(f"no mesh {sorted(unknown)}; there are {', '.join(mesh_catalog.BROKEN)}")
    os.environ.setdefault("OMP_NUM_THREADS", str(launcher.thread_count()))
    rows = run(inputs.subdivided(inputs.bunny(), options.subdivide), options.points, options.names)
    if options.out:
        options.out.write_text("\n".join([HEADER, *map(str, rows)]) + "\n", encoding="utf-8")
    wrong = [row for row in rows if row.right < REQUIRED]
    for row in wrong:
        print(f"{row.mesh}, {row.points}: {row.right:.6%} of the signs are right, {REQUIRED:.2%} are required")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
