"""Statistics of a volume's values."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory.needs import needs
from geokit.volume.level_set.operands import require_level_set
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.nodes import bits_of
from geokit.volume.nanovdb.types import BY_NAME
from geokit.volume.tree.estimates import leaf_count, require_openvdb_room
from geokit.volume.tree.leaves import dequantized, is_cubic, require_volume
from geokit.volume.tree.openvdb_call import scale_factor, scaled_up
from geokit.volume.tree.typed_tree import VALUE_TYPES, TypedTree, tree_of

# Colors are left out: their length means nothing.
TYPES = tuple(name for name in VALUE_TYPES if BY_NAME[name].family != "color")
# Leaves converted to float64 at a time: 8 million values.
LEAVES_AT_A_TIME = 16384


class Statistics(NamedTuple):
    """Statistics of the values of active voxels, for vectors of their lengths; NaN if no voxel is active.

    Attributes:
        count: Number of active voxels, including those of active tiles.
        minimum: Smallest value.
        maximum: Largest value.
        mean: Mean value.
        standard_deviation: Root of the mean squared difference from the mean.
        area: Area of a level set's surface [world^2]; None for other grids, or if the voxels are not cubes.
        volume: Volume inside a level set's surface [world^3]; None like the area.
    """

    count: int  # type: ignore[assignment]
    minimum: float
    maximum: float
    mean: float
    standard_deviation: float
    area: float | None = None
    volume: float | None = None


@needs(lambda volume, *_, **__: 7000 * leaf_count(volume), fatal=True)
@np.errstate(over="ignore", invalid="ignore")  # squares of numbers beyond 1e154
def statistics(volume: SparseVolume) -> Statistics:
    """Compute count, extrema, mean and spread of a volume's active voxels, and area and volume of a level set.

    Sums are float64 and exact to a few times 2^-53 of the largest; int64 values beyond 2^53 are rounded first. Area and
    volume are integrals over the band, of second order in the voxel size: on a sphere with a radius of 10 voxels they
    are 0.1 % and 0.7 % off. They require closed surfaces and values that are distances.

    Args:
        volume: A grid of any scalar or vector type; quantized ones are read as float. True, and every voxel of a mask,
            counts as 1.
    Returns:
        Statistics: count, minimum, maximum, mean and standard_deviation [value units] of the active voxels, area
            [world^2] and volume [world^3].
    Raises:
        InputError: volume is not a SparseVolume, or is a level set whose background is not positive.
        UnsupportedGridError: A grid of colors, indices or points.
        MissingDependencyError: A level set with cubic voxels, and geokit was built without OpenVDB.
    """
    require_volume(volume, "volume", TYPES)
    area, inside = _measures(volume)
    tree = tree_of(dequantized(volume))
    counts, sums, limits = [0], [0.0], []
    for values, voxels in _active_values(tree):
        counts.append(len(values) * voxels)
        sums.append(float(values.sum()) * voxels)
        limits += [float(values.min()), float(values.max())]
    count = sum(counts)
    if not count:
        return Statistics(0, math.nan, math.nan, math.nan, math.nan, area, inside)
    mean = math.fsum(sums) / count
    squares = math.fsum(float(np.square(values - mean).sum()) * voxels for values, voxels in _active_values(tree))
    return Statistics(count, min(limits), max(limits), mean, math.sqrt(squares / count), area, inside)


def _active_values(tree: TypedTree) -> Iterator[tuple[NDArray[np.float64], int]]:
    """Values of active voxels and tiles (lengths for vectors), some leaves at a time, with their voxel counts."""
    for first in range(0, len(tree.origins), LEAVES_AT_A_TIME):
        part = slice(first, first + LEAVES_AT_A_TIME)
        yield from _lengths(tree.values[part][bits_of(tree.masks[part])], 1)
    for nodes, voxels in ((tree.lower, 8**3), (tree.upper, 128**3), (tree.root, 4096**3)):
        yield from _lengths(nodes.values[nodes.active], voxels)


def _lengths(values: NDArray[Any], voxels: int) -> Iterator[tuple[NDArray[np.float64], int]]:
    if len(values):
        numbers = values.astype(np.float64)
        yield np.linalg.norm(numbers, axis=1) if numbers.ndim == 2 else numbers, voxels


def _measures(volume: SparseVolume) -> tuple[float | None, float | None]:
    """Area and enclosed volume of a level set of cubic voxels."""
    if volume.info.grid_class != "level set" or not is_cubic(volume.info.transform):
        return None, None
    from geokit.native import operations

    voxel_size = require_level_set(volume, "volume")
    require_openvdb_room(volume)
    if not volume.info.active_voxel_count:
        return 0.0, 0.0
    factor = scale_factor(volume.info.transform)
    return operations.measure(scaled_up(volume.nanovdb, factor), voxel_size)
