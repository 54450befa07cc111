"""Conversion of leaves of scalar floating-point grids to values, and of values to float and quantized leaves.

A quantized leaf holds codes of 1 to 16 bits: ``value = code * quantum + minimum``, in float32, as NanoVDB reads it.

Source:
    NanoVDB (Museth 2021), NanoVDB.h and GridBuilder.h of OpenVDB 10.0.1. Differs: the thresholds of dithering are a
    Bayer pattern.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.memory.host_array import HostArray
from geokit.errors import InputError
from geokit.volume.nanovdb.grid_array import array_of
from geokit.volume.nanovdb.header import grid_header
from geokit.volume.nanovdb.layout import LEAF_VOXELS, QUANTIZED_HEADER, layout_of
from geokit.volume.nanovdb.nodes import grid_nodes
from geokit.volume.nanovdb.types import BY_NAME
from geokit.volume.tree.retype_tree import RetypedTree

HEADER = QUANTIZED_HEADER
# Widths of an FpN leaf, in the order of the logarithms that the flags store.
BITS = (1, 2, 4, 8, 16)
# Bytes of box, flags and mask, the same in every type.
COMMON = 80
# Bits of a leaf's flags; the remaining bits hold the width of an FpN leaf.
FLAG_BITS = 0x1F
FPN_TYPE = BY_NAME["fpn"].number
# A leaf of a float grid has as many bytes before its values as a quantized one.
FLOAT_LEAF = HEADER + 4 * LEAF_VOXELS
# Leaves of other types converted to float leaves at a time: 17 MiB.
LEAVES_AT_A_TIME = 8192
# Leaves that a thread converts at a time: their values in float64 take a megabyte.
LEAVES_PER_TASK = 256
# Fewest leaves that are worth a slice of a launch: each takes some microseconds.
LEAF_GRAIN = 64


class Codes(NamedTuple):
    """Leaves as codes.

    Attributes:
        codes: Shape (L, 512) uint16, below ``2^bits``.
        minimum: Value of code 0, shape (L,) float32.
        quantum: Difference of two successive codes, shape (L,) float32; 0 if all values are equal.
    """

    codes: NDArray[np.uint16]
    minimum: NDArray[np.float32]
    quantum: NDArray[np.float32]


class FloatLeaves(NamedTuple):
    """Leaves in the layout of a float grid.

    Attributes:
        first: Index of the first leaf.
        memory: Bytes that hold the leaves.
        starts: Offset of each leaf, shape (n,).
        loss: Largest rounding error of each leaf's values in float32, shape (n,).
    """

    first: int
    memory: NDArray[np.uint8]
    starts: NDArray[np.int64]
    loss: NDArray[np.float64]


class LeafReader:
    """Reader of the values and statistics of the leaves of a float, double or quantized grid.

    Args:
        buffer: A structurally valid grid.
    """

    def __init__(self, buffer: NDArray[np.uint8]) -> None:
        self.layout = layout_of(int(grid_header(buffer)["grid_type"]), "grid")
        self.starts = grid_nodes(buffer).leaf.starts
        self.count = len(self.starts)
        self._buffer = buffer

    def float_leaves(self) -> Iterator[FloatLeaves]:
        """All leaves, some thousands at a time; those of float grids in one part and without a copy."""
        if self.layout.name == "float":
            yield FloatLeaves(0, self._buffer, self.starts, np.zeros(self.count))
            return
        for first in range(0, self.count, LEAVES_AT_A_TIME):
            stop = min(first + LEAVES_AT_A_TIME, self.count)
            leaves = np.empty((stop - first, FLOAT_LEAF), np.uint8)
            loss = np.zeros(stop - first)

            @np.errstate(over="ignore", invalid="ignore")
            def convert(begin: int, end: int, first: int = first, leaves: Any = leaves, loss: Any = loss) -> float:
                rows = slice(begin - first, end - first)
                exact = self.values(begin, end)
                values = exact.astype("<f4", copy=False)
                leaves[rows, :COMMON] = self.rows(begin, end, 0, COMMON)
                leaves[rows, 88:HEADER] = self.statistics(begin, end).astype("<f4").view(np.uint8)
                leaves[rows, HEADER:] = np.ascontiguousarray(values).view(np.uint8)
                if exact.dtype != np.float32:
                    loss[rows] = np.abs(values - exact).max(axis=1)
                return 0.0

            in_tasks(first, stop, convert)
            yield FloatLeaves(first, leaves.reshape(-1), FLOAT_LEAF * np.arange(stop - first), loss)

    def values(self, first: int, stop: int) -> NDArray[Any]:
        """Values of leaves, shape (n, 512), float64 for double grids, else float32.

        Raises:
            InputError: A value is not finite.
        """
        name = self.layout.name
        if name in ("float", "double"):
            size = self.layout.background.itemsize
            table = self.layout.leaf_size - size * LEAF_VOXELS
            values = self.rows(first, stop, table, size * LEAF_VOXELS).view(self.layout.background)
        else:
            values = self._decoded(first, stop)
        # The extrema reveal every NaN and infinity, at a tenth of the cost of a pass that tests each value.
        with np.errstate(invalid="ignore"):
            bad = ~(np.isfinite(values.min(axis=1)) & np.isfinite(values.max(axis=1)))
        if bad.any():
            raise self.not_finite(first + int(np.argmax(bad)))
        return values

    def not_finite(self, leaf: int) -> InputError:
        """The error for a leaf that holds a value that is not finite."""
        origin = self.rows(leaf, leaf + 1, 0, 12).view("<i4")[0] & ~7
        return InputError(f"volume: the leaf at voxel {origin.tolist()} holds a value that is not finite; replace it")

    def statistics(self, first: int, stop: int) -> NDArray[np.float64]:
        """Average and deviation of the active values of leaves, as stored, shape (n, 2)."""
        if self.layout.name == "double":
            return self.rows(first, stop, 96, 16).view("<f8")
        if self.layout.name == "float":
            return self.rows(first, stop, 88, 8).view("<f4").astype(np.float64)
        minimum, quantum = self.rows(first, stop, 80, 8).view("<f4").astype(np.float64).T
        codes = self.rows(first, stop, 92, 4).view("<u2")
        return np.stack([codes[:, 0] * quantum + minimum, codes[:, 1] * quantum], axis=1)

    def rows(self, first: int, stop: int, offset: int, size: int) -> NDArray[np.uint8]:
        """Copy ``size`` bytes of each leaf from ``offset`` on, shape (n, size)."""
        return self._copied(self.starts[first:stop] + offset, size)

    def _copied(self, starts: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
        step = self.layout.leaf_size
        if len(starts) and self.layout.leaf_bits >= 0 and starts[-1] - starts[0] == step * (len(starts) - 1):
            return np.ndarray((len(starts), size), np.uint8, self._buffer, int(starts[0]), (step, 1)).copy()
        out = np.empty((len(starts), size), np.uint8)
        for row, start in enumerate(starts):
            out[row] = self._buffer[start : start + size]
        return out

    def _decoded(self, first: int, stop: int) -> NDArray[np.float32]:
        heads = self.rows(first, stop, 0, HEADER)
        minimum, quantum = np.ascontiguousarray(heads[:, 80:88]).view("<f4").T
        fixed = self.layout.leaf_bits
        bits = np.full(len(heads), fixed) if fixed > 0 else np.array(BITS)[heads[:, 15] >> 5]
        out = np.empty((len(heads), LEAF_VOXELS), np.float32)
        for width in np.unique(bits):
            rows = np.flatnonzero(bits == width)
            codes = unpack(self._copied(self.starts[first + rows] + HEADER, 64 * int(width)), int(width))
            out[rows] = decode(Codes(codes, minimum[rows], quantum[rows]))
        return out


def thresholds(dither: bool) -> NDArray[np.float32]:
    """Rounding terms added to a scaled value before truncation to a code: 1/2, or 512 dithering levels from 0 to 1.

    Neighbors get levels far from each other, and each half, quarter and eighth of a leaf gets all levels evenly. So the
    mean over a few voxels is more exact than one voxel, whose error is up to twice that without dithering.
    """
    if not dither:
        return np.full(LEAF_VOXELS, 0.5, np.float32)
    x, y, z = np.unravel_index(np.arange(LEAF_VOXELS), (8, 8, 8))
    level = np.zeros(LEAF_VOXELS, np.int64)
    for bit in range(3):
        a, b, c = (axis >> bit & 1 for axis in (x, y, z))
        # Corners of a cube in an order in which successive ones lie far apart; the finest cube has the most weight.
        level = level << 3 | (a ^ b ^ c) << 2 | (a ^ b) << 1 | a
    return ((level + 0.5) / LEAF_VOXELS).astype(np.float32)


def decode(coded: Codes) -> NDArray[np.float32]:
    """Values (L, 512) float32 as NanoVDB's own classes read them: product and sum are rounded separately."""
    with np.errstate(invalid="ignore", over="ignore", under="ignore"):
        return coded.codes * coded.quantum[:, None] + coded.minimum[:, None]


def unpack(packed: NDArray[np.uint8], bits: int) -> NDArray[np.uint16]:
    """Unpack codes (L, 512) from bytes (L, 64 * bits); the first voxel is in the lowest bits."""
    if bits == 16:
        return np.ascontiguousarray(packed).view("<u2")
    shift = np.arange(0, 8, bits, dtype=np.uint8)
    codes = packed[:, :, None] >> shift & np.uint8((1 << bits) - 1)
    return codes.reshape(len(packed), -1).astype(np.uint16)


def in_tasks(first: int, stop: int, work: Callable[[int, int], float]) -> float:
    """The largest of ``work(begin, end)`` over blocks of leaves, in threads: NumPy releases the GIL in most of it."""
    begins = range(first, stop, LEAVES_PER_TASK)
    found = launcher.pool().map(lambda begin: work(begin, min(begin + LEAVES_PER_TASK, stop)), begins)
    return max(found, default=0.0)


def fewest_bits(reader: LeafReader, tolerance: float, rounding: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Smallest width of each leaf that keeps the tolerance, 16 bits if none does."""
    from geokit.volume.tree.quantize_kernels import bits_kernel

    device = launcher.resolve_device("cpu")
    bits = np.empty(reader.count, np.uint8)
    for leaves in reader.float_leaves():
        count = len(leaves.starts)
        out = bits[leaves.first : leaves.first + count]
        given: list[NDArray[Any]] = [leaves.starts, tolerance - leaves.loss, rounding]
        inputs = [array_of(leaves.memory), *map(HostArray, given)]
        launcher.launch(bits_kernel, count, inputs, [HostArray(out)], device, grain=LEAF_GRAIN)
    return bits


def write_codes(
    reader: LeafReader, target: RetypedTree, bits: NDArray[np.uint8], rounding: NDArray[np.float32]
) -> float:
    """Write all leaves as codes, and the extrema of all nodes; returns the largest change of a value.

    Args:
        reader: The leaves of the source.
        target: The grid to be filled.
        bits: Width of each leaf in bits.
        rounding: Thresholds of the rounding, shape (512,).

    Raises:
        InputError: A value is not finite.
    """
    from geokit.volume.tree.quantize_kernels import encode_kernel

    device = launcher.resolve_device("cpu")
    is_fpn = int(grid_header(target.buffer)["grid_type"]) == FPN_TYPE
    flags = (np.log2(bits).astype(np.uint8) << 5) if is_fpn else np.zeros_like(bits)
    measures = np.empty((reader.count, 3))
    worst = 0.0
    for leaves in reader.float_leaves():
        rows = slice(leaves.first, leaves.first + len(leaves.starts))
        given = leaves.starts, bits[rows], flags[rows], rounding, target.leaf_starts[rows]
        inputs = [array_of(leaves.memory), *map(HostArray, given)]
        outputs = [array_of(target.buffer), HostArray(measures[rows])]
        launcher.launch(encode_kernel, len(leaves.starts), inputs, outputs, device, grain=LEAF_GRAIN)
        error = measures[rows, 0]
        if (error < 0.0).any():
            raise reader.not_finite(leaves.first + int(np.argmin(error)))
        worst = max(worst, float((error + leaves.loss).max(initial=0.0)))
    # Leaves whose span exceeds float32 get extrema that are not finite; the caller rejects them.
    with np.errstate(over="ignore", invalid="ignore"):
        target.write_extrema(measures[:, 1].astype(np.float32), measures[:, 2].astype(np.float32))
    return worst


def write_floats(reader: LeafReader, target: RetypedTree) -> float:
    """Write all leaves as float leaves, and the extrema of all nodes; returns the largest change of a value.

    Raises:
        InputError: A value is not finite.
    """
    low, high = np.empty((2, reader.count), np.float32)
    table = grid_nodes(target.buffer).leaf.column(np.uint8, 0, FLOAT_LEAF)

    def write(first: int, stop: int) -> float:
        exact = reader.values(first, stop)
        with np.errstate(over="ignore"):
            values = exact.astype("<f4", copy=False)
        leaves = table[first:stop]
        leaves[:, :COMMON] = reader.rows(first, stop, 0, COMMON)
        leaves[:, 15] &= FLAG_BITS
        active = np.unpackbits(leaves[:, 16:COMMON], axis=1, bitorder="little").view(np.bool_)
        low[first:stop] = np.where(active, values, np.float32(np.inf)).min(axis=1)
        high[first:stop] = np.where(active, values, np.float32(-np.inf)).max(axis=1)
        limits = np.stack([low[first:stop], high[first:stop]], axis=1)
        leaves[:, COMMON:88] = np.where(limits[:, :1] <= limits[:, 1:], limits, np.float32(0.0)).view(np.uint8)
        leaves[:, 88:HEADER] = reader.statistics(first, stop).astype("<f4").view(np.uint8)
        leaves[:, HEADER:] = np.ascontiguousarray(values).view(np.uint8)
        return float(np.abs(values - exact).max()) if exact.dtype != np.float32 else 0.0

    worst = in_tasks(0, reader.count, write)
    target.write_extrema(low, high)
    return worst
