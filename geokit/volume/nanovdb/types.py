"""The grid types of NanoVDB: one table, from which all other tables of types are derived.

To add a type (one that NanoVDB has, see PNanoVDB.h), add a row here, the code that reads its voxels in a kernel
(``volume/nanovdb/read_voxel.inl``) and an example for the tests (``benchmarks/catalog/typed_grids.py``). If OpenVDB has
the type too, add it to ``native/src``.
tests/volume/nanovdb/test_types.py reports each place that was forgotten.

Source:
    NanoVDB.h 32.8, GridType and isValid(GridType, GridClass).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

Family = Literal["none", "float", "quantized", "integer", "bool", "mask", "vector", "color", "index", "point"]

# In the order of NanoVDB's class codes.
GRID_CLASSES = (
    "unknown", "level set", "fog volume", "staggered", "point index", "point data", "topology", "voxel volume",
    "index grid", "tensor grid",
)  # fmt: skip
DISTANCE = ("level set", "fog volume")
COLORS = "voxel volume"


@dataclass(frozen=True)
class GridType:
    """One grid type.

    Attributes:
        number: NanoVDB's code of the type.
        name: NanoVDB's name in lower case.
        family: Kind of its values; a "quantized" type has float values and stores codes in its leaves.
        value: NumPy type of a tile and of the background, with its shape for vectors; None if geokit reads none.
        statistic_bytes: Size and alignment of an average or deviation in a node.
        leaf_bits: Bits of a voxel in a leaf's table; 0 if leaves have no table, -1 if each has its own width.
        openvdb: OpenVDB's name of the value type that geokit writes into .vdb files; None if OpenVDB has none.
        classes: Grid classes that NanoVDB allows for this type, in addition to "unknown".
        align: Alignment of a value [bytes]; 0 for the size of one component.
    """

    number: int
    name: str
    family: Family
    value: np.dtype[Any] | None = None
    statistic_bytes: int = 0
    leaf_bits: int = 0
    openvdb: str | None = None
    classes: tuple[str, ...] = ()
    align: int = 0

    @property
    def components(self) -> int:
        """Number of components of a value."""
        return self.value.shape[0] if self.value is not None and self.value.shape else 1

    @property
    def has_values(self) -> bool:
        """Whether voxels have values, so that such grids can be sampled."""
        return self.family not in ("none", "index", "point")

    @property
    def has_plain_leaves(self) -> bool:
        """Whether leaves store values as an array of the value type, neither as codes nor as bits."""
        return self.has_values and self.value is not None and self.leaf_bits == 8 * self.value.itemsize

    @property
    def has_isosurface(self) -> bool:
        """Whether values can be interpolated to an isosurface; integers, bits and vectors cannot."""
        return self.family in ("float", "quantized")


def _scalar(number: int, name: str, family: Family, code: str, statistic_bytes: int, **options: Any) -> GridType:
    value = np.dtype(code)
    return GridType(number, name, family, value, statistic_bytes, **{"leaf_bits": 8 * value.itemsize, **options})


def _vector(number: int, name: str, code: str, components: int, statistic_bytes: int, **options: Any) -> GridType:
    value = np.dtype((code, (components,)))
    return GridType(number, name, "vector", value, statistic_bytes, 8 * value.itemsize, **options)


def _quantized(number: int, name: str, leaf_bits: int) -> GridType:
    return _scalar(number, name, "quantized", "<f4", 4, leaf_bits=leaf_bits, openvdb="float", classes=DISTANCE)


# Leaves of index grids have no table. They have 96 bytes, or 96 bytes and a mask, as if a voxel had one bit.
def _index(number: int, name: str, leaf_bits: int) -> GridType:
    return _scalar(number, name, "index", "<u8", 8, leaf_bits=leaf_bits)


TYPES: tuple[GridType, ...] = (
    GridType(0, "unknown", "none"),
    _scalar(1, "float", "float", "<f4", 4, openvdb="float", classes=(*DISTANCE, COLORS)),
    _scalar(2, "double", "float", "<f8", 8, openvdb="double", classes=(*DISTANCE, COLORS)),
    _scalar(9, "half", "float", "<f2", 4, classes=DISTANCE),
    _quantized(13, "fp4", 4),
    _quantized(14, "fp8", 8),
    _quantized(15, "fp16", 16),
    _quantized(16, "fpn", -1),
    _scalar(3, "int16", "integer", "<i2", 4),
    _scalar(4, "int32", "integer", "<i4", 4, openvdb="int32"),
    _scalar(5, "int64", "integer", "<i8", 8, openvdb="int64"),
    _scalar(26, "uint8", "integer", "u1", 4),
    _scalar(10, "uint32", "integer", "<u4", 4, openvdb="uint32", classes=("point index", "point data", COLORS)),
    _scalar(11, "bool", "bool", "?", 1, leaf_bits=1, openvdb="bool"),
    _scalar(8, "mask", "mask", "?", 1, leaf_bits=0, openvdb="mask", classes=("topology",)),
    _vector(6, "vec3f", "<f4", 3, 4, openvdb="vec3s", classes=("staggered", COLORS)),
    _vector(7, "vec3d", "<f8", 3, 8, openvdb="vec3d", classes=("staggered", COLORS)),
    _vector(24, "vec3u8", "u1", 3, 4),
    _vector(25, "vec3u16", "<u2", 3, 4),
    _vector(17, "vec4f", "<f4", 4, 4, openvdb="vec4s", classes=("staggered",)),
    _vector(18, "vec4d", "<f8", 4, 8, openvdb="vec4d", classes=("staggered",)),
    # Four bytes that are read and aligned as one word.
    GridType(12, "rgba8", "color", np.dtype(("u1", (4,))), 4, 32, classes=(COLORS,), align=4),
    _index(19, "index", 0),
    _index(20, "onindex", 0),
    _index(21, "indexmask", 1),
    _index(22, "onindexmask", 1),
    GridType(23, "pointindex", "point"),
)

BY_NAME: Mapping[str, GridType] = MappingProxyType({grid_type.name: grid_type for grid_type in TYPES})


# The tables below keep the order of the rows above, except the first, which is in the order of NanoVDB's codes.
GRID_TYPES = tuple(kind.name for kind in sorted(TYPES, key=lambda kind: kind.number))
FLOAT = BY_NAME["float"].number
INDEX_TYPES = tuple(kind.name for kind in TYPES if kind.family == "index")

# Types whose voxels have values, with the number of components of each.
COMPONENTS: Mapping[str, int] = MappingProxyType({kind.name: kind.components for kind in TYPES if kind.has_values})
SCALAR_TYPES = tuple(name for name, count in COMPONENTS.items() if count == 1)
ISOSURFACE_TYPES = tuple(kind.name for kind in TYPES if kind.has_isosurface)
# Types that a channel of an index grid can have.
CHANNEL_TYPES = tuple(kind.name for kind in TYPES if kind.has_plain_leaves)

QUANTIZED = tuple(kind.name for kind in TYPES if kind.family == "quantized")
# Bits of a voxel of the quantized types whose leaves all have the same size.
FIXED_BITS: Mapping[str, int] = MappingProxyType(
    {name: BY_NAME[name].leaf_bits for name in QUANTIZED if BY_NAME[name].leaf_bits > 0}
)

# Types that NanoVDB allows for each grid class; every type may be "unknown".
CLASS_TYPES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {name: tuple(kind.name for kind in TYPES if name in kind.classes) for name in GRID_CLASSES if name != "unknown"}
)


def _smallest_type(code: str) -> str | None:
    """Scalar type for the whole numbers of a NumPy type: that type itself, or the smallest that holds it."""
    dtype = np.dtype(code)
    fitting = [
        kind
        for kind in TYPES
        if kind.family in ("integer", "bool") and kind.value is not None and np.can_cast(dtype, kind.value, "safe")
    ]
    best = min(fitting, key=lambda kind: (kind.value != dtype, kind.leaf_bits), default=None)
    return best.name if best else None


# Grid types for arrays of whole numbers, by NumPy's type code, and by that and the number of components.
_WHOLE = ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
WHOLE_TYPES: Mapping[str, str] = MappingProxyType(
    {code: name for code in _WHOLE if (name := _smallest_type(code)) is not None}
)
WHOLE_VECTOR_TYPES: Mapping[tuple[str, int], str] = MappingProxyType(
    {
        (kind.value.base.str[1:], kind.components): kind.name
        for kind in TYPES
        if kind.value is not None and kind.value.shape and kind.value.base.kind in "iu"
    }
)
