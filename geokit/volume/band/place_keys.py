"""Places on a lattice as sort keys: three coordinates in 63 bits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Bits of a coordinate, which is not negative.
KEY_BITS = 21


def keys_of(places: NDArray[Any]) -> NDArray[np.int64]:
    """Sort keys (N,) of places (N, 3), ordered by x, then y, then z."""
    return np.asarray((places[:, 0] << 2 * KEY_BITS) | (places[:, 1] << KEY_BITS) | places[:, 2])


def places_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The places (N, 3) of keys."""
    return np.stack([keys >> shift & ((1 << KEY_BITS) - 1) for shift in (2 * KEY_BITS, KEY_BITS, 0)], axis=1)
