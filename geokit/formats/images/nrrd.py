"""NRRD (.nrrd, .nhdr): the header by pynrrd. The world is the file's own "space", such as left-posterior-superior.

A first axis of colors or vectors makes components; a list, first or last, several grids.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.errors import FileFormatError
from geokit.formats.images.image import (
    Image,
    affine,
    file_beside,
    fitting_codec,
    grids_of,
    left_out_keys,
    note_of,
    noted,
    one_unit,
    reading,
    require_three,
)
from geokit.formats.images.stream import packed_writer, slabs_in
from geokit.formats.reader.warnings import warn_of

HEAD_BYTES = 1 << 20
# A key with a value of the user's own, such as the name of a segment.
_KEY = re.compile(rb"^([^#:\r\n][^:\r\n]*):=", re.MULTILINE)
# Names of types, in the order of the sizes 1, 2, 4 and 8.
_WHOLE = (("int8", "signed char"), ("int16", "short", "short int", "signed short", "signed short int"),
          ("int32", "int", "signed int"),
          ("int64", "longlong", "long long", "long long int", "signed long long", "signed long long int"))  # fmt: skip
TYPES = {name: f"i{1 << at}" for at, names in enumerate(_WHOLE) for name in (*names, f"{names[0]}_t")}
TYPES |= {f"{'u' if name.startswith('int') and name[3:4].isdigit() else 'unsigned '}{name}": f"u{kind[1:]}"
          for name, kind in TYPES.items() if not name.startswith("signed")}  # fmt: skip
TYPES |= {"unsigned char": "u1", "uchar": "u1", "ushort": "u2", "uint": "u4", "ulonglong": "u8", "float": "f4",
          "double": "f8"}  # fmt: skip
WRITTEN = {"b1": "uint8", "f2": "float", "f4": "float", "f8": "double"}
WRITTEN |= {f"{sign[0]}{size}": f"{sign[1:]}int{8 * size}" for sign in ("i", "uu") for size in (1, 2, 4, 8)}
ENCODINGS = {"raw": "", "gz": "gzip", "gzip": "gzip", "bz2": "bzip2", "bzip2": "bzip2"}
BODY = {"right": "R", "left": "L", "anterior": "A", "posterior": "P", "superior": "S", "inferior": "I"}
UNITS = {
    "millimeters": "mm",
    "millimeter": "mm",
    "microns": "um",
    "micron": "um",
    "meters": "m",
    "meter": "m",
    "???": "",
}
LISTS = ("list", "time", "none", "???", "stub")


def open_images(path: Path, limit: int) -> list[Image]:
    """Read the header."""
    nrrd = require_package("nrrd")
    with reading(path):
        with open(path, "rb") as file:
            head = io.BytesIO(file.read(HEAD_BYTES))
        # Told by the first bytes: pynrrd says of the others only that they are not right.
        if not head.getvalue().startswith(b"NRRD"):
            raise FileFormatError(f"{path}: is no NRRD file (it begins with another word); check the extension")
        header = nrrd.read_header(head)
        offset = head.tell()
        keys = [key.decode("utf-8", "replace") for key in _KEY.findall(head.getvalue()[:offset])]
        sizes = [int(n) for n in header["sizes"]]
        if len(sizes) != int(header["dimension"]) or min(sizes) < 1:
            raise FileFormatError(f"{path}: has the sizes {sizes} in dimension {header['dimension']}; it is damaged")
        dtype = _type_of(header, path)
        packing = ENCODINGS.get(str(header["encoding"]).lower())
        if packing is None:
            remedy = "save it with the encoding raw or gzip"
            raise FileFormatError(f"{path}: has the encoding {str(header['encoding'])!r}; {remedy}")
        lead, frames, spatial = _axes(header, sizes, path)
        matrix, space = _place(header, spatial), _space(header)
        data, offset, skip = _data(header, path, offset, packing, int(np.prod(sizes, dtype=object)) * dtype.itemsize)
        told = header.get("space units", ())
        if not len(told) and "space directions" not in header:
            told = [header["units"][at] for at in spatial] if "units" in header else ()
        units = [UNITS.get(text := str(unit).strip('"'), text) for unit in told]
    factors, unit = one_unit(path, units)
    matrix[: len(factors)] *= factors[:, None]
    shape = require_three(path, ([sizes[at] for at in spatial] + [1, 1, 1])[:3])
    kinds = header.get("kinds")
    is_list = kinds is not None and len(kinds) and str(kinds[0]).lower() in LISTS
    frame_bytes = int(np.prod(shape, dtype=object)) * lead * dtype.itemsize
    note = note_of(header.get("geokit"))
    warn_of(path, left_out_keys(key for key in keys if key != "geokit"))

    def slabs(frame: int) -> Iterator[NDArray[Any]]:
        begin = skip + frame * frame_bytes
        return slabs_in(path, dtype, (*shape, lead), offset=offset, skip=begin, packing=packing, beside=data)

    image = Image(
        shape=shape,
        dtype=dtype,
        transform=matrix,
        components=lead if lead in (3, 4) and not is_list else 1,
        unit=unit,
        space=space,
        packed=packing != "",
        note=note,
    )
    return grids_of(path, image, frames, slabs, lead)


def _type_of(header: Any, path: Path) -> np.dtype[Any]:
    kind = TYPES.get(" ".join(str(header["type"]).split()))
    if kind is None:
        raise FileFormatError(f"{path}: holds the type {str(header['type'])!r}; convert it to numbers")
    order = str(header.get("endian", "little")).lower()
    if order not in ("little", "big"):
        raise FileFormatError(f"{path}: has the byte order {order!r}; it is little or big")
    return np.dtype((">" if order == "big" else "<") + kind)


def _axes(header: Any, sizes: list[int], path: Path) -> tuple[int, int, list[int]]:
    """Numbers in a first axis that is none of space, and in a last one; and the axes of space."""
    directions = header.get("space directions")
    kinds = [str(kind).lower() for kind in header.get("kinds", ["space"] * len(sizes))]
    if directions is not None:
        spatial = [at for at, one in enumerate(directions) if one is not None and np.isfinite(np.asarray(one)).all()]
    else:
        spatial = [at for at, kind in enumerate(kinds) if kind in ("domain", "space")]
        if len(spatial) == 4:  # nothing said: colors come first, lists last
            spatial = [1, 2, 3] if sizes[0] in (1, 3, 4) else [0, 1, 2]
    first, last = (spatial[0], spatial[-1]) if spatial else (0, 0)
    if not 1 <= len(spatial) <= 3 or spatial != list(range(first, last + 1)) or first > 1 or last < len(sizes) - 2:
        raise FileFormatError(
            f"{path}: has {len(spatial)} axes of space among sizes {sizes}; save x, y, z next to each other"
        )
    return (sizes[0] if first else 1), (sizes[-1] if last < len(sizes) - 1 else 1), spatial


def _place(header: Any, spatial: list[int]) -> NDArray[np.float64]:
    columns, origin = np.eye(3), np.zeros(3)
    directions = header.get("space directions")
    for column, axis in enumerate(spatial):
        if directions is not None:
            step = np.asarray(directions[axis], np.float64)
            columns[: len(step), column] = step
            continue
        lowest, highest = (_number(header.get(f"axis {end}s"), axis) for end in ("min", "max"))
        size = int(header["sizes"][axis])
        centers = header.get("centerings", header.get("centers"))
        cells = centers is not None and str(centers[axis]).lower() == "cell"
        length = _number(header.get("spacings"), axis)
        if not np.isfinite(length):
            length = (highest - lowest) / max(1, size if cells else size - 1)
        columns[column, column] = length if np.isfinite(length) and length != 0.0 else 1.0
        if np.isfinite(lowest):
            origin[column] = lowest + (0.5 * columns[column, column] if cells else 0.0)
    if "space origin" in header:
        given = np.asarray(header["space origin"], np.float64)
        origin[: len(given)] = given
    return affine(columns, origin)


def _number(values: Any, axis: int) -> float:
    return float("nan") if values is None else float(values[axis])


def _space(header: Any) -> str:
    words = str(header.get("space", "")).lower().removesuffix("-time").split("-")
    letters = "".join(BODY.get(word, "?") for word in words) if len(words) == 3 else words[0].upper()[:3]
    return letters if len(letters) == 3 and set(letters) <= set(BODY.values()) else ""


def _data(header: Any, path: Path, offset: int, packing: str, need: int) -> tuple[Path, int, int]:
    """The file with the voxels, where they begin in it, and how much of its decompressed content to skip."""
    named = header.get("data file", header.get("datafile"))
    data, offset = (path, offset) if named is None else (file_beside(path, str(named)), 0)
    lines, skip = (int(header.get(f"{what} skip", header.get(f"{what}skip", 0))) for what in ("line", "byte"))
    if lines:
        with open(data, "rb") as file:
            file.seek(offset)
            for _ in range(min(lines, HEAD_BYTES)):
                file.readline(HEAD_BYTES)
            offset = file.tell()
    if skip == -1 and not packing:
        return data, max(0, os.stat(data).st_size - need), 0
    if skip < 0:
        raise FileFormatError(f"{path}: skips {skip} bytes; the file is damaged")
    return data, offset, skip


def write_image(path: Path, image: Image, codec: str | None) -> None:
    """Write voxels, place, unit and space."""
    packing = "gzip" if fitting_codec(path, codec, ("zip", "none")) == "zip" else ""
    kind = WRITTEN[image.dtype.str[1:]]
    dtype = np.dtype("<" + TYPES[kind])
    vectors = image.components > 1
    names = {letter: word for word, letter in BODY.items()}
    matrix = image.transform.tolist()
    columns = ["(" + ",".join(repr(matrix[row][at]) for row in range(3)) + ")" for at in range(3)]
    lines = [
        "NRRD0005",
        f"type: {kind}",
        f"dimension: {3 + vectors}",
        f"space: {'-'.join(names[letter] for letter in image.space)}" if image.space else "space dimension: 3",
        f"sizes: {' '.join(map(str, ([image.components] if vectors else []) + [*image.shape]))}",
        f"space directions: {'none ' * vectors}{' '.join(columns)}",
        f"kinds: {'vector ' * vectors}domain domain domain",
        "endian: little",
        f"encoding: {packing or 'raw'}",
        "space origin: (" + ",".join(repr(matrix[row][3]) for row in range(3)) + ")",
        *([f'space units: "{image.unit}" "{image.unit}" "{image.unit}"'] if image.unit else []),
        f"geokit:={noted(image.note)}",
    ]
    with open(path, "wb") as file:
        file.write(("\n".join(lines) + "\n\n").encode("ascii"))
        with packed_writer(file, packing) as stream:
            image.write_to(stream, dtype)
