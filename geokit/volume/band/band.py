"""Builds the band of voxels around a surface: distances, signs, active voxels, leaves; on the surface's device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.pinned import host_flags
from geokit.core.scan import flagged, gathered
from geokit.volume.band.sign_change_tiles import beyond_signs, keep_sign_changes, with_sign_changes
from geokit.volume.band.signs import inside_bits
from geokit.volume.band.tiles import Lattice, Tiles, near_tiles
from geokit.volume.tree.device_writer import BuiltGrid, Leaves, build_on_device
from geokit.volume.tree.grid_head import GridHead

if TYPE_CHECKING:
    from geokit.core.memory.host_array import HostArray

# Voxels nearer to a closed surface than this share of the band's width are on it, and count as outside.
ON_SURFACE = 1e-12
# A launch counts its threads in 31 bits; longer launches would gain nothing.
VOXELS_AT_A_TIME = 1 << 28
# Bytes per tile of the nearest triangles' slots, of their numbers, and of the leaf that holds these.
SLOT_BYTES = 3 * 2144
# In narrower bands a voxel on the surface may be next to one on the band's edge. Tiles without an active voxel are then
# kept, because the faces of their neighbors would not show which side they are on.
SAFE_HALF_WIDTH = 1.001


@dataclass(frozen=True)
class BandShape:
    """Widths, offset and sign method of a band.

    Attributes:
        exterior: Background, and the width outside [world].
        interior: Width inside [world].
        offset: Half the thickness of a shell [world]; it is subtracted from the distances.
        method: Sign method, or "none" for unsigned distances.
    """

    exterior: float
    interior: float
    offset: float
    method: str

    @property
    def reach(self) -> float:
        """Greatest distance [world] of an active voxel from the surface."""
        if self.method == "none":
            return self.exterior + self.offset
        return max(self.exterior, self.interior)

    @property
    def hollow(self) -> float:
        """Least distance [world] of an active voxel; above 0 for thick shells, whose band stays off the surface."""
        return max(0.0, self.offset - self.interior)


@dataclass(frozen=True)
class Band:
    """A band before it becomes a grid: leaves, distances of all tiles, and bit masks (L, 8) of the leaves' voxels.

    ``inside`` is empty for unsigned distances. ``slots`` (T, 512) are the slots of the nearest triangles, or empty.
    """

    lattice: Lattice
    shape: BandShape
    leaves: Leaves
    distance: "wp.array"
    slots: "wp.array"
    inside: "wp.array"
    active: "wp.array"
    negative: "wp.array"
    has_negative: HostArray

    @property
    def limits(self) -> list[Any]:
        """Values at the band's edges, outside and inside, as kernels take them."""
        return [wp.float32(self.shape.exterior), wp.float32(-self.shape.interior)]


def make_band(lattice: Lattice, shape: BandShape, *, with_slots: bool = False, tiles: Tiles | None = None) -> Band:
    """Compute distances, signs and active voxels of a band.

    Args:
        lattice: The voxels.
        shape: Widths, offset and sign method.
        with_slots: Keep the slots of the nearest triangles.
        tiles: The tiles near the surface, if they have been found.
    Raises:
        DeviceMemoryError: The band needs more memory than there is.
    """
    from geokit.volume.band import band_kernels as kernels

    device = lattice.device
    tiles = near_tiles(lattice, SLOT_BYTES if with_slots else 0) if tiles is None else tiles
    # The sign of an open mesh also changes in its holes, where there may be no active voxel.
    opens = shape.method != "none" and not lattice.surface.is_closed
    if opens:
        tiles = with_sign_changes(lattice, tiles, shape.method)
    distance, slots = _distances(lattice, tiles, shape, with_slots)
    rows = _numbered(len(tiles.keys), device)
    leaves = Leaves(tiles.keys, tiles.coordinates, rows, tiles.axes)
    safe = min(shape.exterior, shape.interior) > SAFE_HALF_WIDTH * lattice.voxel_size
    edge = shape.reach - shape.offset
    if safe:
        near = wp.empty(len(rows), dtype=wp.int32, device=device)
        limits = [wp.float32(-np.inf if shape.method != "none" else -shape.interior), wp.float32(edge)]
        launcher.launch(kernels.near_rows_kernel, len(rows), [distance, *limits], [near], device, grain=64)
        if opens:
            keep_sign_changes(lattice, _places(leaves), shape.method, near)
        leaves, _ = _kept(leaves, near, [])
    uneven = safe and shape.method != "none" and shape.exterior != shape.interior
    if not uneven:
        leaves.nodes  # noqa: B018 - they are made while the host and the device are at the signs
    inside = wp.empty((0, 0), dtype=wp.uint64, device=device)
    has_negative = host_flags(1, device)
    if shape.method != "none":
        beyond = beyond_signs(lattice, _places(leaves), shape.method) if opens else None
        inside = inside_bits(lattice, tiles.coordinates, leaves.rows, distance, shape.method, beyond)
        if not opens or lattice.surface._is_trimmed:
            # Rounding would decide; an open sheet without thickness would have no other inside.
            inputs = [leaves.rows, distance, wp.float32(ON_SURFACE * shape.exterior)]
            launcher.launch(kernels.surface_is_outside_kernel, 8 * len(leaves.keys), inputs, [inside], device)
    active, negative = _bits(lattice, shape, leaves, distance, inside, has_negative)
    if uneven:
        some = wp.empty(len(leaves.keys), dtype=wp.int32, device=device)
        launcher.launch(kernels.set_rows_kernel, len(some), [active], [some], device)
        if opens:
            keep_sign_changes(lattice, _places(leaves), shape.method, some)
        leaves, (inside, active, negative) = _kept(leaves, some, [inside, active, negative])
        has_negative = host_flags(1, device)
        launcher.launch(kernels.any_bits_kernel, len(leaves.keys), [negative], [has_negative], device)
    return Band(lattice, shape, leaves, distance, slots, inside, active, negative, has_negative)


def build_band(band: Band, head: GridHead) -> BuiltGrid:
    """Build the band as a grid of floats."""
    from geokit.volume.band.band_kernels import leaf_values_kernel

    count, device = len(band.leaves.keys), band.lattice.device

    def write(buffer: "wp.array", begin: int) -> None:
        inputs = [wp.int64(begin), band.leaves.rows, band.distance, band.inside, *band.limits]
        launcher.launch(leaf_values_kernel, 8 * count, inputs, [buffer], device)

    signed = band.shape.method != "none" or band.shape.offset > 0.0
    return build_on_device(band.leaves, head, write, band.negative if signed else None)


def build_triangle_ids(band: Band, head: GridHead, source: NDArray[np.int64] | None = None) -> BuiltGrid:
    """Build an int32 grid of the nearest triangle at each active voxel; the band needs its slots.

    Args:
        band: The band.
        head: Head of the grid.
        source: The number to write for each triangle (F,); None for its own.
    """
    from geokit.volume.band.band_kernels import triangle_values_kernel
    from geokit.volume.tree.device_writer_kernels import copy_leaves_kernel

    count, device = len(band.leaves.keys), band.lattice.device

    def write(buffer: "wp.array", begin: int) -> None:
        values = wp.empty(512 * count, dtype=wp.int32, device=device)
        numbers = band.lattice.surface._tree.slot_triangle
        if source is not None:
            numbers = wp.array(source[numbers.numpy()], dtype=wp.int32, device=device)
        inputs = [band.leaves.rows, band.slots, band.active, numbers]
        launcher.launch(triangle_values_kernel, 8 * count, inputs, [values], device)
        inputs = [wp.int64(begin), _numbered(count, device), values, band.active.flatten()]
        launcher.launch(copy_leaves_kernel, 8 * count, inputs, [buffer], device)

    return build_on_device(band.leaves, head, write)


def _places(leaves: Leaves) -> NDArray[np.int32]:
    """Coordinates of leaves in units of tiles, (L, 3), on the host."""
    return np.asarray(leaves.tiles.numpy()[leaves.rows.numpy()])


def _numbered(count: int, device: "wp.Device") -> "wp.array":
    from geokit.core.morton_order_kernels import identity_kernel

    rows = wp.empty(count, dtype=wp.int32, device=device)
    launcher.launch(identity_kernel, count, [], [rows], device)
    return rows


def _distances(lattice: Lattice, tiles: Tiles, shape: BandShape, with_slots: bool) -> tuple["wp.array", "wp.array"]:
    count, device = len(tiles.keys), lattice.device
    distance = wp.empty((count, 512), dtype=wp.float32, device=device)
    slots = wp.empty((count, 512) if with_slots else (0, 0), dtype=wp.int32, device=device)
    where = [tiles.coordinates, *lattice.arguments, lattice.surface._tree, wp.float64(shape.reach)]
    if device.is_cpu:
        from geokit.volume.band.distances_cpu_kernels import tile_distance_kernel

        inputs = [*where, wp.float64(shape.offset)]
        launcher.launch(tile_distance_kernel, count, inputs, [distance, slots], device, grain=8)
        return distance, slots
    from geokit.volume.band.distances_cuda_kernels import brick_kernel, voxel_kernel

    bricks = wp.empty(8 * count, dtype=wp.int32, device=device)
    launcher.launch(brick_kernel, 8 * count, where, [bricks], device)
    step = VOXELS_AT_A_TIME // 512
    for start in range(0, count, step):
        inputs = [*where, wp.float64(shape.offset), bricks, start]
        launcher.launch(voxel_kernel, 512 * min(step, count - start), inputs, [distance, slots], device)
    return distance, slots


def _bits(
    lattice: Lattice,
    shape: BandShape,
    leaves: Leaves,
    distance: "wp.array",
    inside: "wp.array",
    has_negative: HostArray,
) -> list["wp.array"]:
    """Bit masks of the active voxels and of those with negative values; ``has_negative`` is raised if there are any."""
    from geokit.volume.band.band_kernels import bits_kernel

    count, device = len(leaves.keys), lattice.device
    bits = [wp.empty((count, 8), dtype=wp.uint64, device=device) for _ in range(2)]
    inputs = [leaves.rows, distance, inside, wp.float32(shape.exterior), wp.float32(-shape.interior)]
    launcher.launch(bits_kernel, 8 * count, inputs, [*bits, has_negative], device)
    return bits


def _kept(leaves: Leaves, chosen: "wp.array", bits: list["wp.array"]) -> tuple[Leaves, list["wp.array"]]:
    """The chosen leaves, and their rows of the bit masks."""
    from geokit.volume.band.band_kernels import kept_bits_kernel

    chosen = flagged(chosen)
    kept = []
    for words in bits:
        kept.append(wp.empty((len(chosen), 8), dtype=wp.uint64, device=chosen.device))
        launcher.launch(kept_bits_kernel, len(chosen), [chosen, words], [kept[-1]], chosen.device)
    return Leaves(gathered(leaves.keys, chosen), leaves.tiles, gathered(leaves.rows, chosen), leaves.axes), kept
