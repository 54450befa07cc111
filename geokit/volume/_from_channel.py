"""Volumes of values from index grids, whose values are kept apart from their voxels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError, InputError, UnsupportedGridError
from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.header import (
    BLIND_CLASS_NAME,
    BLIND_DATA,
    FLAG_BREADTH_FIRST,
    FLAG_HAS_BBOX,
    HEAD_SIZE,
    TREE_OFFSET,
    aligned_buffer,
    decoded_name,
    encoded_name,
    grid_header,
    info_of,
    tree_header,
)
from geokit.volume.nanovdb.index_checks import (
    LEAF_MASK,
    leaf_offsets,
    masks_of,
    slots_of,
    value_count_of,
)
from geokit.volume.nanovdb.layout import (
    GRID_TYPES,
    INDEX_LAYOUTS,
    LAYOUTS,
    LEAF_VOXELS,
    LOWER_SLOTS,
    UPPER_SLOTS,
    GridLayout,
    type_name,
)
from geokit.volume.nanovdb.types import CHANNEL_TYPES

__all__ = ["channel_names", "from_channel"]

# A name in the header has 255 bytes and a zero.
LONGEST_NAME = 255
# Leaves filled at a time: the values of 1024 leaves of vec4d are 16 megabytes.
LEAVES_AT_A_TIME = 1024


def channel_names(volume: SparseVolume) -> list[str]:
    """Names of the channels of an index grid, in their order; ``""`` for a channel without a name.

    Args:
        volume: Any grid.

    Returns:
        One name for each array of values behind the grid; empty for grids that hold their values themselves.

    Raises:
        FileFormatError: The buffer is not a sound grid.
        UnsupportedGridError: The grid's type cannot be used.

    Example:
        >>> from geokit.volume import load
        >>> channel_names(load("data/samples/torus.vdb"))
        []
    """
    if volume.info.grid_type not in INDEX_LAYOUTS:
        return []
    check_volume(volume)
    return [decoded_name(bytes(entry["name"])) for _, entry in _channels(volume.nanovdb)]


def from_channel(volume: SparseVolume, channel: int | str = 0) -> SparseVolume:
    """The volume that an index grid and one of its channels stand for.

    Every voxel and tile gets the value that its index leads to, bit for bit; active states, tree and transform are
    those of the index grid. All offsets and indices are checked first. The result is made once for a volume and a
    channel and kept while the volume lives. Held by tests/volume/test_from_channel.py.

    Args:
        volume: A grid of type "index", "onindex", "indexmask" or "onindexmask" with values behind its nodes.
        channel: Number or name of the channel; of several with one name the first.

    Returns:
        A volume of the channel's type, called as the channel is (or as the grid, where it has no name).

    Raises:
        InputError: The volume is no index grid, or it has no such channel.
        FileFormatError: The buffer is not a sound grid, or the channel has fewer values than the grid has indices.
        UnsupportedGridError: The grid has no channel, or the channel's values are of a type that cannot be sampled.

    Example:
        >>> from geokit.volume import load
        >>> density = from_channel(load("smoke_index.nvdb"), "density")  # doctest: +SKIP
        >>> density.sample(points, order=3)  # doctest: +SKIP
    """
    if volume.info.grid_type not in INDEX_LAYOUTS:
        raise InputError(
            f"channel: {volume.info.grid_type} grids hold their values themselves, only index grids have channels; "
            "leave it out"
        )
    where = f"volume {volume.info.name!r}"
    check_volume(volume)
    channels = _channels(volume.nanovdb)
    if not channels:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} stores no values that can be "
            f"interpolated, it has no channel; convert it to one of {', '.join(LAYOUTS)}"
        )
    number = _number_of(channel, [decoded_name(bytes(entry["name"])) for _, entry in channels])
    at, entry = channels[number]

    def make() -> SparseVolume:
        return _valued(volume, _values(volume.nanovdb, at, entry, where), entry)

    return volume._cache.find(("channel", number), make)


def _channels(buffer: NDArray[np.uint8]) -> list[tuple[int, Any]]:
    """Where the data of each channel begins, and its entry. Names and data of unknown type are no channels."""
    grid = grid_header(buffer)
    begin, count = int(grid["blind_offset"]), int(grid["blind_count"])
    found = []
    for i, entry in enumerate(buffer[begin : begin + count * BLIND_DATA.itemsize].view(BLIND_DATA)):
        if int(entry["data_class"]) != BLIND_CLASS_NAME and int(entry["data_type"]):
            found.append((begin + i * BLIND_DATA.itemsize + int(entry["offset"]), entry))
    return found


def _number_of(channel: int | str, names: list[str]) -> int:
    if isinstance(channel, str):
        if channel in names:
            return names.index(channel)
    elif isinstance(channel, (int, np.integer)) and not isinstance(channel, bool) and 0 <= channel < len(names):
        return int(channel)
    known = ", ".join(f"{i} ({name!r})" for i, name in enumerate(names))
    raise InputError(f"channel: {channel!r} is not a channel of the grid; use one of {known}")


def _values(buffer: NDArray[np.uint8], at: int, entry: Any, where: str) -> NDArray[Any]:
    """The values of a channel, shape (count, ...)."""
    kind = type_name(int(entry["data_type"]))
    if kind not in CHANNEL_TYPES:
        raise UnsupportedGridError(
            f"{where}: its channel {decoded_name(bytes(entry['name']))!r} of type {kind} cannot be sampled; convert it "
            f"to one of {', '.join(CHANNEL_TYPES)}"
        )
    # The background has an index even where nothing else has.
    dtype, needed = LAYOUTS[kind].background, max(value_count_of(buffer), 1)
    count, size = int(entry["value_count"]), int(entry["value_size"])
    if size not in (0, dtype.itemsize) or count < needed or at + count * dtype.itemsize > len(buffer):
        raise FileFormatError(
            f"{where}: the grid is damaged, a channel of {count} values of {size} bytes does not hold its {needed} "
            f"values of type {kind}; get the file again from its source"
        )
    return np.ndarray((count, *dtype.shape), dtype.base, buffer, at)


class _Places:
    """Where the nodes of a grid are, and where they are if it has another type."""

    def __init__(self, buffer: NDArray[np.uint8], old: GridLayout, new: GridLayout) -> None:
        tree = tree_header(buffer)
        self.counts = [int(n) for n in tree["node_count"]]
        self.old_begins = [TREE_OFFSET + int(offset) for offset in tree["node_offset"]]
        self.old_sizes = (old.leaf_size, old.lower_size, old.upper_size)
        self.new_sizes = (new.leaf_size, new.lower_size, new.upper_size)
        root = self.old_begins[3]
        self.tiles = int(buffer[root + 24 : root + 28].view("<u4")[0])
        upper = HEAD_SIZE + new.root_size + self.tiles * new.root_tile_size
        lower = upper + self.counts[2] * new.upper_size
        leaf = lower + self.counts[1] * new.lower_size
        self.new_begins = [leaf, lower, upper, HEAD_SIZE]
        self.size = leaf + self.counts[0] * new.leaf_size

    def moved(self, level: int, at: NDArray[np.int64]) -> NDArray[np.int64]:
        """New places of nodes of a level, by their old ones."""
        number = (at - self.old_begins[level]) // self.old_sizes[level]
        return self.new_begins[level] + number * self.new_sizes[level]


def _valued(volume: SparseVolume, values: NDArray[Any], entry: Any) -> SparseVolume:
    kind = type_name(int(entry["data_type"]))
    old, new = INDEX_LAYOUTS[volume.info.grid_type], LAYOUTS[kind]
    source = volume.nanovdb
    places = _Places(source, old, new)
    target = aligned_buffer(places.size, zeroed=True)
    name = decoded_name(bytes(entry["name"])) or volume.info.name
    _write_heads(source, target, places, kind, name)
    _write_root(source, target, places, old, new, values)
    for level, slots, table_old, table_new in (
        (2, UPPER_SLOTS, old.upper_table, new.upper_table),
        (1, LOWER_SLOTS, old.lower_table, new.lower_table),
    ):
        for number in range(places.counts[level]):
            _write_node(source, target, places, level, number, slots, table_old, table_new, new, values)
    _write_leaves(source, target, places, old, new, values)
    target.setflags(write=False)
    info = info_of(target, volume.info.metadata, name=name)
    return SparseVolume(target, replace(info, grid_class="unknown"))


def _write_heads(
    source: NDArray[np.uint8], target: NDArray[np.uint8], places: _Places, kind: str, name: str
) -> None:  # fmt: skip
    target[:HEAD_SIZE] = source[:HEAD_SIZE]
    grid, tree = grid_header(target), tree_header(target)
    # No checksum, no statistics, no blind data, no class: they were those of the index grid.
    grid["checksum"] = np.uint64(0xFFFFFFFFFFFFFFFF)
    grid["flags"] = FLAG_BREADTH_FIRST | int(grid["flags"]) & FLAG_HAS_BBOX
    grid["grid_index"], grid["grid_count"], grid["grid_size"] = 0, 1, places.size
    grid["name"] = encoded_name(name)[:LONGEST_NAME]
    grid["grid_class"], grid["grid_type"] = 0, GRID_TYPES.index(kind)
    grid["blind_offset"], grid["blind_count"], grid["data_1"] = places.size, 0, 0
    tree["node_offset"] = [begin - TREE_OFFSET for begin in places.new_begins]


def _put(target: NDArray[np.uint8], at: int, value: NDArray[Any]) -> None:
    raw = np.ascontiguousarray(value).reshape(-1).view(np.uint8)
    target[at : at + len(raw)] = raw


def _write_root(
    source: NDArray[np.uint8], target: NDArray[np.uint8], places: _Places, old: GridLayout, new: GridLayout,
    values: NDArray[Any],
) -> None:  # fmt: skip
    begin, here = places.old_begins[3], places.new_begins[3]
    target[here : here + 28] = source[begin : begin + 28]
    at = begin + old.root_background
    _put(target, here + new.root_background, values[int(source[at : at + 8].view("<u8")[0])])
    for i in range(places.tiles):
        row = source[begin + old.root_size + i * old.root_tile_size :][: old.root_tile_size]
        out = here + new.root_size + i * new.root_tile_size
        target[out : out + 8], target[out + 16 : out + 20] = row[:8], row[16:20]
        child = int(row[8:16].view("<i8")[0])
        if child:
            moved = places.moved(2, np.array([begin + child])) - here
            _put(target, out + 8, moved.astype("<i8"))
        else:
            at = out + -(-20 // new.align) * new.align
            _put(target, at, values[int(row[24:32].view("<u8")[0])])


def _write_node(
    source: NDArray[np.uint8], target: NDArray[np.uint8], places: _Places, level: int, number: int, slots: int,
    table_old: int, table_new: int, new: GridLayout, values: NDArray[Any],
) -> None:  # fmt: skip
    begin = places.old_begins[level] + number * places.old_sizes[level]
    here = places.new_begins[level] + number * places.new_sizes[level]
    head = 32 + 2 * slots // 8
    target[here : here + head] = source[begin : begin + head]
    entries, children = (part[0] for part in slots_of(source, begin, 1, 0, table_old, slots))
    base = new.background
    strides = (new.table_stride, *([base.base.itemsize] if base.shape else []))
    tiles = np.ndarray((slots, *base.shape), base.base, target, here + table_new, strides)
    tiles[~children] = values[entries[~children]]
    offsets = np.ndarray((slots,), "<i8", target, here + table_new, (new.table_stride,))
    offsets[children] = places.moved(level - 1, begin + entries[children].view("<i8")) - here


def _write_leaves(
    source: NDArray[np.uint8], target: NDArray[np.uint8], places: _Places, old: GridLayout, new: GridLayout,
    values: NDArray[Any],
) -> None:  # fmt: skip
    base, size = new.background, new.leaf_size
    table = size - LEAF_VOXELS * base.itemsize
    for first in range(0, places.counts[0], LEAVES_AT_A_TIME):
        some = min(LEAVES_AT_A_TIME, places.counts[0] - first)
        begin = places.old_begins[0] + first * old.leaf_size
        here = places.new_begins[0] + first * size
        head = masks_of(target, here, some, size, 0, 80 * 8)
        head[:] = masks_of(source, begin, some, old.leaf_size, 0, 80 * 8)
        head[:, 15] &= FLAG_HAS_BBOX  # the other bits speak of statistics and quantisation
        offset, _ = leaf_offsets(source, begin, some, old)
        index = offset[:, None] + np.arange(LEAF_VOXELS, dtype=np.uint64)
        if old.name.startswith("on"):
            mask = masks_of(source, begin, some, old.leaf_size, LEAF_MASK, LEAF_VOXELS)
            on = np.unpackbits(mask, axis=1, bitorder="little").astype(np.uint64)
            index = np.where(on, offset[:, None] + np.cumsum(on, axis=1) - on, np.uint64(0))  # 0: the background's
        strides = (size, base.itemsize, *([base.base.itemsize] if base.shape else []))
        np.ndarray((some, LEAF_VOXELS, *base.shape), base.base, target, here + table, strides)[:] = values[index]
