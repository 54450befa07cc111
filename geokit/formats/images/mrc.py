"""MRC2014 and CCP4 maps (.mrc, .map): the header by mrcfile. Lengths are in angstrom.

The cell gives the size and the directions of voxels, MAPC, MAPR and MAPS the order of the axes. The first voxel lies at
ORIGIN, or where that is zero at NXSTART, NYSTART, NZSTART, as ChimeraX has it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.errors import FileFormatError, InputError
from geokit.formats.images.image import (
    Image,
    affine,
    fitting_codec,
    grids_of,
    in_unit,
    note_of,
    noted,
    reading,
    require_straight,
    require_three,
    stored_type,
)
from geokit.formats.images.stream import slabs_in

# It holds no axes but those of the world: others are turned to them, where they are parallel.
STRAIGHT = True
HEAD_BYTES = 1024
MODES = {0: "i1", 1: "i2", 2: "f4", 6: "u2", 12: "f2"}
# Whole numbers that float32 does not hold are refused when they come.
STORED = {"i1": "<i1", "i2": "<i2", "u2": "<u2", "f2": "<f2", "b1": "<i1", "u1": "<u2"}
STORED |= dict.fromkeys(("f4", "f8", "i4", "u4", "i8", "u8"), "<f4")
LABEL = 80
# The first byte of the machine stamp.
ORDERS = {b"\x44": "<", b"\x11": ">"}
# Space groups of stacks of volumes.
STACKS = range(401, 631)


def open_images(path: Path, limit: int) -> list[Image]:
    """Read the header."""
    mrcfile = require_package("mrcfile")
    with reading(path):
        with open(path, "rb") as file:
            raw = file.read(HEAD_BYTES)
        if len(raw) < HEAD_BYTES:
            raise FileFormatError(f"{path}: ends within its header; get a whole copy")
        header = np.frombuffer(raw, mrcfile.dtypes.HEADER_DTYPE)[0]
        order = ORDERS.get(raw[212:213], "")
        if not order:
            # Files from before 2014 state none; then the mode tells, and where that is 0 the order of the axes.
            word = int(header["mode"]) or int(header["mapc"])
            order = "<" if word in range(128) else ">"
        header = np.frombuffer(raw, mrcfile.dtypes.HEADER_DTYPE.newbyteorder(order))[0]
        mode, size = int(header["mode"]), [int(header[name]) for name in ("nx", "ny", "nz")]
        if mode not in MODES:
            remedy = "geokit reads the modes 0, 1, 2, 6 and 12 (whole and real numbers)"
            raise FileFormatError(f"{path}: has mode {mode} or is no MRC file; {remedy}")
        stored = require_three(path, size)
        extra = int(header["nsymbt"])
        if extra < 0:
            raise FileFormatError(f"{path}: has an extended header of {extra} bytes; the file is damaged")
        axes = [int(header[name]) - 1 for name in ("mapc", "mapr", "maps")]
        axes = [0, 1, 2] if axes == [-1, -1, -1] else axes
        if sorted(axes) != [0, 1, 2]:
            raise FileFormatError(
                f"{path}: has the axis order {[axis + 1 for axis in axes]}; it is some order of 1 2 3"
            )
        columns, origin = _place(header, axes)
        count = _volume_count(header, size[2], path)
        labels = b"".join(header["label"][1:].tolist()).decode("ascii", "replace")
    dtype = np.dtype(order + MODES[mode])
    stored = (*stored[:2], stored[2] // count)
    volume_bytes = int(np.prod(stored, dtype=object)) * dtype.itemsize
    # Where each axis of the world lies among the axes of the file.
    place = [axes.index(axis) for axis in range(3)]

    def slabs(number: int) -> Iterator[NDArray[Any]]:
        for slab in slabs_in(path, dtype, (*stored, 1), offset=HEAD_BYTES + extra + number * volume_bytes):
            yield slab[..., 0].transpose(place)

    x, y, z = (stored[at] for at in place)
    image = Image(
        shape=(x, y, z),
        dtype=dtype,
        transform=affine(columns, origin),
        axis=axes[2],
        unit="angstrom",
        note=note_of(labels),
    )
    return grids_of(path, image, count, slabs)


def _volume_count(header: Any, sections: int, path: Path) -> int:
    """Number of volumes that lie one behind the other, of MZ sections each, if the space group says so."""
    if int(header["ispg"]) not in STACKS:
        return 1
    each = int(header["mz"])
    if each < 1 or sections % each:
        raise FileFormatError(f"{path}: has {sections} sections in volumes of {each}; the file is damaged")
    return sections // each


def _place(header: Any, axes: list[int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps along x, y and z as columns, and the place of the first voxel."""
    lengths = np.array([float(header["cella"][name]) for name in "xyz"])
    counts = np.array([int(header[name]) for name in ("mx", "my", "mz")], np.float64)
    steps = np.divide(lengths, counts, out=np.ones(3), where=(lengths > 0.0) & (counts > 0))
    degrees = np.array([float(header["cellb"][name]) for name in ("alpha", "beta", "gamma")])
    columns = np.diag(steps)
    if not np.isin(degrees, (0.0, 90.0)).all():
        alpha, beta, gamma = np.radians(degrees)
        b = np.array([np.cos(gamma), np.sin(gamma), 0.0])
        along = (np.cos(alpha) - np.cos(beta) * np.cos(gamma)) / np.sin(gamma)
        c = np.array([np.cos(beta), along, np.sqrt(max(0.0, 1.0 - np.cos(beta) ** 2 - along**2))])
        columns = np.stack([np.array([1.0, 0.0, 0.0]), b, c], axis=1) * steps
    origin = np.array([float(header["origin"][name]) for name in "xyz"])
    starts = np.array([int(header[name]) for name in ("nxstart", "nystart", "nzstart")], np.float64)
    return columns, origin if origin.any() else columns @ starts[[axes.index(axis) for axis in range(3)]]


def write_image(path: Path, image: Image, codec: str | None) -> None:
    """Write voxels, voxel size and origin, in angstrom and in float32."""
    mrcfile = require_package("mrcfile")
    fitting_codec(path, codec, ("none",))
    if image.components > 1:
        raise InputError(f"{path}: the format holds one number in a voxel; use .nrrd for vectors")
    dtype = stored_type(path, image.dtype, STORED)
    matrix = in_unit(image.transform, image.unit, "angstrom")
    spacing = require_straight(path, matrix, turned=False)
    header = np.zeros((), mrcfile.dtypes.HEADER_DTYPE)
    for at, axis in enumerate("xyz"):
        header[f"n{axis}"] = header[f"m{axis}"] = image.shape[at]
        header["cella"][axis], header["origin"][axis] = spacing[at] * image.shape[at], matrix[at, 3]
    header["mode"] = next(mode for mode, kind in MODES.items() if kind == dtype.str[1:])
    for name in ("alpha", "beta", "gamma"):
        header["cellb"][name] = 90.0
    header["mapc"], header["mapr"], header["maps"] = 1, 2, 3
    header["ispg"], header["nversion"], header["map"], header["machst"] = 1, 20141, b"MAP ", [0x44, 0x44, 0, 0]
    header["label"][0] = b"geokit"
    note = noted(image.note).encode("ascii")
    lines = [note[at : at + LABEL] for at in range(0, len(note), LABEL)]
    lines = lines if len(lines) < len(header["label"]) else []
    header["label"][1 : 1 + len(lines)] = lines
    header["nlabl"] = 1 + len(lines)
    total = squares = 0.0
    low, high = np.inf, -np.inf
    with open(path, "wb") as file:
        file.write(header.tobytes())
        for slab in image.slabs():
            values = np.ascontiguousarray(slab.transpose(2, 1, 0), dtype)
            if (
                slab.dtype.kind in "iu"
                and dtype.kind == "f"
                and (values.astype(np.float64) != slab.transpose(2, 1, 0)).any()
            ):
                raise InputError(f"{path}: holds whole numbers beyond 2^24 as float32 only; use .nrrd")
            file.write(values.data)
            wide = values.astype(np.float64)
            low, high = min(low, wide.min()), max(high, wide.max())
            total, squares = total + wide.sum(), squares + (wide * wide).sum()
        count = float(np.prod(image.shape, dtype=object))
        mean = total / count
        header["dmin"], header["dmax"], header["dmean"] = low, high, mean
        header["rms"] = np.sqrt(max(0.0, squares / count - mean * mean))
        file.seek(0)
        file.write(header.tobytes())
