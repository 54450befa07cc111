"""Shared setup of the charts of a mesh: queries, and the rows that are checked."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.running import without_warnings

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.mesh.surfaces.surface import Surface
    from geokit.volume.model.sparse_volume import SparseVolume

Floats = NDArray[np.float64]

# Seed of every random choice: two runs use the same queries.
SEED = 17
# Queries of a timed call, in a quick chart and in a full one: 1 to 50 ms, and up to 300 ms, on two cores; more on a
# GPU, where launch overhead would dominate otherwise.
COUNTS = {"cpu": (20_000, 100_000), "cuda": (1_000_000, 4_000_000)}
# Budget of pairs of a query and a triangle for the references of a chart. A pair takes 10 ns where bounding spheres
# rule out most triangles, and ten times that where all solid angles are summed: such references check fewer queries,
# and two charts share them.
QUICK_PAIRS = 20_000_000
PAIRS = 100_000_000
SOLID_ANGLE = 4
# Least and greatest number of checked answers.
LEAST, MOST = 32, 4000
# Extent of uniform queries beyond the bounding box of the mesh, and of near queries from its surface [diagonals].
MARGIN = 0.1
NEAR = 0.01
# Half width of level sets [voxels] where a chart does not vary it: the default of from_mesh.
HALF_WIDTH = 3.0


class Queries(NamedTuple):
    """Points (N, 3) [world], and the rows that are checked."""

    points: Floats
    rows: NDArray[np.int64]

    @property
    def checked(self) -> Floats:
        """The checked points."""
        return self.points[self.rows]


class MeshSetup:
    """A mesh on a device, with queries; attributes are computed on first access.

    Args:
        mesh: The triangles.
        device: Where the methods run.
        quick: Use fewer queries.
    """

    def __init__(self, mesh: TriangleMesh, device: Any, quick: bool) -> None:
        self.mesh, self.device, self.quick = mesh, device, quick
        self.size = mesh.diagonal
        self.count = COUNTS["cuda" if str(device).startswith("cuda") else "cpu"][0 if quick else 1]

    @cached_property
    def surface(self) -> Surface:
        """The mesh prepared for queries."""
        from geokit.mesh.surfaces.surface import Surface

        return Surface(self.mesh, device=self.device)

    @cached_property
    def is_closed(self) -> bool:
        """Whether every edge is traversed equally often in both directions: winding numbers are then whole."""
        ends = np.concatenate([np.roll(self.mesh.faces, -k, axis=1)[:, :2] for k in range(3)]).astype(np.int64)
        ways, counts = np.unique(ends @ [len(self.mesh.vertices), 1], return_counts=True)
        back = ways % len(self.mesh.vertices) * len(self.mesh.vertices) + ways // len(self.mesh.vertices)
        order = np.argsort(back)
        return np.array_equal(ways, back[order]) and np.array_equal(counts, counts[order])

    @cached_property
    def oriented(self) -> TriangleMesh:
        """The mesh with faces wound outward, for which the reference computes winding numbers."""
        if self.is_closed and self.surface.orientation == 1:
            return self.mesh
        from geokit.mesh._repair import orient

        return orient(self.mesh).mesh

    def beside(self, count: int, share: float, length: float, seed: int) -> Floats:
        """Points [world] up to a share of a length from the surface, along the normals."""
        rng = np.random.default_rng(seed)
        points, face = area_samples(self.mesh, count, rng)
        offset = rng.uniform(-share, share, (count, 1)) * length
        return points + offset * reference.face_normals(self.mesh.vertices, self.mesh.faces)[face]

    def shared(self, share: float) -> float:
        """A length as a share of the diagonal, rounded to three digits so that a reader can reproduce a setting."""
        return float(f"{share * self.size:.3g}")

    def checked_count(self, weight: int = 1) -> int:
        """Number of checked answers if a pair of a query and a triangle costs ``weight`` times the usual."""
        pairs = (QUICK_PAIRS if self.quick else PAIRS) // weight
        return min(max(pairs // len(self.mesh.faces), LEAST), MOST, self.count)

    def rows(self, weight: int = 1) -> NDArray[np.int64]:
        """Rows of the checked queries, ascending."""
        chosen = np.random.default_rng(SEED).choice(self.count, self.checked_count(weight), replace=False)
        return np.sort(chosen)

    def uniform(self, weight: int = 1) -> Queries:
        """Points anywhere in the bounding box of the mesh and slightly beyond."""
        lower, upper = self.mesh.bounds
        margin = MARGIN * self.size
        points = np.random.default_rng(SEED + 1).uniform(lower - margin, upper + margin, (self.count, 3))
        return Queries(points, self.rows(weight))

    def near(self, weight: int = 1) -> Queries:
        """Points up to a hundredth of the diagonal from the surface, along the normals."""
        return Queries(self.beside(self.count, NEAR, self.size, SEED + 2), self.rows(weight))

    def mixed(self, weight: int = 1) -> Queries:
        """Uniform and near points, alternating."""
        uniform, near = self.uniform(weight), self.near(weight)
        return Queries(np.where(np.arange(self.count)[:, None] % 2 == 0, uniform.points, near.points), uniform.rows)

    def level_set(self, voxel_size: float, *, half_width: float = HALF_WIDTH, method: str = "geokit") -> SparseVolume:
        """geokit's level set of the mesh; warnings about thin components are dropped, as the charts show them."""
        from geokit.volume.distance_fields.from_mesh import from_mesh

        options: dict[str, Any] = {"half_width": half_width, "method": method, "device": self.device}
        return without_warnings(lambda: from_mesh(self.surface, voxel_size, **options))


def area_samples(mesh: TriangleMesh, count: int, rng: np.random.Generator) -> tuple[Floats, NDArray[np.int64]]:
    """Points (N, 3) uniform by area, and their faces (N,)."""
    from geokit.mesh._sample_surface import sample_surface

    found = sample_surface(mesh, count, seed=int(rng.integers(1 << 62)))
    return found.points, found.triangle_id.astype(np.int64)
