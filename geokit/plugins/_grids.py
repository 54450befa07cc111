"""Grids of files for libraries that hold dense arrays, within a budget of memory."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.require import require_count
from geokit.errors import DeviceMemoryError

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

# Largest array that a grid becomes unless asked [bytes]: sparse volumes may span any box.
MOST_BYTES = 4 << 30


def require_fits(
    volume: SparseVolume, path: str | os.PathLike[str], most_bytes: int, *, box: Any = None, remedy: str
) -> None:
    """Refuse a box of voxels that is too large.

    Args:
        volume: The grid.
        path: Its file, for the message.
        most_bytes: Largest array [bytes].
        box: First and last voxel [index], shape (2, 3); None for the box around the active voxels.
        remedy: What to do beside raising most_bytes.
    Raises:
        DeviceMemoryError: The array of the box is larger than most_bytes.
        UnsupportedGridError: The grid stores no values.
    """
    from geokit.volume._dense import native_of
    from geokit.volume.nanovdb.types import INDEX_TYPES
    from geokit.volume.retyped.from_channel import from_channel

    require_count(most_bytes, "most_bytes", 1)
    dtype, components = native_of(from_channel(volume, 0) if volume.info.grid_type in INDEX_TYPES else volume)
    box = volume.info.index_bounds if box is None else box
    voxels = 0 if box is None else math.prod(int(n) for n in np.subtract(box[1], box[0], dtype=np.int64) + 1)
    need = voxels * components * dtype.itemsize
    if need > most_bytes:
        raise DeviceMemoryError(
            f"{path}: the box of grid {volume.info.name!r} has {voxels} voxels, {need >> 20} MiB; raise most_bytes, or "
            f"{remedy}",
            need=need,
        )


def dense_of(volume: SparseVolume, path: str | os.PathLike[str], most_bytes: int) -> Any:
    """The voxels of the box around the active ones, as a DenseGrid.

    Raises:
        DeviceMemoryError: The array is larger than most_bytes.
        UnsupportedGridError: The grid stores no values.
    """
    from geokit.volume._dense import to_dense

    require_fits(volume, path, most_bytes, remedy="read a part with geokit.volume.to_dense(volume, bounds=...)")
    return to_dense(volume)
