"""Differential operators: gradient, divergence, curl and Laplacian at the active voxels."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop.types import Device
from geokit.core.memory.needs import needs
from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.leaves import LEAF_VOXELS, assemble, leaves_of, require_volume, voxelized

SCALARS, VECTORS = ("float", "double"), ("vec3f", "vec3d")
# Leaves whose results are held in float64 at a time: 8 million voxels, 200 MB of vectors.
LEAVES_AT_A_TIME = 16384
# Entries of the metric below this share of its diagonal are rounding errors, and the 12 voxels for mixed differences
# need not be read.
METRIC_ROUNDING = 1e-15


@needs(lambda volume, *_, **__: 26300 * leaf_count(volume))
def gradient_field(volume: SparseVolume, *, device: Device = None) -> SparseVolume:
    """World-space gradient at every active voxel.

    Central differences of second order along the index axes, in float64, are transformed to world space by the inverse
    transpose of the transform. They are exact for linear fields under any affine transform, up to the rounding of the
    values and of the result. At the border of the active voxels, inactive neighbors count with their values in the
    tree.

    Args:
        volume: Float or double grid; quantized ones are read as float. Active tiles become voxels.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Volume of type vec3f (vec3d for double) [value / world] with the same active voxels and background 0.
    Raises:
        InputError: volume is not a SparseVolume.
        UnsupportedGridError: Values are not real numbers.
        DeviceMemoryError: The active tiles hold more voxels than fit into memory.
    """
    return _derived(require_volume(volume, "volume", SCALARS), "gradient_kernel", 3, device)


@needs(lambda volume, *_, **__: 8300 * leaf_count(volume))
def divergence(volume: SparseVolume, *, device: Device = None) -> SparseVolume:
    """World-space divergence at every active voxel.

    Differences as in :func:`gradient_field`. Staggered grids store component c at the lower face along axis c; there
    the divergence is the difference of the two faces, which is of second order at the voxel's center.

    Args:
        volume: Vec3f or vec3d grid whose components lie along the world's axes.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Volume of type float (double for vec3d) [value / world] with the same active voxels and background 0.
    Raises:
        InputError: volume is not a SparseVolume, or is a staggered grid whose voxels are rotated or sheared.
        UnsupportedGridError: Values are not vectors of three real numbers.
        DeviceMemoryError: The active tiles hold more voxels than fit into memory.
    """
    require_volume(volume, "volume", VECTORS)
    if volume.info.grid_class != "staggered":
        return _derived(volume, "divergence_kernel", 1, device)
    linear = volume.info.transform[:3, :3]
    if np.count_nonzero(linear) > 3 or not np.diag(linear).all():
        raise InputError(
            f"volume: the faces of staggered grid {volume.info.name!r} are not along the world's axes; resample it"
        )
    return _derived(volume, "staggered_divergence_kernel", 1, device)


@needs(lambda volume, *_, **__: 26300 * leaf_count(volume))
def curl(volume: SparseVolume, *, device: Device = None) -> SparseVolume:
    """World-space curl at every active voxel.

    Differences as in :func:`gradient_field`.

    Args:
        volume: Vec3f or vec3d grid whose components lie along the world's axes.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Volume of the same type [value / world] with the same active voxels and background 0.
    Raises:
        InputError: volume is not a SparseVolume, or is a staggered grid.
        UnsupportedGridError: Values are not vectors of three real numbers.
        DeviceMemoryError: The active tiles hold more voxels than fit into memory.
    """
    require_volume(volume, "volume", VECTORS)
    if volume.info.grid_class == "staggered":
        raise InputError(
            f"volume: the components of staggered grid {volume.info.name!r} are at different places; sample them at "
            "the voxel centers first"
        )
    return _derived(volume, "curl_kernel", 3, device)


@needs(lambda volume, *_, **__: 8300 * leaf_count(volume))
def laplacian(volume: SparseVolume, *, device: Device = None) -> SparseVolume:
    """World-space Laplacian at every active voxel.

    Second central differences along the index axes, with mixed ones where the voxels' axes are not orthogonal. They are
    exact for quadratic fields under any affine transform. Rounding and border are as in :func:`gradient_field`.

    Args:
        volume: Float or double grid; quantized ones are read as float. Active tiles become voxels.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Volume of the same type [value / world^2] with the same active voxels and background 0.
    Raises:
        InputError: volume is not a SparseVolume.
        UnsupportedGridError: Values are not real numbers.
        DeviceMemoryError: The active tiles hold more voxels than fit into memory.
    """
    return _derived(require_volume(volume, "volume", SCALARS), "laplacian_kernel", 1, device, metric=True)


def _derived(volume: SparseVolume, kernel: str, components: int, device: Any, *, metric: bool = False) -> SparseVolume:
    from geokit.volume.sampling import differential_kernels as kernels

    source = voxelized(volume)
    target = launcher.resolve_device(device)
    leaves = leaves_of(source)
    matrix = np.linalg.inv(source.info.transform[:3, :3])
    if metric:
        matrix = matrix @ matrix.T
        scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
        matrix = np.where(np.abs(matrix) > METRIC_ROUNDING * scale, matrix, 0.0)
    dtype = np.float64 if source.info.grid_type in ("double", "vec3d") else np.float32
    shape = (LEAF_VOXELS,) if components == 1 else (LEAF_VOXELS, components)
    values = np.empty((len(leaves.origins), *shape), dtype)
    handle, given = wp.uint64(source.id(target)), wp.mat33d(*matrix.ravel().tolist())
    for first in range(0, len(values), LEAVES_AT_A_TIME):
        rows = slice(first, min(first + LEAVES_AT_A_TIME, len(values)))
        count = (rows.stop - first) * LEAF_VOXELS
        out = wp.zeros(count, dtype=wp.float64 if components == 1 else wp.vec3d, device=target)
        origins = wp.array(leaves.origins[rows], dtype=wp.vec3i, device=target)
        masks = wp.array(leaves.masks[rows], dtype=wp.uint8, device=target)
        launcher.launch(getattr(kernels, kernel), count, [handle, origins, masks, given], [out], target)
        with np.errstate(over="ignore"):  # derivatives beyond float32 are infinite
            values[rows] = out.numpy().reshape(-1, *shape)
    return assemble(leaves, values, source, background=0.0)
