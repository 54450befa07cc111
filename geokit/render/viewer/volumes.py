"""Volumes as the page has them: a dense box of half floats."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.volume._dense import to_dense
from geokit.volume.at_points.sample import sample

if TYPE_CHECKING:
    from geokit.render.viewer.arrays import Arrays
    from geokit.render.viewer.scene import Frame
    from geokit.volume.model.sparse_volume import SparseVolume

__all__ = ["volume_record"]

# Longest side of a box; browsers promise 256, and all that run on a GPU have 2048.
LONGEST_SIDE = 1024
# Largest distance between samples whose mean is a coarser one [voxels]: the width of the usual band, and of a wisp; and
# the most of them along an axis.
LEVEL_SET_STEP, FOG_STEP, MOST_SAMPLES = 6.0, 2.0, 4
# Share of the positive values of a fog that the color map's upper end is above.
FOG_SHARE = 0.99


class _Box(NamedTuple):
    """Values (X, Y, Z) of a box of samples; index of the samples to world (4, 4); how much coarser than the voxels."""

    values: NDArray[Any]
    transform: NDArray[np.float64]
    coarser: float


def volume_record(
    volume: SparseVolume, name: str, frame: Frame, arrays: Arrays, *, max_voxels: int, device: Any
) -> dict[str, Any]:
    box = _box(volume, max_voxels, device)
    values = np.nan_to_num(box.values)
    low, high = float(values.min()), float(values.max())
    scale = max(abs(low), abs(high)) or 1.0
    is_level_set = volume.info.grid_class == "level set"
    fog = values[values > 0.0]
    top = float(np.quantile(fog, FOG_SHARE)) if fog.size and low >= 0.0 else high
    half = (values / scale).astype(np.float16)
    return {
        "kind": "volume",
        "name": name,
        "grid": volume.info.name.encode("utf-8", "replace").decode(),
        "class": "level set" if is_level_set else "fog",
        # The first axis varies fastest in a texture.
        "values": arrays.add(half.T.view(np.uint16)),
        "shape": list(half.shape),
        "scale": scale,
        "low": low,
        "high": high,
        # Ends of the color map.
        "from": -scale if is_level_set else min(low, 0.0),
        "to": scale if is_level_set else top,
        "matrix": frame.matrix(box.transform).ravel().tolist(),
        "coarser": box.coarser,
        "voxel_size": volume.info.voxel_size.tolist(),
        "active": volume.info.active_voxel_count,
    }


def _box(volume: SparseVolume, max_voxels: int, device: Any) -> _Box:
    bounds = volume.info.index_bounds
    if bounds is None:
        raise InputError(f"grid {volume.info.name!r} has no active voxels: there is nothing to draw")
    factor = _factor(bounds[1] - bounds[0] + 1, max_voxels)
    return _dense(volume, bounds, device) if factor == 1.0 else _sampled(volume, bounds, factor, device)


def _factor(size: NDArray[np.int64], max_voxels: int) -> float:
    """How much coarser the samples of a box must be: 1 for as fine as the voxels."""

    def fits(factor: float) -> bool:
        sides = np.ceil(size / factor) + 2.0
        return float(np.prod(sides)) <= max_voxels and float(sides.max()) <= LONGEST_SIDE

    factor = 1.0
    while not fits(factor):
        factor *= 1.05
    return factor


def _dense(volume: SparseVolume, bounds: NDArray[np.int64], device: Any) -> _Box:
    # A voxel around the active ones, so that surfaces close and fog fades out.
    grid = to_dense(volume, bounds=bounds + np.array([[-1], [1]]), device=device)
    return _Box(_scalars(grid.values), grid.array_transform, 1.0)


def _sampled(volume: SparseVolume, bounds: NDArray[np.int64], factor: float, device: Any) -> _Box:
    """Means of the interpolant over steps of ``factor`` voxels, a plane at a time.

    A level set's values end with its band, and at large steps few samples are in it: their mean still says on which
    side, and how near, a surface is.
    """
    first, last = bounds.astype(np.float64)
    counts = np.ceil((last - first + 1.0) / factor).astype(int) + 2
    first = 0.5 * (first + last) - 0.5 * factor * (counts - 1)
    axes = [start + factor * np.arange(count) for start, count in zip(first, counts, strict=True)]
    farthest = LEVEL_SET_STEP if volume.info.grid_class == "level set" else FOG_STEP
    parts = min(int(np.ceil(factor / farthest)), MOST_SAMPLES)
    offsets = factor * ((np.arange(parts) + 0.5) / parts - 0.5)
    values = np.zeros(tuple(counts), np.float32)
    grid = np.stack(np.meshgrid(axes[1], axes[2], indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.empty((len(grid), 3))
    for row, x in enumerate(axes[0]):
        for offset in itertools.product(offsets, repeat=3):
            points[:, 0], points[:, 1:] = x + offset[0], grid + offset[1:]
            found = np.asarray(sample(volume, points, space="index", device=device))
            values[row] += _scalars(found.reshape(counts[1], counts[2], *found.shape[1:]), 2)
    steps = np.diag([factor, factor, factor, 1.0])
    steps[:3, 3] = first
    return _Box(values / parts**3, volume.info.transform @ steps, factor)


def _scalars(values: NDArray[Any], axes: int = 3) -> NDArray[Any]:
    """Numbers as they are, vectors as their length."""
    values = values.astype(np.float32) if values.dtype.kind not in "f" else values
    return values if values.ndim == axes else np.linalg.norm(values, axis=-1)
