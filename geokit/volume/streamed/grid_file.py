"""One grid of floats in a .nvdb file, from parts that are built one after the other.

Each part is a grid of its own, made by the writers of ``volume/tree``, whose lower nodes (128^3 voxels) are whole: no
other part has one at the same place. Their leaves and lower nodes wait on disk until all are known; a line for each
lower node stays in memory. The file has the bytes of the grid that one writer would have made of all leaves.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.header import FLAG_HAS_BBOX, HEAD_SIZE, grid_header, tree_header
from geokit.volume.nanovdb.metadata import body_with_metadata
from geokit.volume.nanovdb.nodes import NodeLevel, grid_nodes, slot_of
from geokit.volume.nanovdb.write import file_metadata, file_version, segment_start
from geokit.volume.tree.flood_signs import face_signs, flood
from geokit.volume.tree.grid_head import GridHead, Places, places_of, root_keys_of, write_head, write_root

INT32 = np.iinfo(np.int32)


class _Lowers(NamedTuple):
    """Lower nodes: first voxels (N, 3), numbers of leaves, boxes (N, 6), limits (N, 2), faces inside as bits (N,)."""

    origins: NDArray[np.int32]
    leaves: NDArray[np.int64]
    boxes: NDArray[np.int32]
    limits: NDArray[np.float32]
    faces: NDArray[np.uint8]


class GridParts:
    """The parts of a grid, in two files that grow.

    Args:
        folder: Where the files are.
        head: Headers and options of the grid.
        signed: Whether empty regions inside the leaves' negative values take ``head.inside``.
    """

    def __init__(self, folder: Path, head: GridHead, *, signed: bool) -> None:
        self.head, self.signed = head, signed
        self._paths = folder / "lowers", folder / "leaves"
        shapes = ((0, 3), np.int32), ((0,), np.int64), ((0, 6), np.int32), ((0, 2), np.float32), ((0,), np.uint8)
        self._found, self._active = [_Lowers._make(np.zeros(shape, kind) for shape, kind in shapes)], 0

    def add(self, buffer: NDArray[np.uint8]) -> None:
        """Take over the nodes of a grid."""
        grid = grid_nodes(buffer, self.head.layout)
        lower, leaf = grid.lower, grid.leaf
        children = np.unpackbits(lower.child_mask, axis=1, bitorder="little")
        leaves = children.sum(axis=1, dtype=np.int64)
        # Also of lower nodes without an active voxel, whose boxes start at their first voxels.
        boxes = lower.column("<i4", 0, 6).copy()
        faces = np.zeros(lower.count, np.uint8)
        if self.signed:
            node, slot = np.nonzero(children)
            _, faces = flood(lower.count, 4, node, slot, face_signs(leaf.values))
        self._found.append(_Lowers(lower.origins, leaves, boxes, lower.limits.copy(), faces))
        self._active += int(tree_header(buffer)["voxel_count"])
        for path, level in zip(self._paths, (lower, leaf), strict=True):
            with open(path, "ab") as file:
                file.write(buffer[level.begin : level.end].data)

    def write(self, path: Path, metadata: dict[str, Any]) -> None:
        """Write the .nvdb file of the whole grid."""
        layout = self.head.layout
        lowers = _Lowers(*(np.concatenate(column) for column in zip(*self._found, strict=True)))
        keys, uppers, upper_of = np.unique(root_keys_of(lowers.origins), return_index=True, return_inverse=True)
        slots = slot_of(lowers.origins, 32, 128)
        order = np.lexsort([slots, upper_of])
        origins = lowers.origins[uppers].astype(np.int64).reshape(-1, 3) >> 12
        leaf_count = int(lowers.leaves.sum())
        places = places_of(layout, leaf_count, len(order), origins, fill_gaps=self.signed)
        first_leaf = np.cumsum(lowers.leaves) - lowers.leaves
        sorted_lowers = _Lowers._make(column[order] for column in lowers)
        nodes, faces, boxes, limits = self._uppers(places, sorted_lowers, upper_of[order], slots[order], len(keys))
        start = write_head(self.head, places, faces)
        write_root(start, self.head, boxes.reshape(-1, 2, 3), limits, self._active)
        with open(path, "wb") as file:
            begin = len(_segment(start))
            file.seek(begin + places.upper_begin)
            sums = 0
            for node in nodes:
                file.write(node.data)
                sums = _with_sum(node.data, sums)
            leaves = sorted_lowers.leaves
            sums = self._copy_lowers(file, places, order, np.cumsum(leaves) - leaves, sums)
            sums = self._copy_leaves(file, first_leaf[order], leaves, sums)
            self._finish(file, begin, start, metadata, sums)

    def _uppers(
        self, places: Places, lowers: _Lowers, upper_of: NDArray[np.int64], slots: NDArray[np.int64], count: int
    ) -> tuple[list[NDArray[np.uint8]], NDArray[np.uint8], NDArray[np.int32], NDArray[np.float32]]:
        """Upper nodes, the faces that lie inside as bits, boxes (U, 6) and limits (U, 2)."""
        from geokit.volume.tree.node_signs_kernels import INSIDE

        layout, head = self.head.layout, self.head
        nodes, faces, states = [], np.zeros(count, np.uint8), np.zeros((count, 1), np.uint8)
        if self.signed:
            states, faces = flood(count, 5, upper_of, slots, lowers.faces)
        boxes = np.tile(np.array([INT32.max] * 3 + [INT32.min] * 3, np.int32), (count, 1))
        limits = np.zeros((count, 2), np.float32)
        starts = np.searchsorted(upper_of, np.arange(count + 1))
        for i in range(count):
            rows = np.arange(starts[i], starts[i + 1])
            slot = slots[rows]
            node = np.zeros(layout.upper_size, np.uint8)
            level = NodeLevel(node, layout, "upper", 0, 1, layout.upper_size, layout.upper_table, 32, 128)
            level.values[0] = np.where(states[i] == int(INSIDE), head.inside, head.background)
            at = places.upper_begin + i * layout.upper_size
            level.child_offsets[0, slot] = places.lower_begin + rows * layout.lower_size - at
            np.bitwise_or.at(level.child_mask[0], slot >> 3, (1 << (slot & 7)).astype(np.uint8))
            some = rows[lowers.boxes[rows, 0] <= lowers.boxes[rows, 3]]
            box = level.column("<i4", 0, 6)[0]
            box[:] = [*(lowers.origins[rows[0]] & ~np.int32(4095)), *[INT32.min] * 3]
            if len(some):
                box[:3], box[3:] = lowers.boxes[some, :3].min(axis=0), lowers.boxes[some, 3:].max(axis=0)
                boxes[i] = box
                limits[i] = lowers.limits[some, 0].min(), lowers.limits[some, 1].max()
                level.column("<u8", 24, 1)[0] = FLAG_HAS_BBOX
            level.limits[0] = limits[i]
            nodes.append(node)
        return nodes, faces, boxes, limits

    def _copy_lowers(
        self, file: BinaryIO, places: Places, order: NDArray[np.int64], first_leaf: NDArray[np.int64], sums: int
    ) -> int:
        """The lower nodes in their order, with the offsets of their leaves in this file; returns the new checksum."""
        layout = self.head.layout
        for rank, row in enumerate(order.tolist()):
            node = np.fromfile(self._paths[0], np.uint8, layout.lower_size, offset=row * layout.lower_size)
            level = NodeLevel(node, layout, "lower", 0, 1, layout.lower_size, layout.lower_table, 16, 8)
            slot = np.flatnonzero(np.unpackbits(level.child_mask[0], bitorder="little"))
            leaf = places.leaf_begin + (first_leaf[rank] + np.arange(len(slot))) * layout.leaf_size
            level.child_offsets[0, slot] = leaf - (places.lower_begin + rank * layout.lower_size)
            file.write(node.data)
            sums = _with_sum(node.data, sums)
        return sums

    def _copy_leaves(self, file: BinaryIO, first_leaf: NDArray[np.int64], leaves: NDArray[np.int64], sums: int) -> int:
        size = self.head.layout.leaf_size
        if not len(leaves):
            return sums
        with open(self._paths[1], "rb") as source:
            for first, count in zip(first_leaf.tolist(), leaves.tolist(), strict=True):
                source.seek(first * size)
                block = memoryview(source.read(count * size))
                file.write(block)
                for at in range(0, len(block), size):
                    sums = _with_sum(block[at : at + size], sums)
        return sums

    def _finish(
        self, file: BinaryIO, begin: int, start: NDArray[np.uint8], metadata: dict[str, Any], sums: int
    ) -> None:
        """Write the metadata at the end, and what stands before the nodes."""
        head = start[:HEAD_SIZE]
        # Of the grid only the size is used: one byte stands for all.
        whole = np.broadcast_to(np.uint8(0), file.tell() - begin)
        for part in body_with_metadata(head, whole, metadata, "the grid")[1:]:
            file.write(np.ascontiguousarray(part).data)
        low = crc32(start[HEAD_SIZE:].data, crc32(head[16:].data))
        grid_header(head)["checksum"] = sums << 32 | low
        file.seek(0)
        file.write(_segment(start))
        file.write(start.data)


def _segment(start: NDArray[np.uint8]) -> bytes:
    """What stands in the file before the grid, whose headers and root are given."""
    head = start[:HEAD_SIZE]
    name = bytes(grid_header(head)["name"])
    block = file_metadata(head, name, start[HEAD_SIZE : HEAD_SIZE + 24].view("<i4"), "none")
    block["file_size"] = block["grid_size"]
    return segment_start(*file_version(head), "none", [block], [name])


def _with_sum(node: Any, sums: int) -> int:
    """The checksum over those of the nodes: each is 8 bytes, as NanoVDB 32.4 has them."""
    return crc32(crc32(node).to_bytes(8, "little"), sums)
