"""Shared setup of the charts of a volume: points near active voxels, and reference values there."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.charts.volume_setup import SEED, Effort
from geokit.accuracy.reference.volume import Voxels
from geokit.errors import UnsupportedGridError
from geokit.volume.nanovdb.types import QUANTIZED

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

__all__ = ["VolumePoints"]

Floats = NDArray[np.float64]

# Grid types that quantize can convert to float; values are unchanged, except float64 values that float32 cannot hold.
SOURCES = ("float", "double", *QUANTIZED)


class VolumePoints:
    """Points near the active voxels of a volume, and its interpolants there; attributes are computed on first access.

    Args:
        volume: A scalar grid of floating point or quantized values.
        device: Where the methods run.
        quick: Use fewer queries.
    Raises:
        UnsupportedGridError: The grid is of another type.
    """

    def __init__(self, volume: SparseVolume, device: Any, quick: bool) -> None:
        if volume.info.grid_type not in SOURCES:
            raise UnsupportedGridError(
                f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} has no charts; use one of "
                f"{', '.join(SOURCES)}"
            )
        self.volume = volume if volume.info.grid_type == "float" else volume.quantize("float")
        self.device, self.quick = device, quick
        self.effort = Effort.of(device, quick)
        self.voxels = Voxels(self.volume)
        self.is_level_set = volume.info.grid_class == "level set"
        self.unit = "world" if self.is_level_set else "relative"

    @cached_property
    def active(self) -> NDArray[np.int64]:
        """Active voxels (N, 3), at most as many as queries."""
        return self.voxels.draw_active(self.effort.queries, SEED)

    @cached_property
    def points(self) -> Floats:
        """Queries [world], each at a random position in an active voxel."""
        rng = np.random.default_rng(SEED + 1)
        chosen = self.active[rng.integers(len(self.active), size=self.effort.queries)]
        return self.voxels.to_world(chosen + rng.uniform(-0.5, 0.5, chosen.shape))

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """Rows of the checked points."""
        return np.arange(min(self.effort.checked, len(self.points)))

    @cached_property
    def value_range(self) -> float:
        """Difference between the largest and the least value of those voxels; 1 if they are equal."""
        values = self.voxels(self.active)
        return float(np.ptp(values)) or 1.0

    @property
    def error_scale(self) -> float:
        """Divisor that converts a difference of values to an error in the chart's unit."""
        return 1.0 if self.is_level_set else self.value_range

    @cached_property
    def isovalue(self) -> float:
        """0 of a level set, else the median of the active voxels."""
        return 0.0 if self.is_level_set else float(np.median(self.voxels(self.active)))

    def sampled(self, order: int) -> Floats:
        """The interpolant of an order at the checked points."""
        return self._kept("value", order)

    def gradients(self, order: int) -> Floats:
        """The gradients of the interpolant at the checked points."""
        return self._kept("gradient", order)

    def _kept(self, what: str, order: int) -> Floats:
        known = self._known
        if (what, order) not in known:
            ask = self.voxels.sample if what == "value" else self.voxels.gradient
            known[what, order] = ask(self.points[self.rows], order)
        return known[what, order]

    @cached_property
    def _known(self) -> dict[tuple[str, int], Floats]:
        return {}
