"""Metadata of a grid in a .nvdb file: a channel of blind data at the grid's end, which other readers ignore.

NanoVDB has no place for OpenVDB's metadata, but allows any data after the nodes, each with an entry that states its
class, type and name. geokit's entry has class and type "unknown" (which means bytes) and the name ``geokit:metadata``.
Its data is a JSON object::

    {"blind_offset": "zero", "metadata": {"creator": "me", "seed": 7, "scale": {"type": "float", "hex": "0000803f"}}}

Strings, booleans, integers and finite doubles are stored as they are; all other values as their OpenVDB type and bytes.
``blind_offset`` records the header's offset of blind data before there was any, at "zero" or at the "end" of the grid,
so that removing the channel restores the grid's own bytes. The grid's checksum covers nodes only, so a CRC32 of the
text follows the zero byte that ends the entry's name.

Source:
    NanoVDB.h 32.4 and 32.8, GridBlindMetaData.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.native._metadata import decode, encode_all
from geokit.volume.nanovdb.checksum import LAST_OLD_VERSION, checksum_mode, full_checksum, partial_checksum
from geokit.volume.nanovdb.header import BLIND_DATA, HEAD_SIZE, Damage, damage_named, grid_header
from geokit.volume.nanovdb.layout import ALIGNMENT

CHANNEL = b"geokit:metadata"
# JSON expands to objects of some thirty times its size: a damaged length must not exhaust memory.
LARGEST_TEXT = 16 << 20
INT64 = np.iinfo(np.int64)


def body_with_metadata(
    head: NDArray[np.uint8], buffer: NDArray[np.uint8], metadata: Mapping[str, Any], where: str
) -> list[NDArray[np.uint8]]:
    """The parts of a file that follow a grid's headers, with its metadata at the end; the grid is not copied.

    Args:
        head: The grid's first 736 bytes; size and offset of the blind data are changed in place.
        buffer: The structurally valid grid.
        metadata: Values of the types of OpenVDB's metadata; an empty one leaves the grid as it is.
        where: Name of the volume, for the message.

    Returns:
        Parts that follow the head, one after the other.

    Raises:
        InputError: A value that OpenVDB's metadata cannot hold, or more than 16 MiB of text.
    """
    if not metadata:
        return [buffer[HEAD_SIZE:]]
    grid = grid_header(head)
    count, offset = int(grid["blind_count"]), int(grid["blind_offset"])
    text = _encoded(metadata, offset, where)
    end = len(buffer)
    begin = offset if count else end
    table = begin + count * BLIND_DATA.itemsize
    entries = np.zeros(count + 1, BLIND_DATA)
    if count:
        entries[:count] = buffer[begin:table].view(BLIND_DATA)
        # Data after the table moves back by one entry, data before it stays, and offsets count from the entries.
        start = entries["offset"][:count] + begin + BLIND_DATA.itemsize * np.arange(count)
        entries["offset"][:count] += np.where(start >= table, BLIND_DATA.itemsize, 0)
    mine = entries[count]
    mine["offset"] = end - table + BLIND_DATA.itemsize
    mine["value_count"], mine["value_size"], mine["name"] = len(text), 1, CHANNEL + b"\0" + _checksum(text)
    padded = np.zeros(-(-len(text) // ALIGNMENT) * ALIGNMENT, np.uint8)
    padded[: len(text)] = np.frombuffer(text, np.uint8)
    grid["blind_offset"], grid["blind_count"] = begin, count + 1
    grid["grid_size"] = end + BLIND_DATA.itemsize + len(padded)
    return [buffer[HEAD_SIZE:begin], entries.view(np.uint8), buffer[table:end], padded]


def metadata_of(grid: NDArray[np.uint8], where: str) -> tuple[dict[str, Any], int]:
    """Metadata attached to a grid, and the size of the grid without it; reads only headers and channel.

    Args:
        grid: A grid, which need not be valid.
        where: File and grid, for the message.

    Raises:
        FileFormatError: The channel does not have geokit's format.
    """
    with damage_named(where):
        found = _channel(grid)
        if found is None:
            return {}, len(grid)
        return _decoded(found.text)[1], found.size_without(grid)


def without_metadata(buffer: NDArray[np.uint8], where: str) -> tuple[NDArray[np.uint8], dict[str, Any]]:
    """Remove the metadata from a grid; returns the original grid and the metadata.

    Args:
        buffer: The structurally valid grid with a matching checksum; changed in place.
        where: File and grid, for the message.

    Returns:
        The grid (the beginning of ``buffer``) and the metadata; a channel that is not the last one is left in place.

    Raises:
        FileFormatError: The channel does not have geokit's format.
    """
    with damage_named(where):
        found = _channel(buffer)
        if found is None:
            return buffer, {}
        blind_offset, metadata = _decoded(found.text)
    return _stripped(buffer, found, blind_offset), metadata


@dataclass(frozen=True)
class _Channel:
    """Location of a grid's metadata: its entry, its data, and whether both are the last of their kind."""

    entry: int
    start: int
    text: bytes
    last: bool

    def size_without(self, grid: NDArray[np.uint8]) -> int:
        return self.start - BLIND_DATA.itemsize if self.last else len(grid)


def _stripped(buffer: NDArray[np.uint8], channel: _Channel, blind_offset: str) -> NDArray[np.uint8]:
    if not channel.last:
        return buffer
    grid = grid_header(buffer)
    begin, count = int(grid["blind_offset"]), int(grid["blind_count"]) - 1
    mode = checksum_mode(buffer)
    entries = buffer[begin : channel.entry].view(BLIND_DATA)
    start = entries["offset"] + begin + BLIND_DATA.itemsize * np.arange(count)
    entries["offset"] -= np.where(start > channel.entry, BLIND_DATA.itemsize, 0)
    size = channel.size_without(buffer)
    buffer[channel.entry : size] = buffer[channel.entry + BLIND_DATA.itemsize : channel.start].copy()
    grid["grid_size"], grid["blind_count"] = size, count
    grid["blind_offset"] = begin if count else 0 if blind_offset == "zero" else size
    buffer = buffer[:size]
    _renew_checksum(buffer, mode)
    return buffer


def _renew_checksum(buffer: NDArray[np.uint8], mode: str) -> None:
    grid = grid_header(buffer)
    if mode == "none":
        return
    if mode == "full" and int(grid["version"]) <= LAST_OLD_VERSION:
        # The sum over the nodes does not cover blind data, so only that of the headers changes.
        low = (1 << 32) - 1
        head = int(partial_checksum(buffer[:HEAD_SIZE], buffer)) & low
        grid["checksum"] = int(grid["checksum"]) & ~low | head
        return
    grid["checksum"] = (full_checksum if mode == "full" else partial_checksum)(buffer[:HEAD_SIZE], buffer)


def _channel(buffer: NDArray[np.uint8]) -> _Channel | None:
    """The last channel with geokit's name."""
    grid = grid_header(buffer)
    begin, count = int(grid["blind_offset"]), int(grid["blind_count"])
    if not count:
        return None
    table_end = begin + count * BLIND_DATA.itemsize
    if begin < HEAD_SIZE or table_end > len(buffer):
        raise Damage(f"{count} blocks of blind data do not fit")
    entries = buffer[begin:table_end].view(BLIND_DATA)
    names = [name.split(b"\0", 1) for name in entries["name"].tolist()]
    mine = [i for i, name in enumerate(names) if name[0] == CHANNEL]
    if not mine:
        return None
    index = mine[-1]
    entry = begin + index * BLIND_DATA.itemsize
    start, length = entry + int(entries["offset"][index]), int(entries["value_count"][index])
    if (
        int(entries["value_size"][index]) != 1
        or length > LARGEST_TEXT
        or not HEAD_SIZE <= start <= len(buffer) - length
    ):
        raise Damage(f"{length} bytes of metadata do not fit")
    text = buffer[start : start + length].tobytes()
    if names[index][1:] not in ([], [_checksum(text)]):
        raise Damage("the checksum of its metadata does not match")
    ends = start + -(-length // ALIGNMENT) * ALIGNMENT == len(buffer)
    return _Channel(entry, start, text, ends and index == count - 1 and start >= table_end)


def _checksum(text: bytes) -> bytes:
    return b"%08x" % crc32(text)


def _encoded(metadata: Mapping[str, Any], blind_offset: int, where: str) -> bytes:
    plain: dict[str, Any] = {}
    for name, (_, kind, data) in zip(metadata, encode_all(metadata), strict=True):
        value = metadata[name]
        finite = type(value) is float and math.isfinite(value)
        plain[name] = value if type(value) in (str, bool, int) or finite else {"type": kind, "hex": data.hex()}
    content = {"blind_offset": "end" if blind_offset else "zero", "metadata": plain}
    text = json.dumps(content, separators=(",", ":")).encode("ascii")
    if len(text) > LARGEST_TEXT:
        raise InputError(f"{where}: the metadata takes {len(text)} bytes; use at most {LARGEST_TEXT}")
    return text


def _decoded(text: bytes) -> tuple[str, dict[str, Any]]:
    try:
        content = json.loads(text.decode("ascii"))
        blind_offset, plain = content["blind_offset"], content["metadata"]
        if blind_offset not in ("zero", "end") or not isinstance(plain, dict):
            raise Damage("the metadata is not what geokit writes")
        return blind_offset, {name: _value(value) for name, value in plain.items()}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise Damage(f"the metadata cannot be read ({type(error).__name__})") from None


def _value(value: Any) -> Any:
    if isinstance(value, dict):
        kind, data = value["type"], bytes.fromhex(value["hex"])
        if not isinstance(kind, str) or len(value) != 2:
            raise ValueError
        return decode(kind, data)
    if isinstance(value, int) and not isinstance(value, bool) and not INT64.min <= value <= INT64.max:
        raise ValueError
    if not isinstance(value, (str, bool, int, float)) or (isinstance(value, float) and not math.isfinite(value)):
        raise ValueError
    return value
