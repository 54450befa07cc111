"""Shared setup of the charts of volumes: sizes of the workload, codecs, points near a mesh or near active voxels."""

from __future__ import annotations

import tempfile
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.charts.mesh_setup import MeshSetup, area_samples
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.reference.volume import Voxels
from geokit.errors import UnsupportedGridError
from geokit.volume.nanovdb.types import QUANTIZED

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.volume.model.sparse_volume import SparseVolume

Floats = NDArray[np.float64]

# Codecs that geokit can make. "half" comes from a .vdb file, measured as read back: NanoVDB only has a name for it.
CODECS = ("float", "half", "fp16", "fp8", "fp4", "fpn")
# Codecs of a quick chart that is not about the loss of codecs.
QUICK_CODECS = ("float", "fp8")
# Tolerance for "fpn", as a share of the range of values: between the steps of fp8 (1/255 of a leaf's range) and fp16,
# so that its leaves use different numbers of bits.
FPN_SHARE = 1e-3
# If the winding number is this close to one half, in the opening of an open mesh, no side is right; geokit's own
# winding number is accurate to 0.02.
UNDECIDED = 0.05
# Seed of every random choice: two runs use the same queries.
SEED = 61
# Grid types that quantize can convert to float; values are unchanged, except float64 values that float32 cannot hold.
SOURCES = ("float", "double", *QUANTIZED)


class Effort(NamedTuple):
    """Sizes of the workload, so that a timed call takes 1 to 50 ms in quick charts and up to 300 ms in full ones.

    Attributes:
        queries: Points of a timed call.
        rays: Rays of a timed call.
        checked: Number of answers compared with the reference.
        checked_rays: Number of rays compared; each is marched through the volume.
        divisions: Diagonal over voxel size, ascending.
    """

    queries: int
    rays: int
    checked: int
    checked_rays: int
    divisions: tuple[int, ...]

    @classmethod
    def of(cls, device: Any, quick: bool, triangle_count: int = 0) -> Effort:
        """The workload for a device and a mesh; references compare each answer with each triangle, 3e6 pairs if
        quick."""
        more = 10 if str(device).startswith("cuda") else 1
        pairs, least, most = (3_000_000, 64, 600) if quick else (30_000_000, 256, 2000)
        checked = min(max(pairs // max(triangle_count, 1), least), most)
        if quick:
            return cls(20_000 * more, 10_000 * more, checked, 60, (32, 128))
        return cls(100_000 * more, 100_000 * more, checked, 200, (32, 64, 128, 256))


class Known(NamedTuple):
    """Reference values at M points near a mesh.

    Attributes:
        rows: Their rows among the queries (M,).
        points: Positions [world], shape (M, 3).
        distance: Signed distances [world], shape (M,).
        closest: Closest points [world], shape (M, 3).
        triangle_id: Triangles of the closest points, shape (M,).
    """

    rows: NDArray[np.int64]
    points: Floats
    distance: Floats
    closest: Floats
    triangle_id: NDArray[np.int64]

    def take(self, rows: NDArray[Any]) -> Known:
        return Known(*(np.asarray(column)[rows] for column in self))


class NearSurface(MeshSetup):
    """Points near a mesh and reference values there; computed on first access and shared by the charts of a mesh.

    Args:
        mesh: The triangles.
        device: Where the methods run.
        quick: Use fewer queries.
    """

    def __init__(self, mesh: TriangleMesh, device: Any, quick: bool) -> None:
        super().__init__(mesh, device, quick)
        self.effort = Effort.of(device, quick, len(mesh.faces))
        # Rounded to three digits, so that a reader can reproduce a setting.
        self.voxel_sizes = tuple(float(f"{mesh.diagonal / parts:.3g}") for parts in self.effort.divisions)

    @cached_property
    def points(self) -> Floats:
        """Queries [world] up to half the smallest voxel from the surface, within the band of every grid of the
        charts."""
        return self.beside(self.effort.queries, 0.5, min(self.voxel_sizes), SEED)

    @cached_property
    def known(self) -> Known:
        """Reference values at the rows of the checked points."""
        count = min(self.effort.checked, len(self.points))
        rows = np.sort(np.random.default_rng(SEED + 1).choice(len(self.points), count, replace=False))
        return self.truth(self.points[rows], rows)

    def truth(self, points: Floats, rows: NDArray[np.int64]) -> Known:
        """Closest points and signed distances of the points whose side is unambiguous."""
        mesh = self.oriented
        winding = reference.winding_number(mesh.vertices, mesh.faces, points)
        told = np.abs(winding - 0.5) > UNDECIDED
        closest = reference.closest_point(mesh.vertices, mesh.faces, points[told])
        distance = np.where(winding[told] > 0.5, -closest.distance, closest.distance)
        return Known(rows[told], points[told], distance, closest.points, closest.triangle_id)


def surface_samples(mesh: TriangleMesh, count: int, seed: int) -> Floats:
    """Shuffled points of a surface for measuring its distance from another; half are vertices, which include
    corners."""
    rng = np.random.default_rng(seed)
    used = np.unique(mesh.faces)
    vertices = mesh.vertices[rng.choice(used, min(count // 2, len(used)), replace=False)]
    return rng.permutation(np.concatenate([vertices, area_samples(mesh, count - len(vertices), rng)[0]]))


def known_codecs() -> tuple[str, ...]:
    """The codecs that this build can make: "half" needs OpenVDB."""
    from geokit import native

    return CODECS if native.available() else tuple(codec for codec in CODECS if codec != "half")


def coded(volume: SparseVolume, codec: str, value_range: float) -> SparseVolume:
    """A float grid converted to another codec."""
    if codec == "float":
        return volume
    if codec == "half":
        from geokit.volume._io import load, save

        with tempfile.TemporaryDirectory() as folder:
            save(Path(folder) / "half.vdb", volume, half=True)
            return load(Path(folder) / "half.vdb", trusted=True)
    return volume.quantize(codec, tolerance=FPN_SHARE * value_range if codec == "fpn" else None)


class VolumePoints:
    """Points near the active voxels of a volume, and its interpolants there; attributes are computed on first access.

    Args:
        volume: A scalar grid of floating point or quantized values.
        device: Where the methods run.
        quick: Use fewer queries.
    Raises:
        UnsupportedGridError: The grid is of another type.
    """

    def __init__(self, volume: SparseVolume, device: Any, quick: bool) -> None:
        if volume.info.grid_type not in SOURCES:
            raise UnsupportedGridError(
                f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} has no charts; use one of "
                f"{', '.join(SOURCES)}"
            )
        self.volume = volume if volume.info.grid_type == "float" else volume.quantize("float")
        self.device, self.quick = device, quick
        self.effort = Effort.of(device, quick)
        self.voxels = Voxels(self.volume)
        self.is_level_set = volume.info.grid_class == "level set"
        self.unit = "world" if self.is_level_set else "relative"

    @cached_property
    def active(self) -> NDArray[np.int64]:
        """Active voxels (N, 3), at most as many as queries."""
        return self.voxels.draw_active(self.effort.queries, SEED)

    @cached_property
    def points(self) -> Floats:
        """Queries [world], each at a random position in an active voxel."""
        rng = np.random.default_rng(SEED + 1)
        chosen = self.active[rng.integers(len(self.active), size=self.effort.queries)]
        return self.voxels.to_world(chosen + rng.uniform(-0.5, 0.5, chosen.shape))

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """Rows of the checked points."""
        return np.arange(min(self.effort.checked, len(self.points)))

    @cached_property
    def value_range(self) -> float:
        """Difference between the largest and the least value of those voxels; 1 if they are equal."""
        values = self.voxels(self.active)
        return float(np.ptp(values)) or 1.0

    @property
    def error_scale(self) -> float:
        """Divisor that converts a difference of values to an error in the chart's unit."""
        return 1.0 if self.is_level_set else self.value_range

    @cached_property
    def isovalue(self) -> float:
        """0 of a level set, else the median of the active voxels."""
        return 0.0 if self.is_level_set else float(np.median(self.voxels(self.active)))

    def sampled(self, order: int) -> Floats:
        """The interpolant of an order at the checked points."""
        return self._kept("value", order)

    def gradients(self, order: int) -> Floats:
        """The gradients of the interpolant at the checked points."""
        return self._kept("gradient", order)

    def _kept(self, what: str, order: int) -> Floats:
        known = self._known
        if (what, order) not in known:
            ask = self.voxels.sample if what == "value" else self.voxels.gradient
            known[what, order] = ask(self.points[self.rows], order)
        return known[what, order]

    @cached_property
    def _known(self) -> dict[tuple[str, int], Floats]:
        return {}
