"""Triangles of a prepared surface that intersect boxes, another surface, or each other."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.snapshot import snapshot
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Array, Rows
from geokit.core.memory import available_memory
from geokit.core.memory.needs import rows
from geokit.core.memory.pinned import host_flags
from geokit.core.memory.unchecked import sort_pairs
from geokit.core.query.ask import query
from geokit.core.require import require_one_world
from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.core.frame import Frame
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# Least number of leaves, or boxes, in a thread's share.
LEAF_GRAIN = 16
WIDTH = 8


class BoxOverlaps(NamedTuple):
    """Triangles whose boxes overlap each of N boxes.

    Attributes:
        offsets: Box i has ``triangle_id[offsets[i]:offsets[i + 1]]``; shape (N + 1,) int64.
        triangle_id: The triangles, ascending for each box; shape (H,) int32.
    """

    offsets: Array
    triangle_id: Array


class OverlapQueries:
    """Overlap queries of a :class:`geokit.mesh.Surface`."""

    mesh: TriangleMesh
    _device: "wp.Device"
    _frame: Frame
    _tree: Any

    @query("lower", "upper", is_stepped=True, memory=lambda self, lower, upper: 36 * rows(lower))
    def overlapping(self, lower: Rows, upper: Rows) -> BoxOverlaps:
        """Triangles that intersect each box; exact tests of the triangles, not only of their bounding boxes.

        Boxes and triangles are closed sets: touching counts as intersecting. No intersecting triangle is missed;
        another one may be listed if it is within 1e-14 of the box's size.

        Args:
            lower: Lower corners of the boxes [world], shape (N, 3).
            upper: Upper corners [world], shape (N, 3); no component is below that of the lower corner.
        Returns:
            BoxOverlaps with offsets (N + 1,) and triangle_id (H,), ascending for each box.
        Raises:
            InputError: An array is not (N, 3) or not finite, their lengths differ, or a box is inverted.
            DeviceMemoryError: There are more overlaps than the device can hold.
        Source:
            Akenine-Möller, "Fast 3D Triangle-Box Overlap Testing" (2001). Differs: margins for rounding, so that no
            triangle is missed.
        Example:
            >>> triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
            >>> surface = gk.mesh.Surface(triangle, device="cpu")
            >>> surface.overlapping([[0, 0, 0], [0.8, 0.8, 0]], [[0.1, 0.1, 0], [1, 1, 0]]).offsets
            array([0, 1, 1])
        """
        from geokit.mesh.queries.intersecting_kernels import (
            count_overlaps_kernel,
            list_overlaps_kernel,
            triangle_of_key_kernel,
        )

        device = self._device
        low, high = user_arrays.read_rows([lower, upper], ["lower", "upper"], device)
        _require_boxes(low, high)
        boxes, tree = [low.rows, high.rows], [self._tree, self._slot_boxes]
        offsets = wp.zeros(len(low) + 1, dtype=wp.int64, device=device)
        if len(low):
            count = wp.empty(len(low), dtype=wp.int64, device=device)
            launcher.launch(count_overlaps_kernel, len(low), [*boxes, *tree], [count], device, grain=LEAF_GRAIN)
            wp.utils.array_scan(count, offsets[1:], inclusive=True)
        total = int(offsets[-1:].numpy()[0])
        # Memory for keys and values, twice each because the sort needs scratch space, and for the list itself.
        available_memory.require_room(28 * total, f"{total} overlaps need", "ask for fewer at once", device)
        key = wp.empty(2 * total, dtype=wp.int64, device=device)
        triangle_id = wp.empty(total, dtype=wp.int32, device=device)
        if total:
            launcher.launch(list_overlaps_kernel, len(low), [*boxes, offsets, *tree], [key], device, grain=LEAF_GRAIN)
            _sort(key, total)
            launcher.launch(triangle_of_key_kernel, total, [key], [triangle_id], device)
        give = low.to_lists or low.to_caller
        return BoxOverlaps(give(offsets), give(triangle_id))

    @query(is_stepped=True, memory=lambda self, *_, **__: 32 * self.mesh.face_count)
    def intersecting_triangles(self, other: "OverlapQueries") -> NDArray[np.int32]:
        """Pairs of intersecting triangles, one of this surface and one of another.

        Decided exactly for float64 corners. Triangles are closed sets: touching counts as intersecting. Triangles
        without area are treated as segments or points.

        Args:
            other: A surface on the same device.
        Returns:
            int32 (P, 2): triangle of this surface and triangle of the other in each row, sorted.
        Raises:
            InputError: other is not a Surface, or is on another device; units or up axes are known and differ.
            DeviceMemoryError: There are more pairs than the device can hold.
        Source:
            Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates" (1997);
            Guigue, Devillers, "Fast and Robust Triangle-Triangle Overlap Test Using Orientation Predicates" (2003).
        """
        other = require_surface(self, other)
        require_one_world(surface=self.mesh, other=other.mesh)
        return self._pairs(snapshot(other))

    @query(is_stepped=True, memory=lambda self, *_, **__: 32 * self.mesh.face_count)
    def self_intersections(self) -> NDArray[np.int32]:
        """Pairs of triangles of this mesh that intersect beyond the vertex or edge that they share.

        Corners are shared if their positions are equal, so that a triangle soup gives the same answer as the indexed
        mesh. Pairs with the same three positions count as intersecting. So do triangles that touch without a common
        corner, for example at a T-junction. Decided exactly for float64 corners.

        Returns:
            int32 (P, 2): the lower and the higher triangle_id of each pair, sorted.
        Raises:
            DeviceMemoryError: There are more pairs than the device can hold.
        Source:
            Shewchuk (1997) and Guigue, Devillers (2003), as for :meth:`intersecting_triangles`.
        """
        return self._pairs(self)

    def _has_self_intersections(self) -> bool:
        """Whether :meth:`self_intersections` has any pair; stops at the first one found."""

        from geokit.mesh.queries.intersecting_kernels import find_pair_kernel

        return self._any_leaf(find_pair_kernel, self._pair_inputs(self))

    def _has_facing(
        self, other: "OverlapQueries", within: float, sense: float = 1.0, body: NDArray[np.int32] | None = None
    ) -> bool:
        """Whether triangles of two bodies, both wound outward, may face each other, no farther apart than ``within``.

        ``sense`` is -1 where one body is wound inward. Where ``other`` is this surface, ``body`` has the body of each
        face, -1 for none.
        """
        from geokit.mesh.queries.intersecting_kernels import find_facing_kernel

        label = wp.array(np.zeros(0, np.int32) if body is None else body, dtype=wp.int32, device=self._device)
        inputs = [*self._pair_inputs(other)[:-1], label, wp.float64(within), wp.float64(sense)]
        return self._any_leaf(find_facing_kernel, inputs)

    def _any_leaf(self, kernel: Any, inputs: list[Any]) -> bool:
        found = host_flags(1, self._device)
        launcher.launch(kernel, self._leaf_count, inputs, [found], self._device, grain=LEAF_GRAIN)
        return bool(found.numpy()[0])

    def _pairs(self, other: "OverlapQueries") -> NDArray[np.int32]:
        from geokit.mesh.queries.intersecting_kernels import count_pairs_kernel, fill_pairs_kernel

        device, inputs = self._device, self._pair_inputs(other)
        count = wp.empty(self._leaf_count, dtype=wp.int64, device=device)
        launcher.launch(count_pairs_kernel, len(count), inputs, [count], device, grain=LEAF_GRAIN)
        counts = count.numpy()
        items = np.flatnonzero(counts)
        ends = np.cumsum(counts[items])
        total = int(ends[-1]) if len(ends) else 0
        available_memory.require_room(8 * total, f"{total} pairs need", "ask for fewer at once", device)
        pairs = wp.empty(2 * total, dtype=wp.int32, device=device)
        where = [
            wp.array(items, dtype=wp.int32, device=device),
            wp.array(ends - counts[items], dtype=wp.int64, device=device),
        ]
        launcher.launch(fill_pairs_kernel, len(items), [*where, *inputs], [pairs], device, grain=LEAF_GRAIN)
        # Each row packed into one number: the numbers sort as the rows do, on any byte order.
        rows = pairs.numpy().reshape(-1, 2)
        key = np.sort(rows[:, 0].astype(np.int64) << 32 | rows[:, 1])
        return np.stack([key >> 32, key & 0xFFFFFFFF], axis=1).astype(np.int32)

    def _pair_inputs(self, other: "OverlapQueries") -> list[Any]:
        # A power of two scales without rounding; unscaled, products of corners could underflow.
        unit = 2.0 ** -round(math.log2(max(self._frame.scale, other._frame.scale)))
        return [self._tree, other._tree, other._slot_boxes, other is self, wp.float64(unit)]

    @property
    def _leaf_count(self) -> int:
        slots = len(self._tree.slot_triangle)
        return slots // WIDTH if self._device.is_cpu else slots

    @cached_property
    def _slot_boxes(self) -> "wp.array":
        """Boxes of the triangles in blocks of eight, one for each leaf; empty on a GPU, which has one triangle per
        leaf."""
        from geokit.mesh.bvh.tree_kernels import slot_boxes_kernel

        slots = len(self._tree.slot_triangle) if self._device.is_cpu else 0
        boxes = wp.empty(6 * slots, dtype=wp.float32, device=self._device)
        launcher.launch(slot_boxes_kernel, slots, [self._tree], [boxes], self._device)
        return boxes


def require_surface(surface: OverlapQueries, other: OverlapQueries) -> OverlapQueries:
    """``other``, if it is a surface on the device of ``surface``.

    Raises:
        InputError: It is not a Surface, or is on another device.
    """
    if not isinstance(other, OverlapQueries):
        remedy = "prepare one, mesh.Surface(mesh); of a volume take mesh.from_volume(volume)"
        raise InputError(f"other: {type(other).__name__} is not a Surface; {remedy}")
    if other._device != surface._device:
        raise InputError(
            f"other: it is on {other._device.alias}, this surface on {surface._device.alias}; prepare both on one"
        )
    return other


def _require_boxes(lower: user_arrays.Batch, upper: user_arrays.Batch) -> None:

    from geokit.mesh.queries.intersecting_kernels import first_inverted_kernel

    row = user_arrays.reported_row(first_inverted_kernel, lower.rows, [upper.rows])
    if row >= 0:
        low, high = (batch.rows[row : row + 1].numpy()[0].tolist() for batch in (lower, upper))
        raise InputError(f"upper: row {row} {high} is below lower {low}; swap them where they are")


def _sort(key: "wp.array", count: int) -> None:
    if key.device.is_cpu:
        key.numpy()[:count].sort()  # in place: the NumPy array shares the memory of key
        return
    values = wp.empty(2 * count, dtype=wp.int32, device=key.device)
    sort_pairs(key, values, count)
