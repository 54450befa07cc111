"""How long the first call of each public query takes where no kernel is in the cache, and how long the second."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

COLUMNS = ("call", "first [s]", "CPU time [s]", "second [ms]", "compiled")
SECONDS = 600.0

# What a query is asked of, by the names that it uses. Only what it names is made, and is part of its first call.
INPUTS = {
    "surface": "gk.mesh.Surface(mesh, device=device)",
    "field": "gk.volume.load(folder / 'field.nvdb')",
    "moved": "gk.volume.load(folder / 'moved.nvdb')",
    "fog": "gk.volume.load(folder / 'fog.nvdb')",
    "vectors": "gk.volume.load(folder / 'vectors.nvdb')",
    "small": "gk.mesh.TriangleMesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])",
    "both": "gk.mesh.Surfaces([mesh, other], device=device)",
    "adaptive": "gk.volume.load_adaptive(folder / 'adaptive.nvdb')",
    "grid": "gk.points.NeighborGrid(cloud, 0.1, device=device)",
    "cell": "gk.points.NeighborGrid(cloud + 2.0, 0.1, periodic=[4.0, 4.0, 4.0], device=device)",
}
_ON = "device=device"
QUERIES = {
    "mesh.audit": "gk.mesh.audit(mesh)",
    "mesh.orient": "gk.mesh.orient(mesh)",
    "Surface.closest_point": "surface.closest_point(points)",
    "Surface.furthest_point": "surface.furthest_point(points)",
    "Surface.signed_distance": "surface.signed_distance(points)",
    "Surface.contains": "surface.contains(points)",
    "Surface.winding_number": "surface.winding_number(points)",
    "Surface.raycast": "surface.raycast(points, rays)",
    "Surface.raycast_all": "surface.raycast_all(points, rays)",
    "Surface.occluded": "surface.occluded(points, rays)",
    "Surface.crossing_count": "surface.crossing_count(points, rays)",
    "Surface.overlapping": "surface.overlapping(points, points + 0.1)",
    "Surface.self_intersections": "surface.self_intersections()",
    "Surface.distance": "surface.distance(gk.mesh.Surface(other, device=device))",
    "Surfaces.closest_point": "both.closest_point(points, [0, 500, 1000])",
    "Surfaces.signed_distance": "both.signed_distance(points, [0, 500, 1000])",
    "Surfaces.raycast": "both.raycast(points, rays, [0, 500, 1000])",
    "mesh.sample_attributes": f"gk.mesh.sample_attributes(mesh, {{'distance': field}}, {_ON})",
    "mesh.union": "gk.mesh.union(mesh, other)",
    "mesh.hausdorff": f"gk.mesh.hausdorff(mesh, other, {_ON})",
    "mesh.simplify": f"gk.mesh.simplify(small, tolerance=0.1, {_ON})",
    "mesh.sample_surface": "gk.mesh.sample_surface(mesh, 1000)",
    "mesh.sample_surface, Poisson disk": "gk.mesh.sample_surface(mesh, 1000, method='poisson_disk')",
    "mesh.from_volume": f"gk.mesh.from_volume(field, {_ON})",
    "mesh.from_volume, dual contouring": f"gk.mesh.from_volume(field, method='dual_contouring', {_ON})",
    "volume.from_mesh": f"gk.volume.from_mesh(mesh, 0.05, {_ON})",
    "volume.from_mesh, tolerance": f"gk.volume.from_mesh(small, tolerance=0.4, {_ON})",
    "volume.adaptive_from_mesh": f"gk.volume.adaptive_from_mesh(small, 0.4, {_ON})",
    "volume.from_points": f"gk.volume.from_points(cloud, radius=0.05, voxel_size=0.02, {_ON})",
    "volume.plan": f"gk.volume.plan(small, 0.4, {_ON})",
    "volume.sample, order 0": f"field.sample(points, order=0, {_ON})",
    "volume.sample, order 1": f"field.sample(points, order=1, {_ON})",
    "volume.sample, order 2": f"field.sample(points, order=2, {_ON})",
    "volume.sample, order 3": f"field.sample(points, order=3, {_ON})",
    "volume.gradient": f"field.gradient(points, {_ON})",
    "volume.hessian": f"field.hessian(points, {_ON})",
    "volume.curvature": f"field.curvature(points, {_ON})",
    "volume.active_at": f"field.active_at(points, {_ON})",
    "AdaptiveSDF.sample": f"adaptive.sample(points, {_ON})",
    "volume.raycast": f"field.raycast(points, rays, {_ON})",
    "volume.integrate": f"fog.integrate(points, rays, {_ON})",
    "volume.statistics": "gk.volume.statistics(field)",
    "volume.union": "gk.volume.union(field, moved)",
    "volume.offset": f"gk.volume.offset(field, 0.05, {_ON})",
    "volume.renormalize": f"gk.volume.renormalize(field, {_ON})",
    "volume.resample": f"gk.volume.resample(fog, voxel_size=0.2, {_ON})",
    "volume.divergence": f"gk.volume.divergence(vectors, {_ON})",
    "volume.connected_components": "gk.volume.connected_components(field)",
    "volume.to_dense": f"gk.volume.to_dense(field, {_ON})",
    "NeighborGrid.count": "grid.count(points)",
    "NeighborGrid.radius_search": "grid.radius_search(points)",
    "NeighborGrid.knn": "grid.knn(points, k=8)",
    "NeighborGrid.hybrid": "grid.hybrid(points, k=8, radius=0.1)",
    "NeighborGrid.pairs": "grid.pairs()",
    "NeighborGrid.neighbor_list": "cell.neighbor_list()",
    "points.normals": f"gk.points.normals(cloud, {_ON})",
    "points.density": f"gk.points.density(cloud, radius=0.1, {_ON})",
    "points.outliers": f"gk.points.outliers(cloud, {_ON})",
    "points.cluster": f"gk.points.cluster(cloud, radius=0.1, {_ON})",
    "points.downsample": f"gk.points.downsample(cloud, voxel_size=0.1, {_ON})",
    "points.register": f"gk.points.register(cloud, mesh, {_ON})",
    "points.chamfer": f"gk.points.chamfer(cloud, points, {_ON})",
    "points.hausdorff": f"gk.points.hausdorff(cloud, points, {_ON})",
}

_START = """
import sys, time
from pathlib import Path
import numpy as np
import geokit as gk
device, folder = sys.argv[1] or None, Path(sys.argv[2])
u, v = np.meshgrid(np.arange(64) * (np.pi / 32), np.arange(32) * (np.pi / 16), indexing="ij")
ring = 1.0 + 0.4 * np.cos(v)
torus = np.stack([ring * np.cos(u), ring * np.sin(u), 0.4 * np.sin(v)], -1).reshape(-1, 3)
i, j = np.meshgrid(np.arange(64), np.arange(32), indexing="ij")
a, b, c, d = (((i + s) % 64 * 32 + (j + t) % 32).ravel() for s, t in ((0, 0), (1, 0), (1, 1), (0, 1)))
faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
mesh, other = gk.mesh.TriangleMesh(torus, faces), gk.mesh.TriangleMesh(torus * 0.99, faces)
random = np.random.default_rng(0)
points = random.random((1000, 3)) * 2.0 - 1.0
rays = random.normal(size=(1000, 3))
cloud = torus + random.normal(size=torus.shape) * 0.01
"""
_PREPARE = """
gk.volume.save(folder / "field.nvdb", gk.volume.from_mesh(mesh, 0.05, device=device))
gk.volume.save(folder / "moved.nvdb", gk.volume.from_mesh(other, 0.05, device=device))
gk.volume.adaptive_from_mesh(mesh, 0.05, device=device).save(folder / "adaptive.nvdb")
fog = gk.volume.from_dense(random.random((32, 32, 32)), voxel_size=0.1, grid_class="fog volume")
gk.volume.save(folder / "fog.nvdb", fog)
gk.volume.save(folder / "vectors.nvdb", gk.volume.gradient_field(fog, device=device))
"""
_ASK = """
import json
from geokit.core.running.answers import take_stdout
answers = take_stdout()
from geokit.core import launcher
compiled = []
launcher.on_compile(compiled.append)
started, worked = time.perf_counter(), time.process_time()
try:
{inputs}
    {call}
except gk.errors.MissingDependencyError as error:
    sys.exit(print(json.dumps(str(error)), file=answers))
first, work = time.perf_counter() - started, time.process_time() - worked
started = time.perf_counter()
{call}
print(json.dumps([first, work, time.perf_counter() - started, len(compiled)]), file=answers)
"""


def measure_latency(device: str | None, report: Callable[[str], None]) -> list[dict[str, Any]]:
    """Call each query twice in a process of its own with an empty kernel cache.

    Args:
        device: Alias of the device to ask on, or None for the default one.
        report: Called with a line for each query.
    Returns:
        A row for each query, by COLUMNS: the first call with what its inputs need and the start of warp, without the
        import of NumPy and geokit; the time of processors in it, which other programs prolong less; the second call;
        and how many kernel modules were compiled. Queries that need a package that is not installed have no row.
    """
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        _run(_START + _PREPARE, device, folder, {})
        for name, call in QUERIES.items():
            lines = [f"    {key} = {made}" for key, made in INPUTS.items() if re.search(rf"\b{key}\b", call)]
            with tempfile.TemporaryDirectory(dir=folder) as cache:
                script = _START + _ASK.format(inputs="\n".join(lines), call=call)
                answer = json.loads(_run(script, device, folder, {"WARP_CACHE_PATH": cache}))
            if isinstance(answer, str):
                report(f"{name}: {answer}")
                continue
            first, work, second, count = answer
            rows.append(
                dict(zip(COLUMNS, (name, round(first, 2), round(work, 2), round(second * 1e3, 1), count), strict=True))
            )
            report(f"{len(rows)}/{len(QUERIES)} {name}: {first:.2f} s")
    return rows


def _run(script: str, device: str | None, folder: str | Path, environment: dict[str, str]) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script, device or "", str(folder)],
        stdout=subprocess.PIPE,
        text=True,
        timeout=SECONDS,
        env={**os.environ, **environment},
        check=True,
    )
    return done.stdout
