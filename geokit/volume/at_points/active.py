"""Tests whether points lie in active voxels."""

from __future__ import annotations

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.query import FIRST_ALONE
from geokit.core.interop.types import Array, Devices, Rows
from geokit.core.interop.user_arrays import read_vectors
from geokit.core.query.ask import query
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.sampling.space import query_inputs, require_space
from geokit.volume.tree.leaves import require_volume


# A point takes less time than its copy to another device.
@query("points", is_replayed=True, is_stepped=True, least_rows=FIRST_ALONE, row_bytes=5)
def active_at(volume: SparseVolume, points: Rows, *, space: str = "world", device: Devices = None) -> Array:
    """Return whether the voxel nearest to each point is active.

    Halves round up in index space, as in sampling of order 0. A tile is active or inactive as a whole. Outside all
    nodes, and beyond the range of int32, no voxel is active.

    Args:
        volume: A grid of any type, index grids included.
        points: Query points [world], shape (N, 3).
        space: Space of ``points``: "world", or "index", where voxel centers lie at whole numbers.
        device: Where to compute; None for the first GPU, else the CPU. The first of several devices answers.

    Returns:
        bool (N,) in the container of ``points``.

    Raises:
        InputError: points is not (N, 3) or not finite, or the space is unknown.
        FileFormatError: The buffer is not a valid grid.
        UnsupportedGridError: geokit does not read the grid's type.

    Example:
        >>> from geokit.volume import load
        >>> active_at(load("data/samples/torus.vdb"), [[0.7, 0.0, 0.0], [9.0, 9.0, 9.0]]).tolist()
        [True, False]
    """
    from geokit.volume.sampling.active_kernels import active_kernel

    require_volume(volume, "volume")
    require_space(space)
    target = launcher.resolve_device(device)
    batch = read_vectors(points, "points", target, single=True)
    out = wp.empty(len(batch), dtype=wp.bool, device=target)
    launcher.launch(active_kernel, len(batch), query_inputs(volume, batch.array, space), [out], target)
    return batch.to_caller(out)
