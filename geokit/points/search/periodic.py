"""Periodic cells: points are moved into the cell, and their images around it become further points to find.

Any radius is allowed. Where it is longer than half the cell, several images of a point are its neighbors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop.arrays import reinterpreted
from geokit.core.interop.user_arrays import read_numbers
from geokit.core.memory import available_memory, host_pool
from geokit.core.scan import gathered, prefix_sum
from geokit.errors import DeviceMemoryError, InputError

# Flatter cells lose the digits of fractional coordinates: this bounds the ratio of the longest to the shortest stretch.
FLATTEST = 1e8
# Margin of fractional coordinates for their roundings, times that ratio. Images beyond the reach cost time only.
MARGIN = 1e-14
# Most cells between a point and the first one.
MOST_TURNS = 1 << 24
# Bytes of an image: its position, its point and its shift, and what the cells of the search hold and need in between.
BYTES_PER_IMAGE = 24 + 4 + 12 + 76
# Indices of points and images are int32.
MOST_POINTS = 2**31 - 1


def read_cell(periodic: Any) -> NDArray[np.float64]:
    """Check a periodic cell and return its vectors as rows (3, 3).

    Raises:
        InputError: periodic is neither three positive lengths nor three vectors that span a volume.
    """
    cell = read_numbers(periodic, "periodic")
    if cell.shape not in ((3,), (3, 3)):
        raise InputError(f"periodic: shape {cell.shape} is neither (3,), edges of a box, nor (3, 3), vectors of a cell")
    if not np.isfinite(cell).all():
        raise InputError("periodic: the cell is not finite; give the length of every edge")
    if cell.ndim == 1:
        if (cell <= 0.0).any():
            row = int(np.argmax(cell <= 0.0))
            raise InputError(f"periodic: edge {row} is {cell[row]:g}; give three positive lengths")
        cell = np.diag(cell)
    lengths = np.sqrt((cell * cell).sum(axis=1))
    if not (lengths > 0.0).all() or not np.isfinite(lengths).all() or np.linalg.cond(cell) > FLATTEST:
        raise InputError(f"periodic: the vectors {cell.tolist()} hardly span a volume; give three in general position")
    return cell


class Images:
    """Points moved into a periodic cell, followed by their images within reach of it.

    Args:
        points: vec3d positions (N,) [world].
        cell: Vectors of the cell (3, 3), rows [world].
        reach: Longest search radius [world] that finds all neighbors.
    Attributes:
        given: The points as given.
        inside: The points in the cell, vec3d (N,).
        turn: By how many of the cell's vectors each was outside, vec3i (N,).
        points: ``inside`` and the M images, vec3d (N + M,).
        of: Point of each image, int32 (M,), ascending.
        shift: Vectors of the cell by which each image is moved, vec3i (M,).
        ends: Number of the images of each point and of those before it, int32 (N,).
        vectors: The cell as kernels take it.
        extent: Bound of the coordinates of points in the cell and of images [world].
    Raises:
        DeviceMemoryError: The images do not fit in memory.
    """

    def __init__(self, points: "wp.array", cell: NDArray[np.float64], reach: float) -> None:
        from geokit.points.search import periodic_kernels as kernels

        self.given, self.cell, self.reach = points, cell, reach
        device: Any = points.device
        count = len(points)
        inverse = np.linalg.inv(cell)
        # Distances between opposite faces of the cell.
        heights = 1.0 / np.sqrt((inverse * inverse).sum(axis=0))
        margin = MARGIN * float(np.linalg.cond(cell))
        with np.errstate(over="ignore"):
            shares = (reach / heights) * (1.0 + margin) + margin
        self._require_room(count, shares, device)
        self.vectors: Any = kernels.PeriodicCell()
        self.vectors.a, self.vectors.b, self.vectors.c = (wp.vec3d(*row) for row in cell.tolist())
        self.vectors.inverse = wp.mat33d(*inverse.ravel().tolist())
        self.vectors.reach = wp.vec3d(*shares.tolist())
        self.extent = float((2.0 + shares.max()) * np.abs(cell).sum())
        self.inside, self.turn = self.wrapped(points)
        counts = wp.empty(count, dtype=wp.int32, device=device)
        launcher.launch(kernels.image_count_kernel, count, [self.inside, self.vectors], [counts], device)
        self.ends, total = prefix_sum(counts)
        self.points = wp.empty(count + total, dtype=wp.vec3d, device=device)
        self.of = wp.empty(total, dtype=wp.int32, device=device)
        self.shift = wp.empty(total, dtype=wp.vec3i, device=device)
        given = [self.inside, self.vectors, self.ends]
        launcher.launch(kernels.image_kernel, count, given, [self.points, self.of, self.shift], device)

    def _require_room(self, count: int, shares: NDArray[np.float64], device: Any) -> None:
        # At most so many: a point has up to as many images along a vector as fit into the reach, and one more.
        with np.errstate(over="ignore"):
            most, likely = (count * float((least + 2.0 * shares).prod()) for least in (2.0, 1.0))
        needed, free = likely * BYTES_PER_IMAGE, available_memory.available(device)
        if most > MOST_POINTS or needed > free:
            raise DeviceMemoryError(
                f"periodic: {count} points and about {likely:.3g} images within {self.reach:g} of the cell need "
                f"{needed / 2**30:.3g} GiB of {free / 2**30:.3g} GiB free on {device.alias}; use a smaller radius",
                need=int(min(needed, 2.0**62)),
            )

    def wrapped(self, points: "wp.array") -> tuple["wp.array", "wp.array"]:
        """vec3d points moved into the cell, and by how many of its vectors they were outside, vec3i."""
        from geokit.points.search.periodic_kernels import wrap_kernel

        device: Any = points.device
        inside = wp.empty(len(points), dtype=wp.vec3d, device=device)
        turn = wp.empty(len(points), dtype=wp.vec3i, device=device)
        launcher.launch(wrap_kernel, len(points), [points, self.vectors], [inside, turn], device)
        return inside, turn

    def listed(self, offsets: Any, indices: Any, distance: Any, turn: Any) -> tuple[Any, ...]:
        """Rows that ascend by index, sorted by point, then shift, and named.

        With the shifts (M,) for queries ``turn``, unless that is None.
        """
        from geokit.points.search.periodic_kernels import LIST

        device, total = offsets.device, 0 if turn is None else len(indices)
        out = [host_pool.empty_warp(len(rows), rows.dtype, device) for rows in (indices, distance)]
        shifts = reinterpreted(host_pool.empty_warp(3 * total, wp.int32, device), wp.vec3i, (total,))
        given = [offsets, indices, distance, self.turn, self.turn if turn is None else turn, self.of, self.shift]
        launcher.launch(LIST[distance.dtype], len(offsets) - 1, given, [*out, shifts], device)
        return (offsets, *out) if turn is None else (offsets, *out, shifts)

    def shifts(self, offsets: Any, indices: Any, turn: Any) -> "wp.array":
        """Shift of each neighbor of queries with these turns, vec3i (M,)."""
        from geokit.points.search.periodic_kernels import shift_kernel

        out = wp.empty(len(indices), dtype=wp.vec3i, device=offsets.device)
        given = [offsets, indices, self.turn, turn, self.of, self.shift]
        launcher.launch(shift_kernel, len(offsets) - 1, given, [out], offsets.device)
        return out

    def named(self, indices: Any) -> Any:
        """The point of each neighbor, in place of its image."""
        from geokit.points.search.periodic_kernels import name_kernel

        launcher.launch(name_kernel, len(indices), [len(self.turn), self.of], [indices], indices.device)
        return indices


def sort_by_distance(offsets: Any, indices: Any, distance: Any, *others: Any) -> tuple[Any, ...]:
    """Rows sorted by distance, then by the order in which they are given, and other arrays of theirs."""
    from geokit.points.search import radius

    place = wp.array(np.arange(len(indices)), dtype=wp.int32, device=offsets.device)
    radius.sort_by_distance(offsets, place, distance)
    return offsets, gathered(indices, place), distance, *(gathered(rows, place) for rows in others)
