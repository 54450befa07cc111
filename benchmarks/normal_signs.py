"""Signs of normals against Open3D: ``python -m benchmarks.normal_signs [--seeds N]``.

Shares of wrong signs [%], in the mean over seeds, of geokit and of Open3D's ``orient_normals_consistent_tangent_plane``
with as many neighbors, for the same unoriented normals; without Open3D its columns are empty. For two surfaces beside
each other a sign is wrong if it differs from most of its own surface. Lengths are in spacings.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.catalog import oriented_clouds as shapes
from geokit.points import normals

K = 16
PLATES = (1.5, 1.8, 2.1, 2.4, 2.7, 3.0, 3.2, 3.6, 4.0, 5.0, 6.0)
GAPS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
BOX = [1.0, 0.7, 0.5]


def clouds(random: np.random.Generator) -> Iterator[tuple[str, Any, float, Any]]:
    """Name, shape, noise, and the number of the surface of each point, or None."""
    for thickness in PLATES:
        yield f"plate, thickness {thickness}", shapes.plate(random, thickness), 0.0, None
    for thickness in (3.2, 4.5, 6.0):
        for noise in (0.1, 0.2, 0.3, 0.5, 0.6):
            yield f"plate, thickness {thickness}, noise {noise}", shapes.plate(random, thickness), noise, None
    for gap in GAPS:
        yield f"nested spheres, gap {gap}", *nest(shapes.nested_spheres(random, gap))
        yield f"parallel sheets, gap {gap}", *nest(shapes.parallel_sheets(random, gap))
    for angle in (3, 5, 10, 20, 45, 70):
        yield f"cone, half angle {angle}", shapes.cone(random, angle), 0.0, None
    for noise in (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 1.0):
        yield f"box, noise {noise}", shapes.box(random, BOX), noise, None
    for diameter in (2.0, 2.5, 3.0, 4.0):
        minor = (diameter * np.pi) ** 2 / shapes.COUNT
        for noise in (0.0, 0.2):
            yield f"thin ring, diameter {diameter}, noise {noise}", shapes.torus(random, minor), noise, None
    for minor in (0.2, 0.35, 0.8):
        for noise in (0.0, 0.5):
            yield f"torus, tube {minor}, noise {noise}", shapes.torus(random, minor), noise, None
    for ratio in (10.0, 100.0, 1000.0):
        ball = shapes.sphere(random, count=40 * shapes.COUNT)
        yield f"sphere, density 1 to {ratio:g}", shapes.uneven(random, ball, 2, ratio), 0.0, None
        plate = shapes.plate(random, 4.0 * 6.0**0.5, 6 * shapes.COUNT)
        yield f"plate of 4, density 1 to {ratio:g}", shapes.uneven(random, plate, 0, ratio), 0.0, None


def nest(made: tuple[Any, Any]) -> tuple[Any, float, Any]:
    return made[0], 0.0, made[1]


def share(found: NDArray[Any], true: NDArray[Any], part: Any) -> float:
    bad = (found * true).sum(axis=1) <= 0.0
    if part is None:
        return float(bad.mean())
    return float(sum(min(bad[part == p].sum(), (~bad[part == p]).sum()) for p in np.unique(part)) / len(bad))


def by_open3d(points: NDArray[Any]) -> NDArray[Any]:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals(points, k=K, orientation="none", device="cpu").normals)
    cloud.orient_normals_consistent_tangent_plane(K)
    return np.asarray(cloud.normals)


def compare(seeds: int) -> None:
    has_open3d = importlib.util.find_spec("open3d") is not None
    rows: dict[str, list[tuple[float, ...]]] = {}
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        for name, (points, normal, spacing), noise, part in clouds(random):
            turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
            points = (points + noise * spacing * random.normal(size=points.shape)) @ turn.T
            begun = time.perf_counter()
            found = normals(points, k=K, device="cpu").normals
            taken = time.perf_counter()
            other = by_open3d(points) if has_open3d else np.full_like(found, np.nan)
            ended = time.perf_counter()
            of_peer = share(other, normal @ turn.T, part) if has_open3d else np.nan
            rows.setdefault(name, []).append(
                (100.0 * share(found, normal @ turn.T, part), 100.0 * of_peer, (ended - taken) / (taken - begun))
            )
    print("| cloud | wrong, geokit [%] | wrong, Open3D [%] | time of Open3D / geokit |")
    print("|---|---:|---:|---:|")
    for name, found in rows.items():
        table = np.array(found)
        wrong, of_peer = table[:, :2].mean(axis=0)
        print(f"| {name} | {wrong:.2f} | {of_peer:.2f} | {np.median(table[:, 2]):.1f} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6)
    compare(parser.parse_args().seeds)
