"""Splits queries into chunks that fit in device memory, and reports progress."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from geokit.core.base.late_warp import wp
from geokit.core.interop import user_arrays
from geokit.core.interop.arrays import led
from geokit.core.memory import available_memory
from geokit.core.require import require_callable

# Called with the number of queries answered so far and the total number.
Progress = Callable[[int, int], None]

# Bounds for the queries of a chunk: a full one is milliseconds of work on a GPU and seconds on a CPU.
MOST_ROWS = 1 << 22
FEWEST_ROWS = 1 << 14
# Device memory of a query with its results and its entry in the query order, rounded up.
BYTES_PER_ROW = 256
# Share of the free memory that a chunk may take.
SHARE = 0.25


def in_percent(progress: Progress | None, first: int = 0, last: int = 100) -> Callable[[float], None]:
    """What to call with the part of some work that is done, from 0 to 1; ``progress`` gets percents of the whole.

    Raises:
        InputError: progress is not callable.
    """
    if progress is not None:
        require_callable(progress, "progress")

    def report(done: float) -> None:
        if progress is not None:
            progress(int(first + (last - first) * min(done, 1.0)), 100)

    return report


def in_chunks(
    query: Callable[..., Any],
    values: Sequence[Any],
    names: Sequence[str],
    device: "wp.Device",
    progress: Progress | None,
    *,
    defer: bool = False,
) -> Any:
    """Run ``query(*batches)`` over all rows, in chunks where a GPU query reads many rows from the host.

    Rows that need no copy (they are on the query device, or the query runs on the CPU) form a single chunk. NumPy
    rows of a CPU query are split as well if ``progress`` is given.

    Args:
        query: Takes one Batch for each of ``values`` and returns an array or a NamedTuple of arrays, of the caller's
            kind. It may pass the rows to kernels only; see ``pin`` of
            :func:`geokit.core.interop.user_arrays.read_vectors`.
        values: The caller's arrays, shape (..., 3) each, or one row for all.
        names: Their names for error messages.
        device: The query device.
        progress: Called after each chunk with (rows done, rows in total).
        defer: Leave the check for rows that are not finite to the query's kernel; see
            :func:`geokit.core.interop.user_arrays.read_vectors`.
    Returns:
        The result of ``query`` for all rows.
    """
    if progress is not None:
        require_callable(progress, "progress")
    values = user_arrays.same_rows(values, names)
    if device.is_cuda and all(isinstance(value, np.ndarray) and value.ndim > 2 for value in values):
        lead = values[0].shape[:-1]
        if math.prod(lead) > FEWEST_ROWS and values[0].shape[-1] == 3:
            answer = in_chunks(query, [v.reshape(-1, 3) for v in values], names, device, progress, defer=defer)
            is_several = isinstance(answer, tuple)
            return type(answer)(*(led(part, lead) for part in answer)) if is_several else led(answer, lead)
    on_host = all(isinstance(value, np.ndarray) and value.ndim == 2 for value in values)
    total = len(values[0]) if on_host else 0
    rows = _chunk_rows(device, total) if on_host else 0
    if not on_host or total <= rows or (device.is_cpu and progress is None) or any(len(v) != total for v in values):
        batches = user_arrays.read_rows(values, names, device, defer=defer, pin=True)
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


def _chunk_rows(device: "wp.Device", total: int) -> int:
    if device.is_cpu:
        return MOST_ROWS
    if total <= FEWEST_ROWS:  # reading the free memory takes a tenth of the time of a small query
        return FEWEST_ROWS
    return int(np.clip(SHARE * available_memory.available(device) / BYTES_PER_ROW, FEWEST_ROWS, MOST_ROWS))
