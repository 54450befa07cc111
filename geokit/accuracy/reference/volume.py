"""Independent reference for volumes: values at points in slow, simple float64 NumPy, without code shared with geokit.

Voxels are read from the bytes of the grid by plain indexing; interpolants are polynomials summed voxel by voxel.
Distances of shapes are in accuracy/stability/shapes.py, those of meshes in accuracy/reference/mesh.py. Tested against
hand-made trees, polynomials and analytic shapes in tests/accuracy/charts/test_volume_charts.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.errors import UnsupportedGridError

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

Floats = NDArray[np.float64]
Reader = Callable[[NDArray[np.int64]], NDArray[Any]]

# Byte offsets in NanoVDB's float grids (PNanoVDB.h): size of the grid header; of a root and of one row of its table;
# child masks and slots of the two inner levels; value mask and values of leaves.
_GRID, _ROOT, _ROW = 672, 64, 32
_UPPER, _LOWER, _LEAF_MASK, _LEAF_VALUES, _LEAF = (32 + 4096, 8256), (32 + 512, 1088), 16, 96, 2144
# Leaves whose masks are unpacked at once when voxels are drawn: 4 MB.
_OPENED = 8192


class Voxels:
    """The voxels of a float grid.

    Args:
        volume: A grid of type "float".
    Raises:
        UnsupportedGridError: The grid is of another type.
    """

    def __init__(self, volume: SparseVolume) -> None:
        if volume.info.grid_type != "float":
            raise UnsupportedGridError(
                f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} cannot be read here; convert it to "
                "float, with quantize(volume, 'float') where its values are floating point"
            )
        buffer = volume.nanovdb[: len(volume.nanovdb) // 8 * 8]
        self._bytes, self._words, self._floats = buffer, buffer.view("<i8"), buffer.view("<f4")
        # Floats and words are indexed by offset over size, since every node starts at a multiple of 32.
        leaf, _, _, root = (int(word) for word in self._words[_GRID // 8 : _GRID // 8 + 4])
        self._leaves = _GRID + leaf
        self._leaf_count = int(buffer[_GRID + 32 : _GRID + 36].view("<u4")[0])
        self._root = _GRID + root
        tiles = int(buffer[self._root + 24 : self._root + 28].view("<u4")[0])
        rows = self._root + _ROOT + _ROW * np.arange(tiles)
        keys = self._words[rows // 8].view("<u8")
        order = np.argsort(keys)
        self._keys, self._rows = keys[order], rows[order]
        self.background = float(self._floats[(self._root + 28) // 4])
        self.transform = volume.info.transform
        self._inverse = np.linalg.inv(self.transform[:3, :3])

    def __call__(self, ijk: NDArray[np.int64]) -> Floats:
        """Values (N,) of voxels (N, 3), from leaves, tiles or the background."""
        return self._walk(np.asarray(ijk, np.int64))[0]

    def leaf_values(self, ijk: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
        """Values (N,) of voxels (N, 3), and whether each is an active voxel of a leaf."""
        values, leaf, slot = self._walk(np.asarray(ijk, np.int64))
        active = np.zeros(len(values), bool)
        some = leaf > 0
        active[some] = self._bits(leaf[some] + _LEAF_MASK, slot[some])
        return values, active

    def draw_active(self, count: int, seed: int) -> NDArray[np.int64]:
        """Up to ``count`` distinct random active voxels of leaves (N, 3)."""
        rng = np.random.default_rng(seed)
        chosen = np.arange(self._leaf_count)
        if self._leaf_count > _OPENED:
            chosen = rng.choice(self._leaf_count, _OPENED, replace=False)
        starts = self._leaves + _LEAF * np.sort(chosen)
        masks = self._bytes[starts[:, None] + _LEAF_MASK + np.arange(64)]
        leaf, slot = np.nonzero(np.unpackbits(masks, axis=1, bitorder="little"))
        if len(leaf) > count:
            rows = np.sort(rng.choice(len(leaf), count, replace=False))
            leaf, slot = leaf[rows], slot[rows]
        corner = self._bytes[starts[:, None] + np.arange(12)].view("<i4").astype(np.int64) & ~7
        return corner[leaf] + np.stack([slot >> 6, slot >> 3 & 7, slot & 7], axis=1)

    def to_index(self, points: Floats) -> Floats:
        """World points converted to index coordinates (N, 3)."""
        return (np.asarray(points, np.float64) - self.transform[:3, 3]) @ self._inverse.T

    def to_world(self, index: Any) -> Floats:
        """Index coordinates converted to world space (N, 3)."""
        return np.asarray(index, np.float64) @ self.transform[:3, :3].T + self.transform[:3, 3]

    def sample(self, points: Floats, order: int) -> Floats:
        """The interpolant of an order, 0 to 3, at world points (N, 3)."""
        return interpolant(self, self.to_index(points), order)

    def gradient(self, points: Floats, order: int) -> Floats:
        """Gradient of the interpolant at world points (N, 3) [value / world]."""
        return interpolant_gradient(self, self.to_index(points), order) @ self._inverse

    def _walk(self, ijk: NDArray[np.int64]) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
        """Values, offsets of the leaves (0 for none) and slots in them."""
        x, y, z = ijk.T
        values, leaf = np.full(len(ijk), self.background), np.zeros(len(ijk), np.int64)
        slot = (x & 7) << 6 | (y & 7) << 3 | (z & 7)
        key = ((x & 0xFFFFFFFF) >> 12 << 42 | (y & 0xFFFFFFFF) >> 12 << 21 | (z & 0xFFFFFFFF) >> 12).astype(np.uint64)
        if len(self._keys) == 0:
            return values, leaf, slot
        row = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
        at = np.flatnonzero(self._keys[row] == key)
        entry = self._rows[row[at]]
        child = self._words[entry // 8 + 1]
        values[at] = self._floats[entry // 4 + 5]
        at, node = at[child != 0], self._root + child[child != 0]
        for bits, shift, (masks, slots) in ((5, 7, _UPPER), (4, 3, _LOWER)):
            low = (1 << bits) - 1
            n = ((x[at] >> shift) & low) << 2 * bits | ((y[at] >> shift) & low) << bits | ((z[at] >> shift) & low)
            entry = node + slots + 8 * n
            has_child = self._bits(node + masks, n)
            values[at] = self._floats[entry // 4]
            at, node = at[has_child], node[has_child] + self._words[entry[has_child] // 8]
        leaf[at] = node
        values[at] = self._floats[(node + _LEAF_VALUES) // 4 + slot[at]]
        return values, leaf, slot

    def _bits(self, mask: NDArray[np.int64], n: NDArray[np.int64]) -> NDArray[np.bool_]:
        return (self._bytes[mask + (n >> 3)] >> (n & 7).astype(np.uint8) & 1).astype(bool)


def axis_weights(order: int, t: Floats, derivative: int = 0) -> Floats:
    """Weights (N, order + 1) of the voxels along an axis for a point at t between voxels 0 and 1.

    Order 1 is the line through voxels 0 and 1, order 2 the parabola through -1, 0 and 1. The cubic of order 3, over -1,
    0, 1 and 2, interpolates voxels 0 and 1 with central differences as slopes, in Hermite form.
    """
    from numpy.polynomial import Polynomial

    x = Polynomial([0.0, 1.0])
    if order == 1:
        basis = [1 - x, x]
    elif order == 2:
        basis = [x * (x - 1) / 2, (1 - x) * (1 + x), x * (x + 1) / 2]
    else:
        value_0, value_1 = (1 + 2 * x) * (1 - x) ** 2, x**2 * (3 - 2 * x)
        slope_0, slope_1 = x * (1 - x) ** 2, x**2 * (x - 1)
        basis = [-slope_0 / 2, value_0 - slope_1 / 2, value_1 + slope_0 / 2, slope_1 / 2]
    return np.stack([(b.deriv(derivative) if derivative else b)(t) for b in basis], axis=-1)


def tensor_interpolant(at: Reader, u: Floats, order: int, derivatives: tuple[int, int, int] = (0, 0, 0)) -> Any:
    """Trilinear, triquadratic or tricubic interpolant at index coordinates, or one of its derivatives.

    Args:
        at: Returns the values (N, ...) of voxels (N, 3).
        u: Index coordinates (N, 3).
        order: 1, 2 or 3.
        derivatives: Order of the derivative along each index axis.
    Returns:
        Values (N, ...).
    """
    base = np.floor(u)
    weights = [axis_weights(order, u[:, a] - base[:, a], derivatives[a]) for a in range(3)]
    count, lowest = order + 1, -1 if order > 1 else 0
    total: Any = 0.0
    for p, q, r in np.ndindex(count, count, count):
        value = at(base.astype(np.int64) + np.array([p, q, r]) + lowest)
        weight = weights[0][:, p] * weights[1][:, q] * weights[2][:, r]
        total = total + weight.reshape(-1, *[1] * (value.ndim - 1)) * value
    return total


def interpolant(at: Reader, u: Floats, order: int) -> Any:
    """Interpolant of an order, 0 (nearest voxel, halves up) to 3, at index coordinates (N, 3)."""
    if order == 0:
        return at(np.floor(u + 0.5).astype(np.int64))
    return tensor_interpolant(at, u, order)


def interpolant_gradient(at: Reader, u: Floats, order: int) -> Floats:
    """Gradient of the interpolant (N, 3), per index unit; for order 0, central differences around the nearest voxel."""
    axes = np.eye(3, dtype=np.int64)
    if order == 0:
        nearest = np.floor(u + 0.5).astype(np.int64)
        return np.stack([0.5 * (at(nearest + axis) - at(nearest - axis)) for axis in axes], axis=1)
    return np.stack([tensor_interpolant(at, u, order, (int(x), int(y), int(z))) for x, y, z in axes], axis=1)


def interpolant_along(at: Reader, start: Floats, toward: Floats, t: Floats) -> Floats:
    """Trilinear interpolant at ``start + t * toward`` (index space), shape (T,).

    Args:
        at: Returns the values (N,) of voxels (N, 3).
        start: Start of the ray.
        toward: Direction of the ray.
        t: Ray parameters.
    """
    u = start + t[:, None] * toward
    base = np.floor(u)
    share = u - base
    total = np.zeros(len(t))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, share, 1.0 - share), axis=1)
        # A weight of zero must not turn an unused voxel into NaN.
        total += np.where(weight == 0.0, 0.0, weight * at(base.astype(np.int64) + corner))
    return total


def borders_along(start: Floats, toward: Floats, first: float, last: float) -> Floats:
    """Ray parameters between ``first`` and ``last`` at which the ray changes cells, with both ends, ascending."""
    found = [np.array([first, last])]
    for a in range(3):
        if toward[a] != 0.0:
            ends = sorted((start[a] + first * toward[a], start[a] + last * toward[a]))
            found.append((np.arange(np.ceil(ends[0]), np.floor(ends[1]) + 1) - start[a]) / toward[a])
    t = np.unique(np.concatenate(found))
    return t[(t >= first) & (t <= last)]


def first_level(at: Reader, start: Floats, toward: Floats, isovalue: float, first: float, last: float) -> float:
    """First t at which the trilinear interpolant along a ray has crossed the isovalue; inf for none.

    Every cell is cut into 16 pieces, and a piece with a crossing is cut into 32 pieces ten times. Levels that are
    touched, or crossed twice within a piece, are missed.
    """
    borders = borders_along(start, toward, first, last)
    t = np.append((borders[:-1, None] + np.diff(borders)[:, None] * np.arange(16) / 16).ravel(), borders[-1])
    for _ in range(11):
        over = interpolant_along(at, start, toward, t) > isovalue
        change = np.flatnonzero(over[:-1] != over[1:])
        if not len(change):
            return np.inf
        t = np.linspace(t[change[0]], t[change[0] + 1], 33)
    return float(t[-1])


class LevelHit(NamedTuple):
    """Result of :func:`nearest_to_level`.

    Attributes:
        distance: Distance to the level of the interpolant, to first order [world], shape (N,).
        steep: Whether the gradient is long enough for this, shape (N,) bool.
    """

    distance: Floats
    steep: NDArray[np.bool_]


def nearest_to_level(voxels: Voxels, points: Floats, isovalue: float, flat: float) -> LevelHit:
    """Distances of points from a level of the trilinear interpolant: its difference over the length of its gradient.

    Correct to first order: accurate for points that are near compared with the radius of curvature of the level.

    Args:
        voxels: The field.
        points: Points [world], shape (N, 3).
        isovalue: The level.
        flat: Gradients shorter than this [value / world] give no distance.
    Returns:
        LevelHit; distances are 0 where ``steep`` is False.
    """
    off = np.abs(voxels.sample(points, 1) - isovalue)
    slope = np.linalg.norm(voxels.gradient(points, 1), axis=1)
    steep = slope > flat
    return LevelHit(np.where(steep, off / np.where(steep, slope, 1.0), 0.0), steep)
