"""Prefix sums on a device, with their totals on the host, and the items that a flag chooses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.pinned import host_arrays


def prefix_sum(counts: "wp.array") -> tuple["wp.array", int]:
    """Inclusive prefix sum of int32 counts, and the total."""
    sums, total = prefix_sum_async(counts)
    return sums, total()


def prefix_sum_async(counts: "wp.array") -> tuple["wp.array", Callable[[], int]]:
    """Inclusive prefix sum of int32 counts, and a function that waits for the total and returns it."""
    from geokit.core.scan_kernels import last_kernel

    device = counts.device
    sums = wp.empty(len(counts), dtype=wp.int32, device=device)
    if len(counts) == 0:
        return sums, lambda: 0
    wp.utils.array_scan(counts, sums, inclusive=True)
    if device.is_cpu:
        return sums, lambda: int(sums.numpy()[-1])
    (total,) = host_arrays(device, ((1,), np.int32))
    launcher.launch(last_kernel, 1, [sums], [total], device)
    return sums, lambda: int(total.numpy()[0])


def flagged(flag: "wp.array") -> "wp.array":
    """Numbers of the items whose flag, int32 (N,), is not 0, ascending."""
    from geokit.core.scan_kernels import flagged_kernel

    ends, count = prefix_sum(flag)
    found = wp.empty(count, dtype=wp.int32, device=flag.device)
    launcher.launch(flagged_kernel, len(flag), [flag, ends], [found], flag.device)
    return found


def gathered(rows: "wp.array", index: "wp.array", count: int | None = None) -> "wp.array":
    """The rows (vec3d, vec3f, vec3i, int32 or int64) of some numbers, or of the first of them, in their order."""
    from geokit.core.sorting.gather_kernels import GATHER

    count = len(index) if count is None else count
    found = wp.empty(count, dtype=rows.dtype, device=rows.device)
    launcher.launch(GATHER[rows.dtype], count, [rows, index], [found], rows.device)
    return found


def row_offsets(counts: Any) -> "wp.array":
    """Beginning of each row and the end of the last one, int64 (N + 1,), for int32 counts (N,) of rows in CSR form."""
    from geokit.core.scan_kernels import widen_kernel

    device = counts.device
    if device.is_cpu:
        offsets = np.zeros(len(counts) + 1, dtype=np.int64)
        np.cumsum(counts.numpy(), out=offsets[1:])
        return wp.array(offsets, dtype=wp.int64, device=device, copy=False)
    wide = wp.empty(len(counts), dtype=wp.int64, device=device)
    offsets = wp.zeros(len(counts) + 1, dtype=wp.int64, device=device)
    if len(counts):
        launcher.launch(widen_kernel, len(counts), [counts], [wide], device)
        wp.utils.array_scan(wide, offsets[1:], inclusive=True)
    return offsets
