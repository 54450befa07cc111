"""Words that are numbers, as programs in many languages write them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError

_PLAIN = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?", re.ASCII)
_NAN = re.compile(r"[+-]?(?:nan(?:\(\w*\))?|1\.#(?:ind|qnan|snan|nan)\d*)", re.IGNORECASE)
_INFINITE = re.compile(r"([+-]?)(?:inf(?:inity)?|1\.#inf\d*)", re.IGNORECASE)
# For a value that is missing, in spreadsheets and tables of statistics.
_MISSING = {"n/a", "na", "<na>", "null", "none", "#n/a", "#num!", "#div/0!", "#value!", "#ref!", "#name?", "#null!"}
# Exponents of Fortran's double precision.
_EXPONENT = re.compile(rb"(?<=[\d.])[dD](?=[+-]?\d)")


def as_number(word: str) -> float | None:
    """The number that a word stands for, rounded correctly; NaN for the words that say so; None if it is no number."""
    if _PLAIN.fullmatch(word):
        return float(word.replace("D", "E").replace("d", "e"))
    if _NAN.fullmatch(word) or word.lower() in _MISSING:
        return float("nan")
    infinite = _INFINITE.fullmatch(word)
    return float(f"{infinite[1]}inf") if infinite else None


def numbers(tokens: list[bytes], dtype: type, path: Path, what: str) -> NDArray[Any]:
    """Convert tokens to an array of ``dtype``, each rounded correctly.

    Raises:
        FileFormatError: A token is not a number of this type; the message names the token and its position.
    """
    if not tokens:
        return np.zeros(0, dtype)
    try:
        return np.array(tokens, dtype=dtype)
    except (ValueError, OverflowError):
        pass
    whole = np.issubdtype(dtype, np.integer)
    if not whole:
        try:
            # A whole file has such exponents, or none.
            return np.array(_EXPONENT.sub(b"E", b" ".join(tokens)).split(b" "), dtype=dtype)
        except (ValueError, OverflowError):
            pass
    values: NDArray[Any] = np.empty(len(tokens), dtype)
    for at, token in enumerate(tokens):
        try:
            value = int(token) if whole else as_number(token.decode("ascii", "replace"))
            values[at] = np.array(float(token) if value is None else value, dtype=dtype)
        except (ValueError, OverflowError):
            shown = token[:40].decode("ascii", "backslashreplace")
            raise FileFormatError(
                f"{path}: {shown!r} (number {at} of the {what}) is not a number that fits; the file is damaged"
            ) from None
    return values
