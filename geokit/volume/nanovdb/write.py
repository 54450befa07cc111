"""Writing .nvdb files that every reader of NanoVDB 32.x and nanovdb_validate accept."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import atomic_path
from geokit.errors import FileFormatError, InputError
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.checksum import LAST_OLD_VERSION, full_checksum
from geokit.volume.nanovdb.codecs import CODECS, compress_into
from geokit.volume.nanovdb.file import FILE_HEADER, FILE_METADATA
from geokit.volume.nanovdb.header import (
    FLAG_LONG_NAME,
    HEAD_SIZE,
    LONGEST_NAME,
    MAGIC_FILE,
    MAGIC_GRID,
    MAGIC_OLD,
    TREE_OFFSET,
    VERSION,
    encoded_name,
    grid_header,
    tree_header,
)
from geokit.volume.nanovdb.metadata import body_with_metadata

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

# The last grid type and the number of grid classes that 32.4 has with the same layout as later versions.
LAST_OLD_TYPE = 18
OLD_CLASSES = 9
GRIDS_PER_SEGMENT = 0xFFFF


def write(path: str | os.PathLike[str], volumes: Sequence[SparseVolume], *, codec: str = "none") -> None:
    """Write grids to one .nvdb file. The file appears complete or not at all.

    Each grid gets its volume's name, its metadata and a checksum over all its nodes. The volumes' own buffers do not
    change. Grids from later versions of NanoVDB are stored as 32.4 if their type and blind data allow it.

    Args:
        path: Target; an existing file is replaced.
        volumes: One or more grids.
        codec: "none", "zip" or "blosc".

    Raises:
        InputError: There is no volume, the codec is unknown, a name is too long, a buffer is not a valid grid, or the
            metadata holds a value that has no OpenVDB type.
        FileAccessError: The target cannot be written.
        UnsupportedGridError: A grid's type is not supported.
        MissingDependencyError: The codec is "blosc" and blosc is not installed.
    """
    if codec not in CODECS:
        raise InputError(f"codec: {codec!r} is unknown; use one of {', '.join(CODECS)}")
    if not volumes:
        raise InputError(f"{path}: no volumes to save; give at least one")
    prepared = [_prepared(volume, i) for i, volume in enumerate(volumes)]
    with atomic_path(path) as part, open(part, "wb") as file:
        for (magic, version), group in groupby(prepared, key=lambda grid: file_version(grid.head)):
            grids = list(group)
            for first in range(0, len(grids), GRIDS_PER_SEGMENT):
                _write_segment(file, grids[first : first + GRIDS_PER_SEGMENT], magic, version, codec)


class _Prepared(NamedTuple):
    """A grid prepared for the file: its first bytes, and the parts that follow them."""

    head: NDArray[np.uint8]
    body: list[NDArray[np.uint8]]
    volume: SparseVolume


def _prepared(volume: SparseVolume, index: int) -> _Prepared:
    buffer = volume.nanovdb
    where = f"volumes[{index}] {volume.info.name!r}"
    try:
        check_volume(volume, where)
    except FileFormatError as error:
        raise InputError(str(error)) from None
    head = buffer[:HEAD_SIZE].copy()
    grid = grid_header(head)
    grid["grid_index"], grid["grid_count"] = 0, 1
    if (
        int(grid["version"]) > VERSION
        and int(grid["grid_type"]) <= LAST_OLD_TYPE
        and int(grid["grid_class"]) < OLD_CLASSES
        and not int(grid["blind_count"])
    ):
        grid["magic"], grid["version"], grid["data_2"] = MAGIC_OLD, VERSION, 0
    name = encoded_name(volume.info.name)
    if not int(grid["flags"]) & FLAG_LONG_NAME:
        if len(name) > LONGEST_NAME or b"\0" in name:
            raise InputError(f"{where}: the name has {len(name)} bytes; use at most {LONGEST_NAME} without a zero byte")
        grid["name"] = name
    body = body_with_metadata(head, buffer, volume.info.metadata, where)
    if len(body) > 1 and int(grid["version"]) > LAST_OLD_VERSION:
        # From this version on the checksum covers blind data too, in blocks that do not end where the parts do.
        whole = np.concatenate([head, *body])
        grid["checksum"] = full_checksum(head, whole)
    else:
        grid["checksum"] = full_checksum(head, buffer)
    return _Prepared(head, body, volume)


def file_version(head: NDArray[np.uint8]) -> tuple[int, int]:
    """Magic number and version of the segment of a grid with this head."""
    grid = grid_header(head)
    return MAGIC_FILE if int(grid["magic"]) == MAGIC_GRID else MAGIC_OLD, int(grid["version"])


def _write_segment(file: BinaryIO, grids: list[_Prepared], magic: int, version: int, codec: str) -> None:
    names = [encoded_name(grid.volume.info.name) for grid in grids]
    blocks = []
    for grid, name in zip(grids, names, strict=True):
        root = TREE_OFFSET + int(tree_header(grid.head)["node_offset"][3])
        blocks.append(file_metadata(grid.head, name, grid.volume.nanovdb[root : root + 24].view("<i4"), codec))
    start = file.tell()
    # Compressed sizes are known only afterwards, so the metadata is written into its place at the end.
    file.seek(len(segment_start(magic, version, codec, blocks, names)), os.SEEK_CUR)
    for block, grid in zip(blocks, grids, strict=True):
        block["file_size"] = compress_into(codec, [grid.head, *grid.body], file)
    end = file.tell()
    file.seek(start)
    file.write(segment_start(magic, version, codec, blocks, names))
    file.seek(end)


def segment_start(magic: int, version: int, codec: str, blocks: Sequence[Any], names: Sequence[bytes]) -> bytes:
    """What stands before the grids of a segment: its header, and each grid's metadata and name."""
    header = np.zeros(1, FILE_HEADER)
    header["magic"], header["version"] = magic, version
    header["grid_count"], header["codec"] = len(blocks), CODECS.index(codec)
    parts = (block.tobytes() + name + b"\0" for block, name in zip(blocks, names, strict=True))
    return header.tobytes() + b"".join(parts)


def file_metadata(head: NDArray[np.uint8], name: bytes, index_box: NDArray[np.int32], codec: str) -> Any:
    """Metadata of a grid in its segment, still without its size in the file.

    Args:
        head: The grid's first 736 bytes.
        name: Its name.
        index_box: Box of its active voxels, (6,).
        codec: One of CODECS.
    """
    grid, tree = grid_header(head), tree_header(head)
    block = np.zeros(1, FILE_METADATA)[0]
    block["grid_size"] = grid["grid_size"]
    block["name_key"] = _name_key(name)
    block["voxel_count"] = tree["voxel_count"]
    for field in ("grid_type", "grid_class", "world_bbox", "voxel_size", "version"):
        block[field] = grid[field]
    block["index_bbox"] = index_box
    block["name_size"] = len(name) + 1
    block["node_count"] = [*tree["node_count"], 1]
    block["tile_count"] = tree["tile_count"]
    block["codec"] = CODECS.index(codec)
    return block


def _name_key(name: bytes) -> int:
    # NanoVDB's own string hash: readers compare it before the names.
    key = 0
    for byte in name:
        key = (key * 67 + byte + (key >> 56)) & 0xFFFFFFFFFFFFFFFF
    return key
