"""What a notebook or a browser shows of a mesh, a cloud or a volume.

The room that draws comes after all others: geokit itself, which knows every room, says here what draws.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from geokit.render._view import Page

__all__ = ["Drawing", "drawn_by", "repr_html", "show"]


class Drawing(NamedTuple):
    """What draws a thing.

    Attributes:
        html: HTML of its line and a small picture.
        show: Makes its page, written to a path or opened.
    """

    html: Callable[[Any], str]
    show: Callable[[Any, str | os.PathLike[str] | None], Page]


_drawing: list[Callable[[], Drawing]] = []


def drawn_by(find: Callable[[], Drawing]) -> None:
    """From now on what ``find`` returns draws; it is asked when something is first drawn, and imports what it needs."""
    _drawing[:] = [find]


def repr_html(thing: Any) -> str:
    """Its one-line description, and a small picture if one can be drawn here; for ``_repr_html_``."""
    return _drawing[0]().html(thing)


def show(self: Any, path: str | os.PathLike[str] | None = None) -> Page:
    """Show it in an interactive page; see :func:`geokit.render.view`.

    A notebook shows the page below the cell. Elsewhere it is written to a temporary file and opened in the browser.

    Args:
        path: A .html file that the page is written to instead of being opened.
    Returns:
        Page with the text and the path.
    """
    return _drawing[0]().show(self, path)
