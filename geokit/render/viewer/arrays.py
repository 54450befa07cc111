"""Typed arrays as text in a page; ``data.js`` reads them."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Compressed arrays that keep more than this share of their bytes are stored as they are: reading them is quicker.
WORTH = 0.95
# A higher level makes the page a few percent smaller and takes several times as long.
LEVEL = 6


class Arrays:
    """Arrays of a page; each is known by its number there.

    An array is compressed (raw DEFLATE) after two steps that make that worth it: differences of neighbors for indices,
    and all first bytes, then all second bytes, ... of the numbers.
    """

    def __init__(self) -> None:
        self.texts: list[str] = []

    def add(self, values: NDArray[Any], *, differences: bool = False) -> dict[str, Any]:
        """Keep an array, and return what the page says of it.

        Args:
            values: Numbers of up to 4 bytes.
            differences: Compress the differences of neighbors, modulo the type's range; for integers.
        """
        flat = np.ascontiguousarray(values).reshape(-1)
        kind = flat.dtype.newbyteorder("<")
        steps = flat.astype(kind, copy=False)
        if differences and len(flat):
            steps = np.concatenate([steps[:1], np.diff(steps)])
        raw = steps.view(np.uint8).reshape(-1, kind.itemsize).T.tobytes()
        deflate = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
        packed = deflate.compress(raw) + deflate.flush()
        is_packed = len(packed) < WORTH * len(raw)
        if not is_packed:
            packed, differences = flat.astype(kind, copy=False).tobytes(), False
        self.texts.append(base64.b64encode(packed).decode("ascii"))
        return {
            "id": len(self.texts) - 1,
            "type": f"{kind.kind}{kind.itemsize}",
            "shape": list(values.shape),
            "packed": is_packed,
            "differences": differences,
        }
