"""Warp's hash grid over the points, for user kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit.core import launcher
from geokit.core.memory.unchecked import allocating

if TYPE_CHECKING:
    import warp as wp

__all__ = ["build_hash_grid"]

# Cells on an axis: 128^3 cells take 16 MiB, a common size for warp.
SIZE = 128


def build_hash_grid(points: "wp.array", cell_size: float) -> tuple[Any, "wp.array"]:
    """Build a ``wp.HashGrid`` over vec3d points cast to float32; returns the grid and the cast points.

    Warp's grid may store the address of the points without keeping the array alive: keep a reference to both.
    """
    import warp as wp

    from geokit.points.search.cells_kernels import narrow_points_kernel

    device: Any = points.device
    single = wp.empty(len(points), dtype=wp.vec3f, device=device)
    launcher.launch(narrow_points_kernel, len(points), [points], [single], device)
    # Begin and end of each cell; cell and number of each point, twice, for the sort.
    with allocating(device, 8 * SIZE**3 + 20 * len(points), fatal=True):
        grid = wp.HashGrid(SIZE, SIZE, SIZE, device=device)
        grid.build(single, cell_size)
    return grid, single
