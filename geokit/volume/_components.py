"""Connected components: their labels in one volume, or a volume for each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.interop.types import Device
from geokit.core.memory.needs import needs
from geokit.volume.components.labels import active_rows, inside_rows, label_components
from geokit.volume.components.level_sets import split_level_set
from geokit.volume.components.split import label_volume, split_active
from geokit.volume.level_set.band_widths import widths_of, with_widths
from geokit.volume.level_set.operands import require_level_set, with_band
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.types import QUANTIZED
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.leaves import dequantized, require_volume
from geokit.volume.tree.typed_tree import VALUE_TYPES, tree_of


class ConnectedComponents(NamedTuple):
    """The connected components of a volume.

    Attributes:
        labels: Grid of int32, active where a component is: 1 for the largest component, 2 for the next one. It is 0
            elsewhere. Transform and name are those of the volume.
        count: Number of components, C.
        voxel_counts: Voxels of each component, (C,) int64, descending; that of label 1 comes first.
    """

    labels: SparseVolume
    count: int  # type: ignore[assignment]
    voxel_counts: NDArray[np.int64]


@needs(lambda volume, *_, **__: 5500 * leaf_count(volume))
def connected_components(volume: SparseVolume, *, device: Device = None) -> ConnectedComponents:
    """Number the connected components of a volume, largest first.

    Voxels are connected over faces. Level sets of real values are labeled inside, where values are negative, and all
    other grids at their active voxels. Tiles stay tiles. Labels go by the number of voxels; components with equally
    many are in the order of the grid's leaves. The time grows with the leaves, not with the components. Needs no
    OpenVDB.

    Args:
        volume: A grid of any type that holds values.
        device: Where to compute; None for the first GPU, else the CPU. The result is the same.
    Returns:
        ConnectedComponents with labels, count and voxel_counts.
    Raises:
        InputError: volume is not a SparseVolume.
        UnsupportedGridError: A grid of indices or points.
        DeviceMemoryError: There are too many leaves.
    """
    require_volume(volume, "volume", VALUE_TYPES)
    tree = tree_of(dequantized(volume))
    rows = inside_rows(tree) if _is_distance(volume) else active_rows(tree)
    labels = label_components(rows, launcher.resolve_device(device))
    return ConnectedComponents(label_volume(labels, volume), len(labels.voxel_counts), labels.voxel_counts)


@needs(lambda volume, *_, **__: 4200 * leaf_count(volume))
def segment(volume: SparseVolume, *, device: Device = None) -> list[SparseVolume]:
    """Split a volume into its connected components, largest first.

    Voxels are connected over faces. Level sets of real values are split by their inside: a hollow body is one
    component. Each component is the distance field of that body alone, in a band of the same widths. A voxel outside
    keeps its value in the component that is nearest. Where bands meet, the other components get their own distance,
    right to 0.1 voxel next to balls, tubes and rings of a radius of 4 voxels or more, whatever the gap. Next to edges
    that are rounded by 3 or 4 voxels, and tubes as thin, it is right to 0.1 voxel where the gap is 3 voxels or more,
    and to 0.5 in smaller gaps; next to sharp edges to 0.5 and 1 voxel. Bodies that touch within a voxel are one
    component if voxels inside them share a face. Components whose bands do not meet keep all values. Other grids are
    split by their active voxels; the voxels of other components become inactive background. Needs no OpenVDB.

    Every volume takes 0.3 MB or more, so for many components see :func:`connected_components`.

    Args:
        volume: A grid of any type that holds values; quantized ones become float.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Volumes with the name, class and metadata of the whole, by number of active voxels, descending; equally large
            ones in the order of their labels. The list is empty if the volume has no active voxels.
    Raises:
        InputError: volume is not a SparseVolume, or is a level set whose voxels are not cubes.
        UnsupportedGridError: A grid of indices or points.
        DeviceMemoryError: The volume has too many leaves, or its components are larger than the free memory.
    """
    require_volume(volume, "volume", VALUE_TYPES)
    if not volume.info.active_voxel_count:
        return []
    target = launcher.resolve_device(device)
    if _is_distance(volume):
        voxel_size = require_level_set(volume, "volume")
        widths = widths_of(volume, voxel_size)
        if widths.are_equal:
            return split_level_set(volume, voxel_size, target)
        whole = with_band(volume, voxel_size, widths.widest, device=device)
        parts = [with_widths(part, voxel_size, widths) for part in split_level_set(whole, voxel_size, target)]
        return sorted(parts, key=lambda part: -int(part.info.active_voxel_count or 0))
    source = dequantized(volume)
    tree = tree_of(source)
    return split_active(label_components(active_rows(tree), target), tree, source)


def _is_distance(volume: SparseVolume) -> bool:
    return volume.info.grid_class == "level set" and volume.info.grid_type in ("float", "double", *QUANTIZED)
