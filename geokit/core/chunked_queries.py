"""Queries in blocks: what goes to a device and comes back is bounded, and the caller hears how far it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import available_memory, user_arrays

if TYPE_CHECKING:
    import warp as wp

__all__ = ["Progress", "in_blocks"]

# Called with the queries that are answered and those that there are.
Progress = Callable[[int, int], None]

# Queries of a block: some milliseconds of work on a GPU, some seconds on a CPU.
MOST_ROWS = 1 << 22
FEWEST_ROWS = 1 << 14
# What a query takes on its device, with its answers and its place in the order, rounded up.
BYTES_PER_ROW = 256
# Share of the free memory that a block may take.
SHARE = 0.25


def in_blocks(
    query: Callable[..., Any],
    values: Sequence[Any],
    names: Sequence[str],
    device: "wp.Device",
    progress: Progress | None,
    *,
    defer: bool = False,
) -> Any:
    """``query(*batches)`` over all rows, in blocks where the rows lie on the host and pay for it.

    Rows that lie on the query device already, or on the host of a CPU query, are not copied: they are one block unless
    ``progress`` is asked for.

    Args:
        query: Takes a Batch for each of ``values`` and gives an array or a NamedTuple of arrays, in the caller's kind;
            passes the rows to nothing but kernels, as ``pin`` of :func:`geokit.core.user_arrays.read_vectors` wants it.
        values: The caller's arrays, (N, 3) each.
        names: Their names for messages.
        device: The query device.
        progress: Called after each block with (rows done, rows in all).
        defer: As for :func:`geokit.core.user_arrays.read_vectors`.
    Returns:
        What ``query`` gives, over all rows.
    """
    on_host = all(isinstance(value, np.ndarray) and value.ndim == 2 for value in values)
    total = len(values[0]) if on_host else 0
    rows = _block_rows(device, total) if on_host else 0
    if not on_host or total <= rows or (device.is_cpu and progress is None) or any(len(v) != total for v in values):
        batches = [
            user_arrays.read_vectors(v, name, device, defer=defer, pin=True)
            for v, name in zip(values, names, strict=True)
        ]
        answer = query(*batches)
        if progress:
            progress(len(batches[0]), len(batches[0]))
        return answer
    whole: list[np.ndarray] = []
    for start in range(0, total, rows):
        stop = min(total, start + rows)
        part = query(
            *(
                user_arrays.read_vectors(v[start:stop], name, device, defer=defer, first_row=start)
                for v, name in zip(values, names, strict=True)
            )
        )
        arrays = part if isinstance(part, tuple) else (part,)
        whole = whole or [np.empty((total, *array.shape[1:]), array.dtype) for array in arrays]
        for target, array in zip(whole, arrays, strict=True):
            target[start:stop] = array
        if progress:
            progress(stop, total)
    return type(part)(*whole) if isinstance(part, tuple) else whole[0]


def _block_rows(device: "wp.Device", total: int) -> int:
    if device.is_cpu:
        return MOST_ROWS
    if total <= FEWEST_ROWS:  # to ask for the free memory takes a tenth of a small query
        return FEWEST_ROWS
    return int(np.clip(SHARE * available_memory.available(device) / BYTES_PER_ROW, FEWEST_ROWS, MOST_ROWS))
