"""Radius search on a CPU: the queries of one cell share the candidates around it.

The candidates of a cell, some dozen ranges of sorted points, are copied to one contiguous buffer that stays in the L1
cache. Every query of the cell then reads it from front to back, sixteen points at a time, without data-dependent
branches. Float32, relative to the cell, decides wherever its error cannot matter, float64 elsewhere.
"""

# mypy: ignore-errors
from typing import Any

import warp as wp

from geokit.core import cpp
from geokit.points.search.cells_kernels import CellGrid
from geokit.points.search.neighbors_kernels import (
    LARGEST_LOCAL,
    OUTWARDS,
    REACH_ABSOLUTE,
    REACH_RELATIVE,
    ROUNDING,
    SMALLEST_SQUARE,
    Queries,
)

# Contracted multiply-adds would round the squared distance once instead of five times.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Queries of one item: many times the usual number of queries in a cell, because runs of one cell are cut at its ends.
SHARE = wp.constant(256)

# The same constants as in the searches on a GPU, where they are explained.
NUMBERS = {
    "ROUNDING": float(ROUNDING),
    "OUTWARDS": float(OUTWARDS),
    "LARGEST_LOCAL": float(LARGEST_LOCAL),
    "SMALLEST_SQUARE": float(SMALLEST_SQUARE),
    "REACH_RELATIVE": float(REACH_RELATIVE),
    "REACH_ABSOLUTE": float(REACH_ABSOLUTE),
    "SHARE_SIZE": int(SHARE),
}


@wp.kernel
@cpp.native_item("points/search/radius_cpu.inl", "count_share", Queries, CellGrid, **NUMBERS)
def count_share_kernel(first: int):
    """Number of neighbors of SHARE queries each, minus ``self_count``.

    Each share stores what it finds in ``note_size`` numbers of ``out_note``, as long as there is space.
    """


@wp.kernel
@cpp.native_item("points/search/radius_cpu.inl", "fill_share", **NUMBERS)
def fill_share_kernel(first: int, queries: Queries, grid: CellGrid, out_distance: wp.array(dtype=Any)):
    """Neighbors of SHARE queries, each written from its offset on, by ascending index or in the order of the cells."""


@wp.kernel
@cpp.native_item("points/search/radius_cpu.inl", "list_places", Queries, CellGrid, **NUMBERS)
def list_kernel(first: int):
    """For Verlet lists: places of the candidates of SHARE points each, by ascending rank, which is ``grid.index``."""


# By type of the distances: with float32 a third less is written.
FILL_OF = {r: wp.overload(fill_share_kernel, {"out_distance": wp.array(dtype=r)}) for r in (wp.float64, wp.float32)}
