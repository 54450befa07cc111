"""A volume of any grid type with known values in leaves and tiles, laid out by hand."""

from __future__ import annotations

import numpy as np

from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import HEAD_SIZE, TREE_OFFSET, aligned_buffer, grid_header, info_of, tree_header
from geokit.volume.nanovdb.layout import GRID_TYPES, layout_of
from geokit.volume.nanovdb.types import TYPES


def _names(*families: str) -> list[str]:
    return [kind.name for kind in TYPES if kind.family in families]


SCALARS = _names("float", "integer", "bool", "mask")
QUANTIZED = _names("quantized")
VECTORS = _names("vector", "color")
VALUED = [*SCALARS, *QUANTIZED, *VECTORS]

LEAVES = np.array([[0, 0, 0], [-8, 0, 0]])


class TypedGrid:
    """A grid of any type: two leaves that meet at a border of root entries, and a tile of each level.

    The leaves start at (0, 0, 0) and (-8, 0, 0); a tile of a lower node at (0, 0, 8), of an upper node at (0, 0, 128),
    of the root at (4096, 0, 0).
    """

    def __init__(self, grid_type: str, transform: np.ndarray | None = None) -> None:
        self.layout = layout_of(GRID_TYPES.index(grid_type), "test grid")
        rng = np.random.default_rng(7)
        shape = self.layout.background.shape
        self.background, self.lower_tile, self.upper_tile, self.root_tile = _values(self.layout, rng, (4, *shape))
        self.codes = None
        if grid_type in QUANTIZED:
            bits = {"fp4": 4, "fp8": 8, "fp16": 16, "fpn": 2}[grid_type]
            self.codes = rng.integers(0, 2**bits, (2, 512), dtype=np.uint32)
            self.bits, self.minimum, self.quantum = bits, np.float32([-3.5, 1.25]), np.float32([0.0371, 0.5])
            self.leaves = self.codes.astype(np.float32) * self.quantum[:, None] + self.minimum[:, None]
        else:
            self.leaves = _values(self.layout, rng, (2, 512, *shape))
        self.transform = np.eye(4) if transform is None else transform
        buffer = self._buffer(GRID_TYPES.index(grid_type))
        self.volume = SparseVolume(buffer, info_of(buffer))

    def at(self, ijk: np.ndarray) -> np.ndarray:
        """Values of voxels (N, 3), read from the arrays that the grid was made from."""
        x, y, z = ijk.T
        out = np.empty((len(ijk), *self.layout.background.shape))
        out[:] = self.background
        layer = (x >= 0) & (x < 8) & (y >= 0) & (y < 8)
        out[layer & (z >= 8) & (z < 16)] = self.lower_tile
        upper = (x >= 0) & (x < 128) & (y >= 0) & (y < 128) & (z >= 128) & (z < 256)
        out[upper] = self.upper_tile
        out[(x >= 4096) & (x < 8192) & (y >= 0) & (y < 4096) & (z >= 0) & (z < 4096)] = self.root_tile
        for leaf, origin in zip(self.leaves, LEAVES, strict=True):
            inside = ((ijk >= origin) & (ijk < origin + 8)).all(axis=1)
            out[inside] = leaf[(ijk[inside] - origin) @ [64, 8, 1]]
        return out

    def _buffer(self, code: int) -> np.ndarray:
        layout = self.layout
        root = HEAD_SIZE
        upper = root + layout.root_size + 3 * layout.root_tile_size
        lower = upper + 2 * layout.upper_size
        leaf = lower + 2 * layout.lower_size
        leaf_size = 96 + 512 * self.bits // 8 if self.codes is not None else layout.leaf_size
        buffer = aligned_buffer(leaf + 2 * leaf_size, zeroed=True)
        self._write_heads(buffer, code, [leaf, lower, upper, root])
        put(buffer, root, np.array([[-8, 0, 0], [4096 + 4095, 4095, 4095]], "<i4"), np.array([3], "<u4"))
        put(buffer, root + layout.root_background, self._stored(self.background))
        # Entries of the root: x >> 12 is the highest part of the key, -1 its largest value.
        entries = [(0, upper, None), (1, 0, self.root_tile), ((1 << 20) - 1, upper + layout.upper_size, None)]
        for row, (x, child, value) in enumerate(entries):
            at = root + layout.root_size + row * layout.root_tile_size
            put(buffer, at, np.array([x << 42], "<u8"), np.array([child - root if child else 0], "<i8"))
            if value is not None:
                put(buffer, at + -(-20 // layout.align) * layout.align, self._stored(value))
        for row, origin in enumerate(LEAVES):
            u, v, w = upper + row * layout.upper_size, lower + row * layout.lower_size, leaf + row * leaf_size
            upper_tile, lower_tile = (self.background,) * 2 if row else (self.upper_tile, self.lower_tile)
            self._write_slots(buffer, u, 32**3, layout.upper_table, upper_tile, (origin[0] & 4095) >> 7 << 10, v - u)
            self._write_slots(buffer, v, 16**3, layout.lower_table, lower_tile, (origin[0] & 127) >> 3 << 8, w - v)
            box = np.array([origin, origin + 7], "<i4")
            put(buffer, u, box)
            put(buffer, v, box)
            self._write_leaf(buffer, w, leaf_size, row)
        return buffer

    def _write_heads(self, buffer: np.ndarray, code: int, begins: list[int]) -> None:
        head, tree = grid_header(buffer), tree_header(buffer)
        head["magic"], head["version"], head["flags"] = 0x304244566F6E614E, 32 << 21 | 4 << 10 | 2, 32
        head["checksum"], head["grid_count"], head["grid_size"] = 0xFFFFFFFFFFFFFFFF, 1, len(buffer)
        head["name"], head["grid_type"] = b"test", code
        matrix = self.transform[:3, :3]
        head["matrix"], head["inverse"] = matrix.ravel(), np.linalg.inv(matrix).ravel()
        head["matrix_f"], head["inverse_f"] = matrix.ravel(), np.linalg.inv(matrix).ravel()
        head["vector"] = head["vector_f"] = self.transform[:3, 3]
        head["taper"] = head["taper_f"] = 1.0
        head["voxel_size"] = np.linalg.norm(matrix, axis=0)
        tree["node_offset"] = [begin - TREE_OFFSET for begin in begins]
        tree["node_count"], tree["tile_count"], tree["voxel_count"] = [2, 2, 2], [1, 1, 1], 1024

    def _write_slots(
        self, buffer: np.ndarray, node: int, count: int, table: int, tile: np.ndarray, own: int, child: int
    ) -> None:
        """Background everywhere, ``tile`` in slot 1, and the child at the offset ``child`` in slot ``own``."""
        base = self.layout.background
        strides = (self.layout.table_stride, *([base.base.itemsize] if base.shape else []))
        slots = np.ndarray((count, *base.shape), base.base, buffer, node + table, strides)
        slots[:] = self.background
        slots[1] = tile
        put(buffer, node + table + own * self.layout.table_stride, np.array([child], "<i8"))
        buffer[node + 32 + count // 8 + own // 8] |= 1 << own % 8

    def _write_leaf(self, buffer: np.ndarray, at: int, size: int, row: int) -> None:
        put(buffer, at, LEAVES[row].astype("<i4"), np.array([7, 7, 7, 0], np.uint8), np.full(64, 255, np.uint8))
        name = self.layout.name
        if self.codes is not None:
            if name == "fpn":
                buffer[at + 15] = (self.bits.bit_length() - 1) << 5
            put(buffer, at + 80, self.minimum[row : row + 1], self.quantum[row : row + 1])
            places = np.arange(512)[:, None] * self.bits + np.arange(self.bits)
            bits = np.zeros(512 * self.bits, np.uint8)
            bits[places] = self.codes[row][:, None] >> np.arange(self.bits, dtype=np.uint32) & 1
            put(buffer, at + 96, np.packbits(bits, bitorder="little"))
        elif name in ("mask", "bool"):
            # A mask has no other table than the active voxels; that of a bool leaf follows them.
            put(buffer, at + (16 if name == "mask" else 80), np.packbits(self.leaves[row] > 0, bitorder="little"))
        else:
            stored = self._stored(self.leaves[row])
            put(buffer, at + size - stored.nbytes, stored)

    def _stored(self, values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(values, dtype=self.layout.background.base)


def _values(layout, rng, shape):
    """Values that the type holds exactly, some of them at the ends of its range."""
    kind = layout.background.base
    if kind.kind == "b":
        return rng.integers(0, 2, shape).astype(float)
    if kind.kind in "iu":
        info = np.iinfo(kind)
        # float64 holds 53 bits of an int64.
        low, high = max(info.min, -(2**53)), min(info.max, 2**53)
        values = rng.integers(-100 if low else 0, 100, shape).astype(float)
        values.reshape(-1)[[0, -1]] = low, high
        return values
    return rng.uniform(-200, 200, shape).astype(kind).astype(float)


def put(buffer, at, *parts):
    for part in parts:
        raw = np.ascontiguousarray(part).reshape(-1).view(np.uint8)
        buffer[at : at + len(raw)] = raw
        at += len(raw)
