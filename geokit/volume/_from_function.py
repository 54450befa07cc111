"""Level set of any function, evaluated only near its zero set: a slope bound proves that octree blocks are empty."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.interop import user_arrays
from geokit.core.memory import available_memory
from geokit.core.memory.needs import needs
from geokit.core.require import described, read_array, require_count
from geokit.errors import InputError
from geokit.volume.band.lattice_origin import checked_band, index_translation
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.layout import LEAF_VOXELS
from geokit.volume.nanovdb.provenance import provenance
from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.grid_head import checked_head

# Largest and smallest block: the largest has the size of an upper node, the smallest that of a leaf.
LARGEST_BLOCK = 4096
LEAF = 8
# Blocks at the start of the refinement: enough that a box much longer than wide loses few steps.
FIRST_BLOCKS = 64
# Largest index of a leaf's corner, with one block's width to spare.
LARGEST_INDEX = (1 << 31) - 1 - LARGEST_BLOCK
# A value and a mask, in the arrays of leaves and in the grid, plus the memory for a leaf's points during evaluation.
BYTES_PER_LEAF = 2 * (4 * LEAF_VOXELS + LEAF_VOXELS // 8) + 256
# A point and what a function of a few steps makes of it.
BYTES_PER_POINT = 85
# Slopes may exceed the bound by rounding: that of the function's own arithmetic is some 1e-15 of its values and of the
# coordinates, divided by a voxel; sums of squares add a relative error.
SLOPE_MARGIN = 1e-6
ROUNDINGS = 64.0 * np.finfo(np.float64).eps

Function = Callable[[NDArray[np.float64]], Any]


def _bytes(function: Function, bounds: Any, voxel_size: float, *, block: int = 1 << 20, **_: Any) -> float:
    """Of the points of one call, and of a band as large as the three sides of the box."""
    size = np.diff(np.asarray(bounds, np.float64), axis=0)[0] / voxel_size
    sides = size[0] * size[1] + size[1] * size[2] + size[2] * size[0]
    return min(block, float(size.prod())) * BYTES_PER_POINT + 1.5 * sides / 64.0 * BYTES_PER_LEAF


@needs(_bytes, late=True)
def from_function(
    function: Function,
    bounds: ArrayLike,
    voxel_size: float,
    *,
    lipschitz: float = 1.0,
    half_width: float = 3.0,
    name: str = "",
    grid_class: str = "level set",
    block: int = 1 << 20,
) -> SparseVolume:
    """Build the narrow band of a function around its zero set without evaluating the function elsewhere.

    Voxels whose value is below ``half_width * voxel_size`` in magnitude are active and hold the function's value,
    rounded to the nearest float32. Elsewhere the value is ``+background`` where the function is positive and
    ``-background`` where it is negative; the background is ``half_width * voxel_size``. The result equals that of an
    evaluation at every voxel, provided that ``lipschitz`` bounds the slope: a block is skipped if the value at its
    center is too large for a zero anywhere in the block. Every slope between neighboring samples is checked against the
    bound. Outside ``bounds`` the grid has the background.

    Voxel centers lie at whole multiples of ``voxel_size``. The transform has a translation (of whole leaves) only where
    indices would otherwise exceed 2^20.

    Args:
        function: Takes points [world], shape (N, 3) float64, and returns N values, negative inside.
        bounds: Lower and upper corner [world] of the box that is searched, shape (2, 3).
        voxel_size: Edge length of a voxel [world].
        lipschitz: Largest slope of the function [value / world]; 1 for distances and for minima, maxima and roundings
            of them.
        half_width: Width of the band on each side of the zero set [voxels], at least 1 and at least ``lipschitz``.
        name: Name of the grid.
        grid_class: Class of the grid.
        block: Largest number of points for one call of the function.
    Returns:
        SparseVolume of type "float".
    Raises:
        InputError: An argument is out of range, the function does not return N finite numbers, or it is steeper than
            ``lipschitz`` (the message says how steep).
        DeviceMemoryError: The band does not fit into memory.
    Source:
        Duff, Interval Arithmetic and Recursive Subdivision for Implicit Functions (1992). Differs: a slope bound
        instead of intervals, after Kalra and Barr, Guaranteed Ray Intersections with Implicit Surfaces (1989).
    Example:
        >>> import numpy as np
        >>> ball = from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.1)
        >>> round(float(ball.sample(np.array([[0.0, 0.0, 1.2]]), device="cpu")[0]), 2)
        0.2
    """
    run = _Refinement(function, bounds, voxel_size, lipschitz, half_width, block)
    origins, values, masks = run.leaves()
    head = checked_head("float", run.background, -run.background, run.transform, name, grid_class)
    buffer = build_leaves(head, origins, values, masks, signed=True)
    made_of = getattr(function, "__qualname__", type(function).__name__)
    return SparseVolume(buffer, info_of(buffer, provenance(made_of, None, run.voxel_size)))


class _Refinement:
    """One run of :func:`from_function`."""

    def __init__(
        self, function: Function, bounds: Any, voxel_size: float, lipschitz: float, half_width: float, block: int
    ) -> None:
        if not callable(function):
            raise InputError(f"function: {type(function).__name__} cannot be called; give a function of points (N, 3)")
        self.function = function
        box = read_array(bounds, "bounds", np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise InputError(f"bounds: {described(box.tolist())} is no finite box; give its lower and its upper corner")
        self.bounds = box
        self.voxel_size, half_width = checked_band(voxel_size, half_width)
        self.lipschitz = user_arrays.require_finite_scalar(lipschitz, "lipschitz", low=0.0)
        if half_width < self.lipschitz:
            raise InputError(
                f"half_width: {half_width} voxels cannot hold a sign change of slope {self.lipschitz:g} on each side; "
                f"use at least {self.lipschitz:g}"
            )
        self.block = require_count(block, "block", LEAF_VOXELS)
        self.band = half_width * self.voxel_size
        self.background = float(np.float32(self.band))
        # Leaves cover the bounds plus one voxel, so that the outer faces show the values outside.
        self.translation = index_translation(self.bounds, self.voxel_size)
        with np.errstate(over="ignore", invalid="ignore"):
            index = (self.bounds - self.translation) / self.voxel_size
        if not (np.abs(index) < LARGEST_INDEX).all():
            raise InputError(
                f"voxel_size: {self.voxel_size:g} gives more than 2^31 voxels along an axis; use a larger one"
            )
        self.lower = np.ceil(index[0]).astype(np.int64)
        self.upper = np.floor(index[1]).astype(np.int64)
        self.transform = np.diag([self.voxel_size] * 3 + [1.0])
        self.transform[:3, 3] = self.translation

    def leaves(self) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.uint8]]:
        """Origins, values and packed masks of the leaves that hold an active voxel or where the inside ends."""
        candidates = self._candidates()
        # Memory pages are allocated on the first write, so leaves that turn out to be empty cost nothing.
        values = np.empty((len(candidates), LEAF_VOXELS), np.float32)
        masks = np.empty((len(candidates), LEAF_VOXELS // 8), np.uint8)
        kept = []
        filled = 0
        step = self.block // LEAF_VOXELS
        offsets = np.stack(np.unravel_index(np.arange(LEAF_VOXELS), (8, 8, 8)), axis=1)
        for first in range(0, len(candidates), step):
            origins = candidates[first : first + step]
            voxels = origins[:, None, :] + offsets
            exact = self._evaluate(voxels.reshape(-1, 3)).reshape(-1, LEAF_VOXELS)
            self._require_slopes(origins, exact.reshape(-1, 8, 8, 8), 1.0)
            within = ((voxels >= self.lower) & (voxels <= self.upper)).all(axis=2)
            active = (np.abs(exact) < self.band) & within
            # Where the inside reaches the bounds, the leaves with the last voxels inside and the first ones outside
            # keep their signs apart. Next to a negative voxel the function is above zero by at most one step times the
            # bound.
            border = ((voxels >= self.lower - 1) & (voxels <= self.upper + 1)).all(axis=2)
            border &= ((voxels <= self.lower) | (voxels >= self.upper)).any(axis=2)
            needed = active.any(axis=1) | (border & (exact < self.lipschitz * self.voxel_size)).any(axis=1)
            stop = filled + int(needed.sum())
            exact, within, active = exact[needed], within[needed], active[needed]
            values[filled:stop] = np.where(within, np.where(active, exact, np.copysign(self.band, exact)), self.band)
            masks[filled:stop] = np.packbits(active, axis=1, bitorder="little")
            kept.append(origins[needed])
            filled = stop
        chosen = np.concatenate(kept) if kept else np.empty((0, 3), np.int64)
        return chosen.astype(np.int32), values[:filled], masks[:filled]

    def _candidates(self) -> NDArray[np.int64]:
        """Origins of the leaves that no larger block has ruled out, shape (L, 3)."""
        if (self.lower > self.upper).any():
            return np.empty((0, 3), np.int64)
        first, last = self.lower - 1, self.upper + 1
        size = LARGEST_BLOCK
        while size > LEAF and int(np.prod(last // size - first // size + 1)) < FIRST_BLOCKS:
            size //= 2
        axes = [np.arange(a, b + 1) for a, b in zip(first // size, last // size, strict=True)]
        self._require_memory(len(axes[0]) * len(axes[1]) * len(axes[2]), size)
        corners = size * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        shape = corners.shape[:3]
        corners = corners.reshape(-1, 3)
        value = self._evaluate(corners + 0.5 * (size - 1))
        self._require_slopes(corners[:1], value.reshape(1, *shape), float(size))
        while True:
            keep = self._undecided(corners, size, value)
            corners, value = corners[keep], value[keep]
            if size == LEAF:
                return corners
            size //= 2
            self._require_memory(8 * len(corners), size)
            octants = size * np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
            corners = (corners[:, None, :] + octants).reshape(-1, 3)
            touching = ((corners <= self.upper + 1) & (corners + size - 1 >= self.lower - 1)).all(axis=1)
            corners, parent = corners[touching], np.repeat(value, 8)[touching]
            centers = corners + 0.5 * (size - 1)
            value = self._evaluate(centers)
            # Distance from the center of a parent block of twice the size: half of this block's size along each axis.
            self._require_slope(value, parent, 0.5 * size * np.sqrt(3.0), centers)

    def _undecided(self, corners: NDArray[np.int64], size: int, value: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether each block may hold a voxel of the band, judged by the function at its center."""
        reach = self.lipschitz * 0.5 * np.sqrt(3.0) * (size - 1) * self.voxel_size * (1.0 + SLOPE_MARGIN)
        near = np.abs(value) < reach + self.band
        # Inner blocks that reach the bounds become leaves, so that the inside ends there.
        outer = ((corners <= self.lower) | (corners + size - 1 >= self.upper)).any(axis=1)
        return near | (outer & (value < 0.0))

    def _evaluate(self, index: NDArray[Any]) -> NDArray[np.float64]:
        """The function at voxels (N, 3) or points between them, N values."""
        out = np.empty(len(index), np.float64)
        for first in range(0, len(index), self.block):
            points = index[first : first + self.block] * self.voxel_size + self.translation
            count = len(points)
            try:
                values = np.asarray(self.function(points), np.float64)
            except (TypeError, ValueError) as error:
                if isinstance(error, InputError):
                    raise
                raise InputError(f"function: it cannot be evaluated at points ({count}, 3): {error}") from error
            if values.shape != (count,):
                raise InputError(f"function: it gives shape {values.shape} for {count} points; give one value for each")
            if not np.isfinite(values).all():
                point = index[first + int(np.argmin(np.isfinite(values)))] * self.voxel_size + self.translation
                raise InputError(
                    f"function: it is not finite at {point.tolist()}; give a number everywhere in the bounds"
                )
            out[first : first + count] = values
        return out

    def _require_slopes(self, origins: NDArray[np.int64], values: NDArray[np.float64], spacing: float) -> None:
        """Compare neighboring samples in boxes (N, A, B, C), ``spacing`` voxels apart."""
        for axis in range(3):
            low, high = (np.moveaxis(values, axis + 1, 1)[:, part] for part in (slice(None, -1), slice(1, None)))
            rise = np.abs(high - low)
            if rise.size:
                at = np.unravel_index(int(np.argmax(rise)), rise.shape)
                where = origins[at[0]] + spacing * (np.array(values.shape[1:]) - 1) / 2
                self._require_slope(high[at].reshape(1), low[at].reshape(1), spacing, where[None])

    def _require_slope(
        self, value: NDArray[np.float64], other: NDArray[np.float64], distance: float, index: NDArray[Any]
    ) -> None:
        """Refuse values that differ by more than the bound allows over a distance [voxels]."""
        step = distance * self.voxel_size
        scale = np.abs(value) + np.abs(other) + self.lipschitz * float(np.abs(self.bounds).max())
        rise = np.abs(value - other)
        bad = np.flatnonzero(rise > self.lipschitz * step * (1.0 + SLOPE_MARGIN) + ROUNDINGS * scale)
        if len(bad):
            worst = bad[np.argmax(rise[bad])]
            point = index[worst] * self.voxel_size + self.translation
            slope = max(float(rise[worst]) / step, self._slope_at(index[worst]))
            raise InputError(
                f"lipschitz: the function has a slope of {slope:.6g} near {point.tolist()}, more than "
                f"{self.lipschitz:g}; use {math.ceil(slope * 1000.0) / 1000.0:g} or more, or divide the function by it"
            )

    def _slope_at(self, index: NDArray[Any]) -> float:
        """Length of the gradient by differences over a voxel: two samples tell the slope along one line only."""
        ends = np.clip([index + 0.5 * np.eye(3), index - 0.5 * np.eye(3)], self.lower, self.upper)
        high, low = self._evaluate(ends.reshape(6, 3)).reshape(2, 3)
        lengths = np.ptp(ends, axis=0).max(axis=1) * self.voxel_size
        return float(np.linalg.norm((high - low)[lengths > 0.0] / lengths[lengths > 0.0]))

    def _require_memory(self, blocks: int, size: int) -> None:
        # Memory of a block during its evaluation; leaves are kept afterwards.
        remedy = "use a larger one, smaller bounds, or a smaller half_width"
        need = blocks * (BYTES_PER_LEAF if size == LEAF else 128)
        available_memory.require_room(need, f"voxel_size: {self.voxel_size:g} needs", remedy)
