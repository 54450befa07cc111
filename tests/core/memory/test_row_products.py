"""Products of many rows with a small matrix: against sums in exact arithmetic, and in a process with little memory."""

from __future__ import annotations

import resource
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from geokit.core.memory.row_products import BLOCK_ROWS, row_product
from tests.support.forked import forked


@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (BLOCK_ROWS, 3), (2 * BLOCK_ROWS + 5, 3), (7, 3, 3)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64])
def test_products(shape, dtype):
    rng = np.random.default_rng(1)
    rows, matrix, shift = (rng.normal(size=shape) * 100).astype(dtype), rng.normal(size=(3, 3)), rng.normal(size=3)
    found = row_product(rows, matrix.T, shift)
    assert (found.shape, found.dtype) == (shape, np.float64)
    flat, results = rows.reshape(-1, 3), found.reshape(-1, 3)
    for row in {0, 1, BLOCK_ROWS - 1, BLOCK_ROWS, len(flat) - 1} & set(range(len(flat))):
        exact = [sum(Fraction(float(a)) * Fraction(b) for a, b in zip(flat[row], line, strict=True)) for line in matrix]
        bound = 4 * np.finfo(np.float64).eps * (np.abs(matrix) @ np.abs(flat[row]) + np.abs(shift))
        for k in range(3):
            assert abs(Fraction(results[row, k]) - exact[k] - Fraction(shift[k])) <= bound[k]


@pytest.mark.process
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc")
def test_a_forked_process_without_memory_for_threads():
    rows, matrix = np.ones((200_000, 3)), np.eye(3)

    def work():
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        # Room for the result, but not for the stack of a thread.
        resource.setrlimit(resource.RLIMIT_AS, (used + rows.nbytes + (1 << 20),) * 2)
        return float(row_product(rows, matrix).sum())

    assert forked(work, 20) == (600_000.0, 0)
