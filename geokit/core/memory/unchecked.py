"""Functions of warp that allocate on a GPU, and go on without what they did not get."""

from __future__ import annotations

import threading
from typing import Any

from geokit.core.base.late_warp import wp
from geokit.core.launches.warp_private import last_noted_error

# What several small allocations are rounded up to, together, and the rows in which memory is asked for: warp counts the
# rows of an array, not its bytes, in 31 bits.
ROUNDING = 1 << 20
# Warp's sorts, and its trees and hash grids, which sort, have scratch memory for each stream, which threads share. If
# two enqueue the kernels of their sorts in turn, the one spoils the scratch of the other, whose kernels may then wait
# for each other for ever.
_one_at_a_time = threading.RLock()


class allocating:
    """Around a call of warp that allocates without checking: ``with allocating(device, size): ...``.

    Without memory warp's sort leaves its keys as they are, and its trees are written to the address 0, after which the
    GPU is lost for the process. Warp notes the error of an allocation, but never forgets it. So the note tells what
    happened in this call only if there was none before; else the memory is asked for, and given back, before the call.
    One thread at a time makes such calls on GPUs.

    Args:
        device: Where warp allocates. On a CPU nothing is done.
        size: Most that it allocates [bytes].
        fatal: Whether the call does damage without the memory: it is always asked for then.
    Raises:
        RuntimeError: There is not that much, in the words of warp's own allocations.
    """

    def __init__(self, device: "wp.Device", size: int, *, fatal: bool = False) -> None:
        self._device, self._size, self._fatal = device, size + ROUNDING, fatal

    def __enter__(self) -> None:
        self._had_error = False
        if not self._device.is_cuda:
            return
        taken: list[bool] = []
        try:
            # Taken and noted in one step: no interrupt comes between.
            taken.extend(map(_one_at_a_time.acquire, (True,)))
            self._had_error = bool(last_noted_error())
            if self._fatal or self._had_error:
                wp.empty((-(-self._size // ROUNDING), ROUNDING), dtype=wp.uint8, device=self._device)
        except BaseException:
            if taken:
                _one_at_a_time.release()
            raise

    def __exit__(self, kind: object, *_: object) -> None:
        if not self._device.is_cuda:
            return
        try:
            if kind is None and not self._had_error and last_noted_error():
                raise RuntimeError(f"Failed to allocate {self._size} bytes on device '{self._device}'")
        finally:
            _one_at_a_time.release()


def sort_pairs(keys: "wp.array", values: "wp.array", count: int, **bits: Any) -> None:
    """``wp.utils.radix_sort_pairs``, which needs room for 2 * count in both arrays.

    Raises:
        RuntimeError: A GPU has no memory for it.
    """
    with allocating(keys.device, count):
        wp.utils.radix_sort_pairs(keys, values, count, **bits)
