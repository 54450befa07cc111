"""Compression of grids in .nvdb files: none, zip (one zlib stream) and Blosc (frames of up to 1 GiB).

Every size is checked against the largest plausible compression ratio before memory is allocated for it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.errors import FileFormatError

# In the order of their codes in the file.
CODECS = ("none", "zip", "blosc")

# Deflate's limit is 1032 to 1 and LZ4's 255 to 1; a file that claims more was made to exhaust memory.
LARGEST_RATIO = 1032
# NanoVDB splits a grid into Blosc frames of this many bytes.
BLOSC_FRAME = 1 << 30
BLOSC_HEADER = 16
# Bit 1 of the flags in a Blosc header: the bytes after the header are the data itself, uncompressed.
BLOSC_STORED = 2
# NanoVDB compresses with LZ4 at level 9 over 4-byte elements; so does geokit.
BLOSC_LEVEL = 9
BLOSC_TYPE_SIZE = 4
ZIP_LEVEL = 6
PIECE = 1 << 20

Fetch = Callable[[int, int], bytes]


class _Damaged(Exception):
    pass


@contextmanager
def _damage_named(where: str, codec: str) -> Iterator[None]:
    try:
        yield
    except (_Damaged, zlib.error, struct.error) as error:
        message = f"{where}: the {codec} data is damaged ({error}); get the file again from its source"
        raise FileFormatError(message) from None


def largest_size(stored: int) -> int:
    """Largest size to which ``stored`` compressed bytes of a valid file can decompress."""
    return LARGEST_RATIO * stored + PIECE


def decompress(codec: str, stored: memoryview, out: NDArray[np.uint8], where: str) -> None:
    """Decompress a whole grid into ``out``, which it must fill exactly.

    Args:
        codec: One of :data:`CODECS`.
        stored: The grid's bytes in the file, including the length words of its codec.
        out: Destination, uint8.
        where: File and grid, for the message.

    Raises:
        FileFormatError: The bytes do not decompress to exactly ``out``.
        MissingDependencyError: Blosc is not installed.
    """
    with _damage_named(where, codec):
        written = _decompress(codec, stored, out)
        if written != len(out):
            raise _Damaged(f"it holds {written} bytes of {len(out)}")


def decompress_head(codec: str, fetch: Fetch, stored: int, size: int, where: str) -> NDArray[np.uint8]:
    """The first bytes of a grid; only the block that holds them is read and decompressed.

    Args:
        codec: One of :data:`CODECS`.
        fetch: ``fetch(start, count)`` returns bytes of the grid as stored in the file.
        stored: Number of stored bytes.
        size: Number of bytes wanted; fewer are returned if the grid is shorter.
        where: File and grid, for the message.

    Raises:
        FileFormatError: The bytes do not decompress.
        MissingDependencyError: Blosc is not installed.
    """
    with _damage_named(where, codec):
        if codec == "none":
            head = fetch(0, min(size, stored))
        elif codec == "zip":
            head = zlib.decompressobj().decompress(fetch(8, min(stored - 8, PIECE)) if stored > 8 else b"", size)
        else:
            head = _blosc_first_block(fetch, stored)[:size]
    # The copy is aligned, so that the headers may be read as records.
    return np.frombuffer(head, np.uint8).copy()


def compress_into(codec: str, parts: Sequence[NDArray[np.uint8]], file: BinaryIO) -> int:
    """Write a grid with the codec's length words to ``file``.

    Args:
        codec: One of :data:`CODECS`.
        parts: The grid's bytes, in any number of arrays.
        file: Open for writing.

    Returns:
        Number of bytes written.

    Raises:
        MissingDependencyError: Blosc is not installed.
    """
    if codec == "none":
        for part in parts:
            file.write(part.data)
        return sum(map(len, parts))
    if codec == "zip":
        deflater = zlib.compressobj(ZIP_LEVEL)
        packed = [deflater.compress(part[i : i + PIECE].data) for part in parts for i in range(0, len(part), PIECE)]
        packed.append(deflater.flush())
        file.write(struct.pack("<Q", sum(map(len, packed))))
        file.writelines(packed)
        return 8 + sum(map(len, packed))
    total, blosc = 0, require_package("blosc")
    how = {"typesize": BLOSC_TYPE_SIZE, "clevel": BLOSC_LEVEL, "shuffle": blosc.SHUFFLE, "cname": "lz4"}
    for frame in _frames(parts):
        stored = blosc.compress(frame.data, **how)
        file.write(struct.pack("<Q", len(stored)))
        file.write(stored)
        total += 8 + len(stored)
    return total


def _frames(parts: Sequence[NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    """The bytes of all parts, split where NanoVDB splits them."""
    room = BLOSC_FRAME
    gathered: list[NDArray[np.uint8]] = []
    for part in parts:
        start = 0
        while start < len(part):
            gathered.append(part[start : start + room])
            start += len(gathered[-1])
            room -= len(gathered[-1])
            if not room:
                yield gathered[0] if len(gathered) == 1 else np.concatenate(gathered)
                room, gathered = BLOSC_FRAME, []
    if gathered:
        yield np.concatenate(gathered)


def _length_prefixed(stored: memoryview, start: int) -> memoryview:
    if start + 8 > len(stored):
        raise _Damaged("a length is missing")
    (length,) = struct.unpack_from("<Q", stored, start)
    if length > len(stored) - start - 8:
        raise _Damaged(f"a part of {length} bytes does not fit")
    return stored[start + 8 : start + 8 + length]


def _decompress(codec: str, stored: memoryview, out: NDArray[np.uint8]) -> int:
    if codec == "none":
        if len(stored) != len(out):
            return len(stored)
        out[:] = np.frombuffer(stored, np.uint8)
        return len(out)
    if codec == "zip":
        return _inflate(_length_prefixed(stored, 0), out)
    written = start = 0
    while written < len(out):
        frame = _length_prefixed(stored, start)
        start += 8 + len(frame)
        written += _blosc_frame(frame, out[written : written + BLOSC_FRAME])
    return written


def _inflate(stored: memoryview, out: NDArray[np.uint8]) -> int:
    inflater = zlib.decompressobj()
    target = out.data
    written = 0
    for first in range(0, len(stored), PIECE):
        waiting: bytes | memoryview = stored[first : first + PIECE]
        while waiting and not inflater.eof:
            # One byte more than fits reveals a stream that is too long.
            piece = inflater.decompress(waiting, min(16 * PIECE, len(out) - written + 1))
            if written + len(piece) > len(out):
                raise _Damaged(f"it holds more than {len(out)} bytes")
            target[written : written + len(piece)] = piece
            written += len(piece)
            waiting = inflater.unconsumed_tail
    if not inflater.eof:
        raise _Damaged("the stream ends early")
    return written


def _blosc_size(frame: memoryview) -> int:
    if len(frame) < BLOSC_HEADER:
        raise _Damaged("a Blosc frame is shorter than its header")
    size, _, stored = struct.unpack_from("<III", frame, 4)
    if stored != len(frame):
        raise _Damaged(f"a Blosc frame of {len(frame)} bytes says {stored}")
    return int(size)


def _blosc_frame(frame: memoryview, out: NDArray[np.uint8]) -> int:
    size = _blosc_size(frame)
    if size != len(out):
        raise _Damaged(f"a Blosc frame holds {size} bytes where {len(out)} belong")
    blosc = require_package("blosc")
    data = bytes(frame)
    if not blosc.cbuffer_validate(data):
        raise _Damaged("a Blosc frame is not valid")
    try:
        return int(blosc.decompress_ptr(data, out.ctypes.data))
    except (blosc.blosc_extension.error, TypeError, ValueError, RuntimeError) as error:
        raise _Damaged(str(error)) from None


def _blosc_first_block(fetch: Fetch, stored: int) -> bytes:
    # A frame of one block is built from the first block of the large one, so that only that block is decompressed.
    header = fetch(8, BLOSC_HEADER) if stored >= 8 + BLOSC_HEADER else b""
    if len(header) < BLOSC_HEADER:
        raise _Damaged("a Blosc frame is shorter than its header")
    size, block, length = struct.unpack_from("<III", header, 4)
    if length > stored - 8:
        raise _Damaged(f"a Blosc frame of {length} bytes does not fit")
    if header[2] & BLOSC_STORED:
        return fetch(8 + BLOSC_HEADER, min(length - BLOSC_HEADER, PIECE)) if length > BLOSC_HEADER else b""
    if not 0 < block <= BLOSC_FRAME or size > largest_size(length):
        raise _Damaged("a Blosc frame's sizes contradict each other")
    count = -(-size // block)
    if not count or BLOSC_HEADER + 4 * count > length:
        raise _Damaged("a Blosc frame's blocks do not fit")
    starts = np.frombuffer(fetch(8 + BLOSC_HEADER, 4 * count), "<u4").astype(np.int64)
    after = starts[starts > starts[0]]
    begin, end = int(starts[0]), min(int(after.min()) if len(after) else length, length)
    if not BLOSC_HEADER + 4 * count <= begin < end:
        raise _Damaged("a Blosc frame's first block does not fit")
    body = fetch(8 + begin, end - begin)
    used = min(size, block)
    alone = struct.pack("<IIII", used, used, BLOSC_HEADER + 4 + len(body), BLOSC_HEADER + 4)
    out = np.empty(used, np.uint8)
    _blosc_frame(memoryview(header[:4] + alone + body), out)
    return out.tobytes()
