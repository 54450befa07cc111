"""Text as people write it becomes plain: no byte order marks, no blanks that are not seen, lines that end alike."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

from geokit.errors import FileFormatError

# Longer marks first: that of UTF-32 begins with that of UTF-16.
_WIDE = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
# Blanks of other widths, and characters without any, which editors and spreadsheets leave between or inside of words:
# U+00A0, U+1680, U+2000 to U+200A, U+202F, U+205F, U+3000; U+00AD, U+200B to U+200F, U+2060, U+FEFF.
_BLANKS = re.compile(rb"\xc2\xa0|\xe1\x9a\x80|\xe2\x80[\x80-\x8a\xaf]|\xe2\x81\x9f|\xe3\x80\x80")
_NOTHING = re.compile(rb"\xc2\xad|\xe2\x80[\x8b-\x8f]|\xe2\x81\xa0|\xef\xbb\xbf")
# A no-break space of Latin-1, in text that is no UTF-8.
_LATIN_BLANK = re.compile(rb"(?<![\x80-\xff])\xa0(?![\x80-\xbf])")
# Text without a mark shows its zeros this early.
_HEAD = 64


def plain_text(data: bytes, path: Path) -> bytes:
    r"""The text in ASCII or UTF-8, without marks, with plain blanks, and with ``\n`` where lines end with ``\r`` only.

    What is plain comes back as it is. Text in UTF-16 and UTF-32 is converted if it begins with a mark.

    Raises:
        FileFormatError: It begins with a mark of UTF-16 or UTF-32 and is something else, or is UTF-16 without a mark.
    """
    wide = next((name for mark, name in _WIDE if data.startswith(mark)), None)
    if wide is not None:
        try:
            data = data.decode(wide).encode()
        except UnicodeDecodeError:
            raise FileFormatError(
                f"{path}: byte 0 is not text, or text of {wide.upper()} that is damaged; get a whole copy"
            ) from None
    elif _has_zeros(data):
        raise FileFormatError(f"{path}: is text of UTF-16 without a byte order mark; save it as UTF-8")
    if not data.isascii():
        data = _without_signs(data)
    # Old programs of Macintosh, and loggers, end lines so; elsewhere the sign stands before a newline, as a blank.
    if b"\r" in data and data.count(b"\r") != data.count(b"\r\n"):
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data


def without_mark(data: bytes) -> bytes:
    """The bytes behind a byte order mark of UTF-8, for binary files that some program took for text."""
    return data.removeprefix(codecs.BOM_UTF8)


def _has_zeros(data: bytes) -> bool:
    """Whether every second byte is zero at the start, and no other."""
    head = data[:_HEAD]
    halves = head[0::2], head[1::2]
    return len(head) >= 4 and any(not any(half) and all(other) for half, other in (halves, halves[::-1]))


def _without_signs(data: bytes) -> bytes:
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return _LATIN_BLANK.sub(b" ", data.removeprefix(codecs.BOM_UTF8))
    # The bytes of one character never stand within those of others.
    return _NOTHING.sub(b"", _BLANKS.sub(b" ", data))
