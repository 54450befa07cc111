"""Warp's own hash grid over the points, for the user's kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit.core import launcher

if TYPE_CHECKING:
    import warp as wp

__all__ = ["build_hash_grid"]

# Cells on an axis: 128^3 takes 16 MiB and is warp's usual size.
SIZE = 128


def build_hash_grid(points: "wp.array", cell_size: float) -> tuple[Any, "wp.array"]:
    """A ``wp.HashGrid`` over vec3d points, cast to float32, and the cast points.

    Warp's grid may keep the address of the points, but not the array: hold both.
    """
    import warp as wp

    from geokit.points.search.cells_kernels import narrow_points_kernel

    device: Any = points.device
    single = wp.empty(len(points), dtype=wp.vec3f, device=device)
    launcher.launch(narrow_points_kernel, len(points), [points], [single], device)
    grid = wp.HashGrid(SIZE, SIZE, SIZE, device=device)
    grid.build(single, cell_size)
    return grid, single
