"""Damage: what a mutant has that its original has not. A seed always makes the same mutant of the same originals.

Most damage knows nothing of a format: bits, bytes, cuts, integers and lengths in both byte orders, numbers and lines
of text, pieces of another file. Some knows containers and mends what guards them: members of archives get a right
checksum, JSON and its chunks right lengths, grids of NanoVDB a right checksum (nvdb_mutators.py). Otherwise nearly all
mutants would end at the guard.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import random
import re
import struct
import zipfile
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from tests.fuzz.nvdb_mutators import mutate_grid
from tests.fuzz.originals import Original, Target

__all__ = ["Mutant", "mutate"]


class Mutant(NamedTuple):
    """A damaged file.

    Attributes:
        variant: The original's.
        data: The file.
        beside: Files beside it.
        mended: Whether a checksum was made right again after the damage: only then may an accepted mutant of a format
            with checksums differ from its original.
        damage: Names of what was done.
    """

    variant: str
    data: bytes
    beside: dict[str, bytes]
    mended: bool
    damage: tuple[str, ...]


Damage = Callable[[bytearray, random.Random, Sequence[bytes]], None]

# Integers at which sizes, counts and indices break.
EXTREMES = [
    0,
    1,
    2,
    3,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63 - 1,
    2**63,
    2**64 - 1,
]
FLOATS = [float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 1e-320, 1e300, -1e300, 1e38, 4e9, -1.0]
TOKENS = [
    b"nan", b"-inf", b"0", b"-0", b"-1", b"1", b"1e400", b"1e-400", b"1e300", b"99999999999999999999", b"4294967295",
    b"4294967296", b"2147483648", b"-2147483648", b"9223372036854775808", b"0x10", b"1,5", b"1e", b".", b"1_0", b"",
    b"\xd9\xa3", b"1 2", b"'1'",
]  # fmt: skip
NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9:.]*")


def _place(chance: random.Random, size: int) -> int:
    """A position; every other one near the beginning, where headers are."""
    return chance.randrange(max(min(size, 600) if chance.random() < 0.5 else size, 1))


def flip_bit(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    data[_place(chance, len(data))] ^= 1 << chance.randrange(8)


def set_bytes(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    for _ in range(chance.choice((1, 1, 4, 20))):
        data[_place(chance, len(data))] = chance.choice((0, 0xFF, 0x20, 0x0A, chance.randrange(256)))


def cut(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    del data[chance.choice((_place(chance, len(data)), max(len(data) - chance.randrange(1, 40), 1))) :]


def remove(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    at = _place(chance, len(data))
    del data[at : at + chance.choice((1, 4, 8, chance.randrange(1, 200)))]


def repeat(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    at = _place(chance, len(data))
    data[at:at] = data[at : at + chance.choice((1, 4, 8, chance.randrange(1, 200)))] * chance.choice((1, 1, 3, 100))


def insert(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    at = chance.choice((_place(chance, len(data)), len(data)))
    data[at:at] = chance.choice(
        (b"\0", b"\xff", b" ", b"\n", b"\r", b"\xef\xbb\xbf", b"#", b'"', b"<!--")
    ) * chance.choice((1, 1, 4, 1000))


def swap_blocks(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    length = chance.choice((4, 8, 16, 64))
    a, b = _place(chance, len(data)), _place(chance, len(data))
    if abs(a - b) >= length and max(a, b) + length <= len(data):
        data[a : a + length], data[b : b + length] = data[b : b + length], data[a : a + length]


def integer(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    size = chance.choice((1, 2, 4, 4, 8))
    at = _place(chance, len(data)) // size * size if chance.random() < 0.7 else _place(chance, len(data))
    value = chance.choice((*EXTREMES, len(data), len(data) + 1)) % 2 ** (8 * size)
    data[at : at + size] = value.to_bytes(size, chance.choice(("little", "little", "big")))


def length(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    """Changes an integer that may be a length, a count or an offset: it is small, and not zero."""
    size, order = chance.choice((2, 4, 4, 8)), chance.choice(("little", "little", "big"))
    start = _place(chance, len(data))
    for at in range(start, min(start + 400, len(data) - size)):
        value = int.from_bytes(data[at : at + size], order)
        if 0 < value <= 2 * len(data):
            change = chance.choice(
                (value + 1, value - 1, 2 * value, value // 2, value + 2**31, value + 8, value * 4096)
            )
            data[at : at + size] = (change % 2 ** (8 * size)).to_bytes(size, order)
            return


def real(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    kind = chance.choice(("<d", "<f", ">d", ">f"))
    at = _place(chance, len(data)) // 4 * 4
    value = chance.choice(FLOATS)
    if kind[1] == "f" and abs(value) > 3e38 and value - value == 0:
        value = 3e38
    data[at : at + struct.calcsize(kind)] = struct.pack(kind, value)


def splice(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    """The beginning of this file and the end of another, or a piece of the other in it."""
    other = chance.choice(others)
    at, source = _place(chance, len(data)), chance.randrange(len(other))
    if chance.random() < 0.5:
        data[at:] = other[chance.choice((at, source)) :]
    else:
        piece = other[source : source + chance.choice((4, 16, 100, 1000))]
        data[at : at + len(piece)] = piece


def number(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    """Another number in text: an extreme one, another one of the file, or one digit more or less."""
    found = list(NUMBER.finditer(data, *_window(data, chance)))
    if not found:
        return
    match = chance.choice(found)
    old = match[0]
    new = chance.choice(
        (chance.choice(TOKENS), bytes(chance.choice(found)[0]), old + b"0", old[:-1], b"-" + old, old + b"9" * 40)
    )
    data[match.start() : match.end()] = new


def word(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    """Another word of the file in the place of one, or the word damaged."""
    found = list(WORD.finditer(data, *_window(data, chance)))
    if not found:
        return
    match = chance.choice(found)
    old = match[0]
    new = chance.choice((bytes(chance.choice(found)[0]), old.upper(), old[1:], old + b"x", b"", old * 50, b"\xff\xfe"))
    data[match.start() : match.end()] = new


def line(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    lines = bytes(data).split(b"\n")
    if len(lines) < 3:
        return
    i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
    match chance.randrange(7):
        case 0:
            del lines[i]
        case 1:
            lines.insert(i, lines[j])
        case 2:
            lines[i], lines[j] = lines[j], lines[i]
        case 3:
            lines[i] += lines[j]
        case 4:
            lines[i] = lines[i].replace(*chance.choice(((b" ", b","), (b",", b" "), (b" ", b"\t"), (b" ", b"  "))))
        case 5:
            lines[i] = b" ".join(lines[i].split()[: chance.randrange(4)])
        case _:
            lines[i] = lines[i] + b" 7" * chance.choice((1, 3, 10000))
    data[:] = chance.choice((b"\n",) * 6 + (b"\r\n", b"\r")).join(lines)


def _window(data: bytearray, chance: random.Random) -> tuple[int, int]:
    # Scanning a part is enough, and keeps mutants of large files cheap.
    start = 0 if chance.random() < 0.6 else _place(chance, len(data))
    return start, start + 2000


GENERAL: list[Damage] = [
    flip_bit, set_bytes, cut, remove, repeat, insert, swap_blocks, integer, integer, length, length, real, splice,
    number, word, line,
]  # fmt: skip
TEXT: list[Damage] = [*GENERAL, number, number, number, word, word, line, line, line]


def archive(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    """Damages a member, its name or its place in an archive, and writes the archive anew with right checksums."""
    with zipfile.ZipFile(io.BytesIO(bytes(data))) as source:
        members = [(info.filename, source.read(info), info.compress_type) for info in source.infolist()]
    i = chance.randrange(len(members))
    name, content, packing = members[i]
    match chance.randrange(12):
        case 0:
            del members[i]
        case 1:
            members.append(members[i])
        case 2:
            members[i] = chance.choice(("../x", "/x", "a\0b", "", "x" * 300, name + "/", name[:-4])), content, packing
        case 3:
            members.insert(0, ("first", b"text", zipfile.ZIP_STORED))
        case 4:
            members[i] = name, content, chance.choice((0, 8, 12, 14))
        case 5:
            members[i] = name, chance.choice(members)[1], packing
        case _:
            damaged = bytearray(content)
            if damaged:
                chance.choice(TEXT if _is_text(content) else GENERAL)(damaged, chance, [content])
            members[i] = name, bytes(damaged), packing
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as made:
        for name, content, packing in members:
            info = zipfile.ZipInfo(name or "none")
            # USD wants the content at multiples of 64 bytes, and pads with an extra field of that type.
            gap = -(target.tell() + 30 + len(info.filename.encode()) + 4) % 64
            info.extra = struct.pack("<HH", 0x1986, gap) + bytes(gap)
            info.compress_type = packing
            made.writestr(info, content)
    data[:] = target.getvalue()


def json_text(text: bytes, chance: random.Random) -> bytes:
    """Another value, or none, somewhere in a JSON text."""
    root: Any = json.loads(text)
    places: list[tuple[Any, Any]] = []

    def gather(node: Any) -> None:
        for key in node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            places.append((node, key))
            gather(node[key])

    gather(root)
    node, key = chance.choice(places)
    old = node[key]
    match chance.randrange(6):
        case 0:
            del node[key]
        case 1 if isinstance(old, int):
            node[key] = chance.choice((old + 1, old - 1, -old, 2 * old + 1, old / 2, 10**30))
        case 2:
            other, its = chance.choice(places)
            # A text of it: a value that holds itself has none.
            node[key] = json.loads(json.dumps(other[its])) if other is not old else None
        case 3 if isinstance(old, list):
            node[key] = old * chance.choice((0, 2, 1000))
        case _:
            node[key] = chance.choice((*EXTREMES, -1, 0.5, None, True, "", "x", [], {}, [[]], "../a", "data:,", 1e300))
    return json.dumps(root).encode()


def gltf(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    data[:] = json_text(bytes(data), chance)


def glb(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    """Damages the JSON or the binary chunk and writes right lengths, or a chunk's type or length itself."""
    size = struct.unpack_from("<I", data, 12)[0]
    text, rest = bytes(data[20 : 20 + size]), bytearray(data[20 + size + 8 :])
    kinds = [b"JSON", b"BIN\0"]
    match chance.randrange(6):
        case 0 if rest:
            chance.choice(GENERAL)(rest, chance, [bytes(rest)])
        case 1:
            kinds[chance.randrange(2)] = chance.choice((b"JSON", b"BIN\0", b"none"))
        case _:
            text = json_text(text, chance)
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), kinds[0]) + text + struct.pack("<I4s", len(rest), kinds[1]) + rest
    data[:] = b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def e57(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    """Damages what the pages of an .e57 hold, and writes them with right checksums and the right length."""
    content = bytearray(b"".join(bytes(data[at : at + 1020]) for at in range(0, len(data), 1024)))
    chance.choice([*GENERAL, *TEXT])(content, chance, [bytes(content)])
    content += bytes(-len(content) % 1020 or 1020 * (not content))
    struct.pack_into("<Q", content, 16, len(content) // 1020 * 1024)
    pages = (bytes(content[at : at + 1020]) for at in range(0, len(content), 1020))
    data[:] = b"".join(page + struct.pack(">I", _crc32c(page)) for page in pages)


def _crc32c(page: bytes) -> int:
    found = 0xFFFFFFFF
    for byte in page:
        found = found >> 8 ^ _CRC32C[(found ^ byte) & 0xFF]
    return found ^ 0xFFFFFFFF


def _crc32c_table() -> list[int]:
    table = list(range(256))
    for _ in range(8):
        table = [entry >> 1 ^ 0x82F63B78 * (entry & 1) for entry in table]
    return table


_CRC32C = _crc32c_table()


def _is_text(data: bytes) -> bool:
    return b"\0" not in data[:400]


def gzipped(data: bytearray, chance: random.Random, others: Sequence[bytes]) -> None:
    """Damage what is packed, and pack it again with a right checksum."""
    content = bytearray(gzip.decompress(bytes(data)))
    chance.choice(GENERAL)(content, chance, others or [bytes(content)])
    data[:] = gzip.compress(bytes(content), mtime=0)


def _is_json_object(data: bytes) -> bool:
    with contextlib.suppress(ValueError):
        return data[:1] == b"{" and bool(json.loads(data))
    return False


def folder(beside: dict[str, bytes], chance: random.Random) -> str:
    """Damages a member of a folder, or its name or place in it; returns what was done."""
    name, other = chance.choice(sorted(beside)), chance.choice(sorted(beside))
    content = beside[name]
    texts = [key for key in sorted(beside) if _is_json_object(beside[key])]
    match chance.randrange(10):
        case 0 if len(beside) > 1:
            del beside[name]
            return "member removed"
        case 1:
            beside[name] = beside[other]
            return "member of another"
        case 2:
            renamed = chance.choice(
                ("x", "9.9.9", "DICOMDIR", ".zattrs", "zarr.json", "a\xff", name.rpartition("/")[2] + "0")
            )
            beside[f"{name.rpartition('/')[0]}/{renamed}"] = content
            return "member twice"
        case 3 if len(content) > 400:
            # A field of DICOM: its group, its kind or its length, at an even place behind the preamble.
            damaged = bytearray(content)
            at = chance.randrange(132, len(damaged) - 8) & ~1
            damaged[at : at + 2] = chance.choice(
                (
                    b"SQ",
                    b"UN",
                    b"DS",
                    b"IS",
                    b"OW",
                    b"US",
                    b"\xfe\xff",
                    b"\x00\xe0",
                    b"\xe0\x7f",
                    b"\x28\x00",
                    b"\xff\xff",
                )
            )
            beside[name] = bytes(damaged)
            return "field"
        case 4 | 5 | 6 if texts:
            chosen = chance.choice(texts)
            beside[chosen] = json_text(beside[chosen], chance)
            return "json"
        case _:
            damaged = bytearray(content)
            kind = chance.choice(TEXT if _is_text(content) else GENERAL)
            if damaged:
                kind(damaged, chance, [beside[other] or b"\0"])
            beside[name] = bytes(damaged)
            return kind.__name__


# Damage that knows the container, by extension; half of the mutants of these get it.
CONTAINERS: dict[str, Damage] = {
    ".nii.gz": gzipped,
    ".npz": archive,
    ".3mf": archive,
    ".usdz": archive,
    ".gltf": gltf,
    ".glb": glb,
    ".e57": e57,
}


def mutate(target: Target, sources: Sequence[Original], seed: int) -> Mutant:
    """The mutant of a seed.

    Args:
        target: What the originals are of.
        sources: The originals.
        seed: Any number; it chooses the original and the damage.
    """
    chance = random.Random(f"{target.content}{target.kind}{seed}")
    source = chance.choice(sources)
    if target.kind == ".nvdb" and chance.random() < 0.7:
        return Mutant(source.variant, *mutate_grid(source.data, chance))
    data, beside = bytearray(source.data), dict(source.beside)
    if not data:
        steps = tuple(folder(beside, chance) for _ in range(chance.choice((1, 1, 1, 2, 4))))
        return Mutant(source.variant, b"", beside, False, steps)
    mended, done = False, []
    container = CONTAINERS.get(target.kind)
    if container is not None and chance.random() < 0.6:
        container(data, chance, [])
        mended, done = True, [container.__name__]
    if not mended or chance.random() < 0.1:
        # Half of the mutants of a file that has others beside it are sound: the other is damaged.
        damaged, name = data, ""
        if beside and chance.random() < 0.5:
            name = chance.choice(sorted(beside))
            damaged = bytearray(beside[name])
        others = [original.data for original in sources if original.data]
        for _ in range(chance.choice((1, 1, 1, 2, 4))):
            if damaged:
                kind = chance.choice(TEXT if _is_text(damaged) else GENERAL)
                kind(damaged, chance, others)
                done.append(kind.__name__ + (" beside" if name else ""))
        if name:
            beside[name] = bytes(damaged)
    return Mutant(source.variant, bytes(data), beside, mended, tuple(done))
