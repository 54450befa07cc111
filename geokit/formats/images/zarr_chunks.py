"""A folder of zarr whose chunks are held to the size that their array says, before they are decompressed.

Codecs trust what they are given: a chunk of a megabyte may unfold to a gigabyte, whatever the array's metadata say.
"""

from __future__ import annotations

import asyncio
import bz2
import contextlib
import lzma
import math
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from geokit._packages import require_package
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError

__all__ = ["hold_chunks", "open_store"]

# Filters may store a number in wider ones; then a chunk is decompressed to as much more. Blocks of zstd may be as much
# shorter than the longest.
WIDEST = 8
# Content of a block of zstd at most; the last one of a chunk may be short.
ZSTD_BLOCK = 1 << 17
ZSTD_MAGIC = 0xFD2FB528
# At a time, of streams that do not say what they unfold to.
PIECE = 1 << 20
# They leave the size of a chunk as it is, or change it by less than WIDEST.
CONTENT = {"adler32", "bytes", "crc32", "crc32c", "fletcher32", "jenkins_lookup3", "shuffle", "transpose"}
NUMBERS = {"astype", "bitround", "delta", "fixedscaleoffset", "packbits", "quantize"}
METADATA = (".zarray", ".zattrs", ".zgroup", ".zmetadata", "zarr.json")


def _zstd(data: bytes, most: int) -> int:
    """What the headers of all frames and blocks allow at most."""
    at = content = 0
    while at + 4 <= len(data):
        (magic,) = struct.unpack_from("<I", data, at)
        if magic & 0xFFFFFFF0 == 0x184D2A50:  # a frame to be skipped
            at += 8 + struct.unpack_from("<I", data, at + 4)[0]
            continue
        if magic != ZSTD_MAGIC:
            break
        kind = data[at + 4]
        is_single = kind >> 5 & 1
        at += 5 + (not is_single) + (0, 1, 2, 4)[kind & 3]
        size = (is_single, 2, 4, 8)[kind >> 6]
        stated = int.from_bytes(data[at : at + size], "little") + (256 if size == 2 else 0)
        at, blocks, is_last = at + size, 0, False
        while not is_last:
            head = int.from_bytes(data[at : at + 3], "little")
            length, is_last = head >> 3, bool(head & 1)
            blocks += ZSTD_BLOCK if head >> 1 & 3 == 2 else length
            at += 3 + (1 if head >> 1 & 3 == 1 else length)
            if at > len(data):
                break
        # The decoder makes room for what is stated, or for what the blocks hold.
        content += stated if size else blocks // WIDEST
        at += 4 * (kind >> 2 & 1)
    return content


def _streamed(make: Callable[[], Any], feed: str) -> Callable[[bytes, int], int]:
    def measure(data: bytes, most: int) -> int:
        """What is there is decompressed and dropped, until it is too much."""
        content = 0
        while data and content <= most:
            stream, rest = make(), data
            while not stream.eof and content <= most:
                piece = stream.decompress(rest, PIECE)
                rest = stream.unconsumed_tail if feed == "tail" else b""
                content += len(piece)
                if not (piece or rest):
                    return content
            data = stream.unused_data
        return content

    return measure


MEASURES: dict[str, Callable[[bytes, int], int]] = {
    "blosc": lambda data, most: int(struct.unpack_from("<I", data, 4)[0]),
    "lz4": lambda data, most: int(struct.unpack_from("<I", data)[0]),
    "zstd": _zstd,
    "zlib": _streamed(lambda: zlib.decompressobj(zlib.MAX_WBITS | 32), "tail"),
    "gzip": _streamed(lambda: zlib.decompressobj(zlib.MAX_WBITS | 32), "tail"),
    "bz2": _streamed(bz2.BZ2Decompressor, ""),
    "lzma": _streamed(lzma.LZMADecompressor, ""),
}


class _Rule(NamedTuple):
    """How chunks of an array are measured, what they may hold [bytes], and where the index of several in a file is."""

    measure: Callable[[bytes, int], int] | None
    most: int
    table: slice | None


def hold_chunks(path: Path, array: Any) -> None:
    """Hold the chunks of an array to its metadata from now on.

    Raises:
        FileFormatError: They are compressed in a way that cannot be held to a size, or twice.
    """
    metadata, shape, table = array.metadata, array.chunks, None
    if metadata.zarr_format == 2:
        given = [one.get_config() for one in (*(metadata.filters or ()), metadata.compressor) if one is not None]
        names = [str(one["id"]) for one in given]
    else:
        codecs = [one.to_dict() for one in metadata.codecs]
        if codecs[-1]["name"] == "sharding_indexed":
            inner = metadata.codecs[-1]
            codecs[-1:] = [one.to_dict() for one in inner.codecs]
            table = _index_of(path, inner, math.prod(array.shards) // math.prod(shape))
        names = [str(one["name"]).removeprefix("numcodecs.") for one in codecs]
    packing = [name for name in names if name not in CONTENT | NUMBERS]
    if len(packing) > 1 or not set(packing) <= set(MEASURES):
        raise FileFormatError(
            f"{path}: is compressed by {' and '.join(packing)}, which geokit cannot bound; use one of "
            f"{', '.join(sorted(MEASURES))}"
        )
    most = math.prod(map(int, shape)) * np.dtype(array.dtype).itemsize * (1 if NUMBERS.isdisjoint(names) else WIDEST)
    array.store.rules[str(array.path)] = _Rule(MEASURES[packing[0]] if packing else None, most + ZSTD_BLOCK, table)


def _index_of(path: Path, sharding: Any, count: int) -> slice:
    """Where places and lengths of the chunks are in a file of several.

    Raises:
        FileFormatError: They are not stored as other programs do it.
    """
    told = [one.to_dict() for one in sharding.index_codecs]
    names = [one["name"] for one in told]
    if names not in (["bytes"], ["bytes", "crc32c"]) or told[0]["configuration"]["endian"] != "little":
        raise FileFormatError(f"{path}: has an index of shards in {' and '.join(names)}; export it again")
    size = 16 * count + 4 * (len(names) - 1)
    return slice(0, size) if "start" in str(sharding.index_location) else slice(-size, None)


def open_store(path: Path) -> Any:
    """The folder, for zarr to read from."""
    zarr = require_package("zarr")
    from zarr.abc.store import RangeByteRequest, SuffixByteRequest

    def check(key: str, buffer: Any, byte_range: Any, rules: dict[str, _Rule]) -> Any:
        if buffer is None or key.rpartition("/")[2] in METADATA:
            return buffer
        rule = rules.get(max((name for name in rules if not name or key.startswith(f"{name}/")), key=len, default=""))
        if rule is None or rule.measure is None:
            return buffer
        data = buffer.to_bytes()
        chunks = [data]
        if rule.table is not None:
            if byte_range in (RangeByteRequest(0, rule.table.stop or 0), SuffixByteRequest(-(rule.table.start or 0))):
                return buffer
            if byte_range is None:
                index = data[rule.table]
                places = np.frombuffer(index[: len(index) // 16 * 16], "<u8").reshape(-1, 2).tolist()
                chunks = [data[begin : begin + length] for begin, length in places if begin < len(data)]
        for chunk in chunks:
            # Of a chunk without its head, the codec finds out.
            with contextlib.suppress(struct.error, IndexError, EOFError, OSError, zlib.error, lzma.LZMAError):
                if rule.measure(chunk, rule.most) <= rule.most:
                    continue
                raise FileFormatError(
                    f"{path}: chunk {in_one_line(key)} unfolds to more than the {rule.most} bytes that its array "
                    "allows; the file is damaged, export it again"
                )
        return buffer

    class Store(zarr.storage.LocalStore):  # type: ignore[name-defined]
        async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
            buffer = await super().get(key, prototype, byte_range)
            return await asyncio.to_thread(check, key, buffer, byte_range, self.rules)

        def get_sync(self, key: str, *, prototype: Any = None, byte_range: Any = None) -> Any:
            return check(key, super().get_sync(key, prototype=prototype, byte_range=byte_range), byte_range, self.rules)

        async def get_partial_values(self, prototype: Any, key_ranges: Any) -> Any:
            return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    store = Store(path, read_only=True)
    store.rules = {}
    return store
