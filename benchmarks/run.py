"""Side-by-side timings against peers: ``./dev bench [NAME ...] [--triangles N] [--queries N] [--out FILE]``.

Answers are compared before anything is timed; a peer that disagrees is reported and not timed. Ratios are medians of
paired runs: geokit, peer, geokit, peer, ... A peer that is not installed is named and left out. Mesh queries have
options of their own: ``python -m benchmarks.mesh_queries --help``.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import numpy as np

import geokit as gk
from benchmarks import inputs, mesh_queries
from benchmarks.measure import Asked, Case, Peer, Report, Row, paired
from benchmarks.mesh_queries import Setting
from geokit import native

# Voxels along the longest side of the narrow band.
BAND_RESOLUTION = 256


def scipy_counts(cloud: np.ndarray, radius: float) -> Asked:
    from scipy.spatial import cKDTree

    tree = cKDTree(cloud)
    return Asked(lambda: tree.query_ball_point(cloud, radius, workers=-1, return_length=True))


def open3d_counts(cloud: np.ndarray, radius: float) -> Asked:
    import open3d as o3d

    points = o3d.core.Tensor(cloud)
    search = o3d.core.nns.NearestNeighborSearch(points)
    search.fixed_radius_index(radius)
    return Asked(lambda: search.fixed_radius_search(points, radius), lambda found: np.diff(found[2].numpy()))


def neighbors(report: Report, setting: Setting) -> None:
    """Counts within a radius, about thirty each, in a uniform cloud."""
    cloud = np.random.default_rng(1).random((setting.queries, 3))
    radius = float((30 / (4.19 * setting.queries)) ** (1 / 3))
    grid = gk.points.NeighborGrid(cloud, radius, device="cpu")
    asked = [
        Peer("SciPy cKDTree", partial(scipy_counts, cloud, radius)),
        Peer("Open3D", partial(open3d_counts, cloud, radius)),
    ]
    report.case(Case("neighbor counts, 30 each", len(cloud), partial(grid.count, cloud), asked, 1.0))


def narrow_band(report: Report, setting: Setting) -> None:
    """A level set, half width 3; OpenVDB's is not exact, so no equality here."""
    mesh = inputs.bunny_of(setting.triangles)
    surface = gk.mesh.Surface(mesh, device="cpu")
    voxel = float((mesh.bounds[1] - mesh.bounds[0]).max()) / BAND_RESOLUTION
    task = f"narrow band {BAND_RESOLUTION}^3, {len(mesh.faces):,} triangles"
    if not native.available():
        report.row(Row(task, peer="OpenVDB", note="the extension is not built"))
        return
    active = gk.volume.from_mesh(surface, voxel).info.active_voxel_count or 0
    mine, theirs = paired(
        lambda: gk.volume.from_mesh(surface, voxel),
        lambda: native.mesh_to_level_set(mesh.vertices, mesh.faces, voxel_size=voxel, half_width=3.0),
    )
    shown = [f"{active / seconds / 1e6:.3f}" for seconds in (mine, theirs)]
    note = "OpenVDB's band is up to 0.5 voxel off"
    report.row(Row(task, shown[0], "OpenVDB meshToLevelSet", shown[1], theirs / mine, note=note))


TASKS = {"neighbors": neighbors, "band": narrow_band}
NAMES = ("mesh", *TASKS)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which to run: {', '.join(NAMES)}; default: all")
    parser.add_argument("--triangles", type=int, default=Setting().triangles)
    parser.add_argument("--queries", type=int, default=Setting().queries)
    parser.add_argument("--out", type=Path, default=None, help="also write the table there")
    options = parser.parse_args()
    unknown = set(options.names) - set(NAMES)
    if unknown:
        parser.error(f"no benchmark {sorted(unknown)}; there are {', '.join(NAMES)}")
    setting = Setting(options.triangles, options.queries)
    names = options.names or NAMES
    table = mesh_queries.begin(setting, options.out)
    if "mesh" in names:
        mesh_queries.run_tasks(table, mesh_queries.TASKS, setting)
    mesh_queries.run_tasks(table, {name: task for name, task in TASKS.items() if name in names}, setting)
    table.end()
    return 0


if __name__ == "__main__":
    sys.exit(main())
