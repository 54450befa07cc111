"""LZF, the compression of .pcd files: literals and back references, byte by byte."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.host_array import HostArray

__all__ = ["compress", "decompress"]

# Places that the compressor remembers by the hash of the three bytes there.
TABLE_BITS = 15
# Each 32 literals cost a byte, and the last run may be short.
LITERAL_RUN = 32


def decompress(packed: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], int]:
    """``size`` bytes from ``packed``, and the byte of it where it is damaged, -1 for none.

    Damage is a reference to before the beginning, a run beyond the end, or another size than was said.
    """
    from geokit.formats.lzf_kernels import decompress_kernel

    out = np.zeros(size, np.uint8)
    bad = np.full(1, -1, np.int64)
    # Nothing to point at in an empty array.
    if size or len(packed):
        arrays = [HostArray(np.ascontiguousarray(packed)), HostArray(out), HostArray(bad)]
        sizes = [len(packed), size]
        launcher.launch(decompress_kernel, 1, [arrays[0], *sizes], arrays[1:], launcher.resolve_device("cpu"))
    return out, int(bad[0])


def compress(plain: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``plain`` as LZF; at worst a 32nd longer."""
    from geokit.formats.lzf_kernels import compress_kernel

    out = np.empty(len(plain) + len(plain) // LITERAL_RUN + 2, np.uint8)
    used = np.zeros(1, np.int64)
    if len(plain):
        table = np.full(1 << TABLE_BITS, -1, np.int64)
        arrays = [HostArray(plain), HostArray(table), HostArray(out), HostArray(used)]
        inputs = [arrays[0], len(plain), arrays[1], TABLE_BITS]
        launcher.launch(compress_kernel, 1, inputs, arrays[2:], launcher.resolve_device("cpu"))
    return out[: int(used[0])]
