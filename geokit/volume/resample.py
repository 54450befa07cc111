"""Volumes on other voxels."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit import _memory
from geokit._arrays import require_finite_scalar
from geokit.errors import DeviceMemoryError, InputError
from geokit.volume._build import _checked_transform
from geokit.volume._leaves import (
    CUBE_TOLERANCE,
    LEAF_VOXELS,
    Leaves,
    assemble,
    is_cubic,
    leaves_of,
    require_volume,
    uniform_voxel_size,
    voxelized,
)
from geokit.volume._level_set import half_width_of, require_level_set, with_band
from geokit.volume._nanovdb import voxel_size_of
from geokit.volume.model import SparseVolume

__all__ = ["resample"]

TYPES = ("float", "double", "vec3f", "vec3d")
# Leaves whose points are made, sampled and stored at a time: a quarter of a million points, 13 MB with their values.
LEAVES_AT_A_TIME = 512
# A target leaf while it is made: values and masks, their copy in OpenVDB's tree and that in the buffer.
BYTES_PER_LEAF = 3 * 2144
# Voxel indices are int32; this much is left free for stencils at both ends.
LARGEST_INDEX = 2**31 - 64
# Source voxels that a level set's band is known beyond the band of the target: the trilinear stencil's reach.
STENCIL = 2.0
# Widest band [source voxels] that is computed to fill a coarser target's.
WIDEST_BAND = 512.0


def resample(
    volume: SparseVolume,
    *,
    voxel_size: float | None = None,
    transform: Any = None,
    order: int = 1,
    device: Any = None,
) -> SparseVolume:
    """The volume on voxels of another size, or under another transform.

    A voxel's value is the volume's sample at its centre (:func:`geokit.volume.sample`, in float64, rounded once); a
    linear field is reproduced to that rounding inside the active region. A voxel is active where the nearest voxel of
    the source is; all others get the background. Level sets keep the width of their band in voxels: their background
    follows the voxel size, values are distances [world] as before, and where the new band is wider than the old one,
    distances are first computed beyond the old one (:func:`geokit.volume.renormalize`), which needs cubic source
    voxels. Held by tests/unit/test_operations_resample.py.

    Args:
        volume: Float, double, vec3f or vec3d grid; quantised ones become float. The components of vectors are not
            turned with the voxels.
        voxel_size: New edge length [world]; voxels become cubes, along the same axes where these are orthogonal, else
            along the world's. The centre of voxel (0, 0, 0) stays.
        transform: Instead: index to world, shape (4, 4).
        order: Of interpolation, as of ``sample``.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Volume of the same type, class, name and metadata.
    Raises:
        InputError: Not exactly one of voxel_size and transform, one that no grid can have, an unknown order, or voxels
            too many to be counted.
        UnsupportedGridError: A grid of another type.
        DeviceMemoryError: The result needs more memory than there is.
        MissingDependencyError: geokit was built without OpenVDB.
    """
    require_volume(volume, "volume", TYPES)
    if (voxel_size is None) == (transform is None):
        raise InputError("voxel_size, transform: give one of the two")
    if voxel_size is not None:
        target = _scaled(volume.info.transform, require_finite_scalar(voxel_size, "voxel_size", low=0.0))
    else:
        target = _checked_transform(transform)
    dtype = np.float64 if volume.info.grid_type in ("double", "vec3d") else np.float32
    return resampled(volume, target, order=order, dtype=dtype, device=device)


def resampled(
    volume: SparseVolume, transform: NDArray[np.float64], *, order: int, dtype: Any, device: Any = None
) -> SparseVolume:
    """:func:`resample` for checked arguments and any real value type."""
    if volume.info.grid_class != "level set":
        return _sampled(voxelized(volume), transform, order, dtype, volume.info.background, None, device)
    band = _band(volume, transform)
    source = voxelized(band.source)
    result = _sampled(source, transform, order, dtype, band.background, band.background, device)
    if band.missing:
        return with_band(result, uniform_voxel_size(result, "volume"), band.half_width)
    return result


class _Band(NamedTuple):
    source: SparseVolume
    background: float
    half_width: float
    missing: bool


def _band(volume: SparseVolume, transform: NDArray[np.float64]) -> _Band:
    """A source whose band reaches as far as the target's, and the target's background."""
    old = float(np.cbrt(np.prod(volume.info.voxel_size)))
    new = float(np.cbrt(np.prod(voxel_size_of(transform))))
    if not is_cubic(volume.info.transform):
        # Distances beyond the band need cubes: what is missing is computed on the target's, if these are.
        half_width = float(volume.info.background) / old
        known = min(half_width * new, float(volume.info.background))
        return _Band(volume, known, half_width, known < half_width * new and is_cubic(transform))
    old = require_level_set(volume, "volume")
    half_width = half_width_of(volume, old)
    background = half_width * new
    needed = background / old + STENCIL
    # Also for equal voxels: at the end of the band the stencil would take the background for a distance.
    if needed > half_width:
        if needed > WIDEST_BAND:
            raise InputError(
                f"voxel_size: {new:g} is {new / old:.3g} times the old one, too much at a time; resample at "
                f"{old * WIDEST_BAND / 2 / half_width:.2g} first"
            )
        volume = with_band(volume, old, needed)
    return _Band(volume, background, half_width, False)


def _scaled(transform: NDArray[np.float64], voxel_size: float) -> NDArray[np.float64]:
    """Cubes of another size that share the centre of voxel (0, 0, 0)."""
    target = np.array(transform)
    axes = transform[:3, :3] / voxel_size_of(transform)
    is_orthogonal = np.allclose(axes.T @ axes, np.eye(3), rtol=0.0, atol=CUBE_TOLERANCE)
    target[:3, :3] = axes * voxel_size if is_orthogonal else np.eye(3) * voxel_size
    return target


def _sampled(
    source: SparseVolume,
    transform: NDArray[np.float64],
    order: int,
    dtype: Any,
    background: Any,
    band: float | None,
    device: Any,
) -> SparseVolume:
    """Sample ``source`` at the voxels of another transform; of level sets only within ``band`` of the surface."""
    from geokit.volume.active import active_at
    from geokit.volume.sample import sample

    origins = _target_leaves(source, transform)
    leaf_shape = (LEAF_VOXELS,) if isinstance(background, (int, float)) else (LEAF_VOXELS, len(background))
    values = np.empty((len(origins), *leaf_shape), dtype)
    masks = np.empty((len(origins), 64), np.uint8)
    outside = np.asarray(background, dtype)
    offsets = np.stack(np.unravel_index(np.arange(LEAF_VOXELS), (8, 8, 8)), axis=1)
    # Leaves without an active voxel are written over by the next: room that is never touched is no memory.
    filled = 0
    for first in range(0, len(origins), LEAVES_AT_A_TIME):
        rows = slice(first, first + LEAVES_AT_A_TIME)
        voxels = (origins[rows, None, :].astype(np.int64) + offsets).reshape(-1, 3)
        points = voxels @ transform[:3, :3].T + transform[:3, 3]
        sampled = np.asarray(sample(source, points, order=order, device=device)).reshape(-1, *leaf_shape).astype(dtype)
        active = np.asarray(active_at(source, points, device=device)).reshape(-1, LEAF_VOXELS)
        if band is not None:
            active &= np.abs(sampled) < outside
            sampled = np.where(active, sampled, np.copysign(outside, sampled))
        else:
            sampled = np.where(active.reshape(*active.shape, *[1] * (sampled.ndim - 2)), sampled, outside)
        used = active.any(axis=1)
        place = slice(filled, filled := filled + int(used.sum()))
        origins[place] = origins[rows][used]
        values[place] = sampled[used]
        masks[place] = np.packbits(active[used], axis=1, bitorder="little")
    return assemble(
        Leaves(origins[:filled], masks[:filled]),
        values[:filled],
        source,
        background=background,
        grid_class=source.info.grid_class,
        transform=transform,
    )


def _target_leaves(source: SparseVolume, transform: NDArray[np.float64]) -> NDArray[np.int32]:
    """First voxels of the leaves that may hold a voxel whose nearest voxel of the source is active."""
    leaves = leaves_of(source)
    used = leaves.origins[leaves.masks.any(axis=1)].astype(np.float64)
    if not len(used):
        return np.empty((0, 3), np.int32)
    back = np.linalg.inv(transform[:3, :3])
    linear = back @ source.info.transform[:3, :3]
    shift = back @ (source.info.transform[:3, 3] - transform[:3, 3])
    centre = (used + 3.5) @ linear.T + shift
    # Half the extent of a leaf with half a voxel around its centres, and a little for rounding.
    reach = 4.0 * np.abs(linear).sum(axis=1) * (1.0 + 1e-9) + 1e-6
    lowest, highest = np.floor((centre - reach) / 8.0), np.floor((centre + reach) / 8.0)
    if max(-lowest.min(), highest.max()) * 8.0 > LARGEST_INDEX:
        raise InputError("transform: voxel indices of the result exceed int32; use larger voxels or a nearer origin")
    size = highest - lowest + 1.0
    # In floats: voxels that are far too small make more leaves than integers can count.
    _require_memory(float(size.prod(axis=1).sum()))
    size = size.astype(np.int64)
    count = size.prod(axis=1)
    row = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    _, high, deep = size[row].T
    tile = lowest[row].astype(np.int64) + np.stack([step // (high * deep), step // deep % high, step % deep], axis=1)
    return (np.unique(tile, axis=0) * 8).astype(np.int32)


def _require_memory(leaves: float) -> None:
    need, have = leaves * BYTES_PER_LEAF, _memory.available_host()
    if need > have:
        raise DeviceMemoryError(
            f"voxel_size: the result may need {need / 2**20:.3g} MiB of the {have >> 20} MiB free; use voxels about "
            f"{(need / have) ** (1.0 / 3.0):.2g} times as large"
        )
