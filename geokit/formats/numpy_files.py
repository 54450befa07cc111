"""NumPy's files (.npy, .npz) as tables and columns."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError

__all__ = ["read_archive", "read_array", "read_cloud", "write_archive"]

Columns = dict[str, NDArray[np.generic]]


def read_array(path: Path) -> NDArray[np.float64]:
    """The table of numbers in an .npy file.

    Raises:
        FileFormatError: The content is damaged or no table of numbers.
    """
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # numpy, zipfile, zlib and the parser of Python's literals raise a dozen kinds
        raise FileFormatError(
            f"{path}: is not a NumPy array ({_line(error)}); write it again with numpy.save"
        ) from None
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu":
        shape = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else "an archive"
        raise FileFormatError(f"{path}: holds {shape}; it needs to be a table of numbers, one row for each point")
    return array.astype(np.float64)


def read_archive(path: Path) -> Columns:
    """Every array of an .npz file by name.

    Raises:
        FileFormatError: The content is damaged.
    """
    try:
        # Opened here: numpy leaves a file that is not an archive open.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:
        raise FileFormatError(f"{path}: is not a NumPy archive ({_line(error)}); use numpy.savez again") from None


def read_cloud(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """The points of an .npz file, and the arrays that have a row for each.

    Raises:
        FileFormatError: The content is damaged or has no points.
    """
    arrays = read_archive(path)
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


def write_archive(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> None:
    """Arrays by name, in their own types."""
    with zipfile.ZipFile(path, "w", allowZip64=True) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
