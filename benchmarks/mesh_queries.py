"""Mesh queries side by side with every peer: ``python -m benchmarks.mesh_queries [--quick] [--tasks NAME ...]``.

Prints a table with ratios (above 1: geokit is faster) and whether they reach the required values, then notes and tables
of growth. ``measure`` describes how answers are compared and timed, ``peers`` the inputs of peers. Points and rays are
in random order; geokit's ordering of them is included in its time.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import inputs, peers
from benchmarks.growth import grow_queries, grow_triangles, powers
from benchmarks.measure import SAME, Bar, Case, Peer, Report, Row, Table, in_process, median_seconds, paired
from benchmarks.sign_check import UNDECIDED, as_wound
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher
from geokit.mesh import Surface, TriangleMesh

# libigl's signed_distance multiplies with 1 - 2w, and its fast w is off by hundredths; point-cloud-utils calls it too.
SAME_LIBIGL_FAST = 0.1
# Sine of the angle below which a ray counts as grazing: for grazing rays the lengths must differ as well.
LEAST_RISE = 1e-3
# Share of faces missing from the broken mesh.
BROKEN = 0.05
# Number of points checked by libigl's exact winding number, which sums all triangles for each.
JUDGED = 2000
# Points that show the gain of peers from ordered points.
ORDER_TRIAL = 50_000
# Queries of the large mesh: peers answer ten thousand per second.
LARGE_QUERIES = 50_000
# Triangles of the large mesh, and the time limit of its preparation [s].
LARGE, LARGE_SECONDS = 3_000_000, 3.0
SMALL_RUNS = 500
# Largest overhead of a small call [s].
OVERHEAD = 200e-6
# Required ratios.
CLOSEST = (Bar(4.0),)
WATERTIGHT = (Bar(1.0, ("Open3D",)),)
SIGNED = (Bar(4.0, ("Open3D",)), Bar(2.5, ("warp",)))
WINDING = (Bar(6.0, ("libigl",)),)
# Half the speed of Open3D's build.
BUILD = (Bar(0.5, ("Open3D",)),)


class Setting(NamedTuple):
    """Settings of the tasks.

    Attributes:
        triangles: Least number of triangles of the bunny.
        queries: Points or rays of a call.
        growth: Most triangles and most queries of the tables of growth.
    """

    triangles: int = 195_200
    queries: int = 200_000
    growth: int = 1_000_000


Task = Callable[[Report, Setting], None]


def prepared(triangles: int) -> tuple[TriangleMesh, Surface, str]:
    """The bunny, its surface on the CPU, and its name in tasks."""
    mesh = inputs.bunny_of(triangles)
    return mesh, Surface(mesh, device="cpu"), f"{len(mesh.faces):,} triangles"


def point_sets(mesh: TriangleMesh, count: int) -> dict[str, np.ndarray]:
    sets = {"uniform": inputs.uniform(mesh, count), "near": inputs.near(mesh, count)}
    return {name: inputs.in_float32(points) for name, points in sets.items()}


def ray_sets(mesh: TriangleMesh, count: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rays by name; the camera has as many as a 4:3 picture."""
    height = max(1, round((count * 3 / 4) ** 0.5))
    sets = {
        "random": inputs.random_rays(mesh, count),
        "camera": inputs.camera_rays(mesh, max(1, count // height), height),
        "between surface points": inputs.surface_rays(mesh, count),
    }
    return {name: (inputs.in_float32(o), inputs.in_float32(d)) for name, (o, d) in sets.items()}


# Tasks


def closest_point(report: Report, setting: Setting) -> None:
    mesh, surface, named = prepared(setting.triangles)
    for name, points in point_sets(mesh, setting.queries).items():
        report.case(closest_case(f"closest point, {name}, {named}", mesh, surface, points))
    note_order(report, mesh, min(setting.queries, ORDER_TRIAL))


def closest_case(task: str, mesh: TriangleMesh, surface: Surface, points: np.ndarray, few: bool = False) -> Case:
    """Comparison with all peers, or with the fastest few."""
    asked = [
        Peer("Open3D", partial(peers.open3d_distance, mesh, points)),
        Peer("fcpw", partial(peers.fcpw_distance, mesh, points)),
        Peer("warp", partial(peers.warp_distance, mesh, points)),
    ]
    if not few:
        asked.append(Peer("libigl", partial(peers.libigl_distance, mesh, points)))
        asked.append(Peer("point-cloud-utils", partial(peers.pcu_distance, mesh, points)))
    ours = partial(surface.closest_point, points)
    return Case(task, len(points), ours, asked, mesh.diagonal, bars=CLOSEST, read=lambda found: found.distance)


def note_order(report: Report, mesh: TriangleMesh, count: int) -> None:
    """The gain of peers from ordered points; the points of the table are unordered for all."""
    points = inputs.in_float32(inputs.uniform(mesh, count))
    ordered = inputs.in_morton_order(points)
    gains = []
    for name, make in (("Open3D", peers.open3d_distance), ("fcpw", peers.fcpw_distance), ("warp", peers.warp_distance)):
        try:
            random, sorted_ = paired(make(mesh, points).run, make(mesh, ordered).run)
        except Exception as error:
            gains.append(f"{name} ({type(error).__name__})")
        else:
            gains.append(f"{name} {random / sorted_:.2f}")
    report.line(
        f"Given the {count:,} uniform points in Morton order, which geokit makes within its own time, peers would be "
        f"quicker by these factors: {', '.join(gains)}."
    )


def first_hit(report: Report, setting: Setting) -> None:
    mesh, surface, named = prepared(setting.triangles)
    for name, rays in ray_sets(mesh, setting.queries).items():
        report.case(hit_case(f"first hit, {name}, {named}", mesh, surface, rays))


def hit_case(
    task: str,
    mesh: TriangleMesh,
    surface: Surface,
    rays: tuple[np.ndarray, np.ndarray],
    few: bool = False,
) -> Case:
    """First hits against all peers, or the fastest few."""
    asked = [
        Peer("Open3D (Embree, robust)", partial(peers.open3d_first_hit, mesh, *rays)),
        Peer("embreex, robust", partial(peers.embreex_first_hit, mesh, *rays, True)),
        Peer("embreex, not robust", partial(peers.embreex_first_hit, mesh, *rays, False)),
        Peer("warp (leaky)", partial(peers.warp_first_hit, mesh, *rays)),
    ]
    if not few:
        asked.append(Peer("fcpw", partial(peers.fcpw_first_hit, mesh, *rays)))
        asked.append(Peer("point-cloud-utils", partial(peers.pcu_first_hit, mesh, *rays)))
    return Case(
        task,
        len(rays[0]),
        partial(surface.raycast, *rays),
        asked,
        mesh.diagonal,
        kind="hit",
        bars=WATERTIGHT,
        read=lambda found: found.t,
        units=height_over_hit(mesh, surface, *rays),
        same=SAME,
    )


def height_over_hit(mesh: TriangleMesh, surface: Surface, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Rise of each ray over the plane of the triangle that it hits, for a t of 1.

    A point that is right in float32 up to its last digits is that far from the plane; along a grazing ray it may be off
    by thousands of times that.
    """
    corners = mesh.vertices[mesh.faces[surface.raycast(origins, directions).triangle_id]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    lengths = np.linalg.norm(directions, axis=1)
    return np.maximum(np.abs(np.einsum("nd,nd->n", normals, directions)), LEAST_RISE * lengths)


def occluded(report: Report, setting: Setting) -> None:
    mesh, surface, named = prepared(setting.triangles)
    for name, rays in ray_sets(mesh, setting.queries).items():
        asked = [
            Peer("Open3D (Embree, robust)", partial(peers.open3d_occluded, mesh, *rays)),
            Peer("embreex, robust", partial(peers.embreex_occluded, mesh, *rays, True)),
            Peer("embreex, not robust", partial(peers.embreex_occluded, mesh, *rays, False)),
            Peer("warp (leaky)", partial(peers.warp_occluded, mesh, *rays)),
        ]
        ours = partial(surface.occluded, *rays)
        report.case(Case(f"occluded, {name}, {named}", len(rays[0]), ours, asked, 1.0, kind="hit"))


def signed_distance(report: Report, setting: Setting) -> None:
    mesh, surface, named = prepared(setting.triangles)
    for name, points in point_sets(mesh, setting.queries).items():
        asked = [
            Peer("Open3D", partial(peers.open3d_signed, mesh, points)),
            *(Peer(f"warp, {m}", partial(peers.warp_signed, mesh, points, m)) for m in ("normal", "parity", "winding")),
            *libigl_signed(mesh, points, calls=name == "near"),
        ]
        if name == "near":  # a minute each where distances are far, and the last of all
            asked.append(Peer("libigl, pseudonormal", partial(peers.libigl_signed_call, mesh, points, "PSEUDONORMAL")))
            asked.append(Peer("point-cloud-utils", partial(peers.pcu_signed, mesh, points), SAME_LIBIGL_FAST))
        report.case(signed_case(f"signed distance, {name}, {named}", mesh, surface, points, "auto", asked, SIGNED))
    report.line(f"Signed distances on the bunny: sign='auto' is {surface.sign_method} ({surface.sign_reason}).")


def signed_case(
    task: str,
    mesh: TriangleMesh,
    surface: Surface,
    points: np.ndarray,
    sign: str,
    asked: list[Peer],
    bars: tuple[Bar, ...],
) -> Case:
    ours = partial(surface.signed_distance, points, sign=sign)
    read = lambda found: found.distance  # noqa: E731
    return Case(task, len(points), ours, asked, mesh.diagonal, kind="signed", bars=bars, read=read)


def libigl_signed(mesh: TriangleMesh, points: np.ndarray, calls: bool) -> list[Peer]:
    """Peers with fast winding numbers: from prebuilt trees and, if ``calls``, also building trees per call, always
    slower."""
    asked = [Peer("libigl, fast winding, trees prebuilt", partial(peers.libigl_signed, mesh, points))]
    if calls:
        call = partial(peers.libigl_signed_call, mesh, points, "FAST_WINDING_NUMBER")
        asked.append(Peer("libigl, fast winding, signed_distance", call, SAME_LIBIGL_FAST))
    return asked


def broken(report: Report, setting: Setting) -> None:
    """Signs by winding numbers where a share of the faces is missing."""
    mesh = inputs.without_faces(inputs.bunny_of(setting.triangles), BROKEN)
    surface = Surface(mesh, device="cpu")
    for name, points in point_sets(mesh, setting.queries).items():
        task = f"signed distance by winding, {name}, {BROKEN:.0%} of faces missing, {len(mesh.faces):,} triangles"
        asked = libigl_signed(mesh, points, calls=name == "near")
        report.case(signed_case(task, mesh, surface, points, "winding", asked, WINDING))
        report.line(judged_signs(name, mesh, surface, points[:JUDGED]))


def judged_signs(name: str, mesh: TriangleMesh, surface: Surface, points: np.ndarray) -> str:
    """Shares of right signs of geokit and libigl, by the exact sum over all triangles."""
    try:
        exact = peers.libigl_exact_winding(as_wound(surface), points)
        theirs = peers.libigl_signed(mesh, points)
    except ImportError as error:
        return f"Signs on the broken mesh are not judged: {error.name} is not installed."
    decided = np.abs(exact - 0.5) > UNDECIDED
    inside = (exact > 0.5)[decided]
    ours = np.signbit(surface.signed_distance(points, sign="winding").distance)[decided]
    libigl = np.signbit(theirs.read(theirs.run()))[decided]
    return (
        f"Signs of {decided.sum():,} {name} points of the broken mesh that the exact winding number decides: geokit "
        f"{(ours == inside).mean():.4%} right, libigl's fast winding number {(libigl == inside).mean():.4%}."
    )


def preparation(report: Report, setting: Setting) -> None:
    """Each build with one query, because some peers build at the first query."""
    mesh = inputs.bunny_of(setting.triangles)
    task = f"preparation and 1 point, {len(mesh.faces):,} triangles"
    build_case(report, task, mesh, signs=False, bars=BUILD)
    build_case(report, f"{task}, signs", mesh, signs=True)


def build_case(
    report: Report, task: str, mesh: TriangleMesh, signs: bool, bars: tuple[Bar, ...] = (), few: bool = False
) -> None:
    point = inputs.in_float32(inputs.uniform(mesh, 1))

    def ours() -> Any:
        surface = Surface(mesh, device="cpu")
        return surface.signed_distance(point) if signs else surface.closest_point(point)

    asked = [
        Peer("Open3D", partial(peers.open3d_build, mesh, point, signs)),
        Peer("warp, winding" if signs else "warp", partial(peers.warp_build, mesh, point, signs)),
    ]
    if not few:
        asked.append(Peer("libigl", partial(peers.libigl_build, mesh, point, signs)))
    if not signs:
        asked.append(Peer("trueform", partial(peers.trueform_build, mesh, point)))
    if not few and not signs:
        asked.append(Peer("fcpw", partial(peers.fcpw_build, mesh, point)))
    read = lambda found: found.distance  # noqa: E731
    kind = "signed" if signs else "distance"
    report.case(Case(task, len(mesh.faces), ours, asked, mesh.diagonal, kind=kind, bars=bars, read=read))


def large(report: Report, setting: Setting) -> None:
    """The mesh of 3.1 million triangles: preparation, closest points and first hits."""
    mesh, surface, named = prepared(LARGE)
    count = min(setting.queries, LARGE_QUERIES)
    point = mesh.vertices[:1]
    seconds = median_seconds(lambda: Surface(mesh, device="cpu").closest_point(point), runs=3)
    rate, met = f"{len(mesh.faces) / seconds / 1e6:.3f}", "met" if seconds < LARGE_SECONDS else "NOT met"
    report.row(
        Row(f"preparation, {named}", rate, bar=f"{LARGE_SECONDS:g} s", met=met, note=f"{seconds:.2f} s with 1 point")
    )
    build_case(report, f"preparation and 1 point, {named}", mesh, signs=False, few=True)
    for name, points in point_sets(mesh, count).items():
        report.case(closest_case(f"closest point, {name}, {named}", mesh, surface, points, few=True))
    for name, rays in ray_sets(mesh, setting.queries).items():
        report.case(hit_case(f"first hit, {name}, {named}", mesh, surface, rays, few=True))


def small_calls(report: Report, setting: Setting) -> None:
    """Overhead of a call: the whole time for one query, and the extra time of two calls with half the queries each."""
    mesh, surface, _ = prepared(setting.triangles)
    points = inputs.in_float32(inputs.uniform(mesh, 100))
    origins, directions = (inputs.in_float32(a) for a in inputs.random_rays(mesh, 100))
    calls = {
        "closest point": lambda some: surface.closest_point(points[some]),
        "signed distance": lambda some: surface.signed_distance(points[some]),
        "first hit": lambda some: surface.raycast(origins[some], directions[some]),
    }
    for name, call in calls.items():
        one = median_seconds(partial(call, slice(1)), SMALL_RUNS, pause=0.0)
        two, hundred = paired(partial(in_halves, call), partial(call, slice(100)), small=True)
        for count, seconds, over in ((1, one, one), (100, hundred, max(0.0, two - hundred))):
            met = "met" if over < OVERHEAD else "NOT met"
            note = f"{seconds * 1e6:.1f} us a call, {over * 1e6:.1f} us of it besides the queries"
            report.row(Row(f"small call, {name}, {count}", bar=f"{OVERHEAD * 1e6:g} us", met=met, note=note))
    for count in (1, 100):
        rays, task = (origins[:count], directions[:count]), f"small call, {{}}, {count}, time of a call"
        for case in (
            closest_case(task.format("closest point"), mesh, surface, points[:count], few=True),
            hit_case(task.format("first hit"), mesh, surface, rays, few=True),
        ):
            asked = [peer for peer in case.peers if peer.name.startswith(("Open3D", "warp"))]
            report.case(replace(case, peers=asked, bars=(), small=True))


def in_halves(call: Callable[[slice], Any]) -> None:
    call(slice(50))
    call(slice(50, 100))


def growth(report: Report, setting: Setting) -> None:
    """Tables of geokit alone, without rows."""
    grow_triangles(report, setting.queries, powers(1_000, setting.growth))
    report.line("")
    _, surface, named = prepared(setting.triangles)
    grow_queries(report, surface, named, powers(100, setting.growth))


TASKS: dict[str, Task] = {
    "closest": closest_point,
    "hit": first_hit,
    "occluded": occluded,
    "signed": signed_distance,
    "broken": broken,
    "preparation": preparation,
    "small": small_calls,
    "large": large,
    "growth": growth,
}
# Tasks left out by --quick.
LENGTHY = ("large",)
QUICK = Setting(triangles=48_800, queries=20_000, growth=100_000)


def begin(setting: Setting, out: Path | None) -> Table:
    """A table with a description of the machine."""
    # Peers get as many threads as geokit.
    os.environ.setdefault("OMP_NUM_THREADS", str(launcher.thread_count()))
    table = Table(path=out)
    table.add(
        f"{processor_name()}, {launcher.thread_count()} threads; "
        f"{setting.queries:,} queries a call; medians of pairs.\n"
    )
    table.begin()
    return table


def run_tasks(table: Table, tasks: dict[str, Task], setting: Setting) -> None:
    """Run each task in a process of its own: a peer that crashes costs one row."""
    for name, task in tasks.items():
        in_process(table, name, task, setting)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, metavar="NAME", help=f"of {', '.join(TASKS)}; default all")
    parser.add_argument("--triangles", type=int, help="least number of triangles of the bunny")
    parser.add_argument("--queries", type=int, help="points or rays of a call")
    parser.add_argument("--growth", type=int, help="most triangles and queries of the growth tables, such as 10000000")
    parser.add_argument("--quick", action="store_true", help="fewer of all, without the large mesh: a look, no result")
    parser.add_argument("--out", type=Path, help="also write the report there")
    options = parser.parse_args()
    given = {name: getattr(options, name) for name in Setting._fields if getattr(options, name) is not None}
    setting = (QUICK if options.quick else Setting())._replace(**given)
    names = options.tasks or [name for name in TASKS if not (options.quick and name in LENGTHY)]
    table = begin(setting, options.out)
    run_tasks(table, {name: TASKS[name] for name in names}, setting)
    table.end()
    return 0


if __name__ == "__main__":
    sys.exit(main())
