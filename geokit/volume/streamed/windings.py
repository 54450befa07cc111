"""Exact winding numbers on a lattice, from one that is known and the triangles that lie between.

Lines parallel to an axis cross them; all decisions are exact. Lines run through points that are shifted by
infinitesimal amounts: most along x, far less along y, far less again along z. So no line meets an edge or a vertex, no
point lies on a triangle, and each crossing counts once. float64 decides where its error bound allows it; whole numbers
of any length decide the rest.

Source:
    Edelsbrunner, Mücke, "Simulation of Simplicity" (1990); the error bound of the orientation test: Shewchuk, "Adaptive
    Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates" (1997).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Pairs of a triangle and a line that are tested together: a few MB each, so that they stay in a processor's cache.
PAIRS = 1 << 16
# Relative error of an orientation test, and of a height that is interpolated from its weights.
ORIENTATION_ERROR = 3.3306690738754716e-16
HEIGHT_ERROR = 1e-15
# Products below this may have lost digits.
UNDERFLOW = 1e-290
Floats = NDArray[np.float64]
# Triangles that are looked at together.
AT_A_TIME = 1 << 14
Coordinates = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


class Crossings(NamedTuple):
    """Crossings of lines.

    Attributes:
        line_u: Line of each crossing along the first axis after that of the lines, (C,).
        line_v: The same along the second axis.
        station: The first station that is beyond the triangle, (C,); as many as there are stations if none is.
        change: What the winding number gains at the crossing, 1 or -1, (C,).
    """

    line_u: NDArray[np.int64]
    line_v: NDArray[np.int64]
    station: NDArray[np.int64]
    change: NDArray[np.int64]


def extent(corners: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Lower and upper corner of the box around each triangle (N, 3, 3)."""
    # NumPy's own reductions over an axis of three are ten times slower.
    a, b, c = (corners[:, k] for k in range(3))
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def crossings(
    corners: Floats, box: tuple[Floats, Floats], axis: int, u: Floats, v: Floats, stations: Floats
) -> Iterator[Crossings]:
    """The crossings of triangles with lines along an axis.

    Args:
        corners: Corners of the triangles, (N, 3, 3).
        box: Their :func:`extent`.
        axis: Axis of the lines. The next two, in turn, are u and v.
        u: Ascending coordinates of the lines, (U,). There is a line for each pair of u and v.
        v: Ascending coordinates of the lines, (V,).
        stations: Ascending coordinates along the lines at which the winding number is wanted.
    """
    axes = (axis + 1) % 3, (axis + 2) % 3
    first, count = [], []
    for across, lines in zip(axes, (u, v), strict=True):
        first.append(np.searchsorted(lines, box[0][:, across]))
        count.append(np.searchsorted(lines, box[1][:, across], "right") - first[-1])
    # Crossings beyond the last station change nothing.
    count[1][box[0][:, axis] > stations[-1]] = 0
    pairs = count[0] * count[1]
    rows = np.flatnonzero(pairs)
    ends = np.cumsum(pairs[rows])
    at, total = 0, int(ends[-1]) if len(rows) else 0
    while at < total:
        # A triangle may cross more lines than are tested together.
        number = np.arange(at, min(at + PAIRS, total))
        at += len(number)
        of = np.searchsorted(ends, number, "right")
        row = rows[of]
        within = number - (ends[of] - pairs[row])
        line_u = first[0][row] + within // count[1][row]
        line_v = first[1][row] + within % count[1][row]
        yield _crossed(corners[row], axis, axes, line_u, line_v, (u, v), stations)


def _crossed(
    corners: Floats,
    axis: int,
    axes: tuple[int, int],
    line_u: NDArray[np.int64],
    line_v: NDArray[np.int64],
    lines: tuple[Floats, Floats],
    stations: Floats,
) -> Crossings:
    at = lines[0][line_u], lines[1][line_v]
    flat = corners[:, :, axes]
    weights, errors, signs = [], [], []
    for a, b in ((1, 2), (2, 0), (0, 1)):
        weight, error, sign = _orientation(flat[:, a], flat[:, b], at, axes)
        weights.append(weight)
        errors.append(error)
        signs.append(sign)
    hit = (signs[0] == signs[1]) & (signs[1] == signs[2]) & (signs[0] != 0)
    corners, sign = corners[hit], signs[0][hit]
    line_u, line_v, at = line_u[hit], line_v[hit], (at[0][hit], at[1][hit])
    weight = np.stack(weights, axis=1)[hit]
    height, error = _height(corners[:, :, axis], weight, sum(each[hit] for each in errors))
    low, high = (np.searchsorted(stations, height + side) for side in (-error, error))
    unsure = np.flatnonzero(low < high)
    if len(unsure):
        number = high[unsure] - low[unsure]
        row = np.repeat(unsure, number)
        station = np.arange(len(row)) - np.repeat(np.cumsum(number) - number, number) + low[row]
        points = np.empty((len(row), 3))
        points[:, axes[0]], points[:, axes[1]], points[:, axis] = at[0][row], at[1][row], stations[station]
        beyond = _beyond(corners[row], points, sign[row])
        np.add.at(low, row[~beyond], 1)
    # Whoever passes a triangle along its normal leaves a solid.
    return Crossings(line_u, line_v, low, -sign)


def _height(heights: Floats, weight: Floats, error: Floats) -> tuple[Floats, Floats]:
    """Height of triangles at lines that cross them, and its error: weights are those of the corners, up to a factor."""
    low, high = extent(heights)
    whole = weight[:, 0] + weight[:, 1] + weight[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        height = np.einsum("ij,ij->i", weight, heights) / whole
        share = 4.0 * error / np.abs(whole)
    unknown = ~(share < 0.5)
    height = np.where(unknown, low, np.clip(height, low, high))
    bound = np.where(unknown, 1.0, share) * (high - low) + HEIGHT_ERROR * np.maximum(np.abs(low), np.abs(high))
    return height, np.where(low == high, 0.0, bound * 1.0000001 + UNDERFLOW)


def _orientation(
    a: Floats, b: Floats, at: tuple[Floats, Floats], axes: tuple[int, int]
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """On which side of a line from a to b (N, 2) points are: twice the area, its error, and the exact sign."""
    factors = a[:, 0] - at[0], b[:, 1] - at[1], a[:, 1] - at[1], b[:, 0] - at[0]
    left, right = factors[0] * factors[1], factors[2] * factors[3]
    area, error = left - right, ORIENTATION_ERROR * (np.abs(left) + np.abs(right)) + UNDERFLOW
    sign = np.sign(area).astype(np.int64)
    unsure = np.flatnonzero(np.abs(area) <= error)
    if len(unsure):
        a, b = a[unsure], b[unsure]
        found = np.zeros(len(unsure), np.int64)
        # Products with a factor of zero have no error; others are computed again.
        zero = [factor[unsure] == 0.0 for factor in factors]
        inexact = np.flatnonzero(~((zero[0] | zero[1]) & (zero[2] | zero[3])))
        if len(inexact):
            table = np.column_stack([a[inexact], b[inexact], at[0][unsure[inexact]], at[1][unsure[inexact]]])
            au, av, bu, bv, pu, pv = _whole_numbers(table).T
            found[inexact] = _signs((au - pu) * (bv - pv) - (av - pv) * (bu - pu))
        shifts = [np.sign(a[:, 1] - b[:, 1]), np.sign(b[:, 0] - a[:, 0])]
        for shift in shifts if axes[0] < axes[1] else shifts[::-1]:
            found = np.where(found == 0, shift.astype(np.int64), found)
        sign[unsure] = found
    return area, error, sign


def _beyond(corners: Floats, points: Floats, sign: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether points (N, 3) are beyond triangles along the axis to which ``sign`` of the normals belongs, exactly."""
    table = _whole_numbers(np.column_stack([corners.reshape(-1, 9), points]))
    a, b, c, p = (table[:, k : k + 3] for k in (0, 3, 6, 9))
    ab, ac, ap = b - a, c - a, p - a
    normal = [ab[:, (k + 1) % 3] * ac[:, (k + 2) % 3] - ab[:, (k + 2) % 3] * ac[:, (k + 1) % 3] for k in range(3)]
    side = _signs(sum(normal[k] * ap[:, k] for k in range(3)))
    for part in normal:
        side = np.where(side == 0, _signs(part), side)
    return np.asarray(side * sign > 0)


def _whole_numbers(table: Floats) -> NDArray[Any]:
    """The same numbers, multiplied by one power of two, as integers of any length."""
    fraction, exponent = np.frexp(table)
    whole = np.ldexp(fraction, 53).astype(np.int64)
    shift = exponent - exponent[whole != 0].min(initial=0)
    return np.asarray(whole.astype(object) << np.where(whole != 0, shift, 0).astype(object))


def _signs(numbers: Any) -> NDArray[np.int64]:
    return np.asarray((numbers > 0).astype(np.int64) - (numbers < 0).astype(np.int64))


def in_parts(rows: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Rows of an array, some at a time."""
    for first in range(0, len(rows), AT_A_TIME):
        yield rows[first : first + AT_A_TIME]


class CornerWindings:
    """Winding numbers at few lattice points, for which many triangles are looked at one after the other.

    The way to a point runs along x, then y, then z. A crossing before the first point of a line counts at all points
    of the line alike, and so not at all.

    Args:
        lattice: Ascending coordinates of the points along each axis.
        known: Winding number at the first point.
    """

    def __init__(self, lattice: Coordinates, known: int) -> None:
        self.lattice, self.known = lattice, known
        x, y, z = (len(axis) for axis in lattice)
        self._along = [np.zeros(shape, np.int64) for shape in ((x + 1,), (x, y + 1), (x, y, z + 1))]

    def add(self, corners: NDArray[np.float64]) -> None:
        """Look at more triangles, (N, 3, 3)."""
        x, y, z = self.lattice
        box = extent(corners)
        for found in crossings(corners, box, 0, y[:1], z[:1], x):
            np.add.at(self._along[0], found.station, found.change)
        for found in crossings(corners, box, 1, z[:1], x, y):
            np.add.at(self._along[1], (found.line_v, found.station), found.change)
        for found in crossings(corners, box, 2, x, y, z):
            np.add.at(self._along[2], (found.line_u, found.line_v, found.station), found.change)

    def numbers(self) -> NDArray[np.int64]:
        """Winding numbers of the points, (X, Y, Z)."""
        x, y, z = (np.cumsum(part[..., 1:-1], axis=-1) for part in self._along)
        x, y, z = (np.concatenate([np.zeros((*part.shape[:-1], 1), np.int64), part], axis=-1) for part in (x, y, z))
        return np.asarray(self.known + x[:, None, None] + y[:, :, None] + z)


class ColumnWindings:
    """Winding numbers at any points of a large lattice, from triangles that are all at hand.

    Args:
        corners: The triangles, (N, 3, 3).
        lattice: Ascending coordinates of the points along each axis.
        known: Winding number at the first point.
    """

    def __init__(self, corners: NDArray[np.generic], lattice: Coordinates, known: int) -> None:
        x, y, z = lattice
        floor = CornerWindings((x, y, z[:1]), known)
        keys, changes = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        self._shape = len(x), len(y), len(z)
        for part in in_parts(corners):
            part = part.astype(np.float64)
            floor.add(part)
            for found in crossings(part, extent(part), 2, x, y, z):
                used = (found.station > 0) & (found.station < len(z))
                keys.append(self._key(found.line_u, found.line_v, found.station)[used])
                changes.append(found.change[used])
        self._floor = floor.numbers()[:, :, 0].reshape(-1)
        key, change = np.concatenate(keys), np.concatenate(changes)
        order = np.argsort(key, kind="stable")
        self._keys = key[order]
        whole = np.cumsum(change[order])
        column = self._keys // len(z)
        starts = np.searchsorted(column, column)
        self._sums = whole - np.where(starts > 0, whole[starts - 1], 0)

    def _key(self, x: NDArray[np.int64], y: NDArray[np.int64], z: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.asarray((x * self._shape[1] + y) * self._shape[2] + z)

    def at(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        """Winding numbers at points, which are given by their places along each axis, (N, 3)."""
        key = self._key(*places.T)
        column = key // self._shape[2]
        numbers = self._floor[column]
        if len(self._keys):
            last = np.searchsorted(self._keys, key, "right") - 1
            below = (last >= 0) & (self._keys[last] // self._shape[2] == column)
            numbers = numbers + np.where(below, self._sums[last], 0)
        return np.asarray(numbers)
