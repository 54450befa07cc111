"""Damage to grids in .nvdb files, field by field: headers, the root's table, boxes, masks, child offsets and values."""

from __future__ import annotations

import io
import random
import struct
import zlib
from typing import Any

import blosc
import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.checksum import checksum_mode, full_checksum, partial_checksum
from geokit.volume.nanovdb.codecs import CODECS, compress_into
from geokit.volume.nanovdb.file import FILE_HEADER, FILE_METADATA
from geokit.volume.nanovdb.header import BLIND_DATA, TREE_OFFSET, aligned_buffer, grid_header, tree_header
from geokit.volume.nanovdb.nodes import NodeLevel, grid_nodes

__all__ = ["mutate_grid"]

NOT_STATED = np.uint64(2**64 - 1)


def mutate_grid(data: bytes, chance: random.Random) -> tuple[bytes, dict[str, bytes], bool, tuple[str, ...]]:
    """A file with one damaged grid: its bytes, no files beside it, whether the checksum is right again, the damage."""
    at, name_size, codec = _first_grid(data)
    head, stored = data[:at], data[at:]
    size = int(np.frombuffer(head, FILE_METADATA, 1, FILE_HEADER.itemsize)["grid_size"][0]) if head else len(stored)
    packed = _packed_size(stored, codec, size)
    buffer = aligned_buffer(size)
    buffer[:] = np.frombuffer(_unpacked(stored[:packed], codec), np.uint8)
    done = tuple(_damage(buffer, chance) for _ in range(chance.choice((1, 1, 2, 3))))
    mended = chance.random() < 0.8
    if mended:
        _mend(buffer, chance)
    codec = chance.choice((codec, codec, 0)) if head else 0
    target = io.BytesIO()
    blosc.set_nthreads(1)  # several lay blocks down in the order in which they end
    compress_into(CODECS[codec], [buffer], target)
    if head:
        file, block = np.frombuffer(head, FILE_HEADER, 1).copy(), bytearray(head[FILE_HEADER.itemsize :])
        if file["grid_count"][0] == 1:
            file["codec"] = codec
            view = np.frombuffer(block, FILE_METADATA, 1)
            view["codec"], view["file_size"] = codec, target.tell()
        head = (
            file.tobytes()
            + bytes(block[: FILE_METADATA.itemsize + name_size])
            + bytes(block[FILE_METADATA.itemsize + name_size :])
        )
    return head + target.getvalue() + stored[packed:], {}, mended, done


def _first_grid(data: bytes) -> tuple[int, int, int]:
    """Where the first grid begins, the size of its name, and its codec."""
    if struct.unpack_from("<I", data, 16)[0] >> 21 == 32:  # a grid without a file's header: its own version is here
        return 0, 0, 0
    count, codec = struct.unpack_from("<HH", data, 12)
    at, first = FILE_HEADER.itemsize, 0
    for i in range(count):
        name = int(np.frombuffer(data, FILE_METADATA, 1, at)["name_size"][0])
        first = first if i else name
        at += FILE_METADATA.itemsize + name
    return at, first, codec


def _packed_size(stored: bytes, codec: int, size: int) -> int:
    return size if codec == 0 else 8 + struct.unpack_from("<Q", stored)[0]


def _unpacked(stored: bytes, codec: int) -> bytes:
    if codec == 0:
        return stored
    return bytes(zlib.decompress(stored[8:]) if codec == 1 else blosc.decompress(stored[8:]))


def _mend(buffer: NDArray[np.uint8], chance: random.Random) -> None:
    """A right checksum, or none."""
    header = grid_header(buffer)
    try:
        if checksum_mode(buffer) == "none" or chance.random() < 0.4:
            header["checksum"] = chance.choice((NOT_STATED, np.uint64(0)))
        else:
            make = full_checksum if checksum_mode(buffer) == "full" else partial_checksum
            header["checksum"] = make(buffer[:736], buffer)
    except Exception:  # of a tree that leads astray: no writer could have made one
        header["checksum"] = NOT_STATED


def _damage(buffer: NDArray[np.uint8], chance: random.Random) -> str:
    try:
        nodes = grid_nodes(buffer)
        level: NodeLevel = getattr(nodes, chance.choice(("root", "upper", "lower", "leaf", "leaf")))
        if not 0 < level.count <= 1000 or not TREE_OFFSET < level.begin < level.end <= len(buffer):
            raise ValueError
        entries = int(nodes.entry_count[0])
    except Exception:  # an earlier damage has led astray
        return _header(buffer, chance)
    at = level.begin + level.size * chance.randrange(level.count)
    match chance.randrange(9):
        case 0 | 1:
            return _header(buffer, chance)
        case 2 if entries and nodes.root.end + entries * nodes.root.layout.root_tile_size <= len(buffer):
            row = nodes.root.end + chance.randrange(entries) * nodes.root.layout.root_tile_size
            return "root " + _number(buffer, row + chance.choice((0, 8, 16, 20, 24)), chance)
        case 3:
            return f"{level.name} box " + _number(buffer, at + 4 * chance.randrange(6), chance, 4)
        case 4 if level.name != "root":
            where = at + (16 if level.name == "leaf" else 32)
            return f"{level.name} mask " + _number(buffer, where + chance.randrange(level.slots // 8), chance, 1)
        case 5 if level.name in ("upper", "lower"):
            return f"{level.name} child mask {_child_mask(buffer, level, at, chance)}"
        case 6 if level.name in ("upper", "lower"):
            return f"{level.name} child {_child(buffer, level, chance)}"
        case 7:
            return _blind(buffer, chance)
        case _:
            return f"{level.name} " + _number(buffer, at + chance.randrange(max(level.size - 8, 1)), chance)


def _header(buffer: NDArray[np.uint8], chance: random.Random) -> str:
    """Any field of the grid's or the tree's header."""
    record = chance.choice((grid_header, tree_header))(buffer)
    # The grid's magic number and its checksum end the reading at once.
    name = chance.choice([name for name in record.dtype.names if name not in ("magic", "checksum")])
    kind, offset = record.dtype.fields[name][:2]
    start = offset + (0 if "grid_size" in record.dtype.names else TREE_OFFSET)
    size = kind.base.itemsize if kind.base.kind != "S" else 1
    at = start + chance.randrange(kind.itemsize // size) * size
    return f"{name} " + _number(buffer, at, chance, size, real=kind.base.kind == "f")


def _child_mask(buffer: NDArray[np.uint8], level: NodeLevel, at: int, chance: random.Random) -> str:
    buffer[at + 32 + level.slots // 8 + chance.randrange(level.slots // 8)] ^= np.uint8(1 << chance.randrange(8))
    return "bit"


def _child(buffer: NDArray[np.uint8], level: NodeLevel, chance: random.Random) -> str:
    node, slot, _ = level.links()
    offsets = level.child_offsets
    i, j = chance.randrange(len(node)), chance.randrange(len(node))
    first, second = (node[i], slot[i]), (node[j], slot[j])
    match chance.randrange(4):
        case 0:
            offsets[first], offsets[second] = offsets[second], offsets[first]
            return "swapped"
        case 1:
            offsets[first] = offsets[second]
            return "twice"
        case 2:
            offsets[first] += chance.choice((32, -32, level.size, -level.size, 1 << 40, 8))
            return "moved"
    # Another slot for the same child: its mask bit moves with the offset.
    other = chance.randrange(level.slots)
    offsets[node[i], other] = offsets[first]
    mask = level.child_mask[node[i]]
    mask[slot[i] // 8] &= np.uint8(255 - (1 << int(slot[i]) % 8))
    mask[other // 8] |= np.uint8(1 << other % 8)
    return "in another slot"


def _blind(buffer: NDArray[np.uint8], chance: random.Random) -> str:
    header = grid_header(buffer)
    at, count = int(header["blind_offset"]), int(header["blind_count"])
    if not 0 < count < 100 or not 0 < at <= len(buffer) - count * BLIND_DATA.itemsize:
        return _header(buffer, chance)
    row = at + chance.randrange(count) * BLIND_DATA.itemsize
    return "blind data " + _number(buffer, row + 4 * chance.randrange(8), chance)


def _number(
    buffer: NDArray[np.uint8], at: int, chance: random.Random, size: int | None = None, *, real: bool = False
) -> str:
    """Another number in the place of one."""
    size = size or chance.choice((1, 4, 4, 8))
    at = min(max(at, 0), len(buffer) - size)
    old = int.from_bytes(buffer[at : at + size].tobytes(), "little")
    extremes: list[Any] = [0, 1, -1, old + 1, old - 1, old ^ 1 << chance.randrange(8 * size), 2 * old, len(buffer)]
    extremes += [2 ** (8 * size - 1), 2 ** (8 * size - 1) - 1, chance.getrandbits(8 * size), old + 8, old + 32]
    value = chance.choice(extremes) % 2 ** (8 * size)
    raw = value.to_bytes(size, "little")
    if size >= 4 and (real or chance.random() < 0.3):
        reals = (float("nan"), float("inf"), 3e38, -3e38, 1e-45, 0.0, -1.0, 1e30)
        raw = struct.pack("<f" if size == 4 else "<d", chance.choice(reals))
    buffer[at : at + size] = np.frombuffer(raw, np.uint8)
    return f"{size} bytes"
