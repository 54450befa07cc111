"""Queries that run while another thread updates their object answer for one of both states, never for a mixture.

``Surface.update`` gives its object a new ``__dict__`` in one assignment and leaves the old one as it is. A query works
on a second object over the ``__dict__`` of its start, so that it needs no lock.
"""

from __future__ import annotations

from typing import Any, TypeVar

_Surface = TypeVar("_Surface")


def snapshot(surface: _Surface) -> _Surface:
    """A second object with the surface's present state; what either derives from that state, both have."""
    view: Any = object.__new__(type(surface))
    view.__dict__ = surface.__dict__
    return view
