"""Text that every terminal prints as it stands; imports nothing of geokit, for the command line starts with it."""

from __future__ import annotations

import re

# Bytes of names that are no UTF-8, but for the control characters among them.
_BYTES = range(0xDCA0, 0xDD00)


def printable(text: str, *, escape_bytes: bool = False) -> str:
    """Text with everything that does not print, line ends among it, as an escape sequence of Python.

    Args:
        text: The text.
        escape_bytes: Also bytes that are no UTF-8 (surrogates); else they stay, for output that writes them as is.
    """
    kept = () if escape_bytes else _BYTES
    return "".join(
        character if character.isprintable() or ord(character) in kept else repr(character)[1:-1] for character in text
    )


def in_one_line(text: str, most: int | None = 300) -> str:
    """Text that may come from a damaged file, as one line that every terminal prints as it stands.

    Args:
        text: Any text: line ends, control characters and bytes in no encoding (surrogates) are escaped.
        most: Number of characters after which it is cut; None for all.
    """
    shown = re.sub(r"\s*[\r\n]\s*", " ", text.strip())[:most]
    return printable(shown, escape_bytes=True)
