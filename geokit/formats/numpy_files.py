"""NumPy files (.npy, .npz) as points and rays."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError, InputError
from geokit.formats.columns import Columns, joined, named, rays

__all__ = ["read_points", "read_rays", "write_points"]


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read the first three columns of an .npy file and the others, or the points of an .npz and its per-point arrays.

    Raises:
        FileFormatError: The content is damaged or has no points.
    """
    return _cloud(path) if path.suffix.lower() == ".npz" else joined(named([], _array(path), path), path)


def read_rays(path: Path) -> NDArray[np.float64]:
    """Read origins and directions (N, 6): six columns, or the arrays with these names.

    Raises:
        FileFormatError: The content is damaged or has no rays.
    """
    if path.suffix.lower() != ".npz":
        return rays([], _array(path), path)
    arrays = _archive(path)
    if {"origins", "directions"} <= arrays.keys():
        parts = [np.asarray(arrays[name]) for name in ("origins", "directions")]
    else:
        wide = [array for array in arrays.values() if array.ndim == 2 and array.shape[1] >= 6]
        parts = [wide[0][:, :3], wide[0][:, 3:6]] if len(wide) == 1 else []
    shapes = {part.shape for part in parts}
    if len(shapes) != 1 or parts[0].ndim != 2 or parts[0].shape[1] != 3:
        raise FileFormatError(f"{path}: has no arrays 'origins' and 'directions' of one shape (N, 3)")
    if any(part.dtype.kind not in "fiu" for part in parts):
        raise FileFormatError(f"{path}: origins or directions are not numbers")
    return np.concatenate(parts, axis=1).astype(np.float64)


def write_points(path: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> None:
    """Write arrays by name to an .npz file, in their own types, with the positions as "points".

    Raises:
        InputError: An array of data has the name "points".
    """
    if "points" in data:
        raise InputError("data: the name 'points' is taken by the positions in .npz; choose another")
    with zipfile.ZipFile(path, "w", allowZip64=True) as archive:
        for name, values in {"points": points, **data}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)


def _array(path: Path) -> NDArray[np.float64]:
    """The table of numbers in an .npy file."""
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # numpy, zipfile, zlib and Python's literal parser raise a dozen kinds of errors
        raise FileFormatError(
            f"{path}: is not a NumPy array ({_line(error)}); write it again with numpy.save"
        ) from None
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu":
        shape = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else "an archive"
        raise FileFormatError(f"{path}: holds {shape}; it needs to be a table of numbers, one row for each point")
    return array.astype(np.float64)


def _archive(path: Path) -> Columns:
    """Every array of an .npz file by name."""
    try:
        # Opened here, because numpy does not close a file that is not an archive.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:
        raise FileFormatError(f"{path}: is not a NumPy archive ({_line(error)}); use numpy.savez again") from None


def _cloud(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """The points of an .npz file, and the arrays that have one row per point."""
    arrays = _archive(path)
    tables = [name for name, array in arrays.items() if array.ndim == 2 and array.shape[1] == 3]
    if "points" not in tables and len(tables) != 1:
        raise FileFormatError(f"{path}: has no array 'points' of shape (N, 3); its arrays are {', '.join(arrays)}")
    name = "points" if "points" in tables else tables[0]
    points = arrays.pop(name)
    if points.dtype.kind not in "fiu":
        raise FileFormatError(f"{path}: array '{name}' has dtype {points.dtype}; it needs to be numbers")
    fitting = {
        key: array
        for key, array in arrays.items()
        if array.ndim in (1, 2) and len(array) == len(points) and array.dtype.kind in "fiub"
    }
    return points.astype(np.float64), fitting


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
