"""VTK's images (.vti), read by VTK in a separate process. Arrays are grids; those of cells lie at their centers."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.files import damaged, in_one_line
from geokit.errors import FileFormatError
from geokit.formats.images.image import (
    Image,
    affine,
    fitting_codec,
    note_of,
    noted,
    require_straight,
    require_three,
    stored_type,
)
from geokit.formats.reader import process as reader_process
from geokit.formats.reader.warnings import warn_of
from geokit.formats.vtk import _collected, _window, _without_pointers, no_numbers, reported

NAMES = {"i1": "Int8", "u1": "UInt8", "i2": "Int16", "u2": "UInt16", "i4": "Int32", "u4": "UInt32", "i8": "Int64",
         "u8": "UInt64", "f4": "Float32", "f8": "Float64"}  # fmt: skip
STORED = {"b1": "<u1", "f2": "<f4"} | {kind: f"<{kind}" for kind in NAMES}
NOTE = "geokit"
# The last tag is within this.
TAIL_BYTES = 1 << 10


def prepare() -> None:
    """Import the reader and load its library."""
    from vtkmodules.util import numpy_support  # noqa: F401
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    vtkXMLImageDataReader()


def read_grids(path: Path, names: list[str]) -> tuple[Any, list[tuple[str, NDArray[Any]]]]:
    """Facts and arrays of a file, in the separate process."""
    require_package("vtkmodules")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    # VTK says nothing of binary data that end early.
    with open(path, "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
        if b"</VTKFile>" not in file.read():
            raise FileFormatError(f"{path}: is no whole VTK file (its last tag is missing); get a whole copy")
    with _window, _collected() as said:
        reader: Any = vtkXMLImageDataReader()
        reader.SetFileName(os.fsencode(path))
        reader.Update()
        data = reader.GetOutput()
    message = reported(said)
    if message or reader.GetErrorCode() or data is None:
        raise damaged(path, f"cannot be read ({_without_pointers(message)})")
    extent = np.array(data.GetExtent()).reshape(3, 2)
    direction = [data.GetDirectionMatrix().GetElement(row, column) for row in range(3) for column in range(3)]
    arrays: dict[str, tuple[bool, NDArray[Any]]] = {}
    for of_cells, kind in ((False, data.GetPointData()), (True, data.GetCellData())):
        for at in range(kind.GetNumberOfArrays()):
            array = kind.GetArray(at)
            if array is not None:
                arrays.setdefault(array.GetName() or "unnamed", (of_cells, vtk_to_numpy(array)))
    note = data.GetFieldData().GetArray(NOTE)
    facts = {
        "extent": extent.tolist(),
        "spacing": list(data.GetSpacing()),
        "origin": list(data.GetOrigin()),
        "direction": direction,
        "of_cells": [of_cells for of_cells, _ in arrays.values()],
        "left_out": [*no_numbers(data.GetPointData()), *no_numbers(data.GetCellData())],
        "note": bytes(vtk_to_numpy(note).astype(np.uint8)).decode("utf-8", "replace") if note else "",
    }
    return facts, [(name, array) for name, (_, array) in arrays.items()]


def open_images(path: Path, limit: int) -> list[Image]:
    """Read all arrays."""
    facts, arrays = reader_process.read_grids(path, __name__, limit, [])
    warn_of(path, facts["left_out"])
    extent = np.array(facts["extent"], np.int64)
    points = extent[:, 1] - extent[:, 0] + 1
    cells = np.maximum(points - 1, 1)
    columns = np.array(facts["direction"], np.float64).reshape(3, 3) * np.array(facts["spacing"], np.float64)
    of_cells = set(facts["of_cells"])
    if not arrays or len(of_cells) != 1:
        what = "arrays of points and of cells" if arrays else "no arrays"
        raise FileFormatError(f"{path}: holds {what}; save one kind of arrays")
    shape = require_three(path, cells if True in of_cells else points)
    shift = 0.5 * (points > 1) if True in of_cells else np.zeros(3)
    origin = np.array(facts["origin"], np.float64) + columns @ (extent[:, 0] + shift)
    note = note_of(facts["note"])
    return [
        Image(
            shape=shape,
            dtype=values.dtype,
            transform=affine(columns, origin),
            slabs=functools.partial(iter, (values,)),
            components=values.shape[3] if values.ndim == 4 else 1,
            name=name,
            note={"origin": extent[:, 0].tolist(), **note},
            unit=str(note.get("unit", "")),
            space=str(note.get("space", "")),
        )
        for name, array in arrays
        for values in [_voxels(path, name, array, shape)]
    ]


def _voxels(path: Path, name: str, array: NDArray[Any], shape: tuple[int, int, int]) -> NDArray[Any]:
    rows = array.reshape(len(array), -1)
    components = rows.shape[1]
    if len(rows) != np.prod(shape, dtype=object) or rows.dtype.kind not in "fiub" or components not in (1, 3, 4):
        held = f"{in_one_line(name)!r} with {len(rows)} times {components} {rows.dtype}"
        raise FileFormatError(f"{path}: holds {held} on {shape}; geokit reads 1, 3 or 4 real numbers in each voxel")
    values = rows.reshape(*shape[::-1], components).transpose(2, 1, 0, 3)
    return values if components > 1 else values[..., 0]


def write_image(path: Path, image: Image, codec: str | None) -> None:
    """Write voxels as the data of points; the extent keeps their indices."""
    fitting_codec(path, codec, ("none",))
    dtype = stored_type(path, image.dtype, STORED)
    spacing = require_straight(path, image.transform, turned=True)
    first = np.array(image.note.get("origin", (0, 0, 0)), np.int64)
    origin = image.transform[:3, 3] - image.transform[:3, :3] @ first
    extent = " ".join(f"{low} {low + size - 1}" for low, size in zip(first.tolist(), image.shape, strict=True))
    note = noted({**image.note, "unit": image.unit, "space": image.space}).encode()
    name = quoteattr(str(image.note.get("name") or "value"))

    def text(values: Any) -> str:
        return " ".join(repr(value) for value in np.ravel(values).tolist())

    head = (
        '<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">'
        f'<ImageData WholeExtent="{extent}" Origin="{text(origin)}" Spacing="{text(spacing)}" '
        f'Direction="{text(image.transform[:3, :3] / spacing)}">\n'
        f'<FieldData><DataArray type="UInt8" Name="{NOTE}" NumberOfTuples="{len(note)}" format="ascii">'
        f"{' '.join(map(str, note))}</DataArray></FieldData>\n"
        f'<Piece Extent="{extent}"><PointData {"Scalars" if image.components == 1 else "Vectors"}={name}>\n'
        f'<DataArray type="{NAMES[dtype.str[1:]]}" Name={name} NumberOfComponents="{image.components}" '
        'format="appended" offset="0"/>\n</PointData></Piece>\n</ImageData>\n<AppendedData encoding="raw">\n_'
    )
    with open(path, "wb") as file:
        size = int(np.prod(image.shape, dtype=object)) * image.components * dtype.itemsize
        file.write(head.encode() + size.to_bytes(8, "little"))
        image.write_to(file, dtype)
        file.write(b"\n</AppendedData>\n</VTKFile>\n")
