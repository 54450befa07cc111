"""The pair of CRC32 checksums in a NanoVDB grid: one of its head, one of everything below.

Writers follow three rules. Up to 32.6.0 the head runs through the root's table, and the tail is a CRC over one CRC per
node, widened to 8 bytes by NanoVDB 32.0 to 32.5 on Linux and kept at 4 elsewhere and in later versions. After 32.6.0
the head ends with the tree header, and the tail is a CRC over one CRC per 4096 bytes.

Source:
    NanoVDB, GridChecksum.h of OpenVDB 10.0.1 and of OpenVDB 12.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.header import HEAD_SIZE, MAJOR_VERSION, TREE_OFFSET, grid_header, tree_header
from geokit.volume.nanovdb.layout import GridLayout, layout_of
from geokit.volume.nanovdb.nodes import grid_nodes

EMPTY = 0xFFFFFFFF
# The magic number and the checksum itself are not part of the sum.
HEAD_START = 16
LAST_OLD_VERSION = MAJOR_VERSION << 21 | 6 << 10
BLOCK = 4096


def checksum_mode(buffer: NDArray[np.uint8]) -> str:
    """Coverage of the grid's checksum: "full", "partial" (headers, up to 32.6 also the root) or "none"."""
    value = int(grid_header(buffer)["checksum"])
    # Zero is a field that was never filled in, from which some writers start.
    if value in (0, EMPTY << 32 | EMPTY):
        return "none"
    return "partial" if value >> 32 == EMPTY else "full"


def checksum_matches(buffer: NDArray[np.uint8]) -> bool:
    """Whether a structurally valid grid matches its checksum; True if it has none."""
    mode = checksum_mode(buffer)
    if mode == "none":
        return True
    stored = int(grid_header(buffer)["checksum"])
    if _head(buffer[:HEAD_SIZE], buffer) != stored & EMPTY:
        return False
    if mode == "partial" or _is_empty(buffer):
        return True
    return (stored >> 32) in _tails(buffer)


def partial_checksum(head: NDArray[np.uint8], buffer: NDArray[np.uint8]) -> np.uint64:
    """Checksum of a grid's headers and root.

    Args:
        head: The first 736 bytes as they will be written, in place of those of ``buffer``.
        buffer: The structurally valid grid.
    """
    return np.uint64(EMPTY << 32 | _head(head, buffer))


def full_checksum(head: NDArray[np.uint8], buffer: NDArray[np.uint8]) -> np.uint64:
    """Checksum of a grid's headers, root and nodes; arguments as for :func:`partial_checksum`."""
    if _is_empty(buffer):
        return partial_checksum(head, buffer)
    return np.uint64(_tails(buffer, old=_is_old(head))[0] << 32 | _head(head, buffer))


def _is_empty(buffer: NDArray[np.uint8]) -> bool:
    return _root_tiles(buffer) == 0


def _root_tiles(buffer: NDArray[np.uint8]) -> int:
    root = TREE_OFFSET + int(tree_header(buffer)["node_offset"][3])
    return int(buffer[root + 24 : root + 28].view("<u4")[0])


def _is_old(head: NDArray[np.uint8]) -> bool:
    return int(grid_header(head)["version"]) <= LAST_OLD_VERSION


def _layout(buffer: NDArray[np.uint8]) -> GridLayout:
    return layout_of(int(grid_header(buffer)["grid_type"]), "NanoVDB buffer")


def _head(head: NDArray[np.uint8], buffer: NDArray[np.uint8]) -> int:
    total = crc32(head[HEAD_START:HEAD_SIZE].data)
    if not _is_old(head):
        return total
    # Writers of that time took as many bytes as root and table have, starting at the end of the headers, wherever the
    # root is.
    layout = _layout(buffer)
    end = HEAD_SIZE + layout.root_size + _root_tiles(buffer) * layout.root_tile_size
    return crc32(buffer[HEAD_SIZE:end].data, total)


def _tails(buffer: NDArray[np.uint8], *, old: bool | None = None) -> tuple[int, ...]:
    """The sums that a writer may have stored, first the one that geokit stores."""
    if not (_is_old(buffer) if old is None else old):
        # The last block also takes the remainder, up to two blocks in size.
        size = len(buffer) - HEAD_SIZE
        starts = [HEAD_SIZE + BLOCK * i for i in range(size // BLOCK)]
        ends = [*starts[1:], len(buffer)]
        memory = buffer.data
        return (crc32(np.array([crc32(memory[a:b]) for a, b in zip(starts, ends, strict=False)], dtype="<u4").data),)
    headers, whole = _node_sums(buffer, _layout(buffer))
    return tuple(crc32(sums.data) for sums in (headers.astype("<u8"), headers, whole, whole.astype("<u8")))


def _node_sums(buffer: NDArray[np.uint8], layout: GridLayout) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    # Early writers took the C++ size of a leaf, which for an FpN leaf is its header; later ones take the whole leaf.
    grid = grid_nodes(buffer, layout)
    headers: list[int] = []
    whole: list[int] = []
    memory = buffer.data
    for level in (grid.upper, grid.lower, grid.leaf):
        if level.name == "leaf" and layout.leaf_bits < 0:
            for at in level.starts.tolist():
                headers.append(crc32(memory[at : at + layout.leaf_header]))
                whole.append(crc32(memory[at : at + layout.leaf_header + (64 << (int(memory[at + 15]) >> 5))]))
            continue
        sums = [crc32(memory[at : at + level.size]) for at in level.starts.tolist()]
        headers += sums
        whole += sums
    return np.array(headers, dtype="<u4"), np.array(whole, dtype="<u4")
