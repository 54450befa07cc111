"""Chooses the voxel sizes of an adaptive field's levels for the least memory.

A ladder is a sequence of voxel sizes that halve from level to level. The choice is a ladder and the level to begin at.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.volume.adaptive.cells import CellLattice, contains, keys_of, near_cells
from geokit.volume.adaptive.level_placement import FLOAT, LEAF, float_grid_bytes
from geokit.volume.adaptive.refine import Refinement
from geokit.volume.band.tiles import Lattice, near_tiles

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh
    from geokit.mesh._surface import Surface

__all__ = ["band_lattice", "choose"]

# Coarsest cells of a ladder, counted along the longest edge of the mesh's box.
COARSEST_CELLS = 12
# Levels of a ladder, from the coarsest down to 2^-20 of the box, where indices end.
MOST_LEVELS = 16
# Cells on a right-angled crease exceed the limit from about this multiple of it on.
FIRST_SIZE = 3.0
# Factors on a ladder's sizes that are considered; a factor of 2 would give the same ladder again.
FACTORS = tuple(2.0 ** (step / 8.0) for step in (-4, -3, -2, -1, 1, 2, 3))
# Further ladders take as long as the first. They are tried if they promise less than this share of its bytes, and if
# the first ladder had at most this many cells, which take some seconds.
WORTH_ANOTHER = 0.95
CELLS_WORTH_ANOTHER = 1 << 20
# The prediction is rough, so sizes on either side of the best are tried as well.
NEARBY = (2.0 ** (-1.0 / 16.0), 1.0, 2.0 ** (1.0 / 16.0))
# Least share of the area on axis-aligned planes for a mesh to count as drawn on a lattice.
PLANE_SHARE = 0.25
# Planes, or a vertex and a plane, closer than this share of the box coincide: float32 meshes round coordinates.
SAME_PLANE = 1e-6
# A lattice through all planes is of no use if its voxels are smaller than this multiple of the limit.
SMALLEST_STEP = 3.0


def choose(surface: Surface, sign: str, within: float, limit: float, level_limit: int) -> Refinement:
    """The refinement of least memory among some ladders of voxel sizes and all levels to begin at.

    The error in a cell on a crease is proportional to its size. So the errors of one ladder predict about how many
    cells of another would be refined, and the ladders around the most promising one are tried as well. For parts drawn
    on a lattice, the only ladder tried is the one whose voxels lie on their faces, because straight edges have no error
    there.

    Args:
        surface: Surface of the distances.
        sign: Sign method.
        within: Distance [world] from the surface up to which errors count.
        limit: Cells with a larger error [world] are refined.
        level_limit: Most levels.
    Raises:
        DeviceMemoryError: There are more cells than memory can hold.
    """

    def ladder(size: float) -> _Ladder:
        return _Ladder(_coarsest(surface, sign, within, size), limit, level_limit)

    step = common_step(surface.mesh)
    if step is not None and step >= SMALLEST_STEP * limit:
        return ladder(step).from_start()
    first = ladder(FIRST_SIZE * limit)
    factor = first.better_factor()
    if factor == 1.0:
        return first.from_start()
    others = [ladder(factor * nearby * first.size) for nearby in NEARBY]
    return min([first, *others], key=lambda made: made.byte_count).from_start()


def common_step(mesh: TriangleMesh) -> float | None:
    """The largest common step [world] from the lower corner of the mesh's box to all its axis-aligned planes.

    None if there are few such planes, or if they have no step in common.
    """
    corners = mesh.vertices[mesh.faces] - mesh.bounds[0]
    longest = float((mesh.bounds[1] - mesh.bounds[0]).max())
    near = SAME_PLANE * longest
    flat = np.ptp(corners, axis=1) <= near
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if area[flat.any(axis=1)].sum() < PLANE_SHARE * area.sum():
        return None
    step = longest
    for axis in range(3):
        for place in np.unique(np.round(corners[flat[:, axis], 0, axis] / near)) * near:
            a, b = step, float(place)
            while b > 4.0 * near:
                a, b = b, abs(a - b * np.round(a / b))
            step = a
    # Planes are rounded, so the step is slightly off; the returned step divides the box's edge exactly.
    return None if step < longest * np.sqrt(SAME_PLANE) else float(longest / np.round(longest / step))


def band_lattice(lattice: CellLattice) -> Lattice:
    """The lattice of level 0, with all voxels that interpolation within the zone needs."""
    reach = float(np.float32(lattice.within + np.sqrt(3.0) * lattice.size))
    # Index 0 is where the band begins, so that the band fills the fewest nodes.
    start = np.floor((lattice.surface.bounds[0] - reach - lattice.origin) / lattice.size)
    return Lattice(lattice.surface, lattice.size, reach, translation=lattice.positions(start))


def _coarsest(surface: Surface, sign: str, within: float, size: float) -> CellLattice:
    """The coarsest lattice that resolves the mesh's shape, with voxels of ``size`` times a power of two.

    The box of the mesh begins at one of its voxels, and cells near the mesh have no negative index.
    """
    longest = float((surface.bounds[1] - surface.bounds[0]).max())
    size *= 2.0 ** np.floor(np.log2(longest / (COARSEST_CELLS * size)))
    margin = np.ceil(within / size) + 3.0
    return CellLattice(surface, sign, surface.bounds[0] - margin * size, size, within)


class _Ladder:
    """A refinement over a whole ladder of sizes, with the level to begin at that takes the fewest bytes."""

    def __init__(self, lattice: CellLattice, limit: float, level_limit: int) -> None:
        self.size = lattice.size
        self.level_limit = level_limit
        self.tree = Refinement(lattice, limit, MOST_LEVELS, errors=[])
        self.tree.explore(0, near_cells(lattice))
        self.finer = [placement.byte_count for placement in self.tree.placements()]
        self.start = first = max(0, self.tree.level_count - level_limit)
        self.byte_count = np.inf
        for start in range(first, self.tree.level_count):
            level = self.tree.lattice_of(start)
            # A surface meets a leaf for each 8 x 8 voxels of its area, so finer levels cannot take fewer bytes.
            if self.byte_count < _area(level) / (LEAF * level.size) ** 2 * FLOAT.leaf_size:
                break
            total = _band_bytes(level) + sum(self.finer[start:])
            if total < self.byte_count:
                self.start, self.byte_count = start, total

    def better_factor(self) -> float:
        """The factor on all voxel sizes that promises the least memory; 1 if none promises enough."""
        assert self.tree.errors is not None
        if sum(map(len, self.tree.errors)) > CELLS_WORTH_ANOTHER:
            return 1.0
        start, head = self.start, FLOAT.upper_size
        band = self.byte_count - sum(self.finer[start:])
        predicted = {}
        for factor in FACTORS:
            total = band / factor**2
            for errors, keys, size in zip(
                self.tree.errors[start:], self.tree.refined[start:], self.finer[start:], strict=False
            ):
                count = np.count_nonzero(errors * factor > self.tree.limit)
                total += head + (size - head) * count / len(keys) / factor if count else 0.0
            predicted[factor] = total
        best = min(predicted, key=lambda factor: predicted[factor])
        return best if predicted[best] < WORTH_ANOTHER * self.byte_count else 1.0

    def from_start(self) -> Refinement:
        """The refinement that begins where it takes the fewest bytes."""
        tree, start = self.tree, self.start
        chosen = Refinement(tree.lattice_of(start), tree.limit, self.level_limit, tree.refined[start:])
        if start:
            # Cells whose coarser parents kept the limit have not been examined yet.
            cells = near_cells(chosen.lattice)
            chosen.explore(0, cells[~contains(tree.refined[start - 1], keys_of(cells >> 1))])
        return chosen


def _area(lattice: CellLattice) -> float:
    scale = lattice.surface._frame.scale
    return Lattice(lattice.surface, lattice.size, lattice.size).area() * scale**2


def _band_bytes(lattice: CellLattice) -> int:
    tiles = near_tiles(band_lattice(lattice))
    return float_grid_bytes(_int64(tiles.coordinates.numpy()[: len(tiles.keys)]))


def _int64(numbers: NDArray[np.int32]) -> NDArray[np.int64]:
    return numbers.astype(np.int64)
