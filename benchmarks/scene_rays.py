"""Rays on scenes by kind: ``python -m benchmarks.scene_rays [--scenes NAME ...] [--triangles N] [--rays N]``.

First hits and any hits of camera rays, bounces and random rays beside Open3D and embreex (both Embree, robust), and the
build with one point beside Open3D's, warp's and trueform's.
"""

from __future__ import annotations

import argparse
import os
import sys
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from benchmarks import peers, scenes
from benchmarks.measure import SAME, Bar, Case, Peer, Report, Table, in_process
from benchmarks.mesh_queries import build_case, height_over_hit
from geokit.accuracy.trials.machine import processor_name
from geokit.core import launcher
from geokit.mesh import Surface

PEERS = ("open3d", "embreex", "trueform")
EMBREE = (Bar(1.2, ("Open3D", "embreex")),)
BUILD = (Bar(0.5, ("Open3D",)),)
# Float32 decides otherwise which of two surfaces is hit where a scene's are as near to each other as its rounding.
SAME_IN_SCENES = 10 * SAME


def rays_of(report: Report, name: str, triangles: int | None, count: int) -> None:
    scene = scenes.SCENES[name](*([triangles] if triangles else []))
    mesh, surface = scene.mesh, Surface(scene.mesh, device="cpu")
    named = f"{name}, {len(mesh.faces):,} triangles"
    for kind, rays in scenes.ray_sets(scene, surface, count).items():
        first = [
            Peer("Open3D (Embree, robust)", partial(peers.open3d_first_hit, mesh, *rays)),
            Peer("embreex, robust", partial(peers.embreex_first_hit, mesh, *rays, True)),
        ]
        any_hit = [
            Peer("Open3D (Embree, robust)", partial(peers.open3d_occluded, mesh, *rays)),
            Peer("embreex, robust", partial(peers.embreex_occluded, mesh, *rays, True)),
        ]
        report.case(
            Case(
                f"first hit, {kind}, {named}",
                len(rays[0]),
                partial(surface.raycast, *rays),
                first,
                mesh.diagonal,
                kind="hit",
                bars=EMBREE,
                read=lambda found: found.t,
                units=height_over_hit(mesh, surface, *rays),
                same=SAME_IN_SCENES,
            )
        )
        ours = partial(surface.occluded, *rays)
        task = f"any hit, {kind}, {named}"
        report.case(Case(task, len(rays[0]), ours, any_hit, 1.0, kind="hit", bars=EMBREE))
    build_case(report, f"preparation and 1 point, {named}", mesh, signs=False, bars=BUILD, few=True)


def versions() -> str:
    found = []
    for name in PEERS:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} is not installed")
    return ", ".join(found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=scenes.SCENES, default=list(scenes.SCENES), metavar="NAME")
    parser.add_argument("--triangles", type=int, help="about this many instead of a scene's own number")
    parser.add_argument("--rays", type=int, default=400_000)
    parser.add_argument("--out", type=Path, help="also write the report there")
    options = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", str(launcher.thread_count()))
    table = Table(path=options.out)
    table.add(f"{processor_name()}, {launcher.thread_count()} threads; {options.rays:,} rays a call; {versions()}.\n")
    table.begin()
    for name in options.scenes:
        in_process(table, name, rays_of, name, options.triangles, options.rays)
    table.end()
    return 0


if __name__ == "__main__":
    sys.exit(main())
