"""Voxel sizes for levels: which ladder of halves, and which of its steps to begin at, for the least memory."""

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

# The coarsest cells that are thought of: so many along the longest edge of the mesh's box.
COARSEST_CELLS = 12
# Levels of a ladder: from there down to 2^-20 of the box, where indices end.
MOST_LEVELS = 16
# Cells on a crease of a right angle miss from about this multiple of the limit on.
FIRST_SIZE = 3.0
# Factors for the sizes of a ladder that are thought of; with 2 it would be the same ladder again.
FACTORS = tuple(2.0 ** (step / 8.0) for step in (-4, -3, -2, -1, 1, 2, 3))
# Further ladders take as long as the first: they must promise this share of its bytes, and the first have had no more
# cells than so many, which take some seconds.
WORTH_ANOTHER = 0.95
CELLS_WORTH_ANOTHER = 1 << 20
# What is promised is rough: sizes on either side of the one that promises most are looked at as well.
NEARBY = (2.0 ** (-1.0 / 16.0), 1.0, 2.0 ** (1.0 / 16.0))
# Of the area of a part that was drawn on a lattice, the share that lies on planes along the axes.
PLANE_SHARE = 0.25
# Planes nearer than this share of the box are one, and so are vertices on a plane: coordinates of float32 meshes.
SAME_PLANE = 1e-6
# A lattice through all planes whose voxels are smaller than this multiple of the limit is of no use.
SMALLEST_STEP = 3.0


def choose(surface: Surface, sign: str, within: float, limit: float, level_limit: int) -> Refinement:
    """The refinement of least memory, of some ladders of voxel sizes and of all levels to begin at.

    The error in a cell on a crease is proportional to its size. So from the errors of one ladder follows about how many
    cells of another would be handed on, and those about the one that promises most are looked at as well. Of a part
    that was drawn on a lattice only the ladder is looked at on whose voxels its faces lie: straight edges cost nothing
    there.

    Args:
        surface: What distances are to.
        sign: How inside is told from outside.
        within: Distance [world] from the surface up to which errors count.
        limit: Error [world] from which on a cell is handed on.
        level_limit: Most levels there may be.
    Raises:
        DeviceMemoryError: There are more cells than can be looked at.
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
    """The largest step [world] from the lower corner of the mesh's box to all its planes along the axes.

    None where there are few such planes, or where they have no step in common.
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
    # Rounded to the nearest plane the step is off by less than that; it must divide the box's edge.
    return None if step < longest * np.sqrt(SAME_PLANE) else float(longest / np.round(longest / step))


def band_lattice(lattice: CellLattice) -> Lattice:
    """The voxels of level 0: all that interpolation within the zone needs."""
    reach = float(np.float32(lattice.within + np.sqrt(3.0) * lattice.size))
    # Index 0 is where the band begins, so that it lies in as few nodes as it can.
    start = np.floor((lattice.surface.bounds[0] - reach - lattice.origin) / lattice.size)
    return Lattice(lattice.surface, lattice.size, reach, translation=lattice.positions(start))


def _coarsest(surface: Surface, sign: str, within: float, size: float) -> CellLattice:
    """The lattice whose voxels are a power of two times ``size``, the largest that tell the shape of the mesh.

    The box of the mesh begins at one of its voxels, and no index that a cell near it may have is negative.
    """
    longest = float((surface.bounds[1] - surface.bounds[0]).max())
    size *= 2.0 ** np.floor(np.log2(longest / (COARSEST_CELLS * size)))
    margin = np.ceil(within / size) + 3.0
    return CellLattice(surface, sign, surface.bounds[0] - margin * size, size, within)


class _Ladder:
    """A refinement from its coarsest level on, and the bytes that it takes from each level on."""

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
            # A surface meets a leaf for each 8 x 8 voxels of its area: no need to count those of ever finer ones.
            if self.byte_count < _area(level) / (LEAF * level.size) ** 2 * FLOAT.leaf_size:
                break
            total = _band_bytes(level) + sum(self.finer[start:])
            if total < self.byte_count:
                self.start, self.byte_count = start, total

    def better_factor(self) -> float:
        """The factor for all voxel sizes that promises the least memory; 1 where none promises much."""
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
            # What lies in cells that were right before has not been looked at by cells of this size.
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
