"""Which columns of a table are the coordinates, by their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from geokit.core.files import in_one_line
from geokit.errors import FileFormatError

# The unit behind a name: X [m], X(m), X_mm.
_UNIT = re.compile(
    r"\s*[\[({<][^\])}>]*[\])}>]$|(?<=[xyz])[ _/](?:[munk]?m|cm|dm|ft|in|feet|inch(?:es)?|met(?:er|re)s?)$"
)
# Lengths as people write them, and one name for each.
_LENGTHS = {"inch": "in", "inches": "in", "feet": "ft", "foot": "ft", "micron": "um", "microns": "um", "µm": "um"}
_METERS = re.compile(r"met(?:er|re)s?")
_LENGTHS |= {unit: unit for unit in ("nm", "um", "mm", "cm", "dm", "m", "km", "in", "ft")}
_PLACE = re.compile(r"[\[(]([012xyz])[\])]$")
_WORD = "pos|position|point|pnt|coord|coordinate|location|loc|vertex|xyz|cent(?:er|re)|centroid"
# position.x, Points:0, px; x_coord, x position. What stands before belongs to the name.
_VECTOR = re.compile(
    rf"(?P<of>(?:.*[ _.:/\-])?(?:{_WORD})s?)[ _.:/\-]*(?P<axis>[xyz012])|(?P<short>p)(?P<letter>[xyz])"
)
_TURNED = re.compile(rf"(?P<axis>[xyz])[ _.:/\-]?(?P<of>(?:{_WORD}|axis)s?)")
_SIGNS = re.compile(r"[ _.:/\-]+")
_EAST, _NORTH = {"easting", "eastings", "east"}, {"northing", "northings", "north"}
_UP = {"height", "elevation", "elev", "altitude", "alt", "z", "up"}
# ox, dir_z, ray origin.y: what stands before the axis.
_ORIGIN = re.compile(r"|(?:.*[ _.:/\-])?(?:o|p|pos|position|origin|start|source|src|eye|from)s?")
_DIRECTION = re.compile(r"(?:.*[ _.:/\-])?(?:d|dir|direction|heading)s?")
_ANGLES = {"lon", "long", "longitude", "lng"}, {"lat", "latitude"}


def coordinate_columns(names: Sequence[str], path: Path) -> tuple[int, int, int] | None:
    """Places of the columns of x, y and z; None if no names are those of coordinates, or several sets are.

    Known are x, y and z, also with a unit (``X [m]``); the three numbers of a position (``pos_x``, ``position.x``,
    ``Points:0``, ``x_coord``); and easting, northing and a height, also a height beside x and y.

    Raises:
        FileFormatError: The names are those of longitude and latitude, which are angles, or have different units.
    """
    plain = [_plain(name) for name in names]
    for found in (_axes(plain), _vector(plain), _east_north_up(plain)):
        if found is not None:
            units = [_LENGTHS.get(_unit(names[at])) for at in found]
            if len({*units} - {None}) > 1:
                listed = in_one_line(", ".join(names[at] for at in found))
                raise FileFormatError(f"{path}: its columns {listed} are in different units; convert them to one")
            return found
    words = [set(_SIGNS.split(name)) for name in plain]
    if all(any(word & angle for word in words) for angle in _ANGLES):
        raise FileFormatError(
            f"{path}: its columns {in_one_line(', '.join(names))} hold longitudes and latitudes, which are angles; "
            "project them to lengths first, or choose three other columns with columns=(...)"
        )
    return None


def ray_columns(names: Sequence[str]) -> list[int] | None:
    """Places of the columns of origins and directions; None if no names are those of rays, or several sets are.

    Known are a place (ox, x, origin_x, pos.x, start:0) and a direction (dx, dir_x, direction.x).
    """
    plain = [_plain(name) for name in names]
    vectors: dict[str, dict[str, int]] = {}
    for at, name in enumerate(plain):
        match = re.fullmatch(r"(?P<of>.*?)[ _.:/\-]*(?P<axis>[xyz012])", name)
        if match:
            axis = {"0": "x", "1": "y", "2": "z"}.get(match["axis"], match["axis"])
            vectors.setdefault(match["of"], {}).setdefault(axis, at)
    whole = {of: [places[axis] for axis in "xyz"] for of, places in vectors.items() if len(places) == 3}
    origins, directions = ([at for of, at in whole.items() if kind.fullmatch(of)] for kind in (_ORIGIN, _DIRECTION))
    if {"o", "d"} <= whole.keys():
        return [*whole["o"], *whole["d"]]
    return [*origins[0], *directions[0]] if len(origins) == len(directions) == 1 else None


def _plain(name: str) -> str:
    low = _PLACE.sub(r"_\1", name.strip().strip("\"'").lstrip("/#%!").strip().lower())
    return _UNIT.sub("", low)


def _unit(name: str) -> str:
    """The unit behind a name, without what sets it off."""
    found = _UNIT.search(name.strip().strip("\"'").lower())
    return _METERS.sub("m", found[0].strip(" \t_/[](){}<>")) if found else ""


def _only(places: list[int]) -> int | None:
    return places[0] if len(places) == 1 else None


def _triple(*places: int | None) -> tuple[int, int, int] | None:
    a, b, c = places
    return None if a is None or b is None or c is None else (a, b, c)


def _axes(plain: list[str]) -> tuple[int, int, int] | None:
    return _triple(*(_only([at for at, name in enumerate(plain) if name == axis]) for axis in "xyz"))


def _vector(plain: list[str]) -> tuple[int, int, int] | None:
    """The columns of the only vector that is a position."""
    vectors: dict[str, dict[str, int]] = {}
    for at, name in enumerate(plain):
        match = _VECTOR.fullmatch(name) or _TURNED.fullmatch(name)
        if match:
            parts = match.groupdict()
            of, axis = parts["of"] or parts["short"], parts["axis"] or parts["letter"]
            vectors.setdefault(of, {}).setdefault({"0": "x", "1": "y", "2": "z"}.get(axis, axis), at)
    whole = [vector for vector in vectors.values() if len(vector) == 3]
    return (whole[0]["x"], whole[0]["y"], whole[0]["z"]) if len(whole) == 1 else None


def _east_north_up(plain: list[str]) -> tuple[int, int, int] | None:
    words = [set(_SIGNS.split(name)) for name in plain]

    def place(known: set[str]) -> int | None:
        return _only([at for at, word in enumerate(words) if word & known])

    found = _triple(place(_EAST), place(_NORTH), place(_UP))
    letters = [_only([at for at, name in enumerate(plain) if name in known]) for known in ("e", "n", ("h", "u", "z"))]
    across = [_only([at for at, name in enumerate(plain) if name == axis]) for axis in "xy"]
    return found or _triple(*letters) or _triple(*across, place(_UP))
