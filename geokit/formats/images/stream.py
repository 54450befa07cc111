"""Voxels that lie one after another in a file, compressed or not, read slab after slab."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import os
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import named_damage
from geokit.errors import FileFormatError

# Size of a slab, so that memory does not grow with the file.
SLAB_BYTES = 32 << 20
# Sparse volumes compress well at any level, and higher ones take several times as long.
LEVEL = 4


def rows_at_a_time(row_bytes: int) -> int:
    """How many planes of voxels make a slab."""
    return max(1, SLAB_BYTES // max(1, row_bytes))


class _Inflated(io.RawIOBase):
    """A stream of zlib, decompressed."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._unpack = file, zlib.decompressobj()

    def readable(self) -> bool:
        return True

    def readinto(self, out: Any) -> int:
        while not self._unpack.eof:
            more = self._unpack.unconsumed_tail or self._file.read(1 << 16)
            found = self._unpack.decompress(more, len(out))
            if found or not more:
                out[: len(found)] = found
                return len(found)
        return 0


# What gives the decompressed content of an open file, from its place on.
PACKINGS: dict[str, Callable[[IO[bytes]], Any]] = {
    "": lambda file: file,
    "gzip": lambda file: gzip.GzipFile(fileobj=file),
    "bzip2": bz2.BZ2File,
    "zlib": lambda file: io.BufferedReader(_Inflated(file), 1 << 16),
}


def slabs_in(
    path: Path,
    dtype: np.dtype[Any],
    shape: tuple[int, int, int, int],
    *,
    offset: int = 0,
    skip: int = 0,
    packing: str = "",
    beside: Path | None = None,
) -> Iterator[NDArray[Any]]:
    """Slabs (X, Y, n, C) of voxels that are stored with their components fastest, then x, y and z.

    Args:
        path: The file that the caller named.
        dtype: As it is stored.
        shape: X, Y, Z, C.
        offset: Of the (compressed) data in the file.
        skip: Bytes to skip of the decompressed data.
        packing: A key of PACKINGS.
        beside: The file with the data, if it is another one.
    Raises:
        FileFormatError: The data end early, or are damaged.
    """
    x, y, z, components = shape
    plane = x * y * components * dtype.itemsize
    step = rows_at_a_time(plane)
    with contextlib.ExitStack() as stack:
        with named_damage(path):
            file = stack.enter_context(open(path if beside is None else beside, "rb"))
            data = f"its data in {beside.name!r} end" if beside and beside != path else "ends"
            missing = 0 if packing else offset + skip + z * plane - os.fstat(file.fileno()).st_size
            if missing > 0:  # before memory is taken for them
                raise FileFormatError(f"{path}: {data} {missing} bytes too early; get a whole copy")
            file.seek(offset if packing else offset + skip)
            stream = stack.enter_context(contextlib.closing(PACKINGS[packing](file)))
            _skip(stream, skip if packing else 0)
        for first in range(0, z, step):
            count = min(step, z - first)
            with named_damage(path):
                buffer = np.empty(count * plane, np.uint8)
                have, view = 0, buffer.data
                while have < len(buffer) and (got := stream.readinto(view[have:])):
                    have += got
                if have < len(buffer):
                    missing = (z - first) * plane - have
                    raise FileFormatError(f"{path}: {data} {missing} bytes too early; get a whole copy")
            if packing and first + step >= z:
                with named_damage(path):
                    stream.read(1)  # the end holds a checksum
            yield buffer.view(dtype).reshape(count, y, x, components).transpose(2, 1, 0, 3)


def _skip(stream: IO[bytes], count: int) -> None:
    while count > 0:
        got = len(stream.read(min(count, 1 << 20)))
        if not got:
            return
        count -= got


class _Deflated(io.RawIOBase):
    """Compresses what is written to a file with zlib."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._pack = file, zlib.compressobj(LEVEL)

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._file.write(self._pack.compress(data))
        return len(data)

    def close(self) -> None:
        if not self.closed:
            self._file.write(self._pack.flush())
        super().close()


@contextlib.contextmanager
def packed_writer(file: IO[bytes], packing: str) -> Iterator[Any]:
    """Context that gives a stream whose content is compressed into a file; the same content makes the same bytes."""
    if not packing:
        yield file
        return
    stream: Any = _Deflated(file) if packing == "zlib" else gzip.GzipFile("", "wb", LEVEL, file, mtime=0)
    with contextlib.closing(stream):
        yield stream
