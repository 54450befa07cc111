"""Sizes and offsets of the nodes of every NanoVDB grid type.

Source:
    NanoVDB.h 32.4 and 32.8. Differs: layouts are computed from the size and alignment of the value type instead of
    being listed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from geokit.errors import UnsupportedGridError
from geokit.volume.nanovdb.types import BY_NAME, GRID_TYPES, INDEX_TYPES, GridType

ALIGNMENT = 32
UPPER_SLOTS = 32**3
LOWER_SLOTS = 16**3
LEAF_VOXELS = 8**3
# Bytes of a quantized leaf before its codes: box, flags, mask, minimum, quantum, statistics.
QUANTIZED_HEADER = 96


@dataclass(frozen=True)
class GridLayout:
    """Byte layout of one grid type.

    Attributes:
        name: The type's name in lower case.
        background: NumPy type of the background value, with its shape for vectors.
        align: Alignment [bytes] of a value.
        stat: Size and alignment [bytes] of an average or deviation.
        leaf_bits: Bits per voxel in a leaf's table; 0 if a leaf stores none, -1 if every leaf has its own width.
        leaf_header: Bytes of a leaf before its table if values are quantized, else 0.
    """

    name: str
    background: np.dtype[Any]
    align: int
    stat: int
    leaf_bits: int
    leaf_header: int = 0

    @cached_property
    def root_background(self) -> int:
        """Offset of the background value from the root."""
        return _round(28, self.align)

    @cached_property
    def root_size(self) -> int:
        """Bytes of the root without its table."""
        return _round(self._after_statistics(self.root_background + self.background.itemsize), ALIGNMENT)

    @cached_property
    def root_tile_size(self) -> int:
        """Bytes of one entry of the root's table: key, child offset, state, value."""
        return _round(_round(20, self.align) + self.background.itemsize, ALIGNMENT)

    @cached_property
    def table_stride(self) -> int:
        """Bytes of one slot of an internal node: a child offset or a tile's value."""
        return _round(max(8, self.background.itemsize), 8)

    @cached_property
    def upper_table(self) -> int:
        """Offset of the slots from an upper node."""
        return _round(self._after_statistics(32 + 2 * UPPER_SLOTS // 8), ALIGNMENT)

    @cached_property
    def upper_size(self) -> int:
        """Bytes of an upper node."""
        return _round(self.upper_table + UPPER_SLOTS * self.table_stride, ALIGNMENT)

    @cached_property
    def lower_table(self) -> int:
        """Offset of the slots from a lower node."""
        return _round(self._after_statistics(32 + 2 * LOWER_SLOTS // 8), ALIGNMENT)

    @cached_property
    def lower_size(self) -> int:
        """Bytes of a lower node."""
        return _round(self.lower_table + LOWER_SLOTS * self.table_stride, ALIGNMENT)

    @cached_property
    def leaf_size(self) -> int:
        """Bytes of a leaf; the smallest possible size if leaves differ."""
        if self.leaf_header:
            return self.leaf_header + max(self.leaf_bits, 1) * LEAF_VOXELS // 8
        if self.leaf_bits == 0:
            return 96
        if self.leaf_bits == 1:
            return 160
        table = _round(self._after_statistics(80), ALIGNMENT)
        return _round(table + self.leaf_bits * LEAF_VOXELS // 8, ALIGNMENT)

    @cached_property
    def leaf_table(self) -> int:
        """Offset of a leaf's values, codes or offset; values are its last entry and fill a multiple of 32 bytes."""
        if self.leaf_header or self.leaf_bits <= 1:
            return self.leaf_header or 80
        return self.leaf_size - LEAF_VOXELS * self.leaf_bits // 8

    def _after_statistics(self, offset: int) -> int:
        # Minimum and maximum have the value type, average and deviation the statistics type; each is aligned to its own
        # size.
        offset = _round(offset, self.align) + 2 * self.background.itemsize
        return _round(offset, self.stat) + 2 * self.stat


def _round(value: int, step: int) -> int:
    return -(-value // step) * step


def _layout(kind: GridType) -> GridLayout:
    assert kind.value is not None
    header = QUANTIZED_HEADER if kind.family == "quantized" else 0
    align = kind.align or kind.value.base.itemsize
    return GridLayout(kind.name, kind.value, align, kind.statistic_bytes, kind.leaf_bits, header)


# In the order of NanoVDB's type codes.
LAYOUTS: Mapping[str, GridLayout] = MappingProxyType(
    {name: _layout(BY_NAME[name]) for name in GRID_TYPES if BY_NAME[name].has_values}
)
# Index grids hold no values: each voxel holds the index of one.
INDEX_LAYOUTS: Mapping[str, GridLayout] = MappingProxyType({name: _layout(BY_NAME[name]) for name in INDEX_TYPES})


def type_name(grid_type: int) -> str:
    """Name of a grid type in lower case."""
    return GRID_TYPES[grid_type] if grid_type < len(GRID_TYPES) else f"number {grid_type}"


def layout_of(grid_type: int, where: str) -> GridLayout:
    """Byte layout of a grid type.

    Args:
        grid_type: NanoVDB's code of the type.
        where: File or argument, for the message.

    Raises:
        UnsupportedGridError: Grids of that type hold no values, or the type is unknown.
    """
    name = type_name(grid_type)
    layout = LAYOUTS.get(name)
    if layout is None:
        raise UnsupportedGridError(
            f"{where}: grids of type {name} cannot be used; convert it to one of {', '.join(LAYOUTS)}"
        )
    return layout
