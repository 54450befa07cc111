"""Models of MagicaVoxel as bytes, written from the description of the format."""

from __future__ import annotations

import struct

import numpy as np

__all__ = ["SHAPE", "VOXELS", "chunk", "palette", "vox_of"]

SHAPE = (5, 6, 7)
# x, y, z and the color's index.
VOXELS = np.array([[0, 0, 0, 1], [4, 5, 6, 255], [1, 2, 3, 7]], np.uint8)


def chunk(name: bytes, content: bytes, children: bytes = b"") -> bytes:
    return name + struct.pack("<ii", len(content), len(children)) + content + children


def dictionary(**pairs: str) -> bytes:
    texts = [text.encode() for pair in pairs.items() for text in pair]
    return struct.pack("<i", len(pairs)) + b"".join(struct.pack("<i", len(text)) + text for text in texts)


def palette() -> np.ndarray:
    """Colors of the indices 1 to 255, and one more."""
    return np.random.default_rng(5).integers(1, 256, (256, 4)).astype(np.uint8)


def vox_of(
    count: int,
    moves: dict[int, str] | None = None,
    turn: str | None = None,
    hidden: tuple[int, ...] = (),
    more: bytes = b"",
) -> bytes:
    """A file with ``count`` models, placed by a scene at ``moves``, each in a layer of its number.

    Args:
        count: Number of models.
        moves: Place of each; None writes no scene.
        turn: Rotation of all.
        hidden: Models whose nodes are hidden.
        more: Chunks in place of the palette.
    """
    body = b""
    for _ in range(count):
        body += chunk(b"SIZE", struct.pack("<3i", *SHAPE))
        body += chunk(b"XYZI", struct.pack("<i", len(VOXELS)) + VOXELS.tobytes())
    if moves is not None:
        body += chunk(b"nTRN", struct.pack("<i", 0) + dictionary() + struct.pack("<4i", 1, -1, -1, 1) + dictionary())
        shown = [2 + 2 * at for at in moves]
        body += chunk(
            b"nGRP", struct.pack("<i", 1) + dictionary() + struct.pack(f"<{1 + len(shown)}i", len(shown), *shown)
        )
        for at, move in moves.items():
            frame = dictionary(_t=move, **({"_r": turn} if turn else {}))
            facts = {"_name": f"part {at}", **({"_hidden": "1"} if at in hidden else {})}
            head = struct.pack("<i", 2 + 2 * at) + dictionary(**facts)
            body += chunk(b"nTRN", head + struct.pack("<4i", 3 + 2 * at, -1, at, 1) + frame)
            body += chunk(
                b"nSHP", struct.pack("<i", 3 + 2 * at) + dictionary() + struct.pack("<2i", 1, at) + dictionary()
            )
    body += more or chunk(b"RGBA", palette().tobytes())
    return b"VOX " + struct.pack("<i", 150) + chunk(b"MAIN", b"", body)
