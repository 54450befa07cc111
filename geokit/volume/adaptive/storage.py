"""Order of interpolation and codec of an adaptive field: what a cell's interpolant reads, and how exact a voxel is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.layout import LAYOUTS, LEAF_VOXELS, QUANTIZED_HEADER
from geokit.volume.nanovdb.types import FIXED_BITS
from geokit.volume.tolerance.interpolation_errors import STENCILS

# Share of the tolerance up to which a cell is accepted. Between the checked places the error is a little larger, and
# each cell that fails a later check costs another round.
ACCEPTED_SHARE = 0.97
# How far an interpolant moves if voxels move by up to 1, evenly distributed, at the worst of millions of points. The
# bound at orders 2 and 3, 1.25 along each axis, would take the bracket at 1e-3 from 1.36 to 1.57 MB.
GAIN = {1: 1.0, 2: 1.3, 3: 1.3}
# Largest change of a voxel by "fpn", as a share of the tolerance, and the bits of most of its leaves then.
FPN_SHARE, FPN_BITS = 0.15, 8


class Storage(NamedTuple):
    """How an adaptive field is interpolated and stored.

    A codec moves voxels by up to half a step. An interpolant of order 1 is a mean of voxels, so it moves by no more. At
    orders 2 and 3 it could move by 1.95 times as much (1.25 along each axis), if all voxels of a stencil were off by
    the most, with the signs of their weights; 1.3 times is what happens. That is taken off the error that a cell of
    exact voxels may have, and the checks of the made field find what exceeds it.

    Attributes:
        order: Order of interpolation, 1, 2 or 3.
        codec: Codec of all levels; None for the best of each.
        tolerance: Largest error of the field [world].
        within: Distance [world] from the surface up to which it holds.
    """

    order: int
    codec: str | None
    tolerance: float
    within: float

    @property
    def halves(self) -> NDArray[np.int64]:
        """Voxels along an axis that the interpolants of a refined cell's halves read, relative to its first voxel."""
        first, count = STENCILS[self.order]
        return np.arange(first, first + count + 1)

    def codec_of(self, size: float) -> str:
        """Codec of a level of voxel ``size``: of all codecs, the one with the fewest bytes per tolerance it leaves.

        The number of leaves is about proportional to the inverse of the error that cells may have: along creases, where
        the error is proportional to the voxel size, and on curved faces at order 1, where it is to its square.
        """
        if self.codec is not None:
            return self.codec
        fixed = [codec for codec in FIXED_BITS if self._left(codec, size) > 0.0]
        cost = {codec: self._leaf_bytes(codec) / self._left(codec, size) for codec in ["float", *fixed]}
        return min(cost, key=lambda codec: cost[codec])

    def change(self, size: float) -> float:
        """Largest change [world] of a voxel by the codec of a level of voxel ``size``."""
        return self._change(self.codec_of(size), size)

    def change_of_interpolant(self, size: float) -> float:
        """Largest change [world] of the interpolant by the codec of a level of voxel ``size``."""
        return GAIN[self.order] * self.change(size)

    def limit(self, size: float) -> float:
        """Largest error [world] of a cell of exact voxels that a level of voxel ``size`` accepts."""
        return self._left(self.codec_of(size), size)

    def leaf_bytes(self, size: float) -> int:
        """Bytes of a leaf of a level of voxel ``size``."""
        return self._leaf_bytes(self.codec_of(size))

    def _left(self, codec: str, size: float) -> float:
        return ACCEPTED_SHARE * self.tolerance - GAIN[self.order] * self._change(codec, size)

    def _change(self, codec: str, size: float) -> float:
        if codec == "fpn":
            return FPN_SHARE * self.tolerance
        if codec not in FIXED_BITS:
            return 0.0
        # A refined cell touches the zone, so its farthest voxel is this far from the surface; those of level 0 are
        # nearer. Half a step of codes over such values on both sides of the surface:
        reach = np.sqrt(3.0) * float(max(self.halves[-1], 2 - self.halves[0])) * size
        return float((self.within + reach) / (2 ** FIXED_BITS[codec] - 1))

    def _leaf_bytes(self, codec: str) -> int:
        return QUANTIZED_HEADER + FPN_BITS * LEAF_VOXELS // 8 if codec == "fpn" else LAYOUTS[codec].leaf_size
