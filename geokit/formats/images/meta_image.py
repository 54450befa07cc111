"""MetaImage (.mhd with its .raw, .mha). The world is in LPS, as ITK has it: x to the left, y to the back, z up.

Its header is lines of text, which geokit reads itself: VTK's reader leaves out the directions of the axes.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import atomic_path, is_there
from geokit.errors import FileAccessError, FileFormatError
from geokit.formats.images.image import (
    Image,
    affine,
    file_beside,
    fitting_codec,
    grids_of,
    in_space,
    left_out_keys,
    note_of,
    noted,
    one_unit,
    reading,
    require_straight,
    require_three,
    stored_type,
)
from geokit.formats.images.stream import packed_writer, slabs_in
from geokit.formats.reader.warnings import warn_of

HEAD_BYTES = 1 << 16
# Keys of the format; others are the user's own.
_KEYS = (
    "objecttype objectsubtype ndims name id parentid color comment binarydata elementbyteordermsb "
    "binarydatabyteordermsb compresseddata compresseddatasize compressionlevel transformmatrix rotation orientation "
    "offset position origin centerofrotation anatomicalorientation elementspacing elementsize distanceunits dimsize "
    "headersize modality sequenceid elementmin elementmax elementnumberofchannels elementtointensityfunctionslope "
    "elementtointensityfunctionoffset elementtype elementdatafile acquisitiondate itk_inputfiltername"
)
TYPES = {"CHAR": "i1", "UCHAR": "u1", "SHORT": "i2", "USHORT": "u2", "INT": "i4", "UINT": "u4", "LONG": "i4",
         "ULONG": "u4", "LONG_LONG": "i8", "ULONG_LONG": "u8", "FLOAT": "f4", "DOUBLE": "f8"}  # fmt: skip
_DATA_FILE = re.compile(rb"^\s*ElementDataFile\s*=\s*(.*?)\s*$", re.IGNORECASE | re.MULTILINE)
NAMES = {kind: name for name, kind in reversed(TYPES.items())}
STORED = {"b1": "<u1", "f2": "<f4"} | {kind: f"<{kind}" for kind in NAMES}


def open_images(path: Path, limit: int) -> list[Image]:
    """Read the header."""
    with reading(path):
        with open(path, "rb") as file:
            head = file.read(HEAD_BYTES)
        found, at, own = {}, 0, []
        while "elementdatafile" not in found:
            line, end, _ = head[at:].partition(b"\n")
            key, equal, value = line.decode("utf-8", "replace").partition("=")
            if not equal or not end:
                raise FileFormatError(
                    f"{path}: is no MetaImage (no ElementDataFile in its header); check the extension"
                )
            found[key.strip().lower()] = value.strip()
            own += [key.strip()] if key.strip().lower() not in _KEYS.split() else []
            at += len(line) + 1
        shape, channels, dtype = _kind(found, path)
        count = len(found.get("dimsize", "").split())
        directions = _numbers(found, ("transformmatrix", "rotation", "orientation"), path)
        if directions is not None and len(directions) != count * count:
            raise FileFormatError(f"{path}: has {len(directions)} numbers in its TransformMatrix, not {count * count}")
        columns = np.eye(3)
        if directions is not None:
            side = min(count, 3)
            columns[:side, :side] = directions.reshape(count, count)[:side, :side].T
        spacing = _first(_numbers(found, ("elementspacing", "elementsize"), path), 1.0)
        origin = _first(_numbers(found, ("offset", "position", "origin"), path), 0.0)
        zipped = found.get("compresseddata", "").lower() in ("true", "1")
        size = int(np.prod(shape, dtype=object)) * channels * dtype.itemsize
        data, offset = _data(found, path, at, size, zipped)

    def slabs(frame: int) -> Iterator[NDArray[Any]]:
        place: Any = {"offset": offset, "skip": frame * (size // shape[3]), "packing": "zlib" if zipped else ""}
        return slabs_in(path, dtype, (*shape[:3], channels), beside=data, **place)

    note = note_of(found.get("comment"))
    warn_of(path, left_out_keys(own))
    told = found.get("distanceunits", "").lower().strip("?")
    image = Image(
        shape=shape[:3],
        dtype=dtype,
        transform=affine(columns * spacing, origin),
        components=channels if channels in (1, 3, 4) else 1,
        unit=str(note.get("unit", "")) or one_unit(path, [told])[1],
        space=str(note.get("space", "LPS")),
        packed=zipped,
        note=note,
    )
    return grids_of(path, image, shape[3], slabs, channels)


def _kind(found: dict[str, str], path: Path) -> tuple[tuple[int, int, int, int], int, np.dtype[Any]]:
    sizes = [int(size) for size in found.get("dimsize", "").split()]
    if not 2 <= len(sizes) <= 4 or min(sizes) < 1:
        raise FileFormatError(f"{path}: has the DimSize {sizes}; geokit reads x, y, z and time")
    kind = TYPES.get(found.get("elementtype", "").upper().removeprefix("MET_").removesuffix("_ARRAY"))
    if kind is None or found.get("binarydata", "true").lower() not in ("true", "1"):
        raise FileFormatError(f"{path}: holds {found.get('elementtype', 'no type')!r}, or text; save binary numbers")
    order = found.get("elementbyteordermsb", found.get("binarydatabyteordermsb", "false")).lower()
    channels = int(found.get("elementnumberofchannels", "1"))
    if channels < 1:
        raise FileFormatError(f"{path}: has {channels} channels; the file is damaged")
    shape = require_three(path, [*sizes, 1, 1][:3])
    return (*shape, [*sizes, 1, 1][3]), channels, np.dtype((">" if order in ("true", "1") else "<") + kind)


def _numbers(found: dict[str, str], names: tuple[str, ...], path: Path) -> NDArray[np.float64] | None:
    text = next((found[name] for name in names if name in found), None)
    return None if text is None else np.array([float(word) for word in text.split()])


def _first(values: NDArray[np.float64] | None, missing: float) -> NDArray[np.float64]:
    """Three numbers."""
    full = np.full(3, missing)
    given = np.zeros(0) if values is None else values[:3]
    full[: len(given)] = given
    return full


def _data(found: dict[str, str], path: Path, at: int, size: int, zipped: bool) -> tuple[Path, int]:
    """The file with the voxels, and where they begin in it."""
    name = found["elementdatafile"]
    data, offset = (path, at) if name.upper() == "LOCAL" else (file_beside(path, name), 0)
    header = int(found.get("headersize", "0"))
    if header == -1 and not zipped:
        return data, max(0, data.stat().st_size - size)
    return data, offset + max(0, header)


def _require_own(data: Path, header: Path) -> None:
    """Refuse to replace a file with voxels that the header beside it does not name, packed or not."""
    if not is_there(data):
        return
    found = None
    with contextlib.suppress(OSError), open(header, "rb") as file:
        found = _DATA_FILE.search(file.read(HEAD_BYTES))
    if found is None or os.fsdecode(found[1]) not in (data.with_suffix(end).name for end in (".raw", ".zraw")):
        raise FileAccessError(
            f"{data}: is there, and the voxels of {header.name} would replace it; move it away, or choose another name"
        )


def write_image(path: Path, image: Image, codec: str | None, *, stem: Path | None = None) -> None:
    """Write voxels and place; an .mhd gets a .raw (.zraw) file beside it.

    Args:
        path: Where to write.
        image: The volume.
        codec: "none" or "zip".
        stem: The target without its extension, after which the .raw file is called.

    Raises:
        FileAccessError: A .raw file is there that is not the one of the .mhd that is replaced.
    """
    zipped = fitting_codec(path, codec, ("none", "zip")) == "zip"
    dtype = stored_type(path, image.dtype, STORED)
    matrix = in_space(image.transform, image.space, "LPS")
    spacing = require_straight(path, matrix, turned=True)
    axes = (matrix[:3, :3] / spacing).T
    stem = path.with_suffix("") if stem is None else stem
    beside = stem.with_name(f"{stem.name}.{'zraw' if zipped else 'raw'}") if path.suffix.lower() == ".mhd" else None
    if beside is not None:
        _require_own(beside, stem.with_name(stem.name + path.suffix))
    facts = {**image.note, "space": "LPS" if image.space else "", "unit": image.unit}

    def text(values: Any) -> str:
        return " ".join(repr(value) for value in np.ravel(values).tolist())

    lines = [
        "ObjectType = Image",
        "NDims = 3",
        f"Comment = {noted(facts)}",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        f"CompressedData = {zipped}",
        f"TransformMatrix = {text(axes)}",
        f"Offset = {text(matrix[:3, 3])}",
        "CenterOfRotation = 0 0 0",
        f"ElementSpacing = {text(spacing)}",
        f"DimSize = {text(image.shape)}",
        *([f"ElementNumberOfChannels = {image.components}"] if image.components > 1 else []),
        f"ElementType = MET_{NAMES[dtype.str[1:]]}",
        f"ElementDataFile = {beside.name if beside else 'LOCAL'}",
    ]

    def put(file: Any) -> int:
        begin = file.tell()
        with packed_writer(file, "zlib" if zipped else "") as stream:
            image.write_to(stream, dtype)
        return int(file.tell() - begin)

    with open(path, "wb") as file:
        head = ("\n".join(lines) + "\n").encode()
        # ITK reads compressed data only if it knows their size, which has room here.
        room = "CompressedDataSize = " if zipped else ""
        at = head.index(b"TransformMatrix")
        file.write(head[:at] + (f"{room}{0:<20}\n".encode() if zipped else b"") + head[at:])
        with contextlib.ExitStack() as stack:
            part = None if beside is None else stack.enter_context(atomic_path(beside))
            if part is None:
                size = put(file)
            else:
                with open(part, "wb") as raw:
                    size = put(raw)
            if zipped:
                file.seek(at)
                file.write(f"{room}{size:<20}\n".encode())
            # All that can fail for want of room has been done before the voxels replace the old ones.
            file.flush()
            os.fsync(file.fileno())
