"""Level sets and fields with known values on any voxels, for the tests of operations on volumes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.tree.grid_head import checked_head
from geokit.volume.tree.leaves import build_real_grid

OFFSETS = np.stack(np.meshgrid(*3 * [np.arange(8)], indexing="ij"), axis=-1).reshape(-1, 3)
# Turned about z by the angle of the 3-4-5 triangle, and somewhere else; a voxel is 0.1.
TURNED = np.array([[0.06, -0.08, 0.0, 5.0], [0.08, 0.06, 0.0, -3.0], [0.0, 0.0, 0.1, 7.0], [0.0, 0.0, 0.0, 1.0]])
SHEARED = np.array([[0.1, 0.03, 0.0, 0.5], [0.0, 0.12, -0.02, 0.1], [0.01, 0.0, 0.09, -0.4], [0.0, 0.0, 0.0, 1.0]])

Field = Callable[[NDArray[np.float64]], NDArray[Any]]


def cubes(voxel_size: float) -> NDArray[np.float64]:
    """The transform of cubic voxels whose first is at the origin."""
    return np.diag([voxel_size, voxel_size, voxel_size, 1.0])


def ball(radius: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Field:
    """Signed distance from a sphere."""
    return lambda points: np.linalg.norm(points - np.array(center), axis=1) - radius


def box(half: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Field:
    """Signed distance from a cube, exact on both sides."""

    def distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
        beyond = np.abs(points - np.array(center)) - half
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)

    return distance


def voxels_within(leaves: int) -> NDArray[np.int32]:
    """First voxels of the leaves of a cube around the origin, ``leaves`` on each side of it."""
    steps = 8 * np.arange(-leaves, leaves)
    return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int32)


def field(
    function: Field,
    *,
    transform: NDArray[np.float64] | None = None,
    leaves: int = 2,
    dtype: Any = np.float32,
    background: Any = 0.0,
    grid_class: str = "unknown",
    name: str = "field",
) -> SparseVolume:
    """A grid whose voxels in a cube of 16 ``leaves`` voxels are all active and hold a function of the world point."""
    matrix = cubes(1.0) if transform is None else transform
    origins = voxels_within(leaves)
    values = function(world_of(origins, matrix))
    shape = (len(origins), 512) if values.ndim == 1 else (len(origins), 512, 3)
    masks = np.full((len(origins), 64), 255, np.uint8)
    return _volume(origins, values.reshape(shape).astype(dtype), masks, background, matrix, name, grid_class)


def level_set(
    distance: Field,
    *,
    values: Field | None = None,
    transform: NDArray[np.float64] | None = None,
    half_width: float = 3.0,
    leaves: int = 3,
    dtype: Any = np.float32,
    name: str = "body",
) -> SparseVolume:
    """The narrow band of a signed distance; ``values`` are what it holds where that is something else."""
    matrix = cubes(1.0) if transform is None else transform
    size = float(np.linalg.norm(matrix[:3, 0]))
    origins = voxels_within(leaves)
    points = world_of(origins, matrix)
    true = distance(points).reshape(-1, 512)
    held = true if values is None else values(points).reshape(-1, 512)
    active = np.abs(true) < half_width * size
    kept = active.any(axis=1)
    background = half_width * size
    table = np.where(active, held, np.copysign(background, true)).astype(dtype)
    masks = np.packbits(active[kept], axis=1, bitorder="little")
    return _volume(origins[kept], table[kept], masks, background, matrix, name, "level set")


def _volume(
    origins: NDArray[np.int32],
    values: NDArray[Any],
    masks: NDArray[np.uint8],
    background: Any,
    transform: NDArray[np.float64],
    name: str,
    grid_class: str,
) -> SparseVolume:
    letter = "d" if values.dtype == np.float64 else "f"
    grid_type = {"f": "float", "d": "double"}[letter] if values.ndim == 2 else f"vec3{letter}"
    kind = LAYOUTS[grid_type].background
    outside = np.array(np.broadcast_to(background, kind.shape), kind.base)
    head = checked_head(grid_type, outside, -outside, transform, name, grid_class)
    buffer = build_real_grid(head, origins, masks, values)
    return SparseVolume(buffer, info_of(buffer, {"author": "tests"}))


def world_of(origins: NDArray[np.int32], transform: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centers of the voxels of leaves, shape (512 L, 3)."""
    voxels = (origins[:, None, :].astype(np.int64) + OFFSETS).reshape(-1, 3)
    return voxels @ transform[:3, :3].T + transform[:3, 3]


def active_voxels(volume: SparseVolume) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World points and values of the active voxels in leaves, by the sampler at voxel centers."""
    from geokit.volume.tree.leaves import leaves_of

    leaves = leaves_of(volume)
    active = np.unpackbits(leaves.masks, axis=1, bitorder="little").astype(bool).ravel()
    points = world_of(leaves.origins, volume.info.transform)[active]
    return points, np.asarray(volume.sample(points, order=0, device="cpu"))


def dense(volume: SparseVolume, lower: int, upper: int) -> NDArray[np.float64]:
    """Values of all voxels with indices from ``lower`` to ``upper`` - 1 on each axis, whatever their state."""
    steps = np.arange(lower, upper)
    voxels = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    points = voxels @ volume.info.transform[:3, :3].T + volume.info.transform[:3, 3]
    values = np.asarray(volume.sample(points, order=0, device="cpu"))
    return values.reshape(*3 * [len(steps)], *values.shape[1:])
