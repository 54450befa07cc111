"""Lengths as they are typed, with a unit or in that of the file: 2mm, 0.1in, 2."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, NamedTuple

from cyclopts import Parameter

from geokit.errors import InputError

_LENGTH = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*(\D*)", re.IGNORECASE)


class Length(NamedTuple):
    """A number and its unit; without one it is in that of the file."""

    number: float
    unit: str


def _length(text: str, low: float = 0.0) -> Length:
    found = _LENGTH.fullmatch(text.strip())
    if found is None or not low < float(found[1]) < math.inf:
        raise ValueError(f"{text!r} is no length; give one as in 2, or with its unit as in 2mm")
    return Length(float(found[1]), found[2])


def _places(texts: list[str]) -> list[Length]:
    for text in texts:
        if text.count(",") != 2:
            raise ValueError(f"{text!r} is no place; give x, y and z with commas between, as in 20,0,-8")
    return [_length(axis, -math.inf) for text in texts for axis in text.split(",")]


def _typed(read: Any, **options: Any) -> Parameter:
    def words(_: Any, tokens: Any) -> Any:
        return read([token.value for token in tokens])

    return Parameter(converter=words, n_tokens=1, accepts_keys=False, **options)


# Of sizes, which are above 0. Of places there are three for each.
AnyLength = Annotated[Length, _typed(lambda texts: _length(texts[0]))]
Places = Annotated[list[Length], _typed(_places, negative="", allow_leading_hyphen=True)]
FromUnit = Annotated[str | None, Parameter(help="The unit of a file that does not say its own: mm, cm, m, in, ...")]


def length_in(meters: float | None, length: Length, option: str) -> float:
    """A length in units of ``meters``; None for those of a file that does not say its unit.

    Raises:
        InputError: The length has a unit, and that is unknown, or the file's is.
    """
    if not length.unit:
        return length.number
    from geokit.mesh._transform import meters_in

    unit = meters_in(length.unit, f"--{option}")
    if meters is None:
        said = f"--{option}: {length.number:g}{length.unit} has a unit, and the file does not say its own"
        raise InputError(f"{said}; give --from-unit, or leave the unit out")
    return length.number * (unit / meters)


def lengths_in(meters: float | None, **given: Length | None) -> dict[str, float]:
    """Those of some lengths that are given, by the names of their parameters."""
    return {name: length_in(meters, one, name.replace("_", "-")) for name, one in given.items() if one is not None}


def unit_of(meters: float | None) -> dict[str, str]:
    """The unit of a file for a summary, where it is known."""
    from geokit.formats.objects import UNITS

    return {} if meters is None else {"unit": UNITS.get(meters, (f"{meters:g} m",))[0]}
