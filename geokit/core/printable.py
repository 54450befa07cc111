"""Text that every terminal prints as it stands; imports nothing, for the command line starts with it."""

from __future__ import annotations

__all__ = ["printable"]


# Bytes of names that are no UTF-8, but for the control characters among them.
_BYTES = range(0xDCA0, 0xDD00)


def printable(text: str) -> str:
    """Text with everything that does not print, line ends among it, as an escape sequence of Python."""
    return "".join(
        character if character.isprintable() or ord(character) in _BYTES else repr(character)[1:-1]
        for character in text
    )
