"""Headers of NanoVDB 32.x as NumPy types: the description of a grid from its buffer, and the options of a new grid.

A buffer holds one grid and starts at a 32-byte boundary: GridData (672 bytes), TreeData (64), the root with its table,
then all upper nodes (32^3 slots), all lower nodes (16^3), all leaves (8^3 voxels), then optional blind data.

Source:
    NanoVDB (Museth 2021), NanoVDB.h 32.4 and 32.8.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.require import described, read_array, require_text
from geokit.errors import FileFormatError, InputError, UnsupportedGridError
from geokit.volume.nanovdb.grid_info import GridInfo
from geokit.volume.nanovdb.layout import GRID_TYPES, LAYOUTS, GridLayout, layout_of, type_name
from geokit.volume.nanovdb.types import BY_NAME, GRID_CLASSES

# A buffer should start at a 32-byte boundary and at a cache line; the latter is the larger.
BUFFER_ALIGNMENT = 64
MAJOR_VERSION = 32

# "NanoVDB0" marks files and grids up to 32.6, "NanoVDB1" grids and "NanoVDB2" files since 32.7 (little endian).
MAGIC_OLD = 0x304244566F6E614E
MAGIC_GRID = 0x314244566F6E614E
MAGIC_FILE = 0x324244566F6E614E

FLAG_LONG_NAME = 1
FLAG_HAS_BBOX = 2
FLAG_HAS_MIN_MAX = 4
FLAG_BREADTH_FIRST = 32

GRID_DATA = np.dtype(
    {
        "names": [
            "magic", "checksum", "version", "flags", "grid_index", "grid_count", "grid_size", "name",
            "matrix_f", "inverse_f", "vector_f", "taper_f", "matrix", "inverse", "vector", "taper",
            "world_bbox", "voxel_size", "grid_class", "grid_type", "blind_offset", "blind_count",
            "data_0", "data_1", "data_2",
        ],
        "formats": [
            "<u8", "<u8", "<u4", "<u4", "<u4", "<u4", "<u8", "S256",
            ("<f4", 9), ("<f4", 9), ("<f4", 3), "<f4", ("<f8", 9), ("<f8", 9), ("<f8", 3), "<f8",
            ("<f8", 6), ("<f8", 3), "<u4", "<u4", "<i8", "<u4",
            "<u4", "<u8", "<u8",
        ],
        "offsets": [
            0, 8, 16, 20, 24, 28, 32, 40,
            296, 332, 368, 380, 384, 456, 528, 552,
            560, 608, 632, 636, 640, 648,
            652, 656, 664,
        ],
        "itemsize": 672,
    }
)  # fmt: skip
# Offsets are relative to the tree header. Node and tile counts run from the leaves upwards.
TREE_DATA = np.dtype(
    [("node_offset", "<u8", 4), ("node_count", "<u4", 3), ("tile_count", "<u4", 3), ("voxel_count", "<u8")]
)
BLIND_DATA = np.dtype(
    [
        ("offset", "<i8"), ("value_count", "<u8"), ("value_size", "<u4"), ("semantic", "<u4"), ("data_class", "<u4"),
        ("data_type", "<u4"), ("name", "S256"),
    ]
)  # fmt: skip
BLIND_CLASS_NAME = 3
TREE_OFFSET = GRID_DATA.itemsize
HEAD_SIZE = GRID_DATA.itemsize + TREE_DATA.itemsize
# The root starts with the bounding box of its active voxels: six int32.
ROOT_BOUNDS = 24
REMEDY = "get the file again from its source"
# OpenVDB 10 writes this version. Its tools reject later versions' magic numbers, and later tools read this one.
VERSION = 32 << 21 | 4 << 10 | 2
# The header holds a name of so many bytes and a zero.
LONGEST_NAME = 255


class Damage(Exception):
    """What is wrong with a grid, for :func:`damage_named`."""


@contextmanager
def damage_named(where: str) -> Iterator[None]:
    """Context in which a :class:`Damage` is raised as a FileFormatError that names file and grid."""
    try:
        yield
    except Damage as damage:
        raise FileFormatError(f"{where}: the grid is damaged, {damage}; {REMEDY}") from None


def grid_class_code(name: str) -> int:
    """NanoVDB's code of a grid class; 0, its "unknown", for a class that NanoVDB does not have."""
    return GRID_CLASSES.index(name) if name in GRID_CLASSES else 0


def aligned_buffer(size: int, *, zeroed: bool = False) -> NDArray[np.uint8]:
    """Allocate ``size`` bytes of uint8, uninitialized or zeroed, at an address where NanoVDB allows a grid to start."""
    make = np.zeros if zeroed else np.empty
    memory = make(size + BUFFER_ALIGNMENT, dtype=np.uint8)
    start = -memory.ctypes.data % BUFFER_ALIGNMENT
    return memory[start : start + size]


def is_aligned(buffer: NDArray[np.uint8]) -> bool:
    """Whether a buffer starts where :func:`aligned_buffer` would let it start."""
    return bool(buffer.ctypes.data % BUFFER_ALIGNMENT == 0)


def grid_header(buffer: NDArray[np.uint8]) -> Any:
    """GridData of a buffer, as one record that shares the buffer's memory."""
    return buffer[:TREE_OFFSET].view(GRID_DATA)[0]


def tree_header(buffer: NDArray[np.uint8]) -> Any:
    """TreeData of a buffer, as one record that shares the buffer's memory."""
    return buffer[TREE_OFFSET:HEAD_SIZE].view(TREE_DATA)[0]


def version_text(version: int) -> str:
    """ "32.4.2" from NanoVDB's packed version number."""
    return f"{version >> 21}.{(version >> 10) & 0x7FF}.{version & 0x3FF}"


def require_header(head: NDArray[np.uint8], where: str) -> None:
    """Check the header of a grid of any type: magic number, version, class and transform.

    Args:
        head: The grid, or its first 736 bytes.
        where: File or argument, for the message.

    Raises:
        FileFormatError: The bytes are not a NanoVDB grid, or its header contradicts itself.
        UnsupportedGridError: The grid has another major version.
    """
    if len(head) < HEAD_SIZE:
        raise FileFormatError(f"{where}: {len(head)} bytes are too few for a NanoVDB grid; {REMEDY}")
    grid = grid_header(head)
    if int(grid["magic"]) not in (MAGIC_OLD, MAGIC_GRID):
        raise FileFormatError(f"{where}: the grid does not start with NanoVDB's magic number; {REMEDY}")
    version = int(grid["version"])
    if version >> 21 != MAJOR_VERSION:
        raise UnsupportedGridError(
            f"{where}: NanoVDB {version_text(version)} is not {MAJOR_VERSION}.x; convert it with nanovdb_convert"
        )
    if int(grid["grid_class"]) >= len(GRID_CLASSES):
        raise FileFormatError(f"{where}: grid class {int(grid['grid_class'])} does not exist; {REMEDY}")
    matrix = grid["matrix"].reshape(3, 3)
    finite = np.isfinite(matrix).all() and np.isfinite(grid["vector"]).all() and np.isfinite(grid["inverse"]).all()
    if not finite or is_singular(matrix):
        raise FileFormatError(f"{where}: the transform is not finite and invertible; {REMEDY}")


def require_supported(head: NDArray[np.uint8], where: str) -> GridLayout:
    """Check the header as :func:`require_header` does, and that geokit reads the grid's type and node order.

    Returns:
        The layout of the grid's type.

    Raises:
        FileFormatError: The bytes are not a NanoVDB grid, or its header contradicts itself.
        UnsupportedGridError: geokit does not read the grid's version, type or node order.
    """
    require_header(head, where)
    grid = grid_header(head)
    layout = layout_of(int(grid["grid_type"]), where)
    if not int(grid["flags"]) & FLAG_BREADTH_FIRST:
        raise UnsupportedGridError(f"{where}: the nodes are not in breadth-first order; write it again with NanoVDB 32")
    return layout


def is_singular(matrix: NDArray[np.float64]) -> bool:
    """Whether a matrix (3, 3) has no inverse."""
    # Rows are scaled first: voxels of 1e-120 have a determinant that underflows although the matrix is regular.
    scale = np.abs(matrix).max(axis=1, keepdims=True)
    return not (scale > 0.0).all() or np.linalg.matrix_rank(matrix / scale) < 3


def voxel_size_of(transform: NDArray[np.float64]) -> NDArray[np.float64]:
    """Edge lengths (3,) of a voxel under a transform, index to world, whose first three columns are linear."""
    linear = transform[:3, :3]
    # Scaled first: squares of lengths beyond 1e154 overflow although the lengths do not.
    largest = np.abs(linear).max(axis=0)
    return np.linalg.norm(linear / np.where(largest > 0.0, largest, 1.0), axis=0) * largest


def info_of(
    buffer: NDArray[np.uint8],
    metadata: Mapping[str, Any] | None = None,
    *,
    name: str | None = None,
    byte_count: int | None = None,
    where: str = "NanoVDB buffer",
) -> GridInfo:
    """Describe the grid in a NanoVDB buffer.

    Args:
        buffer: A grid, uint8, at least through its root's fixed part.
        metadata: OpenVDB metadata of the grid; NanoVDB has no place for it.
        name: The grid's name if known from elsewhere; else it is read from the buffer.
        byte_count: Size of the grid if the buffer holds only its beginning.
        where: File or argument, for the message.

    Returns:
        GridInfo of the grid; its background is None if the type holds no values.

    Raises:
        FileFormatError: The buffer is not a NanoVDB grid.
        UnsupportedGridError: The grid has another major version of NanoVDB.
    """
    require_header(buffer, where)
    grid, tree = grid_header(buffer), tree_header(buffer)
    layout = LAYOUTS.get(type_name(int(grid["grid_type"])))
    root = TREE_OFFSET + int(tree["node_offset"][3])
    if root < HEAD_SIZE or root + (layout.root_size if layout else ROOT_BOUNDS) > len(buffer):
        raise FileFormatError(f"{where}: the root node lies outside the grid; {REMEDY}")
    transform = np.eye(4)
    transform[:3, :3] = grid["matrix"].reshape(3, 3)
    transform[:3, 3] = grid["vector"]
    box = buffer[root : root + ROOT_BOUNDS].copy().view("<i4").reshape(2, 3).astype(np.int64)
    bounds = box if tree["voxel_count"] and (box[0] <= box[1]).all() else None
    voxel_size = voxel_size_of(transform)
    for array in (transform, voxel_size, bounds):
        if array is not None:
            array.setflags(write=False)
    return GridInfo(
        name=grid_name(buffer) if name is None else name,
        grid_type=type_name(int(grid["grid_type"])),
        grid_class=GRID_CLASSES[int(grid["grid_class"])],
        transform=transform,
        voxel_size=voxel_size,
        background=_background(buffer, root, layout) if layout else None,
        active_voxel_count=int(tree["voxel_count"]),
        index_bounds=bounds,
        byte_count=len(buffer) if byte_count is None else byte_count,
        metadata=MappingProxyType(dict(metadata or {})),
    )


def grid_name(buffer: NDArray[np.uint8]) -> str:
    """A grid's name: in the header up to 255 bytes, else in a block of blind data.

    Bytes that are not UTF-8 become surrogates, which encode to the same bytes again.
    """
    grid = grid_header(buffer)
    offset, count = int(grid["blind_offset"]), int(grid["blind_count"])
    if int(grid["flags"]) & FLAG_LONG_NAME and HEAD_SIZE <= offset <= len(buffer) - count * BLIND_DATA.itemsize:
        for i, entry in enumerate(buffer[offset : offset + count * BLIND_DATA.itemsize].view(BLIND_DATA)):
            start = offset + i * BLIND_DATA.itemsize + int(entry["offset"])
            if int(entry["data_class"]) == BLIND_CLASS_NAME and HEAD_SIZE <= start < len(buffer):
                text = buffer[start : start + int(entry["value_count"])].tobytes()
                return decoded_name(text)
    return decoded_name(bytes(grid["name"]))


def decoded_name(text: bytes) -> str:
    """Decode a name from bytes that end with the first zero, if any."""
    return text.split(b"\0", 1)[0].decode("utf-8", "surrogateescape")


def encoded_name(name: str) -> bytes:
    """Encode a name to the bytes from which :func:`decoded_name` made it."""
    try:
        return require_text(name, "name").encode("utf-8", "surrogateescape")
    except UnicodeEncodeError as error:
        raise InputError(f"name: {described(name)} has characters that no file can hold; use others") from error


def value_range(buffer: NDArray[np.uint8]) -> tuple[float, float] | None:
    """Smallest and largest value of the active voxels of a grid, for vectors of their lengths, as its root says.

    None if it says neither, if no voxel is active, and of bits, indices and colors.
    """
    grid, tree = grid_header(buffer), tree_header(buffer)
    kind = BY_NAME.get(type_name(int(grid["grid_type"])))
    if kind is None or not kind.has_values or kind.family in ("bool", "mask", "color"):
        return None
    if not int(grid["flags"]) & FLAG_HAS_MIN_MAX or not tree["voxel_count"]:
        return None
    layout = LAYOUTS[kind.name]
    start = TREE_OFFSET + int(tree["node_offset"][3]) + layout.root_background + layout.background.itemsize
    limits = buffer[start : start + 2 * layout.background.itemsize].copy().view(layout.background.base)
    low, high = limits.astype(np.float64).reshape(2, -1)
    return (
        (float(low[0]), float(high[0])) if len(low) == 1 else (float(np.linalg.norm(low)), float(np.linalg.norm(high)))
    )


def _background(buffer: NDArray[np.uint8], root: int, layout: GridLayout) -> Any:
    start = root + layout.root_background
    value = buffer[start : start + layout.background.itemsize].copy()
    if layout.background == np.bool_:
        return bool(value[0])  # a damaged byte is neither 0 nor 1
    typed = value.view(layout.background.base)
    return tuple(typed.tolist()) if layout.background.shape else typed[0].item()


class GridOptions(NamedTuple):
    """Index to world (4, 4), the name in bytes, and NanoVDB's code of the class."""

    transform: NDArray[np.float64]
    name: bytes
    grid_class: int


def checked_options(transform: NDArray[np.float64], name: str, grid_class: str) -> GridOptions:
    """Validate the options of a grid.

    Raises:
        InputError: A name, class or transform that no grid can have.
    """
    encoded = encoded_name(name)
    if len(encoded) > LONGEST_NAME or b"\0" in encoded:
        raise InputError(f"name: {len(encoded)} bytes; use at most {LONGEST_NAME} without a zero byte")
    matrix = checked_transform(transform)
    code = grid_class_code(require_text(grid_class, "grid_class"))
    if code == 0 and grid_class != "unknown":
        raise InputError(f"grid_class: NanoVDB has no class {grid_class!r}; use 'level set', 'fog volume' or 'unknown'")
    return GridOptions(matrix, encoded, code)


def checked_transform(transform: NDArray[np.float64]) -> NDArray[np.float64]:
    """Validate a transform and return it as float64 (4, 4).

    Raises:
        InputError: No grid can have it.
    """
    matrix = np.array(read_array(transform, "transform"), np.float64)
    if matrix.shape != (4, 4):
        raise InputError(f"transform: shape {matrix.shape} is not (4, 4); give index to world")
    is_affine = np.isfinite(matrix).all() and (matrix[3] == (0.0, 0.0, 0.0, 1.0)).all()
    if not is_affine or is_singular(matrix[:3, :3]):
        raise InputError(
            "transform: not a finite, invertible affine map with the last row 0 0 0 1; give index to world"
        )
    return matrix


def write_header(
    buffer: NDArray[np.uint8],
    layout: GridLayout,
    options: GridOptions,
    size: int,
    begins: tuple[int, int, int, int],
    counts: tuple[int, int, int],
) -> None:
    """Write a grid's headers, still without statistics and checksum.

    Args:
        buffer: Target, filled with zeros.
        layout: Layout of the grid's type, which must have extrema.
        options: Options from :func:`checked_options`.
        size: Size of the grid in bytes.
        begins: Offsets [bytes] of the leaves, lower nodes, upper nodes and the root.
        counts: Numbers of leaves, lower and upper nodes.
    """
    grid = grid_header(buffer)
    grid["magic"], grid["version"] = MAGIC_OLD, VERSION
    grid["flags"] = FLAG_BREADTH_FIRST | FLAG_HAS_MIN_MAX
    grid["grid_count"] = 1
    grid["grid_size"] = grid["blind_offset"] = size
    grid["name"] = options.name
    write_transform(grid, options.transform)
    grid["grid_class"], grid["grid_type"] = options.grid_class, GRID_TYPES.index(layout.name)
    tree = tree_header(buffer)
    tree["node_offset"] = [begin - TREE_OFFSET for begin in begins]
    tree["node_count"] = counts


def write_transform(grid: Any, transform: NDArray[np.float64]) -> None:
    """Write a transform, index to world (4, 4), into a grid's header."""
    linear, translation = transform[:3, :3], transform[:3, 3]
    inverse = np.linalg.inv(linear)
    grid["matrix"], grid["inverse"], grid["vector"], grid["taper"] = linear.ravel(), inverse.ravel(), translation, 1.0
    # Beyond float32's range the single-precision map overflows to inf; geokit's kernels use the double-precision one.
    with np.errstate(over="ignore", under="ignore"):
        grid["matrix_f"], grid["inverse_f"] = linear.ravel(), inverse.ravel()
        grid["vector_f"], grid["taper_f"] = translation, 1.0
    grid["voxel_size"] = voxel_size_of(transform)
