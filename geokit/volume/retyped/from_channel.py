"""Volumes of values from index grids, which store values apart from their voxels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory.needs import needs
from geokit.core.require import described, whole_number
from geokit.errors import FileFormatError, InputError, UnsupportedGridError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.header import (
    BLIND_CLASS_NAME,
    BLIND_DATA,
    FLAG_BREADTH_FIRST,
    FLAG_HAS_BBOX,
    LONGEST_NAME,
    decoded_name,
    encoded_name,
    grid_header,
    info_of,
)
from geokit.volume.nanovdb.index_checks import leaf_offsets, value_count_of
from geokit.volume.nanovdb.layout import GRID_TYPES, INDEX_LAYOUTS, LAYOUTS, LEAF_VOXELS, type_name
from geokit.volume.nanovdb.nodes import NodeLevel, bits_of, grid_nodes
from geokit.volume.nanovdb.types import CHANNEL_TYPES
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.leaves import require_volume
from geokit.volume.tree.retype_tree import retype_tree

# Leaves filled at a time: the values of 1024 leaves of vec4d are 16 megabytes.
LEAVES_AT_A_TIME = 1024


@needs()
def channel_names(volume: SparseVolume) -> list[str]:
    """Names of the channels of an index grid, in order; ``""`` for a channel without a name.

    Args:
        volume: Any grid.

    Returns:
        One name for each array of values that follows the nodes; empty for grids that hold their values themselves.

    Raises:
        FileFormatError: The buffer is not a valid grid.
        UnsupportedGridError: The grid's type cannot be used.

    Example:
        >>> from geokit.volume import load
        >>> channel_names(load("data/samples/torus.vdb"))
        []
    """
    if require_volume(volume, "volume").info.grid_type not in INDEX_LAYOUTS:
        return []
    check_volume(volume)
    return [decoded_name(bytes(entry["name"])) for _, entry in _channels(volume.nanovdb)]


@needs(lambda volume, *_: 4300 * leaf_count(volume))
def from_channel(volume: SparseVolume, channel: int | str = 0) -> SparseVolume:
    """Build the volume that an index grid and one of its channels represent.

    Every voxel and tile gets the value to which its index refers, bit for bit; active states, tree and transform are
    those of the index grid. All offsets and indices are checked first. The result is cached for each volume and channel
    while the volume lives.

    Args:
        volume: A grid of type "index", "onindex", "indexmask" or "onindexmask" whose channels follow its nodes.
        channel: Number or name of the channel; the first of several with the same name.

    Returns:
        A volume of the channel's type, with the channel's name (or the grid's, if the channel has none).

    Raises:
        InputError: The volume is not an index grid, or it has no such channel.
        FileFormatError: The buffer is not a valid grid, or the channel has fewer values than the grid has indices.
        UnsupportedGridError: The grid has no channel, or the type of the channel's values cannot be sampled.

    Example:
        >>> from geokit.volume import load
        >>> density = from_channel(load("smoke_index.nvdb"), "density")  # doctest: +SKIP
        >>> density.sample(points, order=3)  # doctest: +SKIP
    """
    if require_volume(volume, "volume").info.grid_type not in INDEX_LAYOUTS:
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
    """Start of the data of each channel, with its entry. Names and data of unknown type are not channels."""
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
    elif (number := whole_number(channel)) is not None and 0 <= number < len(names):
        return number
    known = ", ".join(f"{i} ({name!r})" for i, name in enumerate(names))
    raise InputError(f"channel: {described(channel)} is not a channel of the grid; use one of {known}")


def _values(buffer: NDArray[np.uint8], at: int, entry: Any, where: str) -> NDArray[Any]:
    """The values of a channel, shape (count, ...)."""
    kind = type_name(int(entry["data_type"]))
    if kind not in CHANNEL_TYPES:
        raise UnsupportedGridError(
            f"{where}: its channel {decoded_name(bytes(entry['name']))!r} of type {kind} cannot be sampled; convert it "
            f"to one of {', '.join(CHANNEL_TYPES)}"
        )
    # The background has an index even if nothing else has one.
    dtype, needed = LAYOUTS[kind].background, max(value_count_of(buffer), 1)
    count, size = int(entry["value_count"]), int(entry["value_size"])
    if size not in (0, dtype.itemsize) or count < needed or at + count * dtype.itemsize > len(buffer):
        raise FileFormatError(
            f"{where}: the grid is damaged, a channel of {count} values of {size} bytes does not hold its {needed} "
            f"values of type {kind}; get the file again from its source"
        )
    return np.ndarray((count, *dtype.shape), dtype.base, buffer, at)


def _valued(volume: SparseVolume, values: NDArray[Any], entry: Any) -> SparseVolume:
    source, kind = volume.nanovdb, type_name(int(entry["data_type"]))
    leaf = grid_nodes(source).leaf
    target = retype_tree(source, GRID_TYPES.index(kind), np.full(leaf.count, LAYOUTS[kind].leaf_size), values)
    name = decoded_name(bytes(entry["name"])) or volume.info.name
    _write_header(target.buffer, name)
    _write_leaves(leaf, grid_nodes(target.buffer).leaf, values)
    target.buffer.setflags(write=False)
    info = info_of(target.buffer, volume.info.metadata, name=name)
    return SparseVolume(target.buffer, replace(info, grid_class="unknown"))


def _write_header(buffer: NDArray[np.uint8], name: str) -> None:
    grid = grid_header(buffer)
    # Checksum, statistics, blind data and class belonged to the index grid.
    grid["checksum"] = np.uint64(0xFFFFFFFFFFFFFFFF)
    grid["flags"] = FLAG_BREADTH_FIRST | int(grid["flags"]) & FLAG_HAS_BBOX
    grid["grid_index"], grid["grid_count"] = 0, 1
    grid["name"] = encoded_name(name)[:LONGEST_NAME]
    grid["grid_class"] = 0
    grid["blind_offset"], grid["blind_count"], grid["data_1"] = len(buffer), 0, 0


def _write_leaves(source: NodeLevel, target: NodeLevel, values: NDArray[Any]) -> None:
    for (_, old), (_, new) in zip(source.parts(LEAVES_AT_A_TIME), target.parts(LEAVES_AT_A_TIME), strict=True):
        head = new.column(np.uint8, 0, 80)
        head[:] = old.column(np.uint8, 0, 80)
        head[:, 15] &= FLAG_HAS_BBOX  # the other bits describe statistics and quantization
        offset = leaf_offsets(old)[:, None]
        index = offset + np.arange(LEAF_VOXELS, dtype=np.uint64)
        if old.layout.name.startswith("on"):
            on = bits_of(old.value_mask).astype(np.uint64)
            index = np.where(on, offset + np.cumsum(on, axis=1) - on, np.uint64(0))  # 0: the background's
        new.values[:] = values[index]
