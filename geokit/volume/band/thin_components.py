"""Finds connected components of a mesh that a band has lost: walls so thin that no voxel center lies inside them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.scan import prefix_sum

if TYPE_CHECKING:
    import warp as wp

    from geokit.volume.band.band import Band

__all__ = ["lost_components"]

# Leaves whose nearest triangles are looked up at a time, so that memory does not grow with the band.
LEAVES_AT_A_TIME = 1024


def lost_components(band: Band, pieces: NDArray[np.int32], piece_count: int) -> list[int]:
    """Connected components of a mesh without a face that is the nearest to some negative voxel.

    Args:
        band: The band.
        pieces: Connected component of each face, (F,), numbered from 0 in the order of their first faces; those that
            no face has are not lost.
        piece_count: Number of connected components.
    """
    import warp as wp

    from geokit.volume.band import signs_kernels as kernels

    device, count = band.lattice.device, len(band.leaves.keys)
    if piece_count == 1:
        return [] if band.has_negative.numpy()[0] else [0]
    found = np.ones(piece_count, np.bool_)
    found[pieces] = False
    both = wp.empty((count, 8), dtype=wp.uint64, device=device)
    launcher.launch(kernels.common_bits_kernel, count, [band.active, band.negative], [both], device)
    # If the band ends one voxel inside, a component's only negative voxels may lie beyond the band's end.
    for bits in (both, band.negative):
        _mark(band, bits, pieces, found)
        if found.all():
            return []
    return [int(piece) for piece in np.flatnonzero(~found)]


def _mark(band: Band, bits: "wp.array", pieces: NDArray[np.int32], found: NDArray[np.bool_]) -> None:
    """Set ``found`` for the components that are nearest to a voxel whose bit is set."""
    import warp as wp

    from geokit.volume.band import signs_kernels as kernels

    for start in range(0, len(bits), LEAVES_AT_A_TIME):
        stop = min(len(bits), start + LEAVES_AT_A_TIME)
        part, rows = bits[start:stop], band.leaves.rows[start:stop]
        counts = wp.empty(stop - start, dtype=wp.int32, device=band.lattice.device)
        launcher.launch(kernels.count_bits_kernel, stop - start, [part], [counts], counts.device)
        ends, total = prefix_sum(counts)
        if total == 0:
            continue
        points = wp.empty(total, dtype=wp.vec3d, device=counts.device)
        inputs = [part, ends, counts, band.leaves.tiles, rows, *band.lattice.arguments]
        launcher.launch(kernels.bit_positions_kernel, stop - start, inputs, [points], counts.device)
        nearest = band.lattice.surface.closest_point(points)
        found[np.unique(pieces[nearest.triangle_id.numpy()])] = True
        if found.all():
            return
