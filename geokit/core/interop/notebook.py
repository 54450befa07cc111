"""What a notebook or a browser shows of a mesh, a cloud or a volume."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from geokit import _drawing

if TYPE_CHECKING:
    from geokit.render._view import Page


def repr_html(thing: object) -> str:
    """Its one-line description, and a small picture if one can be drawn here; for ``_repr_html_``."""
    return _drawing.picture(thing)  # type: ignore[return-value]


def show(self: object, path: str | os.PathLike[str] | None = None) -> Page:
    """Show it in an interactive page; see :func:`geokit.render.view`.

    A notebook shows the page below the cell. Elsewhere it is written to a temporary file and opened in the browser.

    Args:
        path: A .html file that the page is written to instead of being opened.
    Returns:
        Page with the text and the path.
    """
    return _drawing.show(self, path)  # type: ignore[return-value]
