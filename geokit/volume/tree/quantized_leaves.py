"""Values of a leaf as codes of 1 to 16 bits: ``value = code * quantum + minimum``, in float32, as NanoVDB reads them.

Source:
    NanoVDB (Museth 2021), NanoVDB.h and GridBuilder.h of OpenVDB 10.0.1. Differs: the thresholds of dithering are a
    Bayer pattern.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.layout import LEAF_VOXELS, QUANTIZED_HEADER

__all__ = ["BITS", "HEADER", "Codes", "decode", "thresholds", "unpack"]

HEADER = QUANTIZED_HEADER
# Widths of an FpN leaf, in the order of the logarithms that its flags store.
BITS = (1, 2, 4, 8, 16)


class Codes(NamedTuple):
    """Leaves as codes.

    Attributes:
        codes: Shape (L, 512) uint16, below ``2^bits``.
        minimum: Value of code 0, shape (L,) float32.
        quantum: Difference of two codes, shape (L,) float32; 0 where all values are equal.
    """

    codes: NDArray[np.uint16]
    minimum: NDArray[np.float32]
    quantum: NDArray[np.float32]


def thresholds(dither: bool) -> NDArray[np.float32]:
    """What is added before a scaled value is cut to a code: 1/2, or with dithering 512 levels between 0 and 1.

    Neighbours get levels far from each other, and each half, quarter and eighth of a leaf gets all levels evenly: the
    mean over a few voxels is more exact than one voxel, whose error is up to twice that without dithering.
    """
    if not dither:
        return np.full(LEAF_VOXELS, 0.5, np.float32)
    x, y, z = np.unravel_index(np.arange(LEAF_VOXELS), (8, 8, 8))
    level = np.zeros(LEAF_VOXELS, np.int64)
    for bit in range(3):
        a, b, c = (axis >> bit & 1 for axis in (x, y, z))
        # Corners of a cube in an order in which successive ones lie apart, the finest cube deciding most.
        level = level << 3 | (a ^ b ^ c) << 2 | (a ^ b) << 1 | a
    return ((level + 0.5) / LEAF_VOXELS).astype(np.float32)


def decode(coded: Codes) -> NDArray[np.float32]:
    """Values (L, 512) float32 as NanoVDB's own classes read them: product and sum rounded one after the other."""
    with np.errstate(invalid="ignore", over="ignore", under="ignore"):
        return coded.codes * coded.quantum[:, None] + coded.minimum[:, None]


def unpack(packed: NDArray[np.uint8], bits: int) -> NDArray[np.uint16]:
    """Codes (L, 512) from bytes (L, 64 * bits): the first voxel in the lowest bits."""
    if bits == 16:
        return np.ascontiguousarray(packed).view("<u2")
    shift = np.arange(0, 8, bits, dtype=np.uint8)
    codes = packed[:, :, None] >> shift & np.uint8((1 << bits) - 1)
    return codes.reshape(len(packed), -1).astype(np.uint16)
