"""The page as text: the template with the styles, the scripts and the data in it."""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

from geokit.render.viewer.arrays import Arrays

__all__ = ["page_text"]

_FOLDER = Path(__file__).parent
# One scope, in this order.
SCRIPTS = ("data", "camera", "programs", "surfaces", "volumes", "picking", "panel", "viewer")


def page_text(scene: dict[str, Any], arrays: Arrays, title: str) -> str:
    """The page, all of it ASCII: a text of one byte a character, and safe in any encoding.

    Args:
        scene: The scene, as JSON can hold it.
        arrays: The arrays that it names.
        title: The page's title.
    """
    script = "\n".join(_read(f"{name}.js") for name in SCRIPTS)
    # Within a script element "<" could end it.
    held = json.dumps(scene, allow_nan=False).replace("<", "\\u003c")
    data = "\n".join(
        f'<script type="text/plain" id="array-{number}">{text}</script>' for number, text in enumerate(arrays.texts)
    )
    parts = {
        "title": html.escape(title).encode("ascii", "xmlcharrefreplace").decode("ascii"),
        "style": _read("viewer.css"),
        "scene": held,
        "arrays": data,
        "script": script,
    }
    before, *pieces = _read("viewer.html").split("{{")
    found = [before]
    for piece in pieces:
        name, _, rest = piece.partition("}}")
        found += [parts[name], rest]
    return "".join(found)


def _read(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="ascii")
