"""Queries that run while another thread updates their object answer for one of both states, never for a mixture.

``Surface.update`` gives its object a new ``__dict__`` in one assignment and leaves the old one as it is. A query works
on a second object over the ``__dict__`` of its start, so that it needs no lock.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeVar

__all__ = ["on_snapshot", "snapshot"]

_Surface = TypeVar("_Surface")
_Arguments = ParamSpec("_Arguments")
_Answer = TypeVar("_Answer")


def snapshot(surface: _Surface) -> _Surface:
    """A second object with the surface's present state; what either derives from that state, both have."""
    view: Any = object.__new__(type(surface))
    view.__dict__ = surface.__dict__
    return view


def on_snapshot(
    query: Callable[Concatenate[Any, _Arguments], _Answer],
) -> Callable[Concatenate[Any, _Arguments], _Answer]:
    """Make a method run on a snapshot of its object."""

    @functools.wraps(query)
    def run(surface: Any, /, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Answer:
        return query(snapshot(surface), *args, **kwargs)

    return run
