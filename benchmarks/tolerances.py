"""Distance fields that keep a tolerance: requested against achieved, and their memory against an exhaustive search's.

python -m benchmarks.tolerances [--share 4e-3] [NAME ...]

The judge asks at points of its own seed, 50,000 of them, with distances by geokit's float64 closest points (which
tests/property hold against brute force); the search tries every order and codec at voxel sizes 2^(1/4) apart, makes
each grid, and takes the smallest that keeps the tolerance at the judge's points.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from geokit.volume._from_mesh_tolerance import make_setting, tolerance_search
from geokit.volume._tolerance_search import CODECS, ORDERS, Setting, options_of

JUDGED = 50_000
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
    """Those of tests/property/test_from_mesh_tolerance.py, the samples, and the bunny that warp brings."""
    import warp as wp

    from tests.property.test_from_mesh_tolerance import MESHES

    samples = Path(__file__).parents[1] / "data" / "samples"
    files = {name: samples / name for name in ("bracket.obj", "torus.ply", "shell.stl")}
    files["bunny.usd"] = Path(wp.__file__).parent / "examples" / "assets" / "bunny.usd"
    return {**MESHES, **{name: gk.mesh.load(path) for name, path in files.items()}}


def judged(mesh: gk.mesh.TriangleMesh, surface: gk.mesh.Surface, within: float) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(77)
    directions = random.normal(size=(JUDGED, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    away = within * random.uniform(size=(JUDGED, 1)) * 0.999
    points = gk.mesh.sample_surface(mesh, JUDGED, seed=77).points + away * directions
    return points, np.asarray(surface.signed_distance(points).distance)


def exhaustive(surface: gk.mesh.Surface, tolerance: float, points: np.ndarray, exact: np.ndarray) -> tuple[float, str]:
    """Fewest bytes of all settings that keep the tolerance at the points, and which setting that is."""
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
            field = make_setting(search, setting, "auto", surface.sign_method, None)
            if field.info.byte_count >= best:
                continue
            error = float(np.abs(field.sample(points, order=option.order, device="cpu") - exact).max())
            if error <= tolerance:
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
        points, exact = judged(mesh, surface, float(info.metadata["geokit:checked_within"]))
        error = float(np.abs(field.sample(points, device="cpu") - exact).max())
        least, what = exhaustive(surface, tolerance, points, exact)
        chosen = f"order {info.order}, {info.grid_type}, {info.voxel_size[0]:.3g}"
        cells = (
            f"{name} | {tolerance:.3g} | {info.achieved_error / tolerance:.3f} | {error / tolerance:.3f} | {chosen} | "
            f"{info.byte_count / 1024:.0f} | {what}: {least / 1024:.0f} | {info.byte_count / least:.2f} | {seconds:.1f}"
        )
        print(f"| {cells} |", flush=True)


if __name__ == "__main__":
    main()
