"""Clouds packed one after the other, each searched for itself: their offsets, and cells for each of them.

Group g holds the rows from ``offsets[g]`` to ``offsets[g + 1]``. Each has its own cells in common arrays, at its own
place: coordinates are not shifted, so every distance is that of a grid over the group alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop.user_arrays import read_numbers
from geokit.core.memory.struct_array import layout_of_struct, struct_array
from geokit.errors import InputError
from geokit.points.search.cells import FEW_CELLS, INTERVALS, Cells, Survey, frame, intervals, place, survey

# Groups with more points have intervals of cells, as a grid without groups has. A smaller one has equal cells: where
# one far point leaves all others in one cell, a query compares this many.
LARGE = 1 << 12
# A group gets this many cells whatever its size.
LEAST_CELLS = 8.0
# Most cells on an axis of a small group.
MOST_ON_AXIS = 1 << 20
# Edges of cells grow at least by this factor until there are few enough of them.
LEAST_GROWTH = 1.1
# Keys fit in 63 bits with all groups together.
KEY_BITS = 62
# Cells of an interval: at most 2^14 in one large group, 2^7 with as many large groups as int32 has points for.
MOST_BITS = 14


class Groups(NamedTuple):
    """Boxes of the groups, taken before the points are sorted.

    Attributes:
        offsets: Group g is the points ``[offsets[g], offsets[g + 1])``; shape (G + 1,) int64.
        numbers: Group of each point, int32 (N,) on the device.
        lower: Lower corners (G, 3) [world]; inf where there are no points.
        upper: Upper corners (G, 3) [world]; -inf where there are no points.
        large: Survey of each group with more than LARGE points.
    """

    offsets: NDArray[np.int64]
    numbers: Any
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    large: dict[int, Survey]


def read_offsets(groups: Any, count: int, what: str, name: str = "groups") -> NDArray[np.int64]:
    """Check the offsets of groups in ``count`` packed rows and return them.

    Raises:
        InputError: groups are not whole numbers from 0 to ``count`` in ascending order, with both at the ends.
    """
    values = read_numbers(groups, name)
    if values.ndim != 1 or len(values) == 0:
        raise InputError(f"{name}: shape {values.shape} is not (G + 1,); give the first row of each group, and the end")
    bad = values != np.floor(values)
    bad[1:] |= values[1:] < values[:-1]
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"{name}: row {row} is {values[row]:g}; give whole numbers that do not descend")
    if values[0] != 0 or values[-1] != count:
        raise InputError(
            f"{name}: from {values[0]:g} to {values[-1]:g}, which are not all {count} {what}; begin with 0 and end "
            f"with {count}"
        )
    return values.astype(np.int64)


def numbers_of(offsets: NDArray[np.int64], device: Any) -> "wp.array":
    """Group of each row, int32 on the device."""
    numbers = np.repeat(np.arange(len(offsets) - 1, dtype=np.int32), np.diff(offsets))
    return wp.array(numbers, dtype=wp.int32, device=device)


def survey_groups(points: "wp.array", offsets: NDArray[np.int64]) -> Groups:
    """Box of each group of vec3d or vec3f points [world]."""
    from geokit.points.search.cells_kernels import GROUP_BOX

    device: Any = points.device
    count = len(offsets) - 1
    boxes = [wp.empty(count, dtype=wp.vec3d, device=device) for _ in range(2)]
    given = [points, wp.array(offsets, dtype=wp.int64, device=device), LARGE]
    launcher.launch(GROUP_BOX[points.dtype], count, given, boxes, device)
    lower, upper = (box.numpy().reshape(-1, 3).copy() for box in boxes)
    large = {}
    for group in np.flatnonzero(np.diff(offsets) > LARGE).tolist():
        large[group] = survey(points[offsets[group] : offsets[group + 1]])
        lower[group], upper[group] = large[group].lower, large[group].upper
    return Groups(offsets, numbers_of(offsets, device), lower, upper, large)


def usual_spacing_of(groups: Groups) -> float:
    """Median of the groups' mean spacings [world]; 0 if all points of each group coincide."""
    counts = np.diff(groups.offsets)
    extent = np.where(counts[:, None] > 0, groups.upper - groups.lower, 0.0)
    some = (extent > 0.0).any(axis=1)
    edges = (extent > 0.0)[some]
    logarithms = np.log(np.where(edges, extent[some], 1.0)).sum(axis=1) - np.log(counts[some])
    return float(np.exp(np.median(logarithms / edges.sum(axis=1)))) if some.any() else 0.0


def build_group_cells(points: "wp.array", groups: Groups, radius: float) -> Cells:
    """Sort the points of each group into cells of about the radius.

    Args:
        points: vec3d or vec3f positions (N,) [world]; copied.
        groups: Their groups.
        radius: Edge length of a cell [world] if the extents allow it; above 0.
    Returns:
        Cells. Memory: that of build_cells, 4 bytes a point and some 220 bytes a group.
    """
    from geokit.points.search import cells_kernels as kernels

    device: Any = points.device
    sizes = np.diff(groups.offsets)
    extent = np.where(sizes[:, None] > 0, groups.upper - groups.lower, 0.0)
    counts = _cells_of(extent, radius, np.maximum(FEW_CELLS * sizes, LEAST_CELLS))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(extent > 0.0, np.minimum(counts / extent, 1e300), 1.0)
    lower = np.where(sizes[:, None] > 0, groups.lower, 0.0)
    cut = [np.stack([lower, inverse, np.zeros_like(lower), counts], axis=2).reshape(-1, 4)]
    layout: Any = kernels.GroupCells
    rows: Any = np.zeros(len(sizes), dtype=layout_of_struct(layout))
    rows["lower"], rows["upper"] = groups.lower, groups.upper
    rows["center"] = lower + 0.5 * extent
    rows["scale"] = np.ldexp(1.0, np.clip(-np.frexp(extent.max(axis=1, initial=0.0))[1], -1000, 1000))
    rows["first_cut"] = rows["last_cut"] = np.arange(3 * len(sizes)).reshape(-1, 3)
    known = len(cut[0])
    most = 1 << min(MOST_BITS, (KEY_BITS - len(groups.large).bit_length()) // 3 - INTERVALS.bit_length() + 1)
    for group, own in groups.large.items():
        rows["center"][group], rows["scale"][group] = frame(own)
        longest = min(max(int(sizes[group]) // INTERVALS, 1), most)
        for axis in range(3):
            cut.append(intervals(own, axis, radius, longest))
            rows["first_cut"][group, axis], known = known, known + len(cut[-1])
            rows["last_cut"][group, axis] = known - 1
            counts[group, axis] = cut[-1][:, 3].sum()
    whole = counts.astype(np.int64)
    rows["count_x"], rows["count_y"] = whole[:, 0], whole[:, 1]
    keys = whole.prod(axis=1)
    rows["base"] = np.cumsum(keys) - keys
    grid: Any = kernels.CellGrid()
    grid.cut = wp.array(np.concatenate(cut), dtype=wp.vec4d, device=device)
    grid.groups = struct_array(rows, kernels.GroupCells, device)
    grid.group = groups.numbers
    return Cells(grid=place(grid, points, int(keys.sum())), radius=radius)


def _cells_of(extent: NDArray[np.float64], radius: float, most: NDArray[np.float64]) -> NDArray[np.float64]:
    """Number of cells on each axis (G, 3): of the radius, or longer where there would be more than ``most`` (G,)."""
    edge = np.full(len(extent), radius)
    while True:
        with np.errstate(over="ignore"):
            counts = np.clip(np.floor(extent / edge[:, None]), 1.0, MOST_ON_AXIS)
        share = counts.prod(axis=1) / most
        if not (share > 1.0).any():
            return counts
        edge *= np.where(share > 1.0, np.maximum(np.cbrt(share), LEAST_GROWTH), 1.0)
