"""The calls of public_calls.py with arguments that take tens to hundreds of megabytes each."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from benchmarks.catalog.index_grids import IndexGrid
from benchmarks.catalog.mesh_catalog import icosphere
from geokit import native
from tests.support.public_calls import Call, Scene, public_calls

__all__ = ["LargeScene", "large_calls"]


class LargeScene(Scene):
    """What :class:`Scene` holds, a hundred thousand times as large. Lengths that calls state fit it."""

    def __init__(self, folder: Path, scale: float = 1.0, device: str = "cpu") -> None:
        small = folder / "small"
        small.mkdir()
        super().__init__(small)  # for what has no large form, too
        self.folder = folder
        rng = np.random.default_rng(1)
        rows = int(1_000_000 * scale)
        self.count = rows
        self.mesh = icosphere(7 if scale >= 0.5 else 6, radius=10.0)
        self.other = gk.mesh.TriangleMesh(self.mesh.vertices * 0.9 + 0.01, self.mesh.faces)
        self.coarse = icosphere(6 if scale >= 0.5 else 5, radius=10.0)
        self.simple = icosphere(5 if scale >= 0.5 else 4, radius=10.0)
        self.torn = gk.mesh.TriangleMesh(self.mesh.vertices, self.mesh.faces[rng.random(self.mesh.face_count) >= 0.02])
        spikes = self.mesh.vertices.copy()
        spikes[0] *= -1.05
        self.crossed = gk.mesh.TriangleMesh(spikes, self.mesh.faces)
        self.device = device
        self.surface = gk.mesh.Surface(self.mesh, device=device)
        self.directions = rng.normal(size=(rows, 3))
        # Near the surface: all faces are as far from the middle of a sphere, and a query there looks at each.
        self.queries = rng.normal(size=(rows, 3))
        self.queries *= (rng.uniform(9.5, 10.5, rows) / np.linalg.norm(self.queries, axis=1))[:, None]
        # 25 neighbors within 0.3
        side = (rows / 4 / 220) ** (1 / 3)
        self.cloud = rng.random((rows // 4, 3)) * side
        self.near = rng.random((rows // 4, 3)) * side
        self.sdf = gk.volume.from_mesh(self.coarse, 0.1 / (2.0 * scale) ** 0.5, device="cpu")
        self.shallow = gk.volume.from_mesh(self.simple, 0.3, device="cpu")
        self.shifted = gk.volume.from_mesh(icosphere(5, radius=9.9), 0.1 / (2.0 * scale) ** 0.5, device="cpu")
        size = int(240 * scale ** (1 / 3))
        dense = np.zeros((size,) * 3, np.float32)
        dense[8:-8, 8:-8, 8:-8] = rng.random((size - 16,) * 3)
        self.dense = dense
        self.fog = gk.volume.from_dense(dense, voxel_size=0.1, grid_class="fog volume", name="density")
        self.field = gk.volume.gradient_field(self.fog, device="cpu")
        self.index = IndexGrid("index", [("density", "float")]).volume
        self.adaptive = gk.volume.adaptive_from_mesh(self.simple, 0.02, device="cpu")
        self.grid = gk.points.NeighborGrid(self.cloud, 0.3, device=device)
        self.groups = [0, 20, len(self.cloud)], [0, 2, len(self.near)]
        self.grouped = gk.points.NeighborGrid(self.cloud, 0.3, groups=self.groups[0], device=device)
        self.moving = gk.points.NeighborGrid(self.cloud, 0.3, skin=0.1, device=device)
        for name, volumes in (("one.nvdb", [self.sdf]), ("two.nvdb", [self.sdf, self.fog])):
            gk.volume.save(folder / name, *volumes)
        self.adaptive.save(folder / "adaptive.nvdb")
        gk.mesh.save(folder / "mesh.ply", self.mesh)
        gk.points.save(folder / "cloud.csv", self.cloud)
        gk.points.save(folder / "cloud.ply", self.cloud)
        gk.accuracy.write_table(self.rows, folder / "table.csv")
        np.save(folder / "rays.npy", np.hstack([self.queries, self.directions]))
        if native.available():
            gk.volume.save(folder / "one.vdb", self.sdf)
            gk.points.save(folder / "points.vdb", self.cloud)


def large_calls(s: LargeScene) -> Iterator[Call]:
    """Each of the public calls."""
    other = _arguments(s)
    for call in public_calls(s):
        where = {"device": s.device} if "device" in call.arguments else {}
        yield call._replace(arguments={**call.arguments, **where, **other.get(call.name, {})})


def _arguments(s: LargeScene) -> dict[str, dict[str, Any]]:
    """Arguments of calls that state a size themselves."""
    near = {"a": s.cloud, "b": s.near}
    function = {"bounds": [[-10.0] * 3, [10.0] * 3], "voxel_size": 0.1}
    function["function"] = lambda p: np.linalg.norm(p, axis=1) - 9.0
    vectors = np.ones((*(n // 2 for n in s.dense.shape), 3))
    neighbors = {
        f"points.NeighborGrid.{name}": {"queries": s.near}
        for name in ("count", "radius_search", "radius_search_blocks", "knn", "hybrid")
    }
    # These take seconds for each thousand rows.
    few = s.queries[::8]
    packed = {"points": few, "offsets": [0, len(few) // 2, len(few)]}
    rays = {"origins": few, "directions": s.directions[::8]}
    grouped = {f"{name}(groups)": arguments for name, arguments in neighbors.items()}
    return (
        neighbors
        | grouped
        | {
            "mesh.Surface.furthest_point": {"points": s.queries[:2000]},
            "mesh.Surface.furthest_point(transform)": {"points": s.queries[:2000]},
            "mesh.Surface.overlapping": {"lower": s.queries * 1.1, "upper": s.queries * 1.1 + 0.2},
            "mesh.Surface.winding_number": {"points": s.queries[::10]},
            "mesh.Surface.winding_number(transform)": {"points": s.queries[::10]},
            "mesh.Surface.sign_confidence": {"points": s.queries[::10]},
            "mesh.Surface.sign_confidence(transform)": {"points": s.queries[::10]},
            "mesh.Surfaces.closest_point": packed,
            "mesh.Surfaces.contains": packed,
            "mesh.Surfaces.signed_distance": packed,
            "mesh.hausdorff": {"samples": s.count // 4},
            "mesh.simplify": {"mesh": s.simple, "tolerance": 0.04},
            "mesh.simplify(face_count)": {"mesh": s.simple, "face_count": 5000},
            "mesh.sample_surface": {"count": 2 * s.count},
            "mesh.sample_surface(radius)": {"radius": 0.12},
            "mesh.sample_surface(disk)": {"count": s.count // 20},
            "mesh.from_volume(tolerance)": {"volume": s.shallow, "tolerance": 0.06},
            "mesh.from_volume_with_deviation": {"volume": s.shallow, "tolerance": 0.06},
            "volume.adaptive_from_mesh": {"mesh": s.simple, "tolerance": 0.03},
            "volume.plan": {"mesh": s.simple, "tolerance": 0.04},
            "volume.from_mesh": {"voxel_size": 0.05},
            "volume.from_mesh(tolerance)": {"mesh": s.coarse, "tolerance": 0.002},
            "volume.from_mesh(openvdb)": {"mesh": s.simple, "voxel_size": 0.1},
            "volume.from_mesh(codec)": {"voxel_size": 0.05},
            "volume.from_mesh_with_triangles": {"voxel_size": 0.05},
            "volume.from_points": {"radius": 0.3, "voxel_size": 0.05},
            "volume.from_function": function,
            "volume.from_dense": {"values": s.dense},
            "volume.from_dense(transform)": {"values": s.dense},
            "volume.from_dense(int32)": {"values": (s.dense * 100).astype(np.int32)},
            "volume.from_dense(vectors)": {"values": vectors},
            "volume.integrate": rays,
            "volume.integrate(emission)": rays,
            "volume.SparseVolume.integrate": rays,
            "volume.quantize": {"tolerance": 0.01},
            "volume.clip": {"bounds": [[-20.0] * 3, [5.0] * 3]},
            "points.downsample(voxel_size)": {"voxel_size": 0.1},
            "points.downsample(count)": {"count": 1000},
            "points.downsample(radius)": {"radius": 0.1},
            "points.register": {"source": s.cloud + 1e-3},
            "points.register(mesh)": {"source": s.mesh.vertices * 1.01, "target": s.mesh},
            "points.register(volume)": {"source": s.queries, "target": s.sdf},
            "points.chamfer": near,
            "points.chamfer(groups)": near,
            "points.hausdorff": near,
            "points.PointCloud": {"data": {"a": np.arange(len(s.cloud))}},
            "render.figure(points)": {"points": s.cloud, "color": s.cloud[:, 0]},
            "native.mesh_to_level_set": {"vertices": s.simple.vertices, "faces": s.simple.faces, "voxel_size": 0.1},
        }
    )
