"""Index grids laid out by hand, with channels behind them: the two leaves and the tiles of tests.typed_grids."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.catalog.typed_grids import LEAVES, put
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import (
    BLIND_DATA,
    HEAD_SIZE,
    TREE_OFFSET,
    aligned_buffer,
    grid_header,
    info_of,
    tree_header,
)
from geokit.volume.nanovdb.layout import GRID_TYPES, INDEX_LAYOUTS, LAYOUTS

# The background, then a tile of the lower, the upper and the root node, then the leaves.
LOWER_TILE, UPPER_TILE, ROOT_TILE, FIRST_VOXEL = 1, 2, 3, 4
STATISTICS = 4


class IndexGrid:
    """An index grid of any of the four types.

    Attributes:
        volume: The grid.
        count: Number of values that a channel has.
        masks: Active voxels of both leaves, shape (2, 512).
    """

    def __init__(self, grid_type: str, channels: Sequence[tuple[str, str]] = (), statistics: bool = False) -> None:
        self.grid_type, self.layout = grid_type, INDEX_LAYOUTS[grid_type]
        self.masks = np.random.default_rng(11).integers(0, 2, (2, 512)).astype(bool)
        self.statistics = statistics
        used = [512 if not self.sparse else int(mask.sum()) for mask in self.masks]
        self.offsets = np.cumsum([FIRST_VOXEL, *(n + STATISTICS * statistics for n in used)])
        self.count = int(self.offsets[-1])
        rng = np.random.default_rng(12)
        self.values = [_values(LAYOUTS[kind].background, self.count, rng) for _, kind in channels]
        buffer = self._buffer(channels)
        self.volume = SparseVolume(buffer, info_of(buffer))

    @property
    def sparse(self) -> bool:
        return self.grid_type.startswith("on")

    def index_at(self, ijk: np.ndarray) -> np.ndarray:
        """Indices of voxels (N, 3)."""
        x, y, z = ijk.T
        out = np.zeros(len(ijk), np.int64)
        layer = (x >= 0) & (x < 8) & (y >= 0) & (y < 8)
        out[layer & (z >= 8) & (z < 16)] = LOWER_TILE
        out[(x >= 0) & (x < 128) & (y >= 0) & (y < 128) & (z >= 128) & (z < 256)] = UPPER_TILE
        out[(x >= 4096) & (x < 8192) & (y >= 0) & (y < 4096) & (z >= 0) & (z < 4096)] = ROOT_TILE
        for origin, offset, mask in zip(LEAVES, self.offsets, self.masks, strict=False):
            inside = ((ijk >= origin) & (ijk < origin + 8)).all(axis=1)
            n = (ijk[inside] - origin) @ [64, 8, 1]
            before = np.cumsum(mask) - mask
            out[inside] = np.where(mask[n], offset + before[n], 0) if self.sparse else offset + n
        return out

    def places(self) -> dict[str, int]:
        """Where the root and the first node of each level begin in the buffer."""
        layout, root = self.layout, HEAD_SIZE
        upper = root + layout.root_size + 3 * layout.root_tile_size
        lower = upper + 2 * layout.upper_size
        leaf = lower + 2 * layout.lower_size
        return {"leaf": leaf, "lower": lower, "upper": upper, "root": root, "blind": leaf + 2 * layout.leaf_size}

    def _buffer(self, channels: Sequence[tuple[str, str]]) -> np.ndarray:
        layout, places = self.layout, self.places()
        data = places["blind"] + len(channels) * BLIND_DATA.itemsize
        starts = []
        for values in self.values:
            starts.append(data)
            data += -(-values.nbytes // 32) * 32
        buffer = aligned_buffer(-(-data // 32) * 32, zeroed=True)
        self._write_heads(buffer, places, len(channels))
        root, upper, lower, leaf = (places[name] for name in ("root", "upper", "lower", "leaf"))
        put(buffer, root, np.array([[-8, 0, 0], [8191, 4095, 4095]], "<i4"), np.array([3], "<u4"))
        entries = [(0, upper, 0), (1, 0, ROOT_TILE), ((1 << 20) - 1, upper + layout.upper_size, 0)]
        for row, (x, child, index) in enumerate(entries):
            at = root + layout.root_size + row * layout.root_tile_size
            put(buffer, at, np.array([x << 42], "<u8"), np.array([child - root if child else 0], "<i8"))
            put(buffer, at + 24, np.array([index], "<u8"))
        for row, origin in enumerate(LEAVES):
            u, v, w = upper + row * layout.upper_size, lower + row * layout.lower_size, leaf + row * layout.leaf_size
            _write_slots(
                buffer, u, 32**3, layout.upper_table, 0 if row else UPPER_TILE, (origin[0] & 4095) >> 7 << 10, v
            )
            _write_slots(buffer, v, 16**3, layout.lower_table, 0 if row else LOWER_TILE, (origin[0] & 127) >> 3 << 8, w)
            box = np.array([origin, origin + 7], "<i4")
            put(buffer, u, box)
            put(buffer, v, box)
            self._write_leaf(buffer, w, row)
        for i, ((name, kind), values, start) in enumerate(zip(channels, self.values, starts, strict=True)):
            at = places["blind"] + i * BLIND_DATA.itemsize
            entry = buffer[at : at + BLIND_DATA.itemsize].view(BLIND_DATA)[0]
            entry["offset"], entry["value_count"] = start - at, len(values)
            entry["value_size"], entry["data_class"] = LAYOUTS[kind].background.itemsize, 4
            entry["data_type"], entry["name"] = GRID_TYPES.index(kind), name.encode()
            put(buffer, start, values)
        return buffer

    def _write_heads(self, buffer: np.ndarray, places: dict[str, int], channels: int) -> None:
        head, tree = grid_header(buffer), tree_header(buffer)
        head["magic"], head["version"], head["flags"] = 0x314244566F6E614E, 32 << 21 | 8 << 10, 32
        head["checksum"], head["grid_count"], head["grid_size"] = 0xFFFFFFFFFFFFFFFF, 1, len(buffer)
        head["name"], head["grid_type"], head["grid_class"] = b"indices", GRID_TYPES.index(self.grid_type), 8
        head["matrix"] = head["inverse"] = head["matrix_f"] = head["inverse_f"] = np.eye(3).ravel()
        head["taper"] = head["taper_f"] = head["voxel_size"] = 1.0
        head["blind_offset"], head["blind_count"], head["data_1"] = places["blind"], channels, self.count
        tree["node_offset"] = [places[name] - TREE_OFFSET for name in ("leaf", "lower", "upper", "root")]
        tree["node_count"], tree["tile_count"], tree["voxel_count"] = [2, 2, 2], [1, 1, 1], int(self.masks.sum())

    def _write_leaf(self, buffer: np.ndarray, at: int, row: int) -> None:
        mask = self.masks[row]
        flags = 2 | 16 * self.statistics
        put(buffer, at, LEAVES[row].astype("<i4"), np.array([7, 7, 7, flags], np.uint8))
        put(buffer, at + 16, np.packbits(mask, bitorder="little"), self.offsets[row : row + 1].astype("<u8"))
        if self.sparse:
            sums = np.cumsum(mask.reshape(8, 64).sum(axis=1))[:7]
            packed = sum(int(n & 511) << 9 * word for word, n in enumerate(sums))
            put(buffer, at + 88, np.array([packed], "<u8"))


def _write_slots(buffer: np.ndarray, node: int, count: int, table: int, tile: int, own: int, child: int) -> None:
    slots = buffer[node + table : node + table + 8 * count].view("<i8")
    slots[1], slots[own] = tile, child - node
    buffer[node + 32 + count // 8 + own // 8] |= 1 << own % 8


def _values(dtype: np.dtype, count: int, rng: np.random.Generator) -> np.ndarray:
    shape = (count, *dtype.shape)
    if dtype.base.kind == "f":
        return rng.uniform(-200, 200, shape).astype(dtype.base)
    return rng.integers(0, 100, shape).astype(dtype.base)
