"""LZF, the compression of .pcd files, in C++; in Python, which is slow, if geokit was built without a compiler.

A control byte below 32 announces that many literals plus one. Any other control byte is a back reference: its upper
three bits are the length minus two (for 7 the next byte is added), its lower five bits and the next byte the distance
minus one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["compress", "decompress"]

# Each 32 literals cost one more byte, and the last run may be short.
LITERAL_RUN = 32
LONGEST_MATCH = 264
LARGEST_DISTANCE = 8192
# Size of the compressor's hash table, which stores positions by the hash of the three bytes there.
TABLE_BITS = 15


def decompress(packed: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], int]:
    """Decompress ``packed`` to ``size`` bytes; also returns the first damaged byte of ``packed``, or -1.

    Damage is a reference before the beginning, a run beyond the end, or a size other than the declared one.
    """
    from geokit.native.parsers.extension import parsers

    core = parsers()
    if core is None:
        return _decompress(packed.tobytes(), size)
    out = np.zeros(size, np.uint8)
    return out, int(core.lzf_decompress(np.ascontiguousarray(packed), out))


def compress(plain: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Compress ``plain`` with LZF; the result is at most a 32nd longer."""
    from geokit.native.parsers.extension import parsers

    core = parsers()
    if core is None:
        return np.frombuffer(_compress(plain.tobytes()), np.uint8)
    out = np.empty(len(plain) + len(plain) // LITERAL_RUN + 2, np.uint8)
    return out[: int(core.lzf_compress(np.ascontiguousarray(plain), out))]


def _decompress(packed: bytes, size: int) -> tuple[NDArray[np.uint8], int]:
    out = bytearray()
    at = start = 0
    sound = True
    while sound and at < len(packed):
        start = at
        control = packed[at]
        at += 1
        if control < LITERAL_RUN:
            run = packed[at : at + control + 1]
            sound = len(run) == control + 1 <= size - len(out)
            out += run if sound else b""
            at += control + 1
            continue
        long = control >> 5 == 7
        if at + 1 + long > len(packed):
            sound = False
            continue
        length = (control >> 5) + 2 + (packed[at] if long else 0)
        distance = ((control & 31) << 8 | packed[at + long]) + 1
        at += 1 + long
        sound = distance <= len(out) and length <= size - len(out)
        if sound:
            # A reference may overlap its own output, whose bytes then repeat.
            piece = out[len(out) - distance :][:length]
            out += (piece * (length // len(piece) + 1))[:length]
    found = np.zeros(size, np.uint8)
    found[: len(out)] = np.frombuffer(out, np.uint8)
    return found, -1 if sound and len(out) == size else start


def _compress(plain: bytes) -> bytes:
    """Compress to the same bytes as the C++ version."""
    out = bytearray()
    table: dict[int, int] = {}
    at = start = 0
    while at < len(plain):
        length = distance = 0
        if at + 2 < len(plain):
            slot = (int.from_bytes(plain[at : at + 3], "big") * 2654435761 & 0xFFFFFFFF) >> (32 - TABLE_BITS)
            seen = table.get(slot, -1)
            table[slot] = at
            distance = at - seen
            if seen >= 0 and distance <= LARGEST_DISTANCE and plain[seen : seen + 3] == plain[at : at + 3]:
                longest = min(len(plain) - at, LONGEST_MATCH)
                length = 3
                while length < longest and plain[seen + length] == plain[at + length]:
                    length += 1
        if not length:
            at += 1
            continue
        _add_literals(out, plain[start:at])
        code, back = length - 2, distance - 1
        out += bytes([min(code, 7) << 5 | back >> 8, *([code - 7] if code >= 7 else []), back & 255])
        at = start = at + length
    _add_literals(out, plain[start:])
    return bytes(out)


def _add_literals(out: bytearray, literals: bytes) -> None:
    for at in range(0, len(literals), LITERAL_RUN):
        run = literals[at : at + LITERAL_RUN]
        out.append(len(run) - 1)
        out += run
