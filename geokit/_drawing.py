"""What draws meshes, clouds and volumes: geokit itself, which knows every room, says it to the rooms below the last.

It is imported with geokit, so that it imports next to nothing.
"""

from __future__ import annotations

from collections.abc import Callable

_functions: list[Callable[..., object]] = []


def drawn_by(picture: Callable[[object], str], show: Callable[[object, object], object]) -> None:
    """From now on these draw: HTML of a thing's line and a small picture, and its page, written to a path or opened."""
    _functions[:] = picture, show


def picture(thing: object) -> object:
    return _functions[0](thing)


def show(thing: object, path: object) -> object:
    return _functions[1](thing, path)
