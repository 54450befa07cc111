"""Float grids from leaves, as the device writer makes them on the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.grid_head import checked_head

__all__ = ["build_float_grid"]


def build_float_grid(
    leaf_origins: Any,
    leaf_values: Any,
    leaf_masks: Any,
    *,
    background: float,
    transform: Any,
    name: str,
    grid_class: str,
    signed_fill: bool,
) -> NDArray[np.uint8]:
    """A NanoVDB float grid from leaves (L, 3), values (L, 512) and masks (L, 512) or packed (L, 64), in any order."""
    head = checked_head("float", background, -background, transform, name, grid_class)
    return build_leaves(head, leaf_origins, leaf_values, leaf_masks, signed=signed_fill)
