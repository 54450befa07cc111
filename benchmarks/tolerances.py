"""Distance fields that keep a tolerance: requested against achieved, and their memory against an exhaustive search's.

python -m benchmarks.tolerances [--share 4e-3] [NAME ...]

Errors are measured at points with a seed of their own, 50,000 of them and 20,000 more around the worst, against
distances by geokit's float64 closest points (which tests/property compare with brute force). The search tries every
order and codec at voxel sizes 2^(1/4) apart, makes each grid, and takes the smallest that keeps the tolerance by the
same measure.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from benchmarks.catalog.tolerance_meshes import MESHES, points_near
from geokit.volume.tolerance.from_mesh import make_setting, tolerance_search
from geokit.volume.tolerance.search import CODECS, ORDERS, Setting, options_of

# Random points in the zone; then the number of worst points, and how often each is displaced by up to a share of a
# voxel.
JUDGED, WORST, MOVES, SHARES = 50_000, 500, 20, (0.4, 0.1)
# Voxel sizes of the exhaustive search are this far apart; memory goes with the square.
STEP = 2.0**-0.25
ASKED: dict[str, Any] = {
    "within": None,
    "order": None,
    "half_width": None,
    "sign": "auto",
    "thickness": None,
    "codec": None,
}


def meshes() -> dict[str, gk.mesh.TriangleMesh]:
    """The meshes of the catalog, the samples, and the bunny from warp's wheel."""
    import warp as wp

    samples = Path(__file__).parents[1] / "data" / "samples"
    files = {name: samples / name for name in ("bracket.obj", "torus.ply", "shell.stl")}
    files["bunny.usd"] = Path(wp.__file__).parent / "examples" / "assets" / "bunny.usd"
    return {**MESHES, **{name: gk.mesh.load(path) for name, path in files.items()}}


class Judge:
    """Largest errors of fields, at points common to all fields and around the worst of them.

    Args:
        mesh: The mesh of the fields.
        surface: Its exact distances.
        within: Distance from the surface up to which the tolerance applies [world].
    """

    def __init__(self, mesh: gk.mesh.TriangleMesh, surface: gk.mesh.Surface, within: float) -> None:
        self.surface, self.within = surface, within
        self.points = points_near(mesh, within, JUDGED, seed=77)
        self.exact = np.asarray(surface.signed_distance(self.points).distance)

    def largest(self, field: gk.volume.SparseVolume, order: int, enough: float = math.inf) -> float:
        """The largest error; the search stops at any error above ``enough``."""
        random = np.random.default_rng(78)
        points, exact = self.points, self.exact
        errors = np.abs(field.sample(points, order=order, device="cpu") - exact)
        found = float(errors.max())
        for share in SHARES:
            if found > enough:
                break
            worst = np.repeat(points[np.argsort(errors)[-WORST:]], MOVES, axis=0)
            moved = worst + share * field.info.voxel_size[0] * random.uniform(-1.0, 1.0, worst.shape)
            distance = np.asarray(self.surface.signed_distance(moved).distance)
            kept = np.abs(distance) <= self.within
            points, exact = moved[kept], distance[kept]
            errors = np.abs(field.sample(points, order=order, device="cpu") - exact)
            found = max(found, float(errors.max(initial=0.0)))
        return found


def exhaustive(surface: gk.mesh.Surface, tolerance: float, judge: Judge) -> tuple[float, str]:
    """Fewest bytes of all settings that keep the tolerance by the measured error, and the setting."""
    search = tolerance_search(surface, tolerance, **ASKED, device="cpu")
    options = options_of(ORDERS, CODECS)
    best, what = math.inf, "-"
    size = search.zone.longest / 4.0
    while True:
        sure = False
        for option in options:
            width = search.width_of(option, size)
            counts = search.memory.counts(size, width * size)
            least = counts.bytes_of(option.codec, 1.0)
            sure |= least < best
            if least >= best:
                continue
            setting = Setting(option, size, width, 0.0, counts, 0.0)
            field = make_setting(search, setting)
            if field.info.byte_count >= best:
                continue
            if judge.largest(field, option.order, tolerance) <= tolerance:
                best, what = field.info.byte_count, f"order {option.order}, {option.codec}, {size:.3g}"
        if not sure:
            return best, what
        size *= STEP


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--share", type=float, default=4e-3, help="the tolerance as a share of the diagonal")
    arguments = parser.parse_args()
    every = meshes()
    print("| mesh | requested | achieved | judge | chosen | KiB | least that a search finds | ratio | s |")
    print("|---|---:|---:|---:|---|---:|---|---:|---:|")
    for name in arguments.names or every:
        mesh = every[name]
        tolerance = arguments.share * float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
        surface = gk.mesh.Surface(mesh, device="cpu")
        start = time.perf_counter()
        field = gk.volume.from_mesh(surface, tolerance=tolerance)
        seconds = time.perf_counter() - start
        info = field.info
        judge = Judge(mesh, surface, float(info.metadata["geokit:checked_within"]))
        error = judge.largest(field, info.order)
        least, what = exhaustive(surface, tolerance, judge)
        chosen = f"order {info.order}, {info.grid_type}, {info.voxel_size[0]:.3g}"
        cells = (
            f"{name} | {tolerance:.3g} | {info.achieved_error / tolerance:.3f} | {error / tolerance:.3f} | {chosen} | "
            f"{info.byte_count / 1024:.0f} | {what}: {least / 1024:.0f} | {info.byte_count / least:.2f} | {seconds:.1f}"
        )
        print(f"| {cells} |", flush=True)


if __name__ == "__main__":
    main()
