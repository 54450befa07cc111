"""Level set of the union of balls around points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Device, Rows
from geokit.core.memory import available_memory
from geokit.core.memory.needs import needs
from geokit.errors import InputError
from geokit.volume.band.lattice_origin import checked_band, index_translation
from geokit.volume.band.place_keys import KEY_BITS, keys_of, places_of
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.layout import LEAF_VOXELS
from geokit.volume.nanovdb.provenance import content_hash, provenance
from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.grid_head import checked_head

LEAF = 8
# Tiles computed together: their distances take 32 MiB.
TILES_AT_A_TIME = 8192
# Buckets whose neighbors are listed together, 27 keys of 8 bytes each.
BUCKETS_AT_A_TIME = 1 << 17
# Values and mask of a tile, in the arrays of leaves and in the grid.
BYTES_PER_TILE = 2 * (4 * LEAF_VOXELS + LEAF_VOXELS // 8) + 96
# A tile is much work, so a few of them are worth a slice of a launch.
TILE_GRAIN = 32
# State of a block in balls_kernels that holds a voxel of the band.
NEAR = 1
# Entries in the lists of balls of tiles that are computed together: 64 MiB. A tile has as many as it needs.
MOST_LISTED = 1 << 24


def _bytes(points: Any, radius: Any, voxel_size: float, *, half_width: float = 3.0, **_: Any) -> float:
    """Of the tiles that balls cover, at most those of the points' box, and of those that are computed together."""
    rows = np.asarray(points)
    reach = float(np.max(radius)) / voxel_size + half_width
    within = np.prod(np.ptp(rows, axis=0) / (8.0 * voxel_size) + reach / 4.0 + 1.0)
    tiles = min(float(within), len(rows) * (reach / 4.0 + 1.5) ** 3)
    # Distances are there three times, and the lists of a tile hold two thousand balls at most, usually.
    together = min(tiles, TILES_AT_A_TIME) * 3 * 8 * LEAF_VOXELS
    return together + 4.0 * min(2000.0 * tiles, MOST_LISTED) + 1000.0 * tiles


@needs(_bytes, late=True)
def from_points(
    points: Rows, radius: Any, *, voxel_size: float, half_width: float = 3.0, name: str = "", device: Device = None
) -> SparseVolume:
    """Build the signed distance to the union of balls around points, in a band around its surface.

    The band holds the voxels within ``half_width`` of the surface. The value at a voxel is ``min over p of |x - p| -
    r_p``, computed in float64 and rounded to float32. Outside the union that is exactly the distance. Inside, where
    balls overlap, it is the depth in the deepest ball, which is at most the distance to the surface. Voxels whose value
    is below ``half_width * voxel_size`` in magnitude are active; elsewhere the value is ``+background`` outside and
    ``-background`` inside.

    The inside of a ball that contains no voxel center is lost: ``metadata["geokit:lost_points"]`` counts such balls.
    With radii from 0.87 voxels on there are none.

    Args:
        points: Centers of the balls [world], shape (N, 3), float32 or float64, in any supported container.
        radius: Radius of all balls [world], or one for each, shape (N,).
        voxel_size: Edge length of a voxel [world].
        half_width: Width of the band on each side of the surface [voxels], at least 1.
        name: Name of the grid.
        device: Where to compute: "cpu", "cuda:0", a warp device, or None for the first GPU, else the CPU.
    Returns:
        SparseVolume of type "float" and class "level set".
    Raises:
        InputError: points is not (N, 3), not finite or empty; a radius is not positive and finite; voxel_size or
            half_width is out of range; or the voxels are too small to be numbered.
        DeviceMemoryError: The band does not fit into memory.
    Source:
        OpenVDB's ParticlesToLevelSet. Differs: a minimum over the balls near each voxel in a fixed order of arithmetic
            instead of one ball after the other, so that the result does not depend on their order; balls of any size
            count.
    Example:
        >>> ball = from_points([[0.0, 0.0, 0.0]], 1.0, voxel_size=0.1, device="cpu")
        >>> ball.info.world_bounds.round(1).tolist()
        [[-1.2, -1.2, -1.2], [1.2, 1.2, 1.2]]
    """
    voxel_size, half_width = checked_band(voxel_size, half_width)
    target = launcher.resolve_device(device)
    centers = np.asarray(user_arrays.read_vectors(points, "points", target).array.numpy(), np.float64)
    if not len(centers):
        raise InputError("points: there are none; give at least one")
    radii = _checked_radii(radius, len(centers))
    translation, index, reach = _in_voxels(centers, radii, voxel_size, half_width)
    classes = _sorted_balls(index, radii / voxel_size, reach, target)
    tiles = np.unique(np.concatenate([_tiles_of(balls, half_width, target) for balls in classes]), axis=0)
    _require_memory(len(tiles), voxel_size)
    origins, values, masks = _leaves(classes, tiles, half_width, voxel_size, target)
    transform = np.diag([voxel_size] * 3 + [1.0])
    transform[:3, 3] = translation
    background = float(np.float32(half_width * voxel_size))
    head = checked_head("float", background, -background, transform, name, "level set")
    buffer = build_leaves(head, origins, values, masks, signed=True)
    lost = int((np.linalg.norm(index - np.round(index), axis=1) * voxel_size >= radii).sum())
    metadata = provenance("points", content_hash(centers, radii), voxel_size)
    return SparseVolume(buffer, info_of(buffer, {**metadata, "geokit:lost_points": lost}))


def _in_voxels(
    centers: NDArray[np.float64], radii: NDArray[np.float64], voxel_size: float, half_width: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Position of index 0 [world], the centers [voxels], and the reach of each ball's band from its center [voxels].

    Raises:
        InputError: There are too many voxels along an axis for the keys.
    """
    translation = index_translation(np.stack([centers.min(axis=0), centers.max(axis=0)]), voxel_size)
    with np.errstate(over="ignore", invalid="ignore"):
        index = (centers - translation) / voxel_size
        reach = radii / voxel_size + half_width
        tiles_across = float((np.ptp(index, axis=0).max() + 2.0 * reach.max()) / LEAF)
        farthest = float(np.abs(index).max() + reach.max())
    # Four buckets are reserved for the neighbors at both ends.
    if not tiles_across < (1 << KEY_BITS) - 4 or not farthest < 2.0**31 - 64.0:
        raise InputError(
            f"voxel_size: {voxel_size:g} gives {tiles_across:.3g} tiles of 8 voxels along an axis, more than "
            f"{1 << KEY_BITS}; use a larger one or a volume per cluster"
        )
    # Whatever the points, the outer half of their band is no smaller than that of the largest ball.
    ball = reach.max() ** 3 - (reach.max() - half_width) ** 3
    _require_memory(4.18 * float(ball) / LEAF_VOXELS, voxel_size)
    return translation, index, reach


@dataclass(frozen=True)
class _Class:
    """Balls of similar size: the kernels' struct, the buckets (B, 3) that hold a ball, and a bucket's edge [voxels]."""

    struct: Any
    buckets: NDArray[np.int64]
    width: int


def _sorted_balls(
    center: NDArray[np.float64], radius: NDArray[np.float64], reach: NDArray[np.float64], device: "wp.Device"
) -> list[_Class]:
    """Sort balls by the power of two of voxels in their reach, so that a bucket is at least as wide as the reach."""
    from geokit.volume.band.balls_kernels import Balls

    level = np.maximum(0, np.ceil(np.log2(reach / LEAF))).astype(np.int64)
    # The logarithm may round down at a power of two.
    level += LEAF * 2.0**level < reach
    order = np.empty(len(center), np.int64)
    parts = []
    filled = 0
    for n in np.unique(level):
        rows = np.flatnonzero(level == n)
        width = LEAF << int(n)
        bucket = np.floor(center[rows] / width).astype(np.int64)
        lower = bucket.min(axis=0)
        keys = keys_of(bucket - lower)
        by_key = np.argsort(keys, kind="stable")
        order[filled : filled + len(rows)] = rows[by_key]
        found, start = np.unique(keys[by_key], return_index=True)
        parts.append((width, lower, found, filled + np.append(start, len(rows)), bucket[by_key[start]]))
        filled += len(rows)
    centers = wp.array(center[order], dtype=wp.vec3d, device=device)
    radii = wp.array(radius[order], dtype=wp.float64, device=device)
    classes = []
    for width, lower, keys, start, buckets in parts:
        struct = Balls()
        struct.center, struct.radius = centers, radii
        struct.keys = wp.array(keys, dtype=wp.int64, device=device)
        struct.start = wp.array(start.astype(np.int32), dtype=wp.int32, device=device)
        struct.lower = wp.vec3i(*(int(n) for n in lower))
        struct.width = width
        struct.uniform = int(radius.min() == radius.max())
        classes.append(_Class(struct, buckets, width))
    return classes


def _tiles_of(balls: _Class, half_width: float, device: "wp.Device") -> NDArray[np.int32]:
    """Corners of the tiles in which a ball of this class may have a voxel of the band, shape (T, 3), each once."""
    from geokit.volume.band.balls_kernels import state_kernel

    steps = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1
    low = balls.buckets.min(axis=0) - 1
    keys = np.empty(0, np.int64)
    for first in range(0, len(balls.buckets), BUCKETS_AT_A_TIME):
        near = balls.buckets[first : first + BUCKETS_AT_A_TIME, None, :] + steps - low
        keys = np.union1d(keys, keys_of(near.reshape(-1, 3)))
    blocks = (balls.width * (places_of(keys) + low)).astype(np.int32)
    size = balls.width
    while True:
        corners = wp.array(blocks, dtype=wp.vec3i, device=device)
        state = wp.zeros(len(blocks), dtype=wp.int32, device=device)
        inputs = [balls.struct, corners, size, wp.float64(half_width)]
        launcher.launch(state_kernel, len(blocks), inputs, [state], device, grain=TILE_GRAIN)
        blocks = blocks[state.numpy() == NEAR]
        if size == LEAF:
            return blocks
        size //= 2
        octants = size * np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1).astype(np.int32)
        blocks = (blocks[:, None, :] + octants).reshape(-1, 3)


def _leaves(
    classes: list[_Class], tiles: NDArray[np.int32], half_width: float, voxel_size: float, device: "wp.Device"
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.uint8]]:
    """Origins, values and packed masks of the tiles that hold an active voxel."""
    # Memory pages are allocated on the first write, so tiles that turn out to be empty cost nothing.
    values = np.empty((len(tiles), LEAF_VOXELS), np.float32)
    masks = np.empty((len(tiles), LEAF_VOXELS // 8), np.uint8)
    kept = []
    filled = 0
    for first in range(0, len(tiles), TILES_AT_A_TIME):
        part = tiles[first : first + TILES_AT_A_TIME]
        distance = _distances(classes, part, half_width, device)
        active = np.abs(distance) < half_width
        needed = active.any(axis=1)
        stop = filled + int(needed.sum())
        band = np.copysign(half_width, distance[needed])
        values[filled:stop] = np.where(active[needed], distance[needed], band) * voxel_size
        masks[filled:stop] = np.packbits(active[needed], axis=1, bitorder="little")
        kept.append(part[needed])
        filled = stop
    return np.concatenate(kept), values[:filled], masks[:filled]


def _distances(
    classes: list[_Class], tiles: NDArray[np.int32], half_width: float, device: "wp.Device"
) -> NDArray[np.float64]:
    """Distance [voxels] of each voxel of the tiles, at most the half width, shape (T, 512)."""
    from geokit.volume.band.balls_kernels import bound_kernel, distance_kernel, list_kernel, vec8d

    total = len(tiles)
    corners = wp.array(tiles, dtype=wp.vec3i, device=device)
    band = wp.float64(half_width)
    bound = wp.full(total, half_width, dtype=wp.float64, device=device)
    count = wp.zeros(total, dtype=wp.int32, device=device)
    for balls in classes:
        launcher.launch(bound_kernel, total, [balls.struct, corners], [bound], device, grain=TILE_GRAIN)
    none = wp.empty(0, dtype=wp.int32, device=device)
    for balls in classes:
        inputs = [balls.struct, corners, bound, band]
        launcher.launch(list_kernel, total, inputs, [count, none], device, grain=TILE_GRAIN)
    counts = count.numpy()
    end = np.cumsum(counts, dtype=np.int64)
    if end[-1] > MOST_LISTED and total > 1:
        half = total // 2
        return np.concatenate([_distances(classes, part, half_width, device) for part in (tiles[:half], tiles[half:])])
    place = wp.array((end - counts).astype(np.int32), dtype=wp.int32, device=device)
    listed = wp.empty(max(1, int(end[-1])), dtype=wp.int32, device=device)
    for balls in classes:
        inputs = [balls.struct, corners, bound, band]
        launcher.launch(list_kernel, total, inputs, [place, listed], device, grain=TILE_GRAIN)
    out = wp.empty((total, 64), dtype=vec8d, device=device)
    inputs = [classes[0].struct, corners, place, listed, band]
    launcher.launch(distance_kernel, 64 * total, inputs, [out], device, grain=64 * TILE_GRAIN)
    distance = out.numpy().reshape(total, LEAF_VOXELS)
    # A tile deep inside one ball has an empty list.
    distance[bound.numpy() <= -half_width] = -half_width
    return distance


def _checked_radii(radius: Any, count: int) -> NDArray[np.float64]:
    given = user_arrays.read_numbers(radius, "radius")
    if given.shape not in ((), (count,)):
        raise InputError(
            f"radius: shape {given.shape} is neither () nor ({count},); give a number or one for each point"
        )
    bad = np.flatnonzero(~(np.isfinite(given) & (given > 0.0)).reshape(-1))
    if len(bad):
        where = f"row {bad[0]} is " if given.ndim else ""
        raise InputError(f"radius: {where}{given.reshape(-1)[bad[0]]}; give positive, finite numbers")
    return np.broadcast_to(given, count)


def _require_memory(tiles: float, voxel_size: float) -> None:
    available_memory.require_room(
        tiles * BYTES_PER_TILE,
        f"voxel_size: {voxel_size:g} needs",
        lambda times: f"use {voxel_size * times**0.5 * 1.05:.2g} or more, or a smaller half_width",
    )
