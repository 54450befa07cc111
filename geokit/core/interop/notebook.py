"""What a notebook or a browser shows of a mesh, a cloud or a volume."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

from geokit.core.memory.needs import needs

if TYPE_CHECKING:
    from geokit.render._view import Page

__all__ = ["repr_html", "show"]


def repr_html(thing: Any) -> str:
    """Its one-line description, and a small picture if one can be drawn here; for ``_repr_html_``."""
    # geokit itself knows the room that draws, which comes after all others.
    import geokit

    return geokit._picture(thing)  # type: ignore[attr-defined]


def _bytes(thing: Any, *_: Any, **__: Any) -> int:
    """Of the page, and of the color maps' library."""
    import geokit

    library = 0 if "matplotlib" in sys.modules else 30 << 20
    return library + int(geokit.render.view._geokit_bytes(thing))  # type: ignore[attr-defined]


@needs(_bytes, fatal=True)
def show(self: Any, path: str | os.PathLike[str] | None = None) -> Page:
    """Show it in an interactive page; see :func:`geokit.render.view`.

    A notebook shows the page below the cell. Elsewhere it is written to a temporary file and opened in the browser.

    Args:
        path: A .html file that the page is written to instead of being opened.
    Returns:
        Page with the text and the path.
    """
    import geokit

    return geokit._show(self, path)  # type: ignore[attr-defined]
