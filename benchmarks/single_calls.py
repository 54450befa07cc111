"""Loops of 100,000 calls for one query each, from NumPy arrays on a CPU: ``python -m benchmarks.single_calls``.

Each peer gets rows of its own type, prepared before the loop, and keeps its answers in its own containers. Rates are
calls a second, so 0.2 M/s is 5 us a call. trimesh's closest points take milliseconds: their loop has 1,000 calls.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from benchmarks import inputs, mesh_queries
from benchmarks.measure import Asked, Bar, Case, Peer, Report
from benchmarks.mesh_queries import Setting

CALLS = 100_000
# Distinct queries; the loop goes through them again and again.
DISTINCT = 1_000
TRIANGLES = 48_800
POINTS = 100_000
NEAREST = 8
# Required ratios.
BARS = (Bar(1.0, ("Open3D",)),)


def loop(call: Callable[..., Any], *rows: Sequence[Any], calls: int = CALLS) -> list[Any]:
    """The answers to so many single calls; those of the first DISTINCT are kept."""
    given = list(zip(*rows, strict=True))
    kept = [call(*row) for row in given]
    for _ in range(calls // DISTINCT - 1):
        for row in given:
            call(*row)
    return kept


def singles(values: np.ndarray, dtype: type = np.float64) -> list[np.ndarray]:
    """Arrays of one row each."""
    return [np.array(row, dtype)[None] for row in values]


def case(
    task: str,
    ours: Callable[..., Any],
    rows: Sequence[Any],
    read: Any,
    asked: list[Peer],
    calls: int = CALLS,
    **more: Any,
) -> Case:
    """One loop of geokit beside those of its peers; ``read`` takes what is compared from an answer."""
    run = partial(loop, ours, *rows, calls=calls)
    return Case(f"{calls:,} calls, {task}", calls, run, asked, read=partial(joined, read), **more)


def joined(read: Callable[[Any], Any], found: list[Any]) -> np.ndarray:
    return np.concatenate([np.ravel(read(answer)) for answer in found])


def asked(read: Callable[[Any], Any], call: Callable[..., Any], *rows: Sequence[Any], calls: int = CALLS) -> Asked:
    return Asked(partial(loop, call, *rows, calls=calls), partial(joined, read))


def open3d_scene(mesh: gk.mesh.TriangleMesh) -> Any:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32))
    )
    return scene


def open3d_points(mesh: gk.mesh.TriangleMesh, points: np.ndarray, method: str) -> Asked:
    scene = open3d_scene(mesh)
    return asked(lambda found: found.numpy(), getattr(scene, method), singles(points, np.float32))


def open3d_rays(mesh: gk.mesh.TriangleMesh, origins: np.ndarray, directions: np.ndarray) -> Asked:
    rays = singles(np.concatenate([origins, directions], axis=1), np.float32)
    return asked(lambda found: found["t_hit"].numpy(), open3d_scene(mesh).cast_rays, rays)


def fcpw_distance(mesh: gk.mesh.TriangleMesh, points: np.ndarray) -> Asked:
    import fcpw

    scene, found = fcpw.scene_3D(), fcpw.interaction_3D_list()
    scene.set_object_count(1)
    scene.set_object_vertices(np.asfortranarray(mesh.vertices, np.float32), 0)
    scene.set_object_triangles(np.asfortranarray(mesh.faces, np.int32), 0)
    scene.build(fcpw.aggregate_type.bvh_surface_area, True, False, False)
    reach = np.full(1, np.inf, np.float32)

    def call(row: np.ndarray) -> float:
        scene.find_closest_points(row, reach, found, False)
        return float(found[0].d)

    return asked(lambda distance: distance, call, singles(points, np.float32))


def trimesh_of(mesh: gk.mesh.TriangleMesh) -> Any:
    import trimesh

    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def trimesh_points(mesh: gk.mesh.TriangleMesh, points: np.ndarray) -> Asked:
    from trimesh.proximity import ProximityQuery

    query = ProximityQuery(trimesh_of(mesh))
    return asked(lambda found: found[1], query.on_surface, singles(points), calls=DISTINCT)


def trimesh_rays(mesh: gk.mesh.TriangleMesh, origins: np.ndarray, directions: np.ndarray) -> Asked:
    """With embreex, which trimesh takes where it is installed."""
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    cast = RayMeshIntersector(trimesh_of(mesh)).intersects_location

    def call(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return cast(origin, direction, multiple_hits=False)[0], origin, direction

    def read(found: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float:
        places, origin, direction = found
        return float(np.linalg.norm(places - origin) / np.linalg.norm(direction)) if len(places) else np.inf

    return asked(read, call, singles(origins), singles(directions))


def queries_of_meshes(report: Report, setting: Setting) -> None:
    """Closest points, signed distances and first hits."""
    mesh = inputs.bunny_of(setting.triangles)
    surface = gk.mesh.Surface(mesh, device="cpu")
    size = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    points = inputs.in_float32(inputs.uniform(mesh, DISTINCT))
    origins, directions = (inputs.in_float32(values) for values in inputs.random_rays(mesh, DISTINCT))
    distance = lambda found: found.distance  # noqa: E731
    peers = [
        Peer("Open3D", partial(open3d_points, mesh, points, "compute_distance")),
        Peer("fcpw", partial(fcpw_distance, mesh, points)),
    ]
    report.case(case("closest point", surface.closest_point, [singles(points)], distance, peers, size=size, bars=BARS))
    peers = [Peer("trimesh", partial(trimesh_points, mesh, points))]
    report.case(
        case("closest point", surface.closest_point, [singles(points)], distance, peers, calls=DISTINCT, size=size)
    )
    peers = [Peer("Open3D", partial(open3d_points, mesh, points, "compute_signed_distance"))]
    report.case(
        case(
            "signed distance",
            surface.signed_distance,
            [singles(points)],
            distance,
            peers,
            size=size,
            kind="signed",
            bars=BARS,
        )
    )
    rays = [singles(origins), singles(directions)]
    peers = [
        Peer("Open3D", partial(open3d_rays, mesh, origins, directions)),
        Peer("trimesh (embreex)", partial(trimesh_rays, mesh, origins, directions), same=1e-5),
    ]
    lengths = np.linalg.norm(directions, axis=1)
    hit = lambda found: found.t  # noqa: E731
    report.case(case("first hit", surface.raycast, rays, hit, peers, size=size, kind="hit", units=lengths, bars=BARS))


def warp_samples(volume: gk.volume.SparseVolume, points: np.ndarray) -> Asked:
    import warp as wp

    from benchmarks.raw_kernels import raw_sample_kernel

    grid, out = volume.on("cpu"), wp.empty(1, dtype=float, device="cpu")

    def call(row: np.ndarray) -> float:
        where = wp.array(row, dtype=wp.vec3, device="cpu")
        wp.launch(raw_sample_kernel, 1, inputs=[grid.id, where], outputs=[out], device="cpu")
        return float(out.numpy()[0])

    return asked(lambda value: value, call, singles(points, np.float32))


def samples(report: Report, setting: Setting) -> None:
    """Trilinear samples of a level set."""
    mesh = inputs.bunny_of(setting.triangles)
    longest = float((mesh.bounds[1] - mesh.bounds[0]).max())
    volume = gk.volume.from_mesh(gk.mesh.Surface(mesh, device="cpu"), longest / 100)
    points = inputs.in_float32(inputs.near(mesh, DISTINCT))
    call = partial(gk.volume.sample, volume, order=1, device="cpu")
    peers = [Peer("warp", partial(warp_samples, volume, points))]
    report.case(case("trilinear sample", call, [singles(points)], np.asarray, peers, size=longest))


def scipy_tree(cloud: np.ndarray, rows: list[np.ndarray], radius: float | None) -> Asked:
    from scipy.spatial import cKDTree

    tree = cKDTree(cloud)
    if radius is None:
        return asked(lambda found: found[0], partial(tree.query, k=NEAREST), rows)
    return asked(lambda found: found, lambda row: tree.query_ball_point(row, radius, return_length=True), rows)


def open3d_tree(cloud: np.ndarray, rows: list[np.ndarray], radius: float | None) -> Asked:
    import open3d as o3d

    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(cloud))
    if radius is None:
        search.knn_index()
        read, call = lambda found: np.sqrt(found[1].numpy()), lambda row: search.knn_search(row, NEAREST)
    else:
        search.fixed_radius_index(radius)
        read, call = lambda found: np.diff(found[2].numpy()), lambda row: search.fixed_radius_search(row, radius)
    return asked(read, call, [o3d.core.Tensor(row) for row in rows])


def neighbors(report: Report, setting: Setting) -> None:
    """Counts of about thirty points, and the eight nearest."""
    cloud = np.random.default_rng(1).random((POINTS, 3))
    rows = singles(np.random.default_rng(2).random((DISTINCT, 3)))
    radius = float((30 / (4.19 * POINTS)) ** (1 / 3))
    grid = gk.points.NeighborGrid(cloud, radius, device="cpu")
    for task, call, read, reach in (
        ("neighbor count", grid.count, np.asarray, radius),
        (f"{NEAREST} nearest", partial(nearest, grid), lambda found: found.distance, None),
    ):
        peers = [
            Peer("SciPy cKDTree", partial(scipy_tree, cloud, rows, reach)),
            Peer("Open3D", partial(open3d_tree, cloud, rows, reach)),
        ]
        report.case(case(task, call, [rows], read, peers, size=1.0))


def nearest(grid: gk.points.NeighborGrid, row: np.ndarray) -> Any:
    return grid.knn(row, NEAREST)


TASKS = {"mesh": queries_of_meshes, "samples": samples, "points": neighbors}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, metavar="NAME", help=f"of {', '.join(TASKS)}; default all")
    parser.add_argument("--out", type=Path, help="also write the report there")
    options = parser.parse_args()
    setting = Setting(triangles=TRIANGLES, queries=1)
    table = mesh_queries.begin(setting, options.out)
    mesh_queries.run_tasks(table, {name: TASKS[name] for name in options.tasks or TASKS}, setting)
    table.end()
    return 0


if __name__ == "__main__":
    sys.exit(main())
