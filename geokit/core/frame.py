"""The float64 frame that maps world coordinates to the unit-sized local coordinates of kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Frame:
    """Local coordinates are ``(world - origin) / scale``, computed in float64.

    float32 has 24 significant bits: a unit-sized object 1e5 away from the origin would be off by 1e-2. Moved to the
    origin and scaled to unit size before the cast, it is off by 1e-7 of its size, whatever its place and size.
    """

    origin: NDArray[np.float64]
    scale: float

    @staticmethod
    def around(lower: NDArray[np.float64], upper: NDArray[np.float64]) -> Frame:
        """The frame that maps the box ``[lower, upper]`` into ``[-1, 1]^3``."""
        # Halve before adding and subtracting, so that boxes as large as 1e308 do not overflow.
        origin = lower * 0.5 + upper * 0.5
        half = float(np.max(upper * 0.5 - lower * 0.5, initial=0.0))
        return Frame(origin=origin, scale=half if half > 0.0 else 1.0)
