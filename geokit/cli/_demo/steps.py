"""The steps of the demo and their log: each is timed, then compared with an independent float64 reference."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.reference.points import neighbors_within
from geokit.accuracy.reference.volume import Voxels
from geokit.accuracy.report.table import write_rows
from geokit.cli._demo.input import Camera, camera_rays, points_on
from geokit.cli._program.console import note, step
from geokit.core.files import atomic_path
from geokit.errors import MissingDependencyError
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.volume import from_mesh

if TYPE_CHECKING:
    from geokit.mesh import RayHits, Surface
    from geokit.volume.model.sparse_volume import SparseVolume

POINT_COUNT = 1_000_000
EXPORTED_COUNT = 200_000
CLOUD_COUNT = 200_000
IMAGE_SIZE = (640, 480)
# Number of queries that are checked by brute force, at a few milliseconds each.
CHECKED = 300
# Number of voxels along the longest side.
RESOLUTION = 160
CHART_RESOLUTIONS = (32, 48, 64, 96, 128, 192)
CHART_POINTS = 200_000
# The search radius is chosen for this mean number of neighbors.
NEIGHBORS = 30
HALF_WIDTH = 3.0
# The figure of the slice uses a wider band in larger voxels.
SLICE_RESOLUTION = 96
SLICE_HALF_WIDTH = 10.0

COLUMNS = ("step", "count", "items", "seconds", "rate [1/s]", "largest error", "reference")


class Projection(NamedTuple):
    """Closest points of random queries: queries (N, 3), points (N, 3), distance (N,) and triangle_id (N,)."""

    queries: NDArray[np.float64]
    points: NDArray[np.float64]
    distance: NDArray[np.float64]
    triangle_id: NDArray[np.int32]


class Neighborhood(NamedTuple):
    """A point cloud (N, 3), and for each point the number of its neighbors, counts (N,)."""

    points: NDArray[np.float64]
    counts: NDArray[np.int32]


@dataclass(frozen=True)
class AccuracyPoint:
    """Cost and error of an SDF with one voxel size."""

    voxel_size: float
    active_voxels: int
    build_seconds: float
    sample_seconds: float
    largest_error: float
    rms_error: float


def warm_up(log: DemoLog, surface: "Surface", device: Any) -> None:
    """Load every kernel, so that the rates below do not include the cost of first calls."""
    from geokit.points import NeighborGrid

    with log.step("load the kernels", "calls") as entry:
        # Enough queries that they are sorted, as in the steps below.
        few = surface.mesh.vertices[np.arange(4096) % len(surface.mesh.vertices)]
        surface.signed_distance(few)
        surface.raycast(few, np.ones_like(few))
        coarse = from_mesh(surface, surface.mesh.diagonal / 16.0)
        coarse.sample(few, device=device)
        coarse.sample(few, order=0, device=device)
        coarse.gradient(few, device=device)
        grid = NeighborGrid(few, surface.mesh.diagonal / 100.0, device=device)
        grid.radius_search(few[:16])
        grid.count(few)
        entry.count = 8


def build_volume(log: DemoLog, surface: "Surface", device: Any) -> "SparseVolume":
    mesh = surface.mesh
    voxel_size = _voxel_size(mesh, RESOLUTION)
    with log.step("narrow-band SDF", "active voxels") as entry:
        volume = from_mesh(surface, voxel_size, half_width=HALF_WIDTH)
        entry.count = volume.info.active_voxel_count or 0
    positions = _stored_positions(volume)
    stored = np.asarray(volume.sample(positions, order=0, device="cpu"))
    band = np.flatnonzero(np.abs(stored) < abs(volume.info.background))
    some = np.random.default_rng(1).permutation(band)[:CHECKED]
    exact = reference.closest_point(mesh.vertices, mesh.faces, positions[some]).distance
    entry.error = float(np.abs(np.abs(stored[some]) - exact).max())
    entry.reference = f"brute force at {len(some)} voxels [world]"
    return volume


def build_wide_volume(surface: "Surface") -> "SparseVolume":
    """Build an SDF with a wider band in larger voxels, for the figure of the slice."""
    return from_mesh(surface, _voxel_size(surface.mesh, SLICE_RESOLUTION), half_width=SLICE_HALF_WIDTH)


def _voxel_size(mesh: TriangleMesh, resolution: int) -> float:
    return float((mesh.bounds[1] - mesh.bounds[0]).max()) / resolution


def _stored_positions(volume: "SparseVolume") -> NDArray[np.float64]:
    """Centers [world] of all voxels that the buffer stores, active or not."""
    voxels: Any = volume.on("cpu").get_voxels()
    indices = voxels.numpy().astype(np.float64)
    return indices @ volume.info.transform[:3, :3].T + volume.info.transform[:3, 3]


def save_and_reload(log: DemoLog, volume: "SparseVolume", folder: Path) -> "SparseVolume":
    """Write both formats and read them back; returns the grid read through OpenVDB if that is available."""
    from geokit.volume import load, save

    reloaded = volume
    for extension, reader in (("nvdb", "geokit's reader"), ("vdb", "OpenVDB, NanoVDB, warp")):
        path = folder / f"sdf.{extension}"
        try:
            with log.step(f"save .{extension}", "active voxels") as entry:
                save(path, volume)
                entry.count = volume.info.active_voxel_count or 0
            with log.step(f"read .{extension} back", "active voxels") as entry:
                reloaded = load(path)
                entry.count = reloaded.info.active_voxel_count or 0
        except MissingDependencyError as error:
            log.leave_out(f".{extension} round trip", "active voxels", str(error))
            continue
        entry.error = _difference(volume, reloaded)
        entry.reference = f"every voxel as written ({reader})"
    return reloaded


def _difference(first: "SparseVolume", second: "SparseVolume") -> float:
    """Largest difference over all voxels that either grid stores; inf if transforms or active voxels differ."""
    here, there = first.info, second.info
    same = (
        np.array_equal(here.transform, there.transform)
        and np.array_equal(np.asarray(here.index_bounds), np.asarray(there.index_bounds))
        and here.active_voxel_count == there.active_voxel_count
        and here.background == there.background
    )
    if not same:
        return float("inf")
    worst = 0.0
    for positions in (_stored_positions(first), _stored_positions(second)):
        values = [np.asarray(volume.sample(positions, order=0, device="cpu")) for volume in (first, second)]
        worst = max(worst, float(np.abs(values[0] - values[1]).max()))
    return worst


def project_points(log: DemoLog, surface: "Surface") -> Projection:
    mesh = surface.mesh
    random = np.random.default_rng(2)
    margin = 0.1 * mesh.diagonal
    queries = random.uniform(mesh.bounds[0] - margin, mesh.bounds[1] + margin, (POINT_COUNT, 3))
    with log.step("project points", "points") as entry:
        found: Any = surface.closest_point(queries)
        entry.count = len(queries)
    expected = reference.closest_point(mesh.vertices, mesh.faces, queries[:CHECKED]).distance
    entry.error = float(np.abs(found.distance[:CHECKED] - expected).max())
    entry.reference = f"brute force of {CHECKED} [world]"
    return Projection(queries, found.points, found.distance, found.triangle_id)


def cast_image(log: DemoLog, surface: "Surface") -> tuple[Camera, "RayHits"]:
    camera = camera_rays(surface.mesh, *IMAGE_SIZE)
    with log.step(f"cast {camera.width} x {camera.height} rays", "rays") as entry:
        hits = surface.raycast(camera.origins, camera.directions)
        entry.count = len(camera.origins)
    # Check as many hits as misses, spread over the picture.
    random = np.random.default_rng(3)
    is_hit = np.asarray(hits.triangle_id) >= 0
    some = np.concatenate([random.permutation(np.flatnonzero(mask))[: CHECKED // 2] for mask in (is_hit, ~is_hit)])
    mesh = surface.mesh
    expected = reference.first_hit(mesh.vertices, mesh.faces, camera.origins[some], camera.directions[some]).t
    both = np.isfinite(expected) & np.isfinite(hits.t[some])
    disagree = np.isfinite(expected) != np.isfinite(hits.t[some])
    entry.error = float("inf") if disagree.any() else float(np.abs(expected[both] - hits.t[some][both]).max())
    entry.reference = f"brute force of {len(some)}, hits and misses alike [world]"
    return camera, hits


def sample_volume(log: DemoLog, surface: "Surface", volume: "SparseVolume", device: Any) -> None:
    random = np.random.default_rng(4)
    reach = float(volume.info.voxel_size.min())
    queries = points_on(surface.mesh, POINT_COUNT, random) + random.uniform(-reach, reach, (POINT_COUNT, 3)) / np.sqrt(
        3.0
    )
    with log.step("sample the SDF", "points") as entry:
        values = np.asarray(volume.sample(queries, device=device))
        entry.count = len(queries)
    few, voxels = queries[:CHECKED], Voxels(volume)
    entry.error = float(np.abs(values[:CHECKED] - voxels.sample(few, order=1)).max())
    entry.reference = f"float64 trilinear of {CHECKED} [world]"
    with log.step("sample its gradient", "points") as entry:
        gradients = np.asarray(volume.gradient(queries, device=device))
        entry.count = len(queries)
    entry.error = float(np.abs(gradients[:CHECKED] - voxels.gradient(few, order=1)).max())
    entry.reference = f"float64 trilinear of {CHECKED} [world per world]"


def find_neighbors(log: DemoLog, mesh: TriangleMesh, device: Any) -> Neighborhood:
    from geokit.points import NeighborGrid

    random = np.random.default_rng(5)
    cloud = points_on(mesh, CLOUD_COUNT, random, by_area=False)
    radius = float(np.sqrt(NEIGHBORS * mesh.area / (np.pi * len(cloud))))
    with log.step("neighbors of a cloud", "queries") as entry:
        grid = NeighborGrid(cloud, radius, device=device)
        found = grid.radius_search(cloud)
        entry.count = len(cloud)
    worst = 0.0
    for query, indices in enumerate(neighbors_within(cloud, cloud[:CHECKED], radius)):
        distances = np.linalg.norm(cloud[indices] - cloud[query], axis=1)
        row = slice(int(found.offsets[query]), int(found.offsets[query + 1]))
        order = np.argsort(found.indices[row], kind="stable")
        same = np.array_equal(found.indices[row][order], indices)
        worst = max(worst, float(np.abs(found.distance[row][order] - distances).max()) if same else float("inf"))
    entry.error = worst
    entry.reference = f"brute force of {CHECKED}: same sets, distance [world]"
    return Neighborhood(cloud, np.diff(found.offsets).astype(np.int32))


def extract_surface(
    log: DemoLog, surface: "Surface", volume: "SparseVolume"
) -> tuple[TriangleMesh, NDArray[np.float64]]:
    """Mesh the SDF's zero level; also return the distance of each vertex from the original mesh.

    Without OpenVDB, return the original mesh with the absolute SDF values at its vertices.
    """
    from geokit.mesh import from_volume

    try:
        with log.step("mesh the SDF", "faces") as entry:
            mesh = from_volume(volume)
            entry.count = len(mesh.faces)
    except MissingDependencyError as error:
        log.leave_out("mesh the SDF", "faces", str(error))
        return surface.mesh, np.abs(np.asarray(volume.sample(surface.mesh.vertices)))
    distance = np.asarray(surface.closest_point(mesh.vertices).distance)
    entry.error = float(distance.max())
    entry.reference = "exact distance to the original [world]"
    return mesh, distance


def export(log: DemoLog, surface: "Surface", volume: "SparseVolume", projection: Projection, folder: Path) -> None:
    from geokit.mesh import load, save
    from geokit.points import load as load_points
    from geokit.points import save as save_points

    path = folder / "points.vtp"
    with log.step("export points.vtp", "points") as entry:
        queries, distance = projection.queries[:EXPORTED_COUNT], projection.distance[:EXPORTED_COUNT]
        answers: dict[str, Any] = {
            "distance": distance,
            "closest": projection.points[:EXPORTED_COUNT],
            "triangle_id": projection.triangle_id[:EXPORTED_COUNT],
        }
        save_points(path, queries, data=answers)
        entry.count = len(queries)
    read = load_points(path)
    differences = read.points - queries, np.asarray(read.data["distance"], dtype=np.float64) - distance
    entry.error = max(float(np.abs(difference).max()) for difference in differences)
    entry.reference = "read back"

    mesh = surface.mesh
    path = folder / "mesh.vtu"
    sampled = np.asarray(volume.sample(mesh.vertices))
    with log.step("export mesh.vtu", "vertices") as entry:
        data = {"sdf": sampled, "thickness": _thickness(surface)}
        save(path, mesh, point_data=data)
        entry.count = len(mesh.vertices)
    again = load(path)
    same_faces = np.array_equal(again.faces, mesh.faces)
    entry.error = float(np.abs(again.vertices - mesh.vertices).max()) if same_faces else float("inf")
    entry.reference = "read back"


def _thickness(surface: "Surface") -> NDArray[np.float64]:
    """Thickness of the body at each vertex along the inward normal; NaN where the ray hits nothing."""
    mesh = surface.mesh
    normals = mesh.vertex_normals
    inward = np.where(normals.any(axis=1, keepdims=True), -normals, [[0.0, 0.0, 1.0]])
    # Start slightly inside, so that the ray does not hit the faces of its own vertex.
    start = 1e-4 * mesh.diagonal
    t = surface.raycast(mesh.vertices + start * inward, inward).t
    return np.where(np.isfinite(t), t + start, np.nan)


def accuracy_over_voxel_size(log: DemoLog, surface: "Surface", device: Any) -> tuple[list[AccuracyPoint], float]:
    """Errors of trilinear SDF samples near the surface, and the time that exact distances take."""
    mesh = surface.mesh
    random = np.random.default_rng(6)
    reach = 1.5 * _voxel_size(mesh, CHART_RESOLUTIONS[-1])
    offsets = random.uniform(-reach, reach, (CHART_POINTS, 3)) / np.sqrt(3.0)
    queries = points_on(mesh, CHART_POINTS, random) + offsets
    measured = []
    with log.step("accuracy against time", "samples") as entry:
        started = time.perf_counter()
        exact = surface.signed_distance(queries).distance
        exact_seconds = time.perf_counter() - started
        for resolution in CHART_RESOLUTIONS:
            voxel_size = _voxel_size(mesh, resolution)
            started = time.perf_counter()
            volume = from_mesh(surface, voxel_size, half_width=HALF_WIDTH)
            built = time.perf_counter()
            values = np.asarray(volume.sample(queries, device=device))
            sampled = time.perf_counter()
            error = np.abs(values - exact)
            measured.append(
                AccuracyPoint(
                    voxel_size,
                    volume.info.active_voxel_count or 0,
                    built - started,
                    sampled - built,
                    float(error.max()),
                    float(np.sqrt(np.mean(error * error))),
                )
            )
        entry.count = len(CHART_RESOLUTIONS) * CHART_POINTS
    entry.error = measured[-1].largest_error
    entry.reference = f"exact BVH distance, voxel size {measured[-1].voxel_size:.3g} [world]"
    return measured, exact_seconds


@dataclasses.dataclass
class Entry:
    """One row of the closing table.

    Attributes:
        step: Name of the step.
        items: Kind of items that were processed.
        count: Number of items.
        seconds: Wall time of the step alone, without its reference.
        error: Largest deviation from the reference; None if nothing was compared.
        reference: The reference of the comparison.
        left_out: Reason why the step did not run, or "".
    """

    step: str
    items: str
    count: int = 0
    seconds: float = 0.0
    error: float | None = None
    reference: str = ""
    left_out: str = ""

    def cells(self) -> tuple[str, ...]:
        if self.left_out:
            return (self.step, "", self.items, "", "", "", f"left out: {self.left_out.partition(' (')[0]}")
        rate = self.count / self.seconds if self.seconds > 0.0 else 0.0
        error = "" if self.error is None else ("0 (bit for bit)" if self.error == 0.0 else f"{self.error:.2e}")
        return (self.step, f"{self.count:,}", self.items, f"{self.seconds:.3f}", _short(rate), error, self.reference)


class DemoLog:
    """Collects entries and shows each step while it runs."""

    def __init__(self, *, quiet: bool) -> None:
        self.entries: list[Entry] = []
        self.quiet = quiet

    @contextlib.contextmanager
    def step(self, title: str, items: str) -> Iterator[Entry]:
        entry = Entry(title, items)
        with step(title, quiet=self.quiet, lines=True) as shown:
            started = time.perf_counter()
            yield entry
            entry.seconds = time.perf_counter() - started
            shown.result = f"{entry.count:,} {items}"
        self.entries.append(entry)

    def leave_out(self, title: str, items: str, reason: str) -> None:
        self.entries.append(Entry(title, items, left_out=reason))
        if not self.quiet:
            note(f"{title}: left out: {reason.partition(' (')[0]}; geokit doctor says more")

    def write(self, folder: Path) -> None:
        """Write the table as summary.csv, with plain numbers, and as summary.md."""
        names = [field.name for field in dataclasses.fields(Entry)]
        write_rows(folder / "summary.csv", names, map(dataclasses.astuple, self.entries))
        lines = ["| " + " | ".join(COLUMNS) + " |", "|---|---:|---|---:|---:|---:|---|"]
        lines += ["| " + " | ".join(entry.cells()) + " |" for entry in self.entries]
        with atomic_path(folder / "summary.md") as part:
            part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _short(rate: float) -> str:
    for size, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if rate >= size:
            return f"{rate / size:.3g}{suffix}"
    return f"{rate:.3g}"
