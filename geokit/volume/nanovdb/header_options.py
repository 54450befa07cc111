"""Options of a new grid's headers: validation and writing."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.require import read_array, require_text
from geokit.errors import InputError
from geokit.volume.nanovdb.header import (
    FLAG_BREADTH_FIRST,
    FLAG_HAS_MIN_MAX,
    MAGIC_OLD,
    TREE_OFFSET,
    encoded_name,
    grid_class_code,
    grid_header,
    is_singular,
    tree_header,
    voxel_size_of,
)
from geokit.volume.nanovdb.layout import GRID_TYPES, GridLayout

__all__ = ["GridOptions", "checked_options", "checked_transform", "write_header", "write_transform"]

# OpenVDB 10 writes this version. Its tools reject later versions' magic numbers, and later tools read this one.
VERSION = 32 << 21 | 4 << 10 | 2
# The header holds a name of so many bytes and a zero.
LONGEST_NAME = 255


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
