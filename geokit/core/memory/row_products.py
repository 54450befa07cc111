"""Products of many rows with a small matrix that allocate nothing but their result."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# OpenBLAS starts threads for products of 30,000 rows. In a process with little memory, and in a forked one, it then
# prints, ends the process or waits for ever. Smaller blocks also stay in the cache: they take half the time.
BLOCK_ROWS = 8192


def row_product(rows: NDArray[Any], matrix: NDArray[np.float64], shift: Any = 0.0) -> NDArray[np.float64]:
    """``rows @ matrix + shift`` in float64.

    Args:
        rows: Shape (..., K), of any type of number.
        matrix: Shape (K, M).
        shift: Shape (M,).
    """
    flat = rows.reshape(-1, len(matrix))
    out = np.empty((len(flat), matrix.shape[1]))
    for first in range(0, len(flat), BLOCK_ROWS):
        block = out[first : first + BLOCK_ROWS]
        np.matmul(flat[first : first + BLOCK_ROWS], matrix, out=block)
        block += shift
    return out.reshape(*rows.shape[:-1], matrix.shape[1])
