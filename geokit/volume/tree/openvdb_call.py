"""Calls of the OpenVDB bridge on volumes, with a workaround for OpenVDB's limit on small voxels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checksum import partial_checksum
from geokit.volume.nanovdb.header import HEAD_SIZE, aligned_buffer, grid_header
from geokit.volume.tree.estimates import require_openvdb_room
from geokit.volume.tree.grid_head import volume_from_buffer

# OpenVDB treats a transform as singular if a voxel's volume is below 3e-15, which is an edge of 1.4e-5.
SMALLEST_VOXEL_VOLUME = 1e-14


def call_openvdb(function: Callable[..., Any], *volumes: SparseVolume, **options: Any) -> SparseVolume:
    """Call an operation of ``geokit.native.operations`` on volumes that share a lattice.

    Args:
        function: Takes one buffer for each volume and returns a buffer.
        volumes: The operands; the first provides the metadata.
        options: Further arguments of the function.
    Returns:
        SparseVolume.
    """
    for volume in volumes:
        require_openvdb_room(volume)
    factor = scale_factor(volumes[0].info.transform)
    result = function(*(scaled_up(volume.nanovdb, factor) for volume in volumes), **options)
    return volume_from_buffer(scaled_back(result, factor), volumes[0])


def scale_factor(transform: NDArray[np.float64]) -> float:
    """Power of two that scales a transform so that OpenVDB accepts it: 1 for all but tiny voxels."""
    with np.errstate(over="ignore"):
        volume = abs(float(np.linalg.det(transform[:3, :3])))
    if volume >= SMALLEST_VOXEL_VOLUME:
        return 1.0
    return 2.0 ** -int(np.floor(np.log2(np.abs(transform[:3, :3]).max())))


def scaled_back(buffer: NDArray[np.uint8], factor: float) -> NDArray[np.uint8]:
    """Undo the scaling, in place."""
    if factor != 1.0:
        _scale(buffer, 1.0 / factor)
    return buffer


def scaled_up(buffer: NDArray[np.uint8], factor: float) -> NDArray[np.uint8]:
    """The grid in a world ``factor`` times as large: a copy, unless the factor is 1."""
    if factor == 1.0:
        return buffer
    copy = aligned_buffer(len(buffer))
    copy[:] = buffer
    _scale(copy, factor)
    return copy


def _scale(buffer: NDArray[np.uint8], factor: float) -> None:
    grid = grid_header(buffer)
    for name, power in (("matrix", factor), ("vector", factor), ("inverse", 1.0 / factor)):
        grid[name] *= power
        # Beyond float32's range the single-precision map overflows; geokit's kernels use the double-precision one.
        with np.errstate(over="ignore", under="ignore"):
            grid[f"{name}_f"] = grid[name]
    grid["voxel_size"] *= factor
    with np.errstate(over="ignore", under="ignore"):
        grid["world_bbox"] *= factor
    grid["checksum"] = partial_checksum(buffer[:HEAD_SIZE], buffer)
