"""NumPy files (.npy, .npz) as points and rays."""

from __future__ import annotations

import contextlib
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError, InputError
from geokit.formats.columns import AXES, Columns, by_place, first_rays, joined

# Three rows of as many numbers are the axes of a cloud, not three points.
MOST_COLUMNS = 100


def content_bytes(path: Path) -> int | None:
    """Size of the decompressed arrays of an .npz file; None for an .npy file, which is never compressed.

    Raises:
        FileFormatError: The file is not an archive.
    """
    if path.suffix.lower() != ".npz":
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            # No more than these sizes is decompressed, whatever the compressed data holds.
            return sum(member.file_size for member in archive.infolist())
    except Exception as error:
        raise FileFormatError(f"{path}: is not a NumPy archive ({_line(error)}); use numpy.savez again") from None


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read the first three columns of an .npy file and the others, or the points of an .npz and its per-point arrays.

    Raises:
        FileFormatError: The content is damaged or has no points.
    """
    if path.suffix.lower() == ".npz":
        return _cloud(path)
    array = loaded(path)
    if array.dtype.names:
        return joined(_fields(array, path), path)
    table = _table(array, path)
    if len(table) == len(AXES) and table.shape[1] >= MOST_COLUMNS:
        raise FileFormatError(f"{path}: has three rows of {table.shape[1]} numbers, and a row is a point; save array.T")
    return joined(by_place(table, path), path)


def read_rays(path: Path) -> NDArray[np.float64]:
    """Read origins and directions (N, 6): six columns, or the arrays with these names.

    Raises:
        FileFormatError: The content is damaged or has no rays.
    """
    if path.suffix.lower() != ".npz":
        return first_rays(_table(loaded(path), path), path)
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


def loaded(path: Path, mode: Literal["r"] | None = None) -> NDArray[Any]:
    """The array of an .npy file, mapped with the mode "r"."""
    try:
        with _silent():
            array = np.load(path, mmap_mode=mode, allow_pickle=False)
    except Exception as error:  # numpy, zipfile, zlib and Python's literal parser raise a dozen kinds of errors
        raise FileFormatError(
            f"{path}: is not a NumPy array ({_line(error)}); write it again with numpy.save"
        ) from None
    if not isinstance(array, np.ndarray):
        raise FileFormatError(f"{path}: holds an archive; call it .npz")
    return array


def _table(array: NDArray[Any], path: Path) -> NDArray[np.float64]:
    """A table of numbers; an image (H, W, 3) of points is read row by row."""
    if array.ndim == 3 and array.shape[2] == 3:
        array = array.reshape(-1, 3)
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise FileFormatError(
            f"{path}: holds {array.dtype} of shape {array.shape}; it needs to be a table of numbers, one row for each "
            "point"
        )
    return array.astype(np.float64)


def _fields(array: NDArray[Any], path: Path) -> Columns:
    """The fields of a structured array that hold numbers, one or several for each point."""
    rows = array.reshape(-1)
    numeric = [name for name in rows.dtype.names or () if rows.dtype[name].base.kind in "fiub"]
    _say_left_out([name for name in rows.dtype.names or () if name not in numeric], path)
    columns = {name: np.ascontiguousarray(rows[name]).reshape(len(rows), -1) for name in numeric}
    wide = [name for name, values in columns.items() if name.lower() in AXES and values.shape[1] != 1]
    if wide:
        raise FileFormatError(f"{path}: field '{wide[0]}' holds several numbers; a coordinate needs to be one")
    return {name: values[:, 0] if values.shape[1] == 1 else values for name, values in columns.items()}


def _archive(path: Path) -> Columns:
    """Every array of an .npz file by name."""
    try:
        # Opened here, because numpy does not close a file that is not an archive.
        with open(path, "rb") as file, _silent(), np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
            # Members that are not arrays come back as bytes.
            return {name: array for name, array in arrays.items() if isinstance(array, np.ndarray)}
    except Exception as error:
        raise FileFormatError(f"{path}: is not a NumPy archive ({_line(error)}); use numpy.savez again") from None


def _cloud(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """The points of an .npz file, and the arrays that have one row per point."""
    arrays = _archive(path)
    tables = [name for name, array in arrays.items() if array.ndim == 2 and array.shape[1] == 3]
    if "points" not in tables and len(tables) != 1:
        raise FileFormatError(
            f"{path}: has no array 'points' of shape (N, 3); its arrays are {in_one_line(', '.join(arrays))}"
        )
    name = "points" if "points" in tables else tables[0]
    points = arrays.pop(name)
    if points.dtype.kind not in "fiu":
        raise FileFormatError(f"{path}: array {name!r} has dtype {points.dtype}; it needs to be numbers")
    fitting = {
        key: array
        for key, array in arrays.items()
        if array.ndim in (1, 2) and len(array) == len(points) and array.dtype.kind in "fiub"
    }
    _say_left_out([key for key in arrays if key not in fitting], path)
    return points.astype(np.float64), fitting


def _say_left_out(names: Sequence[str], path: Path) -> None:
    if names:
        listed = ", ".join(repr(in_one_line(name)) for name in names)
        warn(f"{path}: arrays without a row of numbers for each point are left out: {listed}")


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Without NumPy's warning of headers that Python 2 wrote: they are read all the same."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _line(error: Exception) -> str:
    if "pickle" in str(error) or "Python objects" in str(error):  # NumPy says how to run them
        return "it is of another format, or holds objects of Python"
    return in_one_line(str(error)) or type(error).__name__
