"""Shared setup of the charts of a mesh: queries, and the rows that are checked."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.charts.volume_setup import area_samples
from geokit.accuracy.reference import mesh as reference

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.mesh.surfaces.surface import Surface

__all__ = ["MeshSetup", "Queries"]

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
        rng = np.random.default_rng(SEED + 2)
        points, face = area_samples(self.mesh, self.count, rng)
        offset = rng.uniform(-NEAR, NEAR, (self.count, 1)) * self.size
        return Queries(
            points + offset * reference.face_normals(self.mesh.vertices, self.mesh.faces)[face], self.rows(weight)
        )

    def mixed(self, weight: int = 1) -> Queries:
        """Uniform and near points, alternating."""
        uniform, near = self.uniform(weight), self.near(weight)
        return Queries(np.where(np.arange(self.count)[:, None] % 2 == 0, uniform.points, near.points), uniform.rows)
