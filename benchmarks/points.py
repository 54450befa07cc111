"""Neighbors against every peer: ``python -m benchmarks.points [--tasks NAME ...] [--counts N ...] [--out FILE]``.

Points are their own queries; the build is part of each time, of geokit's and of the peer's. Answers are compared first:
counts, and all lists of neighbors as sets; no list is sorted. SciPy and nanoflann use float64 points; Open3D uses
float32 points, compared with geokit on float32, and decides in float32: one of 100,000 lists may differ. All use all
threads.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import clouds, mesh_queries
from benchmarks.measure import Asked, Bar, Case, Peer, Report, Row, in_process, median_seconds
from geokit.core import launcher
from geokit.points import NeighborGrid

COUNTS = (200_000, 2_000_000)
NEAREST = (8, 32)
# The shapes are compared with the uniform cloud at this many points.
SHAPE_COUNT = 500_000
RUNS = 5
# SciPy's lists are Python objects: for more points they take minutes and gigabytes.
MOST_LISTS = 500_000


def cloud_of(name: str, count: int) -> tuple[np.ndarray, float]:
    """A cloud with coordinates that float32 represents, so that peers of either precision have the same points."""
    points, radius = clouds.SHAPES[name](count)
    return points.astype(np.float32).astype(np.float64), float(np.float32(radius))


def scipy_counts(points: np.ndarray, radius: float) -> Asked:
    from scipy.spatial import cKDTree

    return Asked(lambda: cKDTree(points).query_ball_point(points, radius, workers=-1, return_length=True))


def open3d_search(points: np.ndarray, radius: float) -> Callable[[], Any]:
    import open3d as o3d

    held = o3d.core.Tensor(points.astype(np.float32))

    def run() -> Any:
        search = o3d.core.nns.NearestNeighborSearch(held)
        search.fixed_radius_index(radius)
        return search.fixed_radius_search(held, radius, sort=False)

    return run


def open3d_counts(points: np.ndarray, radius: float) -> Asked:
    # Its counts come with the lists.
    return Asked(open3d_search(points, radius), lambda found: np.diff(found[2].numpy()))


def sums_of_rows(offsets: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """A hash of each row's set of indices, unlikely to collide."""
    mixed = (indices.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    total = np.concatenate([[np.uint64(0)], np.cumsum(mixed ^ (mixed >> np.uint64(29)), dtype=np.uint64)])
    return (total[offsets[1:]] - total[offsets[:-1]]) >> np.uint64(12)


def open3d_lists(points: np.ndarray, radius: float) -> Asked:
    run = open3d_search(points, radius)
    return Asked(run, lambda found: sums_of_rows(found[2].numpy(), found[0].numpy()).astype(np.float64))


def scipy_lists(points: np.ndarray, radius: float) -> Asked:
    """SciPy's Python lists, converted to arrays."""
    from scipy.spatial import cKDTree

    def run() -> tuple[np.ndarray, np.ndarray]:
        found = cKDTree(points).query_ball_point(points, radius, workers=-1, return_sorted=False)
        lengths = np.fromiter(map(len, found), np.int64, len(found))
        return np.concatenate([[0], np.cumsum(lengths)]), np.concatenate(found).astype(np.int32)

    return Asked(run, lambda found: sums_of_rows(*found).astype(np.float64))


def scipy_nearest(points: np.ndarray, k: int) -> Asked:
    from scipy.spatial import cKDTree

    return Asked(lambda: cKDTree(points).query(points, k, workers=-1), lambda found: found[0].ravel())


def nanoflann_nearest(points: np.ndarray, k: int) -> Asked:
    import pynanoflann

    threads = launcher.thread_count()

    def run() -> Any:
        tree = pynanoflann.KDTree(n_neighbors=k, metric="L2", leaf_size=16)
        tree.fit(points)
        return tree.kneighbors(points, n_jobs=threads)

    def read(found: Any) -> np.ndarray:
        # Whether distances are squared differs between its versions.
        values = np.asarray(found[0], dtype=np.float64).ravel()
        return values

    return Asked(run, read)


def open3d_nearest(points: np.ndarray, k: int) -> Asked:
    import open3d as o3d

    held = o3d.core.Tensor(points.astype(np.float32))

    def run() -> Any:
        search = o3d.core.nns.NearestNeighborSearch(held)
        search.knn_index()
        return search.knn_search(held, k)

    return Asked(run, lambda found: np.sqrt(found[1].numpy().astype(np.float64)).ravel())


def radius_counts(report: Report, count: int) -> None:
    points, radius = cloud_of("uniform", count)
    task = f"radius count, {count:,} points, build included"
    single = points.astype(np.float32)
    report.case(
        Case(
            task,
            count,
            lambda: NeighborGrid(points, radius, device="cpu").count(),
            [Peer("SciPy cKDTree", partial(scipy_counts, points, radius))],
            1.0,
            bars=(Bar(20.0),),
        )
    )
    report.case(
        Case(
            f"{task}, float32",
            count,
            lambda: NeighborGrid(single, radius, device="cpu").count(),
            [Peer("Open3D", partial(open3d_counts, points, radius))],
            1.0,
            kind="hit",
            bars=(Bar(18.0),),
        )
    )


def radius_lists(report: Report, count: int) -> None:
    points, radius = cloud_of("uniform", count)
    single = points.astype(np.float32)
    task = f"radius lists (CSR), {count:,} points, build included"
    if count <= MOST_LISTS:
        report.case(
            Case(
                task,
                count,
                lambda: NeighborGrid(points, radius, device="cpu").radius_search(order="any"),
                [Peer("SciPy cKDTree", partial(scipy_lists, points, radius))],
                1.0,
                bars=(Bar(10.0),),
                read=lambda found: sums_of_rows(found.offsets, found.indices).astype(np.float64),
            )
        )
    report.case(
        Case(
            f"{task}, float32",
            count,
            lambda: NeighborGrid(single, radius, device="cpu").radius_search(order="any"),
            [Peer("Open3D", partial(open3d_lists, points, radius))],
            1.0,
            kind="hit",
            bars=(Bar(10.0),),
            read=lambda found: sums_of_rows(found.offsets, found.indices).astype(np.float64),
        )
    )


def nearest(report: Report, count: int) -> None:
    points, _ = cloud_of("uniform", count)
    for k in NEAREST:
        report.case(
            Case(
                f"{k} nearest, {count:,} points, build included",
                count,
                lambda k=k: NeighborGrid(points, device="cpu").knn(k=k),
                [
                    Peer("SciPy cKDTree", partial(scipy_nearest, points, k)),
                    Peer("pynanoflann", partial(nanoflann_nearest, points, k)),
                    Peer("Open3D", partial(open3d_nearest, points, k)),
                ],
                1.0,
                bars=(Bar(2.0, ("SciPy",)), Bar(2.0, ("pynanoflann",))),
                read=lambda found: found.distance.ravel(),
                same=1e-6,
            )
        )


def shapes(report: Report, _: int) -> None:
    """Time for each neighbor found, of clouds of other shapes, in units of the uniform cloud's."""
    usual: dict[str, float] = {}
    for name in clouds.SHAPES:
        points, radius = cloud_of(name, SHAPE_COUNT)
        found = NeighborGrid(points, radius, device="cpu").count().sum(dtype=np.int64)
        calls = {
            "count": (lambda p=points, r=radius: NeighborGrid(p, r, device="cpu").count(), found),
            "lists": (lambda p=points, r=radius: NeighborGrid(p, r, device="cpu").radius_search(), found),
            "16 nearest": (lambda p=points: NeighborGrid(p, device="cpu").knn(k=16), 16 * len(points)),
        }
        for what, (call, number) in calls.items():
            each = median_seconds(call, RUNS) / number
            against = each / usual.setdefault(what, each)
            report.row(
                Row(
                    f"{what}, {name}, {SHAPE_COUNT:,} points, build included",
                    f"{1e-6 / each:.1f}",
                    bar="2",
                    met="met" if against <= 2.0 else "NOT met",
                    note=f"{number / len(points):.1f} neighbors each; {against:.2f} of the uniform time for each",
                )
            )


TASKS = {"counts": radius_counts, "lists": radius_lists, "nearest": nearest, "shapes": shapes}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, metavar="NAME", help=f"of {', '.join(TASKS)}; default all")
    parser.add_argument("--counts", nargs="+", type=int, default=COUNTS, help="numbers of points")
    parser.add_argument("--out", type=Path, help="also write the report there")
    options = parser.parse_args()
    table = mesh_queries.begin(mesh_queries.Setting(queries=max(options.counts)), options.out)
    for name in options.tasks or TASKS:
        for count in options.counts if name != "shapes" else (SHAPE_COUNT,):
            in_process(table, name, TASKS[name], count)
    table.end()
    return 0


if __name__ == "__main__":
    sys.exit(main())
