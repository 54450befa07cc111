"""Rays from inside closed meshes at their vertices and edges: ``python -m benchmarks.leak_check [--rays N]``.

A ray that hits nothing has leaked. Targets are exact in float64, or rounded to float32 as in a float32 pipeline. In
each case some first hits are compared with brute force over all triangles, in float64.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

import geokit as gk
from benchmarks import inputs
from benchmarks.catalog import mesh_catalog
from geokit.accuracy.reference import mesh as reference

BATCH = 1_000_000
COMPARED = 200


def meshes() -> dict[str, gk.mesh.TriangleMesh]:
    return {
        "box": mesh_catalog.box(),
        "icosphere": mesh_catalog.icosphere(4),
        "bumpy torus": inputs.bumpy_torus(96, 48),
        "L profile": mesh_catalog.l_profile(),
    }


def inside_points(mesh: gk.mesh.TriangleMesh, surface: gk.mesh.Surface) -> np.ndarray:
    """Points well inside, by a float64 winding number that shares no code with the surface."""
    rng = np.random.default_rng(1)
    points = mesh.bounds[0] + rng.random((400, 3)) * (mesh.bounds[1] - mesh.bounds[0])
    deep = surface.closest_point(points).distance > 0.02 * mesh.diagonal
    return points[deep & (reference.winding_number(mesh.vertices, mesh.faces, points) > 0.5)]


def aimed(mesh: gk.mesh.TriangleMesh, start: np.ndarray, count: int, at_edges: bool, seed: int):
    rng = np.random.default_rng(seed)
    face = mesh.faces[rng.integers(len(mesh.faces), size=count)]
    share = rng.random((count, 1)) if at_edges else np.ones((count, 1))
    targets = mesh.vertices[face[:, 0]] * share + mesh.vertices[face[:, 1]] * (1.0 - share)
    return np.broadcast_to(start, targets.shape), targets - start


def largest_error(mesh, origins, directions, t) -> float:
    """Largest relative delay of a hit behind brute force, or distance of a hit from the surface in diagonals.

    Brute force itself leaks at edges and may miss a right hit, so an earlier hit only has to be on the surface.
    """
    pick = np.linspace(0, len(t) - 1, COMPARED).astype(int)
    origins, directions, t = origins[pick], directions[pick], t[pick]
    expected = reference.first_hit(mesh.vertices, mesh.faces, origins, directions).t
    late = np.where(t > expected, (t - expected) / expected, 0.0)
    beside = reference.closest_point(mesh.vertices, mesh.faces, origins + t[:, None] * directions).distance
    return float(max(late.max(), beside.max() / mesh.diagonal))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=10_000_000, help="rays of each case")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=None, help="also write the table there")
    options = parser.parse_args()
    lines = ["| mesh | aims | held in | rays | leaks | largest error |", "|---|---|---|---:|---:|---:|"]
    print("\n".join(lines), flush=True)
    total = 0
    for name, mesh in meshes().items():
        surface = gk.mesh.Surface(mesh, device=options.device)
        starts = inside_points(mesh, surface)
        for at_edges in (False, True):
            for dtype in (np.float64, np.float32):
                leaks, error = 0, 0.0
                for seed, first in enumerate(range(0, options.rays, BATCH)):
                    count = min(BATCH, options.rays - first)
                    origins, directions = aimed(mesh, starts[seed % len(starts)], count, at_edges, seed)
                    origins, directions = origins.astype(dtype), directions.astype(dtype)
                    t = surface.raycast(origins.astype(np.float64), directions.astype(np.float64)).t
                    leaks += int(np.isinf(t).sum())
                    if seed == 0:
                        error = largest_error(mesh, origins.astype(np.float64), directions.astype(np.float64), t)
                total += leaks
                aims = "edges" if at_edges else "vertices"
                lines.append(f"| {name} | {aims} | {dtype.__name__} | {options.rays:,} | {leaks} | {error:.1e} |")
                print(lines[-1], flush=True)
    if options.out:
        options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
