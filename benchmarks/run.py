"""Side-by-side timings against peers: ``./dev bench [NAME ...] [--triangles N] [--queries N] [--out FILE]``.

Answers are compared before anything is timed; a peer that disagrees is reported and not timed. Ratios are medians of
paired runs: peer, geokit, peer, geokit, ... A peer that is not installed is named and left out.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import geokit as gk
from benchmarks import inputs
from geokit import _launch, native

# A peer's answers may be float32: half a millionth of the size; hits at grazing angles lose a digit more.
SAME = 5e-7
SAME_HIT = 1e-5
RUNS = 5


class Table:
    """Rows of one report, printed as they come."""

    def __init__(self) -> None:
        self.lines = [
            "| task | geokit M/s | peer | peer M/s | ratio | largest difference |",
            "|---|---:|---|---:|---:|---:|",
        ]
        print("\n".join(self.lines), flush=True)

    def add(self, line: str) -> None:
        self.lines.append(line)
        print(line, flush=True)


def paired(ours: Callable[[], object], theirs: Callable[[], object]) -> tuple[float, float]:
    """Median seconds of both, run in turn so that a machine that slows down slows both."""
    seconds: tuple[list[float], list[float]] = ([], [])
    for run in range(RUNS + 1):
        for call, record in zip((ours, theirs), seconds, strict=True):
            start = time.perf_counter()
            call()
            if run:  # the first warms up
                record.append(time.perf_counter() - start)
    return statistics.median(seconds[0]), statistics.median(seconds[1])


def against(
    table: Table,
    task: str,
    count: int,
    ours: Callable[[], object],
    peers: dict[str, Callable[[], Callable[[], object]]],
    size: float,
    same: float = SAME,
) -> None:
    """One task against every peer that can be imported; a peer is made by its factory, outside the clock.

    A peer's call may return anything that ``answers`` makes an array of: that too stays outside the clock.
    """
    answer = answers(ours())
    for name, factory in peers.items():
        try:
            call = factory()
        except ImportError as error:
            table.add(f"| {task} | - | {name} | - | - | not installed: {error.name} |")
            continue
        difference = largest_difference(answer, answers(call())) / size
        if not difference <= same:
            table.add(f"| {task} | - | {name} | - | - | {difference:.1e}: disagrees, not timed |")
            continue
        mine, theirs = paired(ours, call)
        table.add(
            f"| {task} | {count / mine / 1e6:.3f} | {name} | {count / theirs / 1e6:.3f} | {theirs / mine:.2f} "
            f"| {difference:.1e} |"
        )


def answers(found: object) -> np.ndarray:
    """Distances of fcpw's interactions, or the array itself."""
    if type(found).__name__ == "interaction_3D_list":
        return np.array([interaction.d for interaction in found])
    return np.asarray(found)


def largest_difference(a: np.ndarray, b: np.ndarray) -> float:
    """Over finite values; misses (inf) may differ at silhouettes for at most 1e-5 of the rows."""
    missed = np.isinf(a) != np.isinf(b)
    if missed.mean() > 1e-5:
        return float("inf")
    both = np.isfinite(a) & np.isfinite(b)
    return float(np.abs(a[both].astype(np.float64) - b[both]).max(initial=0.0))


def open3d_scene(mesh: gk.mesh.TriangleMesh):
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    vertices = o3d.core.Tensor(mesh.vertices.astype(np.float32))
    scene.add_triangles(vertices, o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    return o3d, scene


def open3d_distance(mesh: gk.mesh.TriangleMesh, points: np.ndarray):
    o3d, scene = open3d_scene(mesh)
    query = o3d.core.Tensor(points.astype(np.float32))
    return lambda: scene.compute_distance(query).numpy()


def open3d_rays(mesh: gk.mesh.TriangleMesh, origins: np.ndarray, directions: np.ndarray):
    o3d, scene = open3d_scene(mesh)
    rays = o3d.core.Tensor(np.concatenate([origins, directions], axis=1).astype(np.float32))
    return lambda: scene.cast_rays(rays)["t_hit"].numpy()


def fcpw_distance(mesh: gk.mesh.TriangleMesh, points: np.ndarray):
    import fcpw

    scene = fcpw.scene_3D()
    scene.set_object_count(1)
    scene.set_object_vertices(mesh.vertices.astype(np.float32), 0)
    scene.set_object_triangles(mesh.faces, 0)
    scene.build(fcpw.aggregate_type.bvh_surface_area, True, True, False)
    queries = points.astype(np.float32)
    radii = np.full(len(points), np.inf, np.float32)

    def call() -> object:
        found = fcpw.interaction_3D_list()
        scene.find_closest_points(queries, radii, found, False)
        return found

    return call


def libigl_distance(mesh: gk.mesh.TriangleMesh, points: np.ndarray):
    import igl

    return lambda: np.sqrt(igl.point_mesh_squared_distance(points, mesh.vertices, mesh.faces.astype(np.int64))[0])


def raw_warp_distance(mesh: gk.mesh.TriangleMesh, points: np.ndarray):
    import warp as wp

    from benchmarks.raw_kernels import raw_closest_slice_kernel

    device = wp.get_device("cpu")
    local = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    vertices = wp.array(mesh.vertices.astype(np.float32), dtype=wp.vec3, device=device)
    tree = wp.Mesh(vertices, wp.array(mesh.faces.ravel(), dtype=int, device=device), bvh_leaf_size=8)
    out = wp.empty(len(points), dtype=wp.float32, device=device)

    def call() -> np.ndarray:
        # In slices over all threads, as geokit launches its own.
        _launch.launch(raw_closest_slice_kernel, len(points), [tree.id, local], [out], device)
        return out.numpy()

    return call


def mesh_queries(table: Table, triangles: int, queries: int) -> None:
    """Closest points and first hits; the bunny's triangles are cut into four until there are enough."""
    mesh = inputs.bunny()
    while len(mesh.faces) < triangles:
        mesh = inputs.subdivided(mesh, 1)
    surface = gk.mesh.Surface(mesh, device="cpu")
    size = mesh.diagonal
    for name, points in (("uniform", inputs.uniform(mesh, queries)), ("near", inputs.near(mesh, queries))):
        # Points that float32 can hold, so that every peer is asked the same question.
        points = points.astype(np.float32).astype(np.float64)
        against(
            table,
            f"closest point, {name}, {len(mesh.faces):,} triangles",
            queries,
            lambda points=points: surface.closest_point(points).distance,
            {
                "Open3D": lambda points=points: open3d_distance(mesh, points),
                "fcpw": lambda points=points: fcpw_distance(mesh, points),
                "libigl": lambda points=points: libigl_distance(mesh, points),
                "warp": lambda points=points: raw_warp_distance(mesh, points),
            },
            size,
        )
    origins, directions = (a.astype(np.float32).astype(np.float64) for a in inputs.random_rays(mesh, queries))
    against(
        table,
        f"first hit, random, {len(mesh.faces):,} triangles",
        queries,
        lambda: surface.raycast(origins, directions).t,
        {"Open3D (Embree)": lambda: open3d_rays(mesh, origins, directions)},
        size,
        SAME_HIT,
    )


def neighbors(table: Table, _: int, queries: int) -> None:
    """Counts within a radius, about thirty each, in a uniform cloud."""
    cloud = np.random.default_rng(1).random((queries, 3))
    radius = float((30 / (4.19 * queries)) ** (1 / 3))
    grid = gk.points.NeighborGrid(cloud, radius, device="cpu")

    def scipy_counts() -> Callable[[], np.ndarray]:
        from scipy.spatial import cKDTree

        tree = cKDTree(cloud)
        return lambda: tree.query_ball_point(cloud, radius, workers=-1, return_length=True)

    def open3d_counts() -> Callable[[], np.ndarray]:
        import open3d as o3d

        points = o3d.core.Tensor(cloud)
        search = o3d.core.nns.NearestNeighborSearch(points)
        search.fixed_radius_index(radius)
        return lambda: np.diff(search.fixed_radius_search(points, radius)[2].numpy())

    against(
        table,
        "neighbour counts, 30 each",
        queries,
        lambda: grid.count(cloud),
        {"SciPy cKDTree": scipy_counts, "Open3D": open3d_counts},
        1.0,
    )


def narrow_band(table: Table, triangles: int, _: int) -> None:
    """A level set of 256 voxels along the longest side, half width 3; OpenVDB's is not exact, so no equality here."""
    mesh = inputs.bunny()
    while len(mesh.faces) < triangles:
        mesh = inputs.subdivided(mesh, 1)
    surface = gk.mesh.Surface(mesh, device="cpu")
    voxel = float((mesh.bounds[1] - mesh.bounds[0]).max()) / 256
    active = gk.volume.from_mesh(surface, voxel).info.active_voxel_count or 0
    task = f"narrow band 256^3, {len(mesh.faces):,} triangles"
    if not native.available():
        table.add(f"| {task} | - | OpenVDB | - | - | the extension is not built |")
        return
    mine, theirs = paired(
        lambda: gk.volume.from_mesh(surface, voxel),
        lambda: native.mesh_to_level_set(mesh.vertices, mesh.faces, voxel_size=voxel, half_width=3.0),
    )
    table.add(
        f"| {task} | {active / mine / 1e6:.3f} | OpenVDB meshToLevelSet | {active / theirs / 1e6:.3f} "
        f"| {theirs / mine:.2f} | OpenVDB's band is up to 0.38 voxel off |"
    )


TASKS = {"mesh": mesh_queries, "neighbors": neighbors, "band": narrow_band}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which to run: {', '.join(TASKS)}; default: all")
    parser.add_argument("--triangles", type=int, default=195_200)
    parser.add_argument("--queries", type=int, default=200_000)
    parser.add_argument("--out", type=Path, default=None, help="also write the table there")
    options = parser.parse_args()
    unknown = set(options.names) - set(TASKS)
    if unknown:
        parser.error(f"no benchmark {sorted(unknown)}; there are {', '.join(TASKS)}")
    os.environ.setdefault("OMP_NUM_THREADS", str(_launch.thread_count()))
    print(f"{_launch.thread_count()} CPU threads, medians of {RUNS} paired runs\n")
    table = Table()
    for name in options.names or TASKS:
        TASKS[name](table, options.triangles, options.queries)
    if options.out:
        options.out.write_text("\n".join(table.lines) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
