"""Zarr by the package zarr: an OME-NGFF image at its full size, an array, or a group of arrays; a folder.

Axes that are called x, y and z are those of space, all others (t, c) count grids. Without names an array is (X, Y, Z),
as in memory. Chunks are read a row at a time, and held to the size that their array says before they are decompressed:
codecs trust what they are given, and a chunk of a megabyte may unfold to a gigabyte, whatever the array's metadata say.
"""

from __future__ import annotations

import asyncio
import bz2
import contextlib
import itertools
import lzma
import math
import os
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.content_limit import require_content
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError
from geokit.formats.file_content.references import allowed_folders, require_inside
from geokit.formats.images.image import (
    Image,
    fitting_codec,
    grids_of,
    note_of,
    noted,
    one_unit,
    reading,
    require_straight,
    require_three,
)
from geokit.formats.images.stream import rows_at_a_time

UNITS = {
    "meter": "m",
    "centimeter": "cm",
    "millimeter": "mm",
    "micrometer": "um",
    "nanometer": "nm",
    "angstrom": "angstrom",
}
# It holds no axes but those of the world: others are turned to them, where they are parallel.
STRAIGHT = True
# Edge of the chunks that are written.
CHUNK = 64
# Chunks that are read at a time, and that an array may have whatever is there. Sparse ones lack most of theirs: so many
# for each that is there.
MOST_CHUNKS, ABSENT_CHUNKS = 20_000, 100
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


def open_images(path: Path, limit: int) -> list[Image]:
    """Read the metadata."""
    zarr = require_package("zarr")
    _require_files(path)
    with reading(path):
        node = zarr.open(_open_store(path), mode="r")
        if not hasattr(node, "arrays"):
            return _of_array(path, node, "", {}, {}, limit)
        facts = dict(node.attrs)
        scales = facts.get("multiscales", (facts.get("ome") or {}).get("multiscales"))
        if scales:
            return _of_array(path, node[str(scales[0]["datasets"][0]["path"])], "", scales[0], facts, limit)
        found = [_of_array(path, array, name, {}, {}, limit) for name, array in sorted(node.arrays())]
        if not found:
            raise FileFormatError(f"{path}: holds no arrays at its top; name the group or array that holds them")
    return list(itertools.chain.from_iterable(found))


def _require_files(path: Path) -> None:
    """Check that all in the folder are regular files in it; of FIFOs zarr would wait for ever.

    Raises:
        FileAccessError: One is not, or a link leads elsewhere.
    """
    folders = (path, *allowed_folders(None))  # the caller may name it by a link
    for folder, names, files in os.walk(path):
        for entry in (Path(folder, name) for name in (*names, *files)):
            status = entry.lstat().st_mode
            if not (stat.S_ISREG(status) or stat.S_ISDIR(status)):
                require_inside(str(entry.relative_to(path)), entry, path, folders)


def _of_array(path: Path, array: Any, name: str, scale: Any, facts: Any, limit: int) -> list[Image]:
    sizes, dtype = [int(n) for n in array.shape], np.dtype(array.dtype)
    if dtype.kind not in "fiub":
        raise FileFormatError(f"{path}: holds {in_one_line(str(dtype))}; convert it to real numbers")
    if min(array.chunks, default=0) < 1:
        raise FileFormatError(f"{path}: has chunks of {array.chunks} voxels; the file is damaged, export it again")
    # A whole chunk is decompressed, however little of it is part of the array.
    require_content(path, math.prod(map(int, array.chunks)) * dtype.itemsize, limit)
    _hold_chunks(path, array)
    named = getattr(getattr(array, "metadata", None), "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS")
    axes = scale.get("axes") or [{"name": one} for one in named or ()]
    axes = [one if isinstance(one, dict) else {"name": one} for one in axes]
    labels = [str(one.get("name")).lower() for one in axes] or ["x", "y", "z", "component"][: len(sizes)]
    if len(labels) != len(sizes) or not {"x", "y"} <= set(labels) or len(set(labels)) != len(labels):
        raise FileFormatError(f"{path}: has the axes {labels} of sizes {sizes}; a volume has x, y and z")
    spatial = [labels.index(axis) for axis in "xyz" if axis in labels]
    last = [at for at in range(len(sizes)) if labels[at] == "component" and sizes[at] in (3, 4)]
    others = [at for at in range(len(sizes)) if at not in spatial + last]
    shape = require_three(path, ([sizes[at] for at in spatial] + [1, 1, 1])[:3])
    matrix = np.eye(4)
    steps, shifts = _transforms(scale, len(sizes))
    matrix[: len(spatial), : len(spatial)] = np.diag(steps[spatial])
    matrix[: len(spatial), 3] = shifts[spatial]
    told = [UNITS.get(text := str(axes[at].get("unit") or ""), text) for at in spatial] if axes else []
    factors, unit = one_unit(path, told)
    matrix[: len(factors)] *= factors[:, None]
    # The first axis of the array is the one whose chunks are read a row at a time.
    slow = min(spatial)
    count = int(np.prod([sizes[at] for at in others], dtype=object)) if others else 1
    row_bytes = (
        int(np.prod([n for at, n in enumerate(sizes) if at not in (slow, *others)], dtype=object)) * dtype.itemsize
    )

    def slabs(grid: int) -> Iterator[NDArray[Any]]:
        _require_chunks(path, array)
        chunk = int(array.chunks[slow])
        step = max(chunk, rows_at_a_time(row_bytes) // chunk * chunk)
        key: list[Any] = [slice(0, size) for size in sizes]
        for at, index in (
            zip(others, np.unravel_index(grid, [sizes[at] for at in others]), strict=True) if others else ()
        ):
            key[at] = int(index)
        kept = [at for at in range(len(sizes)) if at not in others]
        order = [kept.index(at) for at in spatial + last]
        for first in range(0, sizes[slow], step):
            key[slow] = slice(first, min(first + step, sizes[slow]))
            with reading(path):
                part = _part(array, key).transpose(order)
            yield part if len(spatial) == 3 else np.expand_dims(part, 2)

    note = note_of(facts.get("geokit"))
    fill = array.fill_value
    image = Image(
        shape=shape,
        dtype=dtype,
        transform=matrix,
        axis=spatial.index(slow),
        components=sizes[last[0]] if last else 1,
        name=name,
        unit=unit,
        space=str(note.get("space", "")),
        background=fill if isinstance(fill, np.generic) and not last else None,
        packed=True,
        note=note,
    )
    return grids_of(path, image, count, slabs)


def _require_chunks(path: Path, array: Any) -> None:
    """Refuse an array that needs many times more chunks than there are: zarr takes 0.2 ms for each that is not there.

    Raises:
        FileFormatError: There are too many.
    """
    chunks = math.prod(-(-int(n) // int(chunk)) for n, chunk in zip(array.shape, array.chunks, strict=True))
    if chunks <= MOST_CHUNKS:
        return
    files = sum(len(names) for _, _, names in os.walk(path / array.path))
    present = files * math.prod(getattr(array, "shards", None) or array.chunks) // math.prod(array.chunks)
    if chunks > MOST_CHUNKS + ABSENT_CHUNKS * present:
        raise FileFormatError(
            f"{path}: is divided into {chunks} chunks of {in_one_line(str(array.chunks))} voxels, of which at most "
            f"{present} are there; get a whole copy, or write it again with larger chunks"
        )


def _part(array: Any, key: list[Any]) -> NDArray[Any]:
    """A part of an array, some chunks at a time: zarr starts a task of 2.5 kB for each."""
    counts = [
        -(-one.stop // chunk) - one.start // chunk if isinstance(one, slice) else 1
        for one, chunk in zip(key, array.chunks, strict=True)
    ]
    if math.prod(counts) <= MOST_CHUNKS:
        return np.asarray(array[tuple(key)])
    at = int(np.argmax(counts))
    begin, end, chunk = key[at].start, key[at].stop, array.chunks[at]
    middle = (begin // chunk + counts[at] // 2) * chunk
    parts = [_part(array, [*key[:at], slice(*ends), *key[at + 1 :]]) for ends in ((begin, middle), (middle, end))]
    return np.concatenate(parts, axis=sum(isinstance(one, slice) for one in key[:at]))


def _transforms(scale: Any, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Scale and translation of each axis, of the first data set and then of all."""
    steps, shifts = np.ones(count), np.zeros(count)
    datasets = scale.get("datasets") or [{}]
    for one in [*datasets[0].get("coordinateTransformations", ()), *scale.get("coordinateTransformations", ())]:
        if "scale" in one:
            factors = np.asarray(one["scale"], np.float64)
            steps, shifts = steps * factors, shifts * factors
        if "translation" in one:
            shifts = shifts + np.asarray(one["translation"], np.float64)
    return steps, shifts


def write_image(path: Path, image: Image, codec: str | None) -> None:
    """Write an OME-NGFF 0.4 image with one level; the folder must not exist."""
    zarr = require_package("zarr")
    try:
        _write(zarr, path, image, codec)
    except Exception:
        _wait_for_writers()
        raise


def _wait_for_writers() -> None:
    """Wait until zarr's threads have ended: after an error in one chunk they write the others, into a new folder."""
    from zarr.core.sync import sync

    async def others() -> None:
        await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()}, return_exceptions=True)

    sync(others())


def _write(zarr: Any, path: Path, image: Image, codec: str | None) -> None:
    fitting_codec(path, codec, ("zip",))
    spacing = require_straight(path, image.transform, turned=False)
    vectors = image.components > 1
    unit = {kind: name for name, kind in UNITS.items()}.get(image.unit)
    axes = [{"name": axis, "type": "space", **({"unit": unit} if unit else {})} for axis in "zyx"]
    axes += [{"name": "component", "type": "component"}] * vectors
    ones, zeros = [1.0] * vectors, [0.0] * vectors
    moves = [
        {"type": "scale", "scale": [*spacing[::-1].tolist(), *ones]},
        {"type": "translation", "translation": [*image.transform[2::-1, 3].tolist(), *zeros]},
    ]
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    shape = (*image.shape[::-1], *([image.components] if vectors else []))
    array = group.create_array(
        "0",
        shape=shape,
        chunks=tuple(min(CHUNK, size) for size in shape),
        dtype=image.dtype,
        chunk_key_encoding={"name": "v2", "separator": "/"},
    )
    scale = {"version": "0.4", "axes": axes, "datasets": [{"path": "0", "coordinateTransformations": moves}]}
    group.attrs["multiscales"] = [scale]
    group.attrs["geokit"] = noted({**image.note, "space": image.space})
    at = 0
    for values in image.planes(image.dtype):
        array[at : at + len(values)] = values
        at += len(values)


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


def _hold_chunks(path: Path, array: Any) -> None:
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


def _open_store(path: Path) -> Any:
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
