"""Sweeps of vehicles' scanners: KITTI's .bin and nuScenes' .pcd.bin, which are float32 without a header."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.columns import Columns

# Numbers of each point after x, y and z, by the end of the name.
_KITTI, _NUSCENES = ("reflectance",), ("intensity", "ring")
# No scanner reaches so far [m], and no echo is so bright.
_REACH, _BRIGHTEST = 1e4, 255.0


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read x, y, z and ``reflectance`` of a .bin; x, y, z, ``intensity`` and ``ring`` of a .pcd.bin.

    Other programs call other files .bin. So coordinates beyond 10 km and a reflectance outside 0 to 255 are refused.

    Raises:
        FileFormatError: The size fits no such rows, or the numbers are not those of a scanner.
    """
    names = _NUSCENES if path.name.lower().endswith(".pcd.bin") else _KITTI
    width = 3 + len(names)
    size = path.stat().st_size
    if size % (4 * width):
        raise FileFormatError(
            f"{path}: has {size} bytes, no multiple of {4 * width}; as a sweep it needs x, y, z, {', '.join(names)} "
            f"in float32 for each point"
        )
    table = np.fromfile(path, "<f4").reshape(-1, width)
    with np.errstate(invalid="ignore"):
        far = (np.abs(table[:, :3]) > _REACH).any(axis=1)
        odd = far | ~((table[:, 3] >= 0.0) & (table[:, 3] <= _BRIGHTEST))
    if odd.any():
        row = int(np.argmax(odd))
        raise FileFormatError(
            f"{path}: row {row} ({', '.join(f'{number:g}' for number in table[row])}) is no echo of a scanner, whose "
            f"{names[0]} is 0 to {_BRIGHTEST:g} within {_REACH:g} m; the file is damaged or not a sweep of KITTI "
            "(nuScenes calls its files .pcd.bin)"
        )
    return table[:, :3].astype(np.float64), {name: table[:, 3 + at].copy() for at, name in enumerate(names)}
