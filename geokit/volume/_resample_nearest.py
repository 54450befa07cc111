"""Grids of any value type on other voxels, each with the value of the nearest."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit import _launch
from geokit.volume._nanovdb_layout import LEAF_VOXELS
from geokit.volume._resample_leaves import filled_leaves, target_leaves, way_between
from geokit.volume._typed_build import built
from geokit.volume._typed_tree import tree_of, tree_of_leaves, voxelized_tree
from geokit.volume.active import active_at
from geokit.volume.model import SparseVolume
from geokit.volume.sample import query_inputs, sample

__all__ = ["resampled_nearest"]


def resampled_nearest(volume: SparseVolume, transform: NDArray[np.float64], device: Any) -> SparseVolume:
    """A volume of one of VALUE_TYPES under another transform: type, name, class, background and metadata stay.

    Raises:
        InputError: Indices of the result exceed int32.
        DeviceMemoryError: The result, or the voxels in the volume's tiles, take more memory than there is.
    """
    tree = tree_of(volume)
    layout, background = tree.layout, tree.background
    leaves = voxelized_tree(tree, volume.info.name)
    used = leaves.origins[leaves.masks.any(axis=1)]
    per_leaf = LEAF_VOXELS * layout.background.itemsize + layout.leaf_size + 256
    origins = target_leaves(used, volume.info.transform, transform, per_leaf)
    linear, shift = way_between(transform, volume.info.transform)

    def read(voxels: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        # From index to index: by way of the world what is half a voxel away would be rounded to either side.
        points = voxels @ linear.T + shift
        active = np.asarray(active_at(volume, points, space="index", device=device))
        values = _values_at(volume, points, device).astype(layout.background.base)
        values[~active] = background
        return values, active

    return built(
        tree_of_leaves(layout, background, *filled_leaves(origins, layout.background, read)), volume, transform
    )


def _values_at(volume: SparseVolume, points: NDArray[np.float64], device: Any) -> NDArray[Any]:
    """Values of the voxels nearest to index coordinates, exact."""
    if volume.info.grid_type != "int64":
        return np.asarray(sample(volume, points, order=0, space="index", device=device))
    import warp as wp

    from geokit.volume._nearest_int64_kernels import nearest_int64_kernel

    target = _launch.resolve_device(device)
    given = wp.array(points, dtype=wp.vec3d, device=target)
    out = wp.empty(len(points), dtype=wp.int64, device=target)
    inputs = [*query_inputs(volume, given, "index"), wp.int64(volume.info.background)]
    _launch.launch(nearest_int64_kernel, len(points), inputs, [out], target)
    return np.asarray(out.numpy())
