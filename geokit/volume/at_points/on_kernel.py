"""A volume as the user's own kernels take it."""

from __future__ import annotations

from typing import Any

from geokit.core import launcher
from geokit.core.memory.struct_array import handed_out
from geokit.errors import UnsupportedGridError
from geokit.volume.at_points.sample import is_scalar, valued
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.sampling.leaf_table import leaf_table
from geokit.volume.sampling.space import world_to_index

__all__ = ["on_kernel"]

# A kernel may ask any number of points: the table that saves each of them some time is always made.
MANY = 1 << 40


def on_kernel(volume: SparseVolume, device: Any = None) -> Any:
    """:meth:`geokit.volume.SparseVolume.on_kernel`."""
    import warp as wp

    from geokit.volume.at_points.user_kernels import SparseVolume as InKernels

    target = launcher.resolve_device(device)
    volume = valued(volume, None)
    if not is_scalar(volume):
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} does not hold numbers, which kernels "
            "sample; use volume.sample, or a volume of one component"
        )
    found: Any = InKernels()
    found.grid = wp.uint64(volume.id(target))
    table = leaf_table(volume, target, MANY)
    if table is not None:
        found.table = table
    found.origin, found.to_index = world_to_index(volume)
    found.background = wp.float64(volume.info.background)
    return handed_out(found, target, volume)
