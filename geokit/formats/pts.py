"""Leica's text format (.pts): a count, then x y z, intensity and color in each row."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError, InputError
from geokit.formats.columns import Columns, integer_colors, joined
from geokit.formats.text_files.decimal import written_lines
from geokit.formats.text_files.plain import plain_text
from geokit.formats.text_files.rows import read_rows

# Names of the columns after x, y and z, by the number of columns.
_LAYOUTS = {3: (), 4: ("intensity",), 6: ("rgb",), 7: ("intensity", "rgb")}


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read points, and intensity (float64) and rgb (N, 3) uint8 if the file has them.

    Raises:
        FileFormatError: The file is damaged, or its number of rows differs from its first line.
    """
    data = plain_text(path.read_bytes(), path)
    end = data.find(b"\n")
    end = len(data) if end < 0 else end + 1
    words = data[:end].split()
    if len(words) != 1 or not words[0].isdigit() or len(words[0]) > 18:
        shown = data[: min(end, 60)].decode("ascii", "backslashreplace").strip()
        raise FileFormatError(
            f"{path}: line 1 ({shown!r}) is not the number of points; write it there, or call the file .xyz"
        )
    count = int(words[0])
    table = read_rows(data, end, path) if data[end:].strip() else np.empty((0, 3))
    if len(table) < count:
        raise FileFormatError(f"{path}: ends in point {len(table)} of the {count} it declares; get a whole copy")
    if len(table) > count:
        raise FileFormatError(f"{path}: has {len(table)} points and declares {count}; correct its first line")
    if table.shape[1] not in _LAYOUTS:
        raise FileFormatError(
            f"{path}: has {table.shape[1]} values in a row; .pts has x y z, then intensity, then red green blue"
        )
    columns: Columns = dict(zip("xyz", table.T, strict=False))
    layout = _LAYOUTS[table.shape[1]]
    if "intensity" in layout:
        columns["intensity"] = table[:, 3]
    if "rgb" in layout:
        columns["rgb"] = _bytes(table[:, -3:], path)
    return joined(columns, path)


def _bytes(colors: NDArray[np.float64], path: Path) -> NDArray[np.uint8]:
    bad = ~((colors >= 0.0) & (colors <= 255.0) & (np.floor(colors) == colors)).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise FileFormatError(
            f"{path}: the color of point {row} ({colors[row].tolist()}) is not three integers of 0 to 255; correct it"
        )
    return colors.astype(np.uint8)


def write_points(path: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> None:
    """Write the count and the rows; every number reads back as the same float64.

    Raises:
        InputError: Data other than ``intensity`` (N,) and ``rgb`` (N, 3) uint8.
    """
    columns: list[NDArray[np.generic]] = list(points.T)
    if "rgb" in data:
        data = {**data, "rgb": integer_colors(data["rgb"], np.uint8)}
    for name, values in data.items():
        if name == "intensity" and values.ndim == 1:
            continue
        if name == "rgb" and values.shape[1:] == (3,) and values.dtype == np.uint8:
            continue
        raise InputError(
            f"data: .pts holds 'intensity' (N,) and 'rgb' (N, 3) uint8, not '{name}' {values.dtype} of shape "
            f"{values.shape}; write .ply or .pcd"
        )
    if "intensity" in data:
        columns.append(data["intensity"])
    if "rgb" in data:
        columns += list(data["rgb"].T)
    with open(path, "wb") as file:
        file.write(f"{len(points)}\n".encode("ascii"))
        file.writelines(written_lines(*columns))
