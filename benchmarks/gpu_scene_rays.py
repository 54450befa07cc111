"""Rays on scenes by kind, on a GPU beside raw warp: ``python -m benchmarks.gpu_scene_rays [--rays N] [--scenes NAME]``.

First hits and any hits of camera rays, bounces and random rays, from arrays on the device. Raw warp is one launch over
float32 arrays and the faster of two of its trees; geokit takes and gives float64.
"""

from __future__ import annotations

import argparse

import numpy as np
import warp as wp

from benchmarks import scenes
from benchmarks.gpu_timing import device_median
from benchmarks.raw_kernels import raw_any_hit_kernel, raw_ray_kernel
from geokit.core import launcher
from geokit.mesh import Surface

RUNS = 7
TREES = ("sah", "cubql")


def rows_of(name: str, count: int, device: str) -> list[tuple[str, float, float, int]]:
    """What was asked, seconds of geokit and of raw warp, and the number of rays whose answers differ."""
    scene = scenes.SCENES[name]()
    surface, rows = Surface(scene.mesh, device=device), []
    points = wp.array(scene.mesh.vertices, dtype=wp.vec3, device=device)
    faces = wp.array(scene.mesh.faces.reshape(-1), dtype=wp.int32, device=device)
    trees = [wp.Mesh(points=points, indices=faces, bvh_constructor=kind, bvh_leaf_size=1) for kind in TREES]
    for kind, rays in scenes.ray_sets(scene, Surface(scene.mesh, device="cpu"), count).items():
        wide = [wp.array(a, dtype=wp.vec3d, device=device) for a in rays]
        narrow = [wp.array(a, dtype=wp.vec3, device=device) for a in rays]
        t, hit = (wp.empty(len(rays[0]), dtype=kind, device=device) for kind in (wp.float32, wp.bool))
        ours = [lambda wide=wide: surface.raycast(*wide), lambda wide=wide: surface.occluded(*wide)]
        for query, kernel, out, ask in zip(
            ("first hit", "any hit"), (raw_ray_kernel, raw_any_hit_kernel), (t, hit), ours, strict=True
        ):
            raw = [
                device_median(
                    lambda k=kernel, m=tree, r=narrow, o=out: wp.launch(k, len(o), [m.id, *r], [o], device=device), RUNS
                )
                for tree in trees
            ]
            answer = ask()
            found = answer.numpy() if query == "any hit" else np.isfinite(answer.t.numpy())
            differ = int(np.count_nonzero(found != (out.numpy() if query == "any hit" else np.isfinite(out.numpy()))))
            rows.append((f"{name}, {kind}, {query}", device_median(ask, RUNS), min(raw), differ))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rays", type=int, default=4_000_000)
    parser.add_argument("--scenes", nargs="+", choices=list(scenes.SCENES), default=list(scenes.SCENES))
    options = parser.parse_args()
    device = launcher.cuda_devices()[0]
    print(f"{wp.get_device(device).name}, warp {wp.__version__}, {options.rays:,} rays, ms by the device's clock")
    print(f"{'':32} {'geokit':>8} {'raw warp':>8} {'ratio':>6} {'differ':>7}")
    for name in options.scenes:
        for what, ours, raw, differ in rows_of(name, options.rays, device):
            print(f"{what:32} {1e3 * ours:8.2f} {1e3 * raw:8.2f} {raw / ours:6.2f} {differ:7}", flush=True)


if __name__ == "__main__":
    main()
