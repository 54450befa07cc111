"""Samples a sparse volume densely for drawing."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume


class DenseField(NamedTuple):
    """Samples on a regular box in world axes.

    Attributes:
        values: Samples, shape (nx, ny, nz); for vector grids, the length of the vectors.
        origin: Position of the first sample [world], shape (3,).
        spacing: Distance between samples along x, y and z [world], shape (3,).
    """

    values: NDArray[np.float64]
    origin: NDArray[np.float64]
    spacing: NDArray[np.float64]


def dense_field(volume: "SparseVolume", *, resolution: int, margin: float = 0.0) -> DenseField:
    """Sample ``volume`` over the box of its active voxels.

    Args:
        volume: The grid.
        resolution: Largest number of samples along the longest side. Samples are never closer than the grid's voxels.
        margin: Extra space on each side, in samples.
    Raises:
        InputError: The grid has no active voxels.
    """
    bounds = volume.info.world_bounds
    if bounds is None:
        raise InputError(f"grid {volume.info.name!r} has no active voxels: there is nothing to draw")
    extent = bounds[1] - bounds[0]
    longest = float(extent.max())
    finest = float(np.min(volume.info.voxel_size))
    step = max(longest / max(resolution - 1, 1), finest)
    counts = np.maximum(np.ceil(extent / step).astype(int) + 1 + 2 * int(margin), 2)
    center = bounds.mean(axis=0)
    origin = center - 0.5 * (counts - 1) * step
    axes = [origin[axis] + step * np.arange(counts[axis]) for axis in range(3)]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = np.asarray(volume.sample(positions), dtype=np.float64)
    if values.ndim == 2:
        values = np.linalg.norm(values, axis=1)
    return DenseField(values.reshape(tuple(counts)), origin, np.full(3, step))
