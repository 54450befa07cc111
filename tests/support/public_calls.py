"""A valid call, or several, of each public function and method, to be spoiled one argument at a time."""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import geokit as gk
from benchmarks.catalog.index_grids import IndexGrid
from geokit import native

__all__ = ["Call", "Scene", "kinds_of", "public_calls", "public_names"]

# Doors of packages that an extra brings.
MORE: tuple[ModuleType, ...] = (gk.distributed,) if importlib.util.find_spec("dask") else ()
DOORS: tuple[ModuleType, ...] = (*MORE, gk.mesh, gk.volume, gk.points, gk.render, gk.threads, gk.accuracy, native)
# What functions return. Users do not make them, so their constructors check nothing.
RESULTS = {
    "mesh": "BoxOverlaps ClosestPoints Contacts DirectedDistance FilledHoles FurthestPoints HausdorffDistance MeshAudit"
    " OrientedMesh RayHitLists RayHits Repaired SignedDistances Simplified SurfaceDistance SurfaceSamples"
    " TimeOfContact Untangled Wrapped",
    "volume": "ActiveVoxels ConnectedComponents Curvatures DenseGrid GridInfo MeshBand PlannedField Statistics"
    " Transmittance VolumeHits",
    "points": "Candidates ChamferDistance Cover DirectedDistance Downsampled HausdorffDistance KNearest NeighborBlock"
    " NeighborList Neighbors Pairs PointNormals PointTile ProcessedFile Registration",
    "accuracy": "ChartInfo Envelope Failure Judgement Measurement Outcome Results",
    "native": "PolygonMesh RawMetadata VdbGrid",
    "render": "Page",
}
# Plain records: the functions that take them check them.
RECORDS = {"mesh": "Material MeshPart Texture", "render": "Series", "accuracy": "Chart Subject Sweep Trial"}
# For kernels of warp, and functions without parameters.
OTHERS = {
    "threads": "Share barrier item", "render": "gl_backend", "native": "available build_facts require versions",
    # Of libraries that are not installed with geokit.
    "mesh": "to_open3d", "points": "to_open3d", "volume": "to_xarray",
}  # fmt: skip


@wp.kernel(enable_backward=False)
def nothing_kernel(share: gk.threads.Share):
    pass


class Call(NamedTuple):
    """A valid call.

    Attributes:
        name: Of the function, after its door; a word in brackets tells several calls of one function apart.
        function: What is called.
        arguments: By parameter; a tuple for ``*more``.
        also: Kinds that a parameter takes beyond those of its annotation.
    """

    name: str
    function: Callable[..., Any]
    arguments: dict[str, Any]
    also: Mapping[str, str] = MappingProxyType({})

    @property
    def parameters(self) -> list[inspect.Parameter]:
        found = inspect.signature(self.function).parameters.values()
        return [p for p in found if not p.name.startswith("_") and p.kind is not p.VAR_KEYWORD]

    def __call__(self, **spoiled: Any) -> Any:
        """What the function returns with some of its arguments replaced; a generator is read to its end."""
        given = {**self.arguments, **spoiled}
        positional = []
        for parameter in self.parameters:
            if parameter.kind is parameter.VAR_POSITIONAL:
                positional = [given.pop(p.name) for p in self.parameters[: self.parameters.index(parameter)]]
                more = given.pop(parameter.name, ())
                positional += more if isinstance(more, tuple) else (more,)
        answer = self.function(*positional, **given)
        return list(answer) if inspect.isgenerator(answer) else answer


class Scene:
    """Small valid things of all kinds, made on a CPU, with files in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.mesh = _octahedron()
        self.other = gk.mesh.TriangleMesh(self.mesh.vertices * 0.9, self.mesh.faces)
        self.torn, self.crossed = gk.mesh.TriangleMesh(self.mesh.vertices, self.mesh.faces[1:]), self.mesh
        self.surface = gk.mesh.Surface(self.mesh, device="cpu")
        data = {"height": self.mesh.vertices[:, 2]}
        painted = gk.mesh.TriangleMesh(self.mesh.vertices, self.mesh.faces, vertex_data=data)
        self.painted = gk.mesh.Surface(painted, device="cpu")
        self.cloud = np.random.default_rng(1).random((60, 3))
        self.queries = np.random.default_rng(2).random((5, 3))
        self.directions = np.tile([[0.0, 0.6, 0.8]], (5, 1))
        self.sdf = gk.volume.from_mesh(self.mesh, 0.2, device="cpu")
        self.shifted = gk.volume.from_mesh(self.other, 0.2, device="cpu")
        dense = np.zeros((9, 9, 9), np.float32)
        dense[2:7, 2:7, 2:7] = np.random.default_rng(3).random((5, 5, 5))
        self.fog = gk.volume.from_dense(dense, voxel_size=0.1, grid_class="fog volume", name="density")
        self.field = gk.volume.gradient_field(self.fog, device="cpu")
        self.index = IndexGrid("index", [("density", "float")]).volume
        self.adaptive = gk.volume.adaptive_from_mesh(self.mesh, 0.2, device="cpu")
        self.grid = gk.points.NeighborGrid(self.cloud, 0.3, device="cpu")
        self.periodic = gk.points.NeighborGrid(self.cloud, 0.3, periodic=[3.0, 3.0, 3.0], device="cpu")
        self.groups = [0, 20, len(self.cloud)], [0, 2, len(self.queries)]
        self.grouped = gk.points.NeighborGrid(self.cloud, 0.3, groups=self.groups[0], device="cpu")
        self.moving = gk.points.NeighborGrid(self.cloud, 0.3, skin=0.1, device="cpu")
        self.team = gk.threads.Team(1, device="cpu")
        self.trial = gk.accuracy.Trial("m", "s", lambda: None, _judged, 3)
        self.chart = gk.accuracy.Chart("c", "Chart", "world", "answers", lambda: [self.trial])
        envelope = gk.accuracy.Envelope(1.0, 1.0, 0.0, "It holds.")
        self.sweep = gk.accuracy.Sweep("sweep", "m", "p", "world", (0.5, 1.0, 2.0), lambda _: _judged(None), envelope)
        row = gk.accuracy.measure(self.trial, self.chart, "subject", "cpu", quick=True)
        self.rows = [row, row]
        for name, volumes in (("one.nvdb", [self.sdf]), ("two.nvdb", [self.sdf, self.fog])):
            gk.volume.save(folder / name, *volumes)
        self.adaptive.save(folder / "adaptive.nvdb")
        gk.mesh.save(folder / "mesh.ply", self.mesh)
        if importlib.util.find_spec("pyvista"):
            gk.mesh.save(folder / "mesh.vtp", self.mesh)
        gk.points.save(folder / "cloud.csv", self.cloud)
        gk.points.save(folder / "cloud.ply", self.cloud)
        np.save(folder / "rays.npy", np.hstack([self.queries, self.directions]))
        gk.accuracy.write_table(self.rows, folder / "table.csv")
        if native.available():
            gk.volume.save(folder / "one.vdb", self.sdf)
            gk.points.save(folder / "points.vdb", self.cloud)


def _octahedron() -> gk.mesh.TriangleMesh:
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return gk.mesh.TriangleMesh(vertices, faces, name="octahedron")


def _judged(_: Any) -> gk.accuracy.Judgement:
    return gk.accuracy.Judgement(np.array([0.1, 0.2]), np.array([False, False]))


def public_calls(s: Scene) -> Iterator[Call]:
    yield from _mesh_calls(s)
    yield from _volume_calls(s)
    yield from _point_calls(s)
    yield from _other_calls(s)
    if MORE:
        from dask import array

        # Two blocks, however many rows.
        d, points = gk.distributed, array.from_array(s.queries, chunks=(len(s.queries) // 2, 3))
        blocks = {"points": points, "directions": array.from_array(s.directions)}
        asked = {"surface": s.surface, **blocks, "query": "raycast"}
        yield Call("distributed.map_queries", d.map_queries, asked, {"directions": ""})
    if native.available():
        yield from _native_calls(s)


def _mesh_calls(s: Scene) -> Iterator[Call]:
    m, cpu, rays = gk.mesh, {"device": "cpu"}, {"origins": s.queries, "directions": s.directions}
    asked = {"points": s.queries}
    yield Call("mesh.TriangleMesh", m.TriangleMesh, {"vertices": s.mesh.vertices, "faces": s.mesh.faces})
    yield Call("mesh.as_mesh", m.as_mesh, {"mesh": s.mesh}, {"mesh": "object"})
    for library in ("trimesh", "pyvista", "meshio"):
        yield Call(f"mesh.to_{library}", getattr(m, f"to_{library}"), {"mesh": s.mesh})
    yield Call("mesh.TriangleMesh.transform", s.mesh.transform, {"matrix": np.eye(4)})
    yield Call("mesh.load", m.load, {"path": s.folder / "mesh.ply"})
    yield Call("mesh.load(vtp)", m.load, {"path": s.folder / "mesh.vtp", "trusted": True})
    yield Call("mesh.save", m.save, {"path": s.folder / "out.vtp", "mesh": s.mesh})
    yield Call("mesh.save(ply)", m.save, {"path": s.folder / "out.ply", "mesh": s.mesh})
    yield Call("mesh.Surface", m.Surface, {"mesh": s.mesh, **cpu})
    yield Call("mesh.Surface.closest_point", s.surface.closest_point, asked)
    yield Call("mesh.Surface.contains", s.surface.contains, asked)
    yield Call("mesh.Surface.crossing_count", s.surface.crossing_count, rays)
    yield Call("mesh.Surface.furthest_point", s.surface.furthest_point, asked)
    other, pose = m.Surface(s.other, device="cpu"), {"transform": np.eye(4)}
    for name in (
        "closest_point", "contains", "signed_distance", "winding_number", "sign_confidence", "furthest_point",
    ):  # fmt: skip
        yield Call(f"mesh.Surface.{name}(transform)", getattr(s.surface, name), {**asked, **pose})
    for name in ("raycast", "raycast_all", "crossing_count", "occluded"):
        yield Call(f"mesh.Surface.{name}(transform)", getattr(s.surface, name), {**rays, **pose})
    yield Call("mesh.Surface.distance", s.surface.distance, {"other": other, "transform": np.eye(4)})
    yield Call("mesh.Surface.contacts", s.surface.contacts, {"other": other, "transform": np.eye(4), "margin": 0.1})
    motion = {"other": other, "motion": np.stack([np.eye(4)] * 2), "tolerance": 0.1}
    yield Call("mesh.Surface.until_contact", s.surface.until_contact, motion)
    yield Call("mesh.Surface.intersecting_triangles", s.surface.intersecting_triangles, {"other": other})
    yield Call("mesh.Surface.sample_attributes", s.painted.sample_attributes, {**asked, "names": ["height"]})
    yield Call("mesh.Surface.self_intersections", s.surface.self_intersections, {})
    yield Call("mesh.Surface.occluded", s.surface.occluded, rays)
    boxes = {"lower": s.queries, "upper": s.queries + 0.5}
    yield Call("mesh.Surface.on_kernel", s.surface.on_kernel, {"sign": "winding"})
    yield Call("mesh.Surface.overlapping", s.surface.overlapping, boxes)
    yield Call("mesh.Surface.raycast", s.surface.raycast, rays)
    yield Call("mesh.Surface.raycast_all", s.surface.raycast_all, rays)
    yield Call("mesh.Surface.sign_confidence", s.surface.sign_confidence, asked)
    yield Call("mesh.Surface.signed_distance", s.surface.signed_distance, asked)
    yield Call("mesh.Surface.update", other.update, {"vertices": s.mesh.vertices})
    yield Call("mesh.Surface.winding_number", s.surface.winding_number, asked)
    many, packed = m.Surfaces([s.mesh, s.other], device="cpu"), {"offsets": [0, 2, len(s.queries)]}
    yield Call("mesh.Surfaces", m.Surfaces, {"meshes": [s.mesh, s.other], **cpu})
    yield Call("mesh.Surfaces.closest_point", many.closest_point, {**asked, **packed})
    yield Call("mesh.Surfaces.contains", many.contains, {**asked, **packed})
    yield Call("mesh.Surfaces.mesh", many.mesh, {"index": 1})
    yield Call("mesh.Surfaces.raycast", many.raycast, {**rays, **packed})
    yield Call("mesh.Surfaces.signed_distance", many.signed_distance, {**asked, **packed})
    poses = {**packed, "transform": np.stack([np.eye(4)] * 2)}
    for name in ("closest_point", "contains", "signed_distance"):
        yield Call(f"mesh.Surfaces.{name}(transform)", getattr(many, name), {**asked, **poses})
    yield Call("mesh.Surfaces.raycast(transform)", many.raycast, {**rays, **poses})
    yield Call("mesh.Surfaces.surface", many.surface, {"index": 1})
    yield Call("mesh.audit", m.audit, {"mesh": s.mesh})
    yield Call("mesh.audit_file", m.audit_file, {"path": s.folder / "mesh.ply"})
    yield Call("mesh.orient", m.orient, {"mesh": s.mesh})
    yield Call("mesh.merge_vertices", m.merge_vertices, {"mesh": s.mesh})
    yield Call("mesh.drop_degenerate", m.drop_degenerate, {"mesh": s.mesh})
    yield Call("mesh.fill_holes", m.fill_holes, {"mesh": s.torn, "max_width": 1.5})
    yield Call("mesh.fill_holes(fair)", m.fill_holes, {"mesh": s.torn, "max_width": 1.5, "fair": True})
    yield Call("mesh.repair", m.repair, {"mesh": s.torn, "tolerance": 0.01, "max_width": 1.5})
    yield Call("mesh.remove_self_intersections", m.remove_self_intersections, {"mesh": s.crossed, "rings": 4})
    yield Call("mesh.hausdorff", m.hausdorff, {"a": s.mesh, "b": s.other, "samples": 50, **cpu})
    yield Call("mesh.simplify", m.simplify, {"mesh": s.mesh, "tolerance": 0.1, **cpu})
    yield Call("mesh.simplify(face_count)", m.simplify, {"mesh": s.mesh, "face_count": 8, **cpu})
    yield Call("mesh.sample_surface", m.sample_surface, {"mesh": s.mesh, "count": 20})
    spread = {"mesh": s.mesh, "method": "poisson_disk"}
    yield Call("mesh.sample_surface(radius)", m.sample_surface, {**spread, "radius": 0.5})
    yield Call("mesh.sample_surface(disk)", m.sample_surface, {**spread, "count": 20})
    yield Call("mesh.split", m.split, {"mesh": s.mesh})
    for name in ("union", "difference", "intersection"):
        given = {"mesh": s.mesh, "others": (s.other,)}
        yield Call(f"mesh.{name}", getattr(m, name), given, {"others": "sequence"})
    yield Call("mesh.keep_largest", m.keep_largest, {"mesh": s.mesh})
    yield Call("mesh.transform", m.transform, {"mesh": s.mesh, "matrix": np.eye(4)})
    asked_unit = {"mesh": s.mesh, "unit": "mm", "up_axis": "z", "from_unit": "in", "from_up_axis": "y"}
    yield Call("mesh.convert_unit", m.convert_unit, asked_unit)
    yield Call("mesh.transfer_attributes", m.transfer_attributes, {"mesh": s.other, "source": s.painted.mesh, **cpu})
    yield Call("mesh.box", m.box, {"size": [1.0, 2.0, 3.0]})
    yield Call("mesh.sphere", m.sphere, {"segments": 6})
    yield Call("mesh.cylinder", m.cylinder, {"segments": 6})
    yield Call("mesh.cone", m.cone, {"segments": 6})
    yield Call("mesh.torus", m.torus, {"segments": 6, "tube_segments": 5})
    yield Call("mesh.plane", m.plane, {"size": [1.0, 2.0]})
    yield Call("mesh.from_volume", m.from_volume, {"volume": s.sdf, **cpu})
    yield Call("mesh.from_volume(openvdb)", m.from_volume, {"volume": s.sdf, "method": "openvdb", **cpu})
    yield Call("mesh.from_volume(tolerance)", m.from_volume, {"volume": s.sdf, "tolerance": 0.1, **cpu})
    deviating = {"volume": s.sdf, "tolerance": 0.1, **cpu}
    yield Call("mesh.from_volume_with_deviation", m.from_volume_with_deviation, deviating)
    yield Call("mesh.wrap", m.wrap, {"mesh": s.mesh, "tolerance": 0.3, "gap": 0.1, **cpu})
    yield Call("mesh.sample_attributes", m.sample_attributes, {"mesh": s.mesh, "volumes": {"d": s.sdf}, **cpu})


def _volume_calls(s: Scene) -> Iterator[Call]:
    v, cpu = gk.volume, {"device": "cpu"}
    asked = {"points": s.queries, **cpu}
    rays = {"origins": s.queries, "directions": s.directions, **cpu}
    level_set = {"volume": s.sdf, **cpu}
    box = [[0.0, 0.0, 0.0], [0.4, 0.4, 0.4]]
    yield Call("volume.load", v.load, {"path": s.folder / "one.nvdb"})
    yield Call("volume.load_all", v.load_all, {"path": s.folder / "two.nvdb"})
    yield Call("volume.inspect", v.inspect, {"path": s.folder / "two.nvdb"})
    yield Call("volume.load_adaptive", v.load_adaptive, {"path": s.folder / "adaptive.nvdb"})
    yield Call("volume.save", v.save, {"path": s.folder / "out.nvdb", "volumes": (s.sdf,)})
    if native.available():
        yield Call("volume.load(vdb)", v.load, {"path": s.folder / "one.vdb", "trusted": True})
        yield Call("volume.save(vdb)", v.save, {"path": s.folder / "out.vdb", "volumes": (s.sdf,)})
    yield Call("volume.SparseVolume", v.SparseVolume, {"nanovdb": s.sdf.nanovdb, "info": s.sdf.info})
    yield Call("volume.SparseVolume.on", s.sdf.on, cpu)
    yield Call("volume.SparseVolume.on_kernel", s.sdf.on_kernel, cpu)
    yield Call("volume.SparseVolume.id", s.sdf.id, cpu)
    yield Call("volume.AdaptiveSDF", v.AdaptiveSDF, {"levels": s.adaptive.levels})
    yield Call("volume.AdaptiveSDF.sample", s.adaptive.sample, asked)
    yield Call("volume.AdaptiveSDF.gradient", s.adaptive.gradient, asked)
    yield Call("volume.AdaptiveSDF.save", s.adaptive.save, {"path": s.folder / "out.nvdb"})
    yield Call("volume.adaptive_from_mesh", v.adaptive_from_mesh, {"mesh": s.mesh, "tolerance": 0.2, **cpu})
    yield Call("volume.plan", v.plan, {"mesh": s.mesh, "tolerance": 0.2, **cpu})
    made = {"mesh": s.mesh, "voxel_size": 0.2, **cpu}
    yield Call("volume.from_mesh", v.from_mesh, made)
    yield Call("volume.from_mesh(tolerance)", v.from_mesh, {"mesh": s.mesh, "tolerance": 0.2, **cpu})
    yield Call("volume.from_mesh(openvdb)", v.from_mesh, {**made, "method": "openvdb"})
    yield Call("volume.from_mesh(codec)", v.from_mesh, {**made, "codec": "fp8"})
    yield Call("volume.from_mesh_with_triangles", v.from_mesh_with_triangles, made)
    streamed = {"path": s.folder / "mesh.ply", "out": s.folder / "out.nvdb", "voxel_size": 0.2, **cpu}
    yield Call("volume.from_mesh_file", v.from_mesh_file, streamed)
    balls = {"points": s.cloud, "radius": 0.1, "voxel_size": 0.05, **cpu}
    yield Call("volume.from_points", v.from_points, balls)
    function = {"function": lambda p: np.linalg.norm(p, axis=1) - 0.3, "bounds": [[-0.5] * 3, [0.5] * 3]}
    yield Call("volume.from_function", v.from_function, {**function, "voxel_size": 0.1})
    ones = np.ones((3, 4, 5), np.float32)
    yield Call("volume.from_dense", v.from_dense, {"values": ones, "voxel_size": 0.5})
    yield Call("volume.from_dense(transform)", v.from_dense, {"values": ones, "transform": np.eye(4)})
    whole = {"values": ones.astype(np.int32), "voxel_size": 0.5, "grid_type": "int32"}
    yield Call("volume.from_dense(int32)", v.from_dense, whole, {"background": "flag"})
    vectors = {"values": np.ones((3, 4, 5, 3)), "voxel_size": 0.5, "background": (0, 0, 0)}
    yield Call("volume.from_dense(vectors)", v.from_dense, vectors, {"background": "flag"})
    values = v.active_voxels(s.sdf).values
    yield Call("volume.active_voxels", v.active_voxels, {"volume": s.sdf})
    yield Call("volume.with_values", v.with_values, {"volume": s.sdf, "values": values})
    yield Call("volume.to_dense", v.to_dense, level_set, {"dtype": "text"})
    yield Call("volume.to_pyvista", v.to_pyvista, level_set)
    yield Call("volume.from_channel", v.from_channel, {"volume": s.index})
    yield Call("volume.channel_names", v.channel_names, {"volume": s.index})
    yield Call("volume.sample(channel)", v.sample, {"volume": s.index, "channel": "density", **asked})
    for name in ("sample", "gradient"):
        yield Call(f"volume.{name}", getattr(v, name), {"volume": s.sdf, **asked})
        yield Call(f"volume.{name}(order)", getattr(v, name), {"volume": s.sdf, **asked, "order": 3})
        yield Call(f"volume.{name}(transform)", getattr(v, name), {"volume": s.sdf, **asked, "transform": np.eye(4)})
    for name in ("hessian", "curvature", "active_at"):
        yield Call(f"volume.{name}", getattr(v, name), {"volume": s.sdf, **asked})
    yield Call("volume.raycast", v.raycast, {"volume": s.sdf, **rays})
    yield Call("volume.raycast(transform)", v.raycast, {"volume": s.sdf, **rays, "transform": np.eye(4)})
    yield Call("volume.integrate", v.integrate, {"volume": s.fog, **rays})
    yield Call("volume.integrate(emission)", v.integrate, {"volume": s.fog, "emission": s.fog, **rays})
    # The methods forward their arguments; only those that other functions do not check are spoiled there.
    for name in ("sample", "gradient", "hessian", "curvature", "active_at"):
        yield Call(f"volume.SparseVolume.{name}", getattr(s.sdf, name), asked)
    yield Call("volume.SparseVolume.raycast", s.sdf.raycast, rays)
    yield Call("volume.SparseVolume.integrate", s.fog.integrate, rays)
    yield Call("volume.SparseVolume.to_dense", s.sdf.to_dense, cpu, {"dtype": "text"})
    yield Call("volume.SparseVolume.quantize", s.sdf.quantize, {"codec": "fp8"})
    for name in ("statistics", "segment", "connected_components"):
        yield Call(f"volume.{name}", getattr(v, name), {"volume": s.sdf})
    for name in ("union", "intersection", "difference"):
        yield Call(f"volume.{name}", getattr(v, name), {"a": s.sdf, "b": s.shifted}, {"more": "sequence"})
    yield Call("volume.offset", v.offset, {**level_set, "distance": 0.1})
    for name in ("dilate", "erode", "opening", "closing"):
        yield Call(f"volume.{name}", getattr(v, name), {**level_set, "distance": 0.1})
        yield Call(f"volume.{name}(voxels)", getattr(v, name), {"volume": s.fog, "voxels": 1, **cpu})
    yield Call("volume.renormalize", v.renormalize, level_set)
    yield Call("volume.smooth", v.smooth, {"volume": s.sdf})
    for name in ("gradient_field", "laplacian"):
        yield Call(f"volume.{name}", getattr(v, name), {"volume": s.fog, **cpu})
    for name in ("divergence", "curl"):
        yield Call(f"volume.{name}", getattr(v, name), {"volume": s.field, **cpu})
    yield Call("volume.resample", v.resample, {"volume": s.fog, "voxel_size": 0.2, **cpu})
    yield Call("volume.resample(transform)", v.resample, {"volume": s.sdf, "transform": s.sdf.info.transform, **cpu})
    yield Call("volume.quantize", v.quantize, {"volume": s.sdf, "tolerance": 0.01})
    yield Call("volume.clip", v.clip, {"volume": s.sdf, "bounds": box})
    yield Call("volume.prune", v.prune, {"volume": s.fog})


def _point_calls(s: Scene) -> Iterator[Call]:
    p, cloud = gk.points, {"points": s.cloud, "device": "cpu"}
    pair = {"a": s.cloud, "b": s.queries, "device": "cpu"}
    yield Call("points.PointCloud", p.PointCloud, {"points": s.cloud, "data": {"a": np.arange(60)}})
    for library in ("trimesh", "pyvista"):
        yield Call(f"points.to_{library}", getattr(p, f"to_{library}"), {"points": s.cloud}, {"points": "numbers"})
    yield Call("points.sample", p.sample, {"mesh": s.painted.mesh, "count": 20})
    yield Call("points.load", p.load, {"path": s.folder / "cloud.csv", "columns": ("x", "y", "z")})
    yield Call("points.load(vtp)", p.load, {"path": s.folder / "mesh.vtp", "trusted": True})
    if native.available():
        yield Call("points.load(vdb)", p.load, {"path": s.folder / "points.vdb", "grid": "points", "trusted": True})
        yield Call("points.save(vdb)", p.save, {"path": s.folder / "out.vdb", "points": s.cloud})
    yield Call("points.load_rays", p.load_rays, {"path": s.folder / "rays.npy"})
    yield Call("points.save", p.save, {"path": s.folder / "out.ply", "points": s.cloud})
    yield Call("points.save(npz)", p.save, {"path": s.folder / "out.npz", "points": s.cloud})
    files = {"path": s.folder / "cloud.ply", "out": s.folder / "out.ply", "device": "cpu"}
    options = {"normals": {"k": 5}, "density": {"radius": 0.3}}
    yield Call("points.process_file", p.process_file, {**files, "voxel_size": 0.2, **options})
    yield Call("points.load_tiles", p.load_tiles, {"path": s.folder / "cloud.ply", "halo": 0.3})
    yield Call("points.NeighborGrid", p.NeighborGrid, {**cloud, "radius": 0.3})
    yield Call("points.NeighborGrid(no radius)", p.NeighborGrid, cloud)
    for name in ("count", "radius_search", "radius_search_blocks", "knn", "hybrid"):
        method = getattr(s.grid, name)
        yield Call(f"points.NeighborGrid.{name}", method, {"queries": s.queries}, {"radius": "numbers"})
        yield Call(f"points.NeighborGrid.{name}(own)", method, {}, {"radius": "numbers"})
    yield Call("points.NeighborGrid.pairs", s.grid.pairs, {})
    yield Call("points.NeighborGrid(groups)", p.NeighborGrid, {**cloud, "radius": 0.3, "groups": s.groups[0]})
    for name in ("count", "radius_search", "radius_search_blocks", "knn", "hybrid"):
        given = {"queries": s.queries, "groups": s.groups[1]}
        yield Call(f"points.NeighborGrid.{name}(groups)", getattr(s.grouped, name), given, {"radius": "numbers"})
    periodic = {**cloud, "radius": 0.3, "periodic": [3.0, 3.0, 3.0]}
    yield Call("points.NeighborGrid(periodic)", p.NeighborGrid, periodic)
    for name in ("count", "radius_search", "radius_search_blocks", "neighbor_list"):
        method = getattr(s.periodic, name)
        yield Call(f"points.NeighborGrid.{name}(periodic)", method, {"queries": s.queries}, {"radius": "numbers"})
    yield Call("points.NeighborGrid.neighbor_list", s.periodic.neighbor_list, {}, {"radius": "numbers"})
    yield Call("points.NeighborGrid(skin)", p.NeighborGrid, {**cloud, "radius": 0.3, "skin": 0.1})
    yield Call("points.NeighborGrid.radius_search(skin)", s.moving.radius_search, {}, {"radius": "numbers"})
    yield Call("points.NeighborGrid.on_kernel", s.grid.on_kernel, {})
    yield Call("points.NeighborGrid.candidates", s.moving.candidates, {})
    yield Call("points.NeighborGrid.update", s.grid.update, {"points": s.cloud})
    yield Call("points.NeighborGrid.update(skin)", s.moving.update, {"points": s.cloud})
    yield Call("points.normals", p.normals, cloud)
    yield Call("points.normals(radius)", p.normals, {**cloud, "radius": 0.3})
    viewed = {**cloud, "orientation": "viewpoint", "viewpoint": [0.0, 0.0, 1.0]}
    yield Call("points.normals(viewpoint)", p.normals, viewed)
    yield Call("points.density", p.density, {**cloud, "radius": 0.3})
    yield Call("points.outliers", p.outliers, cloud)
    yield Call("points.outliers(radius)", p.outliers, {**cloud, "method": "radius", "radius": 0.3})
    yield Call("points.cluster", p.cluster, {**cloud, "radius": 0.3})
    for way in ({"voxel_size": 0.3}, {"count": 10}, {"radius": 0.2}, {"tolerance": 0.2}):
        yield Call(f"points.downsample({next(iter(way))})", p.downsample, {**cloud, **way})
    yield Call("points.cover", p.cover, {**cloud, "tolerance": 0.2})
    near = {"source": s.cloud[:40] + 1e-3, "max_iterations": 3, "device": "cpu"}
    for name, target in (("", s.cloud), ("(mesh)", s.mesh), ("(volume)", s.sdf)):
        yield Call(f"points.register{name}", p.register, {**near, "target": target}, {"target": "object"})
    yield Call("points.chamfer", p.chamfer, pair)
    yield Call("points.chamfer(groups)", p.chamfer, {**pair, "groups": s.groups})
    yield Call("points.hausdorff", p.hausdorff, pair)


def _other_calls(s: Scene) -> Iterator[Call]:
    r, a, out = gk.render, gk.accuracy, s.folder / "out.png"
    size = {"size": (64, 64)}
    yield Call("render.figure", r.figure, {"path": out, "mesh": s.mesh, **size}, {"color": "text"})
    points = {"path": out, "points": s.queries, "color": s.queries[:, 0], **size}
    yield Call("render.figure(points)", r.figure, points, {"color": "text", "point_color": "text"})
    yield Call("render.figure(volume)", r.figure, {"path": out, "volume": s.fog, **size}, {"color": "text"})
    things = {"things": (s.mesh, s.sdf, s.cloud), "path": s.folder / "out.html", "device": "cpu"}
    yield Call("render.view", r.view, things, {"things": "object"})
    for name, thing in (("mesh.TriangleMesh", s.mesh), ("volume.SparseVolume", s.sdf)):
        yield Call(f"{name}.show", thing.show, {"path": s.folder / "out.html"})
    yield Call("points.PointCloud.show", gk.points.PointCloud(s.cloud).show, {"path": s.folder / "out.html"})
    smoke = {"path": out, "volume": s.fog, "look": "smoke", **size}
    yield Call("render.figure(smoke)", r.figure, smoke, {"color": "text"})
    size = {"size": (300, 200)}
    yield Call("render.slice", r.slice, {"path": out, "volume": s.sdf, "device": "cpu", **size})
    yield Call(
        "render.image", r.image, {"path": out, "panels": s.queries, **size}, {"panels": "mapping numbers picture"}
    )
    lines = [r.Series("line", [1.0, 2.0], [3.0, 4.0])]
    yield Call("render.chart", r.chart, {"path": out, "series": lines, "x_label": "x", "y_label": "y", **size})
    yield Call("threads.Team", gk.threads.Team, {"threads": 1, "device": "cpu"})
    yield Call("threads.Team.record", s.team.record, {"kernel": nothing_kernel, "count": 1, "inputs": []})
    yield Call("threads.Team.run", s.team.run, {"kernel": nothing_kernel, "count": 1, "inputs": []})
    yield Call("threads.Team.sequence", s.team.sequence, {"calls": [lambda: None]})
    yield Call("accuracy.default_subjects", a.default_subjects, {"quick": True})
    yield Call("accuracy.front", a.front, {"seconds": [1.0, 2.0], "errors": [2.0, 1.0]})
    yield Call("accuracy.knee", a.knee, {"seconds": [1.0, 2.0], "errors": [2.0, 1.0]})
    measured = {"trial": s.trial, "chart": s.chart, "subject": "x", "device": "cpu", "quick": True}
    yield Call("accuracy.measure", a.measure, measured)
    yield Call("accuracy.follow", a.follow, {"sweep": s.sweep})
    yield Call("accuracy.sweeps", a.sweeps, {"device": "cpu"})
    yield Call("accuracy.read_table", a.read_table, {"path": s.folder / "table.csv"})
    yield Call("accuracy.write_table", a.write_table, {"rows": s.rows, "path": s.folder / "out.csv"})
    report = {"measurements": s.rows, "out": s.folder / "report", "force": True, "pictures": False}
    yield Call("accuracy.write_report", a.write_report, report)
    stability = {"out": s.folder / "stability", "force": True, "chosen": [s.sweep], "device": "cpu"}
    yield Call("accuracy.write_stability", a.write_stability, stability)
    subject = a.Subject("cloud", points=s.cloud)
    wanted = {"subjects": [subject], "devices": ["cpu"], "quick": True, "charts": ["nearest"]}
    yield Call("accuracy.run", a.run, wanted, {"devices": "devices"})


def _native_calls(s: Scene) -> Iterator[Call]:
    path = {"path": s.folder / "one.vdb"}
    yield Call("native.inspect_vdb", native.inspect_vdb, path)
    yield Call("native.read_vdb", native.read_vdb, {**path, "trusted": True})
    yield Call("native.read_vdb(worker)", native.read_vdb, path)
    grid = native.VdbGrid(s.sdf.nanovdb, {"name": "x"})
    yield Call("native.write_vdb", native.write_vdb, {"path": s.folder / "out.vdb", "grids": [grid]})
    yield Call("native.volume_to_mesh", native.volume_to_mesh, {"nanovdb": s.sdf.nanovdb})
    made = {"vertices": s.mesh.vertices, "faces": s.mesh.faces, "voxel_size": 0.2}
    yield Call("native.mesh_to_level_set", native.mesh_to_level_set, made)


# Kinds of parameters by words of their annotations.
_KINDS = {
    "str": "text", "PathLike": "path", "bool": "flag", "int": "count", "float": "number", "None": "none",
    "ArrayLike": "numbers", "NDArray": "numbers", "TriangleMesh": "object", "MeshLike": "object", "Surface": "object",
    "OverlapQueries": "object", "SparseVolume": "object", "GridInfo": "object", "Trial": "object", "Chart": "object",
    "Sweep": "object", "Mapping": "mapping", "Progress": "callable", "Callable": "callable", "Function": "callable",
    "Sequence": "sequence", "Iterable": "sequence", "tuple": "sequence",
    "Rows": "numbers", "Device": "device none", "Devices": "device none",
}  # fmt: skip
# Those of parameters of any type, by name.
_NAMED = {"dtype": "dtype none", "kernel": "object", "bounds": "numbers none"}


def kinds_of(call: Call, parameter: inspect.Parameter) -> frozenset[str]:
    """Kinds of values that a parameter may take."""
    annotation = str(parameter.annotation)
    if annotation == "Any":
        found = set(_NAMED.get(parameter.name, "numbers none" if parameter.default is None else "numbers").split())
    else:
        words = annotation.replace("[", " ").replace("]", " ").replace("|", " ").replace(",", " ").replace("'", " ")
        words = words.replace("os.", "").replace(".", " ")
        found = {kind for word in words.split() for kind in _KINDS.get(word, "").split()}
        if "path" in found:
            found -= {"text"}
    if found & {"number", "numbers"}:
        found |= {"count"}
    return frozenset(found | set(call.also.get(parameter.name, "").split()))


def public_names() -> set[str]:
    """Public functions, classes that users make, and their public methods, as ``door.name`` or ``door.Name.name``."""
    found = set()
    for door in DOORS:
        home = door.__name__.removeprefix("geokit.")
        left_out = " ".join(table.get(home, "") for table in (RESULTS, RECORDS, OTHERS)).split()
        for name in door.__all__:
            entry = getattr(door, name)
            if name in left_out:
                continue
            found.add(f"{home}.{name}")
            if inspect.isclass(entry):
                methods = [m for m, f in inspect.getmembers(entry, callable) if not m.startswith("_")]
                found |= {f"{home}.{name}.{method}" for method in methods}
    return found
