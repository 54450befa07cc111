"""Chooses the voxel sizes of an adaptive field's levels for the least memory.

A ladder is a sequence of voxel sizes that halve from level to level. The choice is an order of interpolation, a ladder,
and the level to begin at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geokit.core.memory import available_memory
from geokit.volume.adaptive.cells import CellLattice, contains, near_cells
from geokit.volume.adaptive.refine import FLOAT, LEAF, Refinement, grid_bytes
from geokit.volume.adaptive.storage import ACCEPTED_SHARE, Storage
from geokit.volume.band.place_keys import keys_of
from geokit.volume.band.tiles import Lattice, near_tiles
from geokit.volume.tolerance.interpolation_errors import REACH

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.mesh.surfaces.surface import Surface

# Orders of interpolation in the order of trial. Order 3 is mostly the best, and its bytes end the exploration of the
# other early. Order 2 has the reach of order 3 and larger errors; it was never the best.
ORDERS = (3, 1)
# Coarsest cells of a ladder, counted along the longest edge of the mesh's box.
COARSEST_CELLS = 12
# A cell's indices and key, and their copies while cells near the mesh are sought.
BYTES_PER_CELL = 64
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
# The prediction is rough, so sizes on either side are tried as well if the predicted one is better.
NEARBY = (2.0 ** (-1.0 / 16.0), 2.0 ** (1.0 / 16.0))
# Least share of the area on axis-aligned planes for a mesh to count as drawn on a lattice.
PLANE_SHARE = 0.25
# Planes, or a vertex and a plane, closer than this share of the box coincide: float32 meshes round coordinates.
SAME_PLANE = 1e-6
# A lattice through all planes is of no use if its voxels are smaller than this multiple of the limit.
SMALLEST_STEP = 3.0


class Choice(NamedTuple):
    """The levels of least memory.

    Attributes:
        tree: The cells to refine; None if all levels take too many bytes. If no levels keep the tolerance,
            ``tree.worst`` is above it.
        byte_count: Predicted size of all grids; infinite if no levels keep the tolerance.
    """

    tree: Refinement | None
    byte_count: float


def choose(
    surface: Surface, sign: str, storages: Sequence[Storage], level_limit: int, most_bytes: float = math.inf
) -> Choice:
    """The refinement of least memory among some orders, ladders of voxel sizes, and all levels to begin at.

    The error in a cell on a crease is proportional to its size. So the errors of one ladder predict about how many
    cells of another would be refined, and the ladders around the most promising one are tried as well. For parts drawn
    on a lattice, the only ladder tried is the one whose voxels lie on their faces, because straight edges have no error
    there at order 1.

    Args:
        surface: Surface of the distances.
        sign: Sign method.
        storages: Orders and codecs to choose from, of one tolerance.
        level_limit: Most levels.
        most_bytes: Levels that take more are of no use. Their exploration ends when that is known.
    Raises:
        DeviceMemoryError: There are more cells than memory can hold.
    """
    made: list[_Ladder] = []

    def least() -> float:
        return min([most_bytes, *(ladder.byte_count for ladder in made)])

    def explore(storage: Storage, size: float) -> None:
        made.append(_Ladder(_coarsest(surface, sign, storage.within, size), storage, level_limit, least()))

    limit = ACCEPTED_SHARE * storages[0].tolerance
    step = common_step(surface.mesh)
    drawn = step is not None and step >= SMALLEST_STEP * limit
    for storage in storages:
        explore(storage, step if drawn and step else FIRST_SIZE * limit)
    best = min(made, key=lambda ladder: (ladder.byte_count, ladder.is_ended, ladder.tree.worst))
    if best.byte_count < most_bytes and not drawn and (factor := best.better_factor()) != 1.0:
        explore(best.tree.storage, factor * best.size)
        if made[-1].byte_count < best.byte_count:
            for nearby in NEARBY:
                explore(best.tree.storage, factor * nearby * best.size)
        best = min(made, key=lambda ladder: ladder.byte_count)
    if best.byte_count < most_bytes:
        return Choice(best.from_start(), best.byte_count)
    return Choice(best.tree if best.tree.worst > best.tree.storage.tolerance else None, math.inf)


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


def band_lattice(lattice: CellLattice, order: int = 1) -> Lattice:
    """The lattice of level 0, with all voxels that interpolation of an order within the zone needs."""
    reach = float(np.float32(lattice.within + REACH[order] * lattice.size))
    # Index 0 is where the band begins, so that the band fills the fewest nodes.
    start = np.floor((lattice.surface.bounds[0] - reach - lattice.origin) / lattice.size)
    return Lattice(lattice.surface, lattice.size, reach, translation=lattice.positions(start))


def _coarsest(surface: Surface, sign: str, within: float, size: float) -> CellLattice:
    """The coarsest lattice that resolves the mesh's shape, with voxels of ``size`` times a power of two.

    The box of the mesh begins at one of its voxels, and cells near the mesh have no negative index.
    """
    longest = float((surface.bounds[1] - surface.bounds[0]).max())
    size *= 2.0 ** np.floor(np.log2(longest / (COARSEST_CELLS * size)))
    # Whatever the mesh, the zone around it is no smaller than a ball.
    with np.errstate(over="ignore"):
        need = 4.18 * (within / size) ** 3 * BYTES_PER_CELL
    what = f"within: the cells within {within:.3g} of the mesh need"
    available_memory.require_room(need, what, "use a smaller within (its default is the tolerance)")
    margin = np.ceil(within / size) + 3.0
    return CellLattice(surface, sign, surface.bounds[0] - margin * size, size, within)


class _Ladder:
    """A refinement over a whole ladder of sizes, with the level to begin at that takes the fewest bytes.

    ``byte_count`` is infinite if all take more than ``most_bytes``, or if no level keeps the tolerance; ``is_ended``
    tells that the exploration ended early because of the former.
    """

    def __init__(self, lattice: CellLattice, storage: Storage, level_limit: int, most_bytes: float) -> None:
        self.size = lattice.size
        self.level_limit = level_limit
        self.start, self.byte_count, self.is_ended = 0, math.inf, False
        self.finer: list[int] = []

        # Bytes of the bands of the levels that are coarse enough to begin at.
        bands: list[float] = []

        def band_of(number: int) -> None:
            level = self.tree.lattice_of(number)
            # A surface meets a leaf for each 8 x 8 voxels of its area, so finer levels cannot take fewer bytes.
            least = _area(level) / (LEAF * level.size) ** 2 * storage.leaf_bytes(level.size)
            bands.append(_band_bytes(level, storage) if least <= most_bytes else math.inf)

        def goes_on(number: int) -> bool:
            self.finer.append(self.tree.placement(number).byte_count)
            band_of(number)
            # Whatever finer levels take: beginning at one of these takes at least this much, and beginning later more.
            least = min(bands[start] + sum(self.finer[start:]) for start in range(number + 1))
            self.is_ended = least > most_bytes
            return not self.is_ended

        self.tree = Refinement(lattice, storage, MOST_LEVELS, errors=[], goes_on=goes_on)
        band_of(0)
        self.tree.explore(0, near_cells(lattice))
        if self.is_ended or self.tree.worst > storage.tolerance:
            return
        for start in range(max(0, self.tree.level_count - level_limit), self.tree.level_count):
            total = bands[start] + sum(self.finer[start:])
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
            for level, (errors, keys, size) in enumerate(
                zip(self.tree.errors[start:], self.tree.refined[start:], self.finer[start:], strict=False), start
            ):
                voxel = self.tree.lattice_of(level).size
                count = np.count_nonzero(errors * factor > self.tree.storage.limit(factor * voxel))
                total += head + (size - head) * count / len(keys) / factor if count else 0.0
            predicted[factor] = total
        best = min(predicted, key=lambda factor: predicted[factor])
        return best if predicted[best] < WORTH_ANOTHER * self.byte_count else 1.0

    def from_start(self) -> Refinement:
        """The refinement that begins where it takes the fewest bytes."""
        tree, start = self.tree, self.start
        chosen = Refinement(tree.lattice_of(start), tree.storage, self.level_limit, tree.refined[start:])
        if start:
            # Cells whose coarser parents kept the limit have not been examined yet.
            cells = near_cells(chosen.lattice)
            chosen.explore(0, cells[~contains(tree.refined[start - 1], keys_of(cells >> 1))])
        return chosen


def _area(lattice: CellLattice) -> float:
    scale = lattice.surface._frame.scale
    return Lattice(lattice.surface, lattice.size, lattice.size).area() * scale**2


def _band_bytes(lattice: CellLattice, storage: Storage) -> int:
    tiles = near_tiles(band_lattice(lattice, storage.order))
    coordinates = tiles.coordinates.numpy()[: len(tiles.keys)].astype(np.int64)
    return grid_bytes(coordinates, storage.leaf_bytes(lattice.size))
