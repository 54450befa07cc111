"""Finds the tiles of 8^3 voxels that a band around a surface may touch, in the order of a grid's leaves."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory import available_memory
from geokit.core.memory.unchecked import allocating, sort_pairs
from geokit.core.scan import gathered, prefix_sum
from geokit.errors import DeviceMemoryError
from geokit.volume.band.lattice_origin import index_translation

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

# Most tiles along an axis: they fit into 2^12 upper nodes of 512 tiles wherever the first starts. A key has 12 bits for
# an upper node's coordinate.
MOST_TILES = (1 << 21) - 1024
# Voxels along an edge of a tile.
TILE_VOXELS = 8
# Most cells from which the search starts; testing so few is cheap. A GPU takes 220 us for the 30,000 tiles of a box at
# 256^3; starting from a fifth as many cells, with one more halving, took 590.
START_CELLS_CPU, START_CELLS_CUDA = 1 << 13, 1 << 16
# A leaf of a float grid in NanoVDB: 512 values, a mask and extrema.
LEAF_BYTES = 2144
# Bytes of a tile besides its leaf while the band is built: distances, and bit masks and links of the signs.
WORKING_BYTES = 512 * 4 + 512
# The voxels of all leaves are counted in 31 bits: 4.19 million leaves.
LARGEST_GRID = (1 << 33) - (1 << 20)


class Tiles(NamedTuple):
    """Coordinates (T,) of vec3i in units of tiles, and ascending keys (T,) of int64; ``axes`` as in ``Leaves``."""

    coordinates: "wp.array"
    keys: "wp.array"
    axes: tuple[NDArray[np.int64], ...]


class Lattice:
    """The lattice of a band's voxels, and the reach of the band.

    Args:
        surface: The surface of the band.
        voxel_size: Edge length of a voxel [world].
        reach: Distance [world] of the band's farthest voxels from the surface.
        hollow: Distance [world] of the band's nearest voxels, for bands that do not begin at the surface.
        translation: Position of index 0 [world], a whole multiple of 8 voxels along each axis; None for the origin
            wherever indices stay small.
    Attributes:
        translation: Position of index 0 [world], shape (3,).
        transform: Index to world, shape (4, 4).
    """

    def __init__(
        self,
        surface: Surface,
        voxel_size: float,
        reach: float,
        hollow: float = 0.0,
        *,
        translation: NDArray[np.float64] | None = None,
    ) -> None:
        self.surface = surface
        self.device = surface._device
        self.voxel_size = voxel_size
        self.reach = reach
        self.hollow = hollow
        self.translation = index_translation(surface.bounds, voxel_size) if translation is None else translation
        self.transform = np.diag([voxel_size, voxel_size, voxel_size, 1.0])
        self.transform[:3, 3] = self.translation

    @property
    def arguments(self) -> list[Any]:
        """Translation and voxel size as kernels take them."""
        return [wp.vec3d(*self.translation.tolist()), wp.float64(self.voxel_size)]

    def box(self, voxel_size: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """First and last tile that the band can touch, in units of tiles with voxels of this size."""
        bounds = self.surface.bounds
        with np.errstate(over="ignore", invalid="ignore"):
            index = (bounds - self.translation + [[-self.reach], [self.reach]]) / voxel_size
            return np.floor(index[0] / 8.0), np.floor(index[1] / 8.0)

    def area(self) -> float:
        """Area of the surface, in squares of its frame's scale; cached per mesh."""
        return self.surface.mesh._cache.find("area in its frame", self._measured_area)

    def _measured_area(self) -> float:
        from geokit.volume.band.tiles_kernels import area_kernel

        count = self.surface.mesh.face_count
        area = wp.empty(count, dtype=wp.float64, device=self.device)
        inputs = [self.surface._vertices, self.surface._faces, wp.float64(self.surface._frame.scale)]
        launcher.launch(area_kernel, count, inputs, [area], self.device)
        with allocating(self.device, count):
            return float(wp.utils.array_sum(area))

    @cached_property
    def free(self) -> float:
        """Bytes that a band may take, measured at the first access."""
        # A later download of the grid needs as much memory on the host as on the device.
        return float(
            min(
                available_memory.available(self.device),
                available_memory.available_host(),
                LARGEST_GRID * (1.0 + WORKING_BYTES / LEAF_BYTES),
            )
        )

    def require_memory(self, need: float) -> None:
        """Raise DeviceMemoryError if ``need`` bytes are not free; the message says which voxel size would fit."""
        have = self.free
        if need > have:
            # Tiles cover a surface, so their number grows with the square of the resolution.
            enough = self.voxel_size * math.sqrt(need / max(have, 1.0)) * 1.05
            raise DeviceMemoryError(
                f"voxel_size: {self.voxel_size:g} needs about {need / 2**20:.0f} MiB of the {have / 2**20:.0f} MiB "
                f"that {self.device.alias} and a grid can hold; use {enough:.2g} or more, or a smaller half_width",
                need=need,
            )


def near_tiles(lattice: Lattice, more_bytes: int = 0) -> Tiles:
    """All tiles with voxel centers within reach of the surface, and few others.

    Args:
        lattice: The voxels.
        more_bytes: Bytes that a tile will take besides its leaf and the building of that.

    Raises:
        DeviceMemoryError: The tiles need more memory than there is.
    """
    from geokit.volume.band import tiles_kernels as kernels

    device = lattice.device
    low, high = _checked_box(lattice)
    span = 1
    most = START_CELLS_CPU if device.is_cpu else START_CELLS_CUDA
    while np.prod((high // span - low // span + 1).astype(np.float64)) > most:
        span *= 2
    start, size = low // span, high // span - low // span + 1
    count = int(np.prod(size))
    cells = wp.empty(count, dtype=wp.vec3i, device=device)
    launcher.launch(kernels.grid_cells_kernel, count, [wp.vec3i(*start), wp.vec3i(*size)], [cells], device)
    while True:
        near = wp.empty(count, dtype=wp.int32, device=device)
        inputs = [cells, 8 * span, *lattice.arguments, lattice.surface._tree]
        inputs += [wp.float64(lattice.reach), wp.float64(lattice.hollow)]
        launcher.launch(kernels.near_cells_kernel, count, inputs, [near], device, grain=32)
        ends, near_count = prefix_sum(near)
        if span == 1:
            break
        lattice.require_memory(8.0 * near_count * 20)
        halves = wp.empty(8 * near_count, dtype=wp.vec3i, device=device)
        launcher.launch(kernels.halve_kernel, count, [cells, near, ends], [halves], device)
        cells, count, span = halves, 8 * near_count, span // 2
    lattice.require_memory(near_count * float(LEAF_BYTES + WORKING_BYTES + more_bytes))
    return in_grid_order(cells, near, ends, near_count, low, high)


def in_grid_order(
    cells: "wp.array", chosen: "wp.array", ends: "wp.array", count: int, low: NDArray[np.int64], high: NDArray[np.int64]
) -> Tiles:
    """The chosen tiles in the order of a grid's leaves.

    Args:
        cells: Coordinates of tiles, (C,) of vec3i.
        chosen: Not 0 for the tiles that are chosen, (C,) of int32.
        ends: Prefix sum of the chosen tiles, (C,) of int32.
        count: Number of chosen tiles.
        low: First tile of a box around them, shape (3,).
        high: Last tile of that box.
    """
    from geokit.volume.band import tiles_kernels as kernels

    device = cells.device
    first, last = low >> 9, high >> 9
    # The arrays are twice as long as the tiles, because the sort needs the other half.
    keys = wp.empty(2 * count, dtype=wp.int64, device=device)
    rows = wp.empty(2 * count, dtype=wp.int32, device=device)
    inputs = [cells, chosen, ends, wp.vec3i(*first), wp.vec3i(*last)]
    launcher.launch(kernels.tile_keys_kernel, len(cells), inputs, [keys, rows], device)
    if count > 1:
        sort_pairs(keys, rows, count, end_bit=63)
    tiles = gathered(cells, rows, count)
    # NanoVDB's keys sort negative coordinates last, and so does tile_keys_kernel.
    lines = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
    axes = tuple(np.concatenate([line[line >= 0], line[line < 0]]) for line in lines)
    return Tiles(tiles, keys[:count] if count else wp.empty(0, dtype=wp.int64, device=device), axes)


def _checked_box(lattice: Lattice) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    size, scale = lattice.voxel_size, lattice.surface._frame.scale
    low, high = lattice.box(size)
    # A surface meets a tile for each 8 x 8 voxels of its area; overlapping faces may count four times.
    least = lattice.area() / 256.0 * LEAF_BYTES
    if not (high - low).max() < MOST_TILES:
        if lattice.reach > scale:  # larger voxels make a band of as many voxels no smaller
            raise DeviceMemoryError(
                f"half_width: the band reaches {lattice.reach / size:.3g} voxels far, more than can be counted; use a "
                "smaller half_width or thickness"
            )
        enough = max(2.0 * scale / (8.0 * MOST_TILES), scale * math.sqrt(least / max(lattice.free, 1.0)))
        raise DeviceMemoryError(
            f"voxel_size: {size:g} makes the mesh {2.0 * scale / size:.3g} voxels across, more than can be counted; "
            f"use at least {1.05 * enough:.2g}"
        )
    with np.errstate(over="ignore"):
        # Whatever the mesh, its band is no smaller than that of a point (Brunn and Minkowski).
        ball = (
            4.18 * (np.float64(lattice.reach / size) ** 3 - np.float64(lattice.hollow / size) ** 3) / 512.0 * LEAF_BYTES
        )
    # There are no more tiles than the box has.
    most = float(np.prod(high - low + 1.0)) * LEAF_BYTES
    lattice.require_memory(min(max(least * (scale / size) ** 2, float(ball)), most))
    return low.astype(np.int64), high.astype(np.int64)
