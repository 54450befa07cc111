"""Files of NanoVDB grids (.nvdb): segments of grids with a block of metadata each, or plain grid buffers.

A segment is a 16-byte header, one 176-byte block with the grid's name per grid, then the grids, all with one codec. A
file is any number of segments. Since NanoVDB 32.6 it may also be grid buffers one after the other.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.content_limit import content_limit, require_content
from geokit.core.files import require_file
from geokit.core.memory.needs import require_free
from geokit.errors import DeviceMemoryError, FileFormatError, UnsupportedGridError
from geokit.volume.nanovdb.checks import check_grid, check_head
from geokit.volume.nanovdb.checksum import checksum_matches, checksum_mode, full_checksum, partial_checksum
from geokit.volume.nanovdb.codecs import BLOSC_FRAME, CODECS, decompress, decompress_head, largest_size
from geokit.volume.nanovdb.grid_info import GridInfo
from geokit.volume.nanovdb.header import (
    FLAG_LONG_NAME,
    GRID_CLASSES,
    HEAD_SIZE,
    MAGIC_FILE,
    MAGIC_GRID,
    MAGIC_OLD,
    MAJOR_VERSION,
    REMEDY,
    aligned_buffer,
    damage_named,
    decoded_name,
    grid_header,
    grid_name,
    info_of,
    version_text,
)
from geokit.volume.nanovdb.layout import GRID_TYPES, INDEX_LAYOUTS
from geokit.volume.nanovdb.metadata import metadata_of, without_metadata
from geokit.volume.nanovdb.part import Part

FILE_HEADER = np.dtype([("magic", "<u8"), ("version", "<u4"), ("grid_count", "<u2"), ("codec", "<u2")])
FILE_METADATA = np.dtype(
    [
        ("grid_size", "<u8"), ("file_size", "<u8"), ("name_key", "<u8"), ("voxel_count", "<u8"),
        ("grid_type", "<u4"), ("grid_class", "<u4"), ("world_bbox", "<f8", 6), ("index_bbox", "<i4", 6),
        ("voxel_size", "<f8", 3), ("name_size", "<u4"), ("node_count", "<u4", 4), ("tile_count", "<u4", 3),
        ("codec", "<u2"), ("padding", "<u2"), ("version", "<u4"),
    ]
)  # fmt: skip
# The root follows the headers. In every known file its fixed part lies within 4 KiB, whatever the padding.
INSPECTED = 4096


class NvdbGrid(NamedTuple):
    """One grid of a file.

    Attributes:
        buffer: The grid, uint8, aligned and checked. Its header says that it is the only grid, and metadata that geokit
            had attached to it is removed.
        name: Its name in the file.
        checksum: Coverage of the checksum that was verified on reading: "full", "partial" or "none".
        metadata: The removed metadata.
    """

    buffer: NDArray[np.uint8]
    name: str
    checksum: str
    metadata: dict[str, Any]


@dataclass(frozen=True)
class _Entry:
    name: str
    codec: str
    grid_size: int
    start: int
    stored: int
    grid_type: int

    @property
    def where(self) -> str:
        return f"grid {self.name!r}"


def names(path: str | os.PathLike[str]) -> list[str]:
    """List the names of the grids in a file, in its order, without reading the grids.

    Raises:
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is damaged or no .nvdb file.
        UnsupportedGridError: The file has another major version of NanoVDB.
    """
    with _opened(path) as file:
        return [entry.name for entry in _entries(file, Path(path))]


def inspect(path: str | os.PathLike[str]) -> list[GridInfo]:
    """Describe the grids of a file, reading and decompressing only their first bytes.

    Grids of types that cannot be loaded are listed too. Metadata stands at the end of a grid: if the grid would have to
    be decompressed for it, it is left out and counts as part of the grid's size.

    Raises:
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is damaged or no .nvdb file.
        UnsupportedGridError: The file has another major version of NanoVDB.
        MissingDependencyError: A grid is Blosc-compressed and blosc is not installed.
    """
    path = Path(path)
    infos = []
    with _opened(path) as file:
        for entry in _entries(file, path):
            where = f"{path}: {entry.where}"
            head = _head_of(file, entry, INSPECTED, where)
            metadata, size = _attached(file, entry, where)
            infos.append(info_of(head, metadata, name=entry.name, byte_count=size, where=where))
    return infos


def read(
    path: str | os.PathLike[str], indices: Sequence[int] | None = None, *, memory_limit: int | None = None
) -> list[NvdbGrid]:
    """Read grids of a file, each into its own buffer, with all checks.

    Args:
        path: A .nvdb file.
        indices: Positions of the grids in the file; None for all.
        memory_limit: Largest size of these grids together [bytes]; None is the rule of core/content_limit.py.

    Returns:
        The grids in the requested order.

    Raises:
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is damaged, truncated or no .nvdb file, or a checksum does not match.
        UnsupportedGridError: geokit does not read a grid's type or version.
        MissingDependencyError: A grid is Blosc-compressed and blosc is not installed.
        DeviceMemoryError: The grids are larger than memory_limit.
    """
    path = Path(path)
    with _opened(path) as file:
        entries = list(_entries(file, path))
        chosen = entries if indices is None else [entries[i] for i in indices]
        limit = content_limit(os.fstat(file.fileno()).st_size, memory_limit)
        require_content(path, sum(entry.grid_size for entry in chosen), limit)
        return [_read_grid(file, entry, path) for entry in chosen]


def read_part(
    path: str | os.PathLike[str],
    index: int,
    box_of: Callable[[GridInfo], tuple[NDArray[np.int64], NDArray[np.int64]]],
    *,
    memory_limit: int | None = None,
) -> NvdbGrid:
    """Read the nodes of a grid that meet a box; the whole grid if it is compressed, or its leaves differ in size.

    Of a part no checksum is compared, because it is that of the whole grid.

    Args:
        path: A .nvdb file.
        index: Position of the grid in the file.
        box_of: First and last voxel of the box, from what is known of the grid.
        memory_limit: Largest size of what is read [bytes]; None is the rule of core/content_limit.py.

    Raises:
        As :func:`read`.
    """
    path = Path(path)
    with _opened(path) as file:
        entry = list(_entries(file, path))[index]
        where = f"{path}: {entry.where}"
        head = _head_of(file, entry, INSPECTED, where)
        layout = check_head(head, entry.grid_size, where)
        is_long = int(grid_header(head)["flags"]) & FLAG_LONG_NAME
        if entry.codec != "none" or layout.leaf_bits < 0 or layout.name in INDEX_LAYOUTS or is_long:
            return read(path, [index], memory_limit=memory_limit)[0]
        grid = np.memmap(file, np.uint8, "r", entry.start, entry.grid_size)
        low, high = box_of(info_of(head, name=entry.name, where=where))
        with damage_named(where):
            part = Part(grid, layout, low, high)
        require_content(path, part.size, content_limit(os.fstat(file.fileno()).st_size, memory_limit))
        require_free(part.size, f"load: the part of {entry.where}", always=True)
        buffer = part.buffer()
        check_grid(buffer, where)
        return NvdbGrid(buffer, entry.name or grid_name(buffer), "none", _attached(file, entry, where)[0])


def _opened(path: str | os.PathLike[str]) -> BufferedReader:
    return open(require_file(path), "rb")


def _entries(file: BufferedReader, path: Path) -> Iterator[_Entry]:
    size = os.fstat(file.fileno()).st_size
    if size == 0:
        raise FileFormatError(f"{path}: the file is empty; {REMEDY}")
    file.seek(0)
    start = file.read(HEAD_SIZE)
    if _is_raw_grid(start, size):
        yield from _raw_entries(file, size, path)
        return
    at = 0
    while at < size:
        entries, at = _segment(file, at, size, path)
        yield from entries


def _bytes(file: BufferedReader, count: int, at: int) -> bytes:
    if hasattr(os, "pread"):
        return os.pread(file.fileno(), count, at)
    file.seek(at)
    return file.read(count)


def _is_raw_grid(start: bytes, size: int) -> bool:
    # A file and a grid may start with the same magic number; the following bytes tell them apart.
    if len(start) < HEAD_SIZE:
        return False
    grid = grid_header(np.frombuffer(start, np.uint8).copy())
    if int(grid["magic"]) == MAGIC_GRID:
        return True
    return (
        int(grid["magic"]) == MAGIC_OLD
        and int(grid["version"]) >> 21 == MAJOR_VERSION
        and int(grid["grid_index"]) < int(grid["grid_count"])
        and HEAD_SIZE <= int(grid["grid_size"]) <= size
        and int(grid["grid_type"]) < len(GRID_TYPES)
        and int(grid["grid_class"]) < len(GRID_CLASSES)
    )


def _raw_entries(file: BufferedReader, size: int, path: Path) -> Iterator[_Entry]:
    at = 0
    while at < size:
        head = np.frombuffer(_bytes(file, HEAD_SIZE, at), np.uint8).copy()
        if len(head) < HEAD_SIZE or int(grid_header(head)["magic"]) not in (MAGIC_OLD, MAGIC_GRID):
            raise FileFormatError(f"{path}: no NanoVDB grid at byte {at}; {REMEDY}")
        grid = grid_header(head)
        length = int(grid["grid_size"])
        if not HEAD_SIZE <= length <= size - at:
            raise FileFormatError(f"{path}: the grid at byte {at} claims {length} of {size - at} bytes; {REMEDY}")
        name = decoded_name(bytes(grid["name"]))
        yield _Entry(name, "none", length, at, length, int(grid["grid_type"]))
        at += length


def _segment(file: BufferedReader, at: int, size: int, path: Path) -> tuple[list[_Entry], int]:
    raw = _bytes(file, FILE_HEADER.itemsize, at)
    if len(raw) < FILE_HEADER.itemsize:
        raise FileFormatError(f"{path}: {len(raw)} bytes at byte {at} are no .nvdb segment; {REMEDY}")
    header = np.frombuffer(raw, FILE_HEADER)[0]
    magic, version = int(header["magic"]), int(header["version"])
    if magic not in (MAGIC_OLD, MAGIC_FILE):
        if int.from_bytes(raw[:8], "big") in (MAGIC_OLD, MAGIC_FILE):
            raise FileFormatError(f"{path}: the file is big-endian; write it again on a little-endian machine")
        what = "this is no .nvdb file; check what it is" if at == 0 else f"no .nvdb segment at byte {at}; {REMEDY}"
        raise FileFormatError(f"{path}: {what}")
    if version >> 21 != MAJOR_VERSION:
        raise UnsupportedGridError(
            f"{path}: NanoVDB {version_text(version)} is not {MAJOR_VERSION}.x; convert it with nanovdb_convert"
        )
    if int(header["codec"]) >= len(CODECS):
        raise FileFormatError(f"{path}: compression {int(header['codec'])} at byte {at} does not exist; {REMEDY}")
    codec = CODECS[int(header["codec"])]
    at += FILE_HEADER.itemsize
    found: list[tuple[Any, str]] = []
    for _ in range(int(header["grid_count"])):
        block, name, at = _metadata(file, at, size, path)
        found.append((block, name))
    entries = []
    for block, name in found:
        grid_size = int(block["grid_size"])
        stored = _stored_size(file, at, int(block["file_size"]), grid_size, codec)
        if stored > size - at:
            raise FileFormatError(
                f"{path}: grid {name!r} needs {stored} bytes and the file has {size - at} left; {REMEDY}"
            )
        if grid_size < HEAD_SIZE or grid_size > (stored if codec == "none" else largest_size(stored)):
            raise FileFormatError(
                f"{path}: grid {name!r} claims {grid_size} bytes, which {stored} {codec} bytes cannot hold; {REMEDY}"
            )
        entries.append(_Entry(name, codec, grid_size, at, stored, int(block["grid_type"])))
        at += stored
    return entries, at


def _stored_size(file: BufferedReader, at: int, declared: int, grid_size: int, codec: str) -> int:
    """Bytes of a grid in the file; warp's writer does not count the length words of compressed blocks."""
    if codec == "none" or grid_size > largest_size(declared):
        return declared
    frames = -(-grid_size // BLOSC_FRAME) if codec == "blosc" else 1
    followed = at
    for _ in range(frames):
        # Follow lengths no further than the declared count, since a damaged length cannot be trusted.
        if followed - at > declared:
            return declared
        followed += 8 + int.from_bytes(_bytes(file, 8, followed), "little")
    return declared + 8 * frames if followed - at == declared + 8 * frames else declared


def _metadata(file: BufferedReader, at: int, size: int, path: Path) -> tuple[Any, str, int]:
    raw = _bytes(file, FILE_METADATA.itemsize, at)
    if len(raw) < FILE_METADATA.itemsize:
        raise FileFormatError(f"{path}: the file ends inside the metadata at byte {at}; {REMEDY}")
    block = np.frombuffer(raw, FILE_METADATA)[0]
    at += FILE_METADATA.itemsize
    length = int(block["name_size"])
    if length > size - at:
        raise FileFormatError(f"{path}: a name of {length} bytes at byte {at} does not fit; {REMEDY}")
    name = decoded_name(_bytes(file, length, at))
    return block, name, at + length


def _head_of(file: BufferedReader, entry: _Entry, size: int, where: str) -> NDArray[np.uint8]:
    def fetch(start: int, count: int) -> bytes:
        return _bytes(file, count, entry.start + start)

    return decompress_head(entry.codec, fetch, entry.stored, min(size, entry.grid_size), where)


def _attached(file: BufferedReader, entry: _Entry, where: str) -> tuple[dict[str, Any], int]:
    if entry.codec != "none":
        return {}, entry.grid_size
    return metadata_of(np.memmap(file, np.uint8, "r", entry.start, entry.grid_size), where)


def _read_grid(file: BufferedReader, entry: _Entry, path: Path) -> NvdbGrid:
    where = f"{path}: {entry.where}"
    # The headers are checked before memory for the whole grid is allocated.
    check_head(_head_of(file, entry, HEAD_SIZE, where), entry.grid_size, where)
    try:
        buffer = aligned_buffer(entry.grid_size)
    except MemoryError as error:
        raise DeviceMemoryError(
            f"{where}: {entry.grid_size} bytes of memory are not to be had; load it on a larger machine",
            need=entry.grid_size,
        ) from error
    file.seek(entry.start)
    if entry.codec == "none":
        if file.readinto(buffer.data) != entry.grid_size:
            raise FileFormatError(f"{where}: the file ends inside the grid; {REMEDY}")
    else:
        decompress(entry.codec, memoryview(file.read(entry.stored)), buffer, where)
    check_grid(buffer, where)
    checksum = checksum_mode(buffer)
    if not checksum_matches(buffer):
        raise FileFormatError(f"{where}: the {checksum} checksum does not match the content; {REMEDY}")
    buffer, metadata = without_metadata(buffer, where)
    _make_single(buffer, checksum)
    return NvdbGrid(buffer, entry.name or grid_name(buffer), checksum, metadata)


def _make_single(buffer: NDArray[np.uint8], checksum: str) -> None:
    # A grid from a buffer of several says so, and readers would search for the others behind it.
    grid = grid_header(buffer)
    if int(grid["grid_count"]) == 1 and int(grid["grid_index"]) == 0:
        return
    grid["grid_index"], grid["grid_count"] = 0, 1
    if checksum != "none":
        renew = full_checksum if checksum == "full" else partial_checksum
        grid["checksum"] = renew(buffer[:HEAD_SIZE], buffer)
