"""Names of arrays in files of XML."""

from __future__ import annotations

from xml.sax.saxutils import escape

__all__ = ["xml_name"]


def xml_name(name: str) -> str:
    """A name as text of an XML attribute, which VTK and meshio do not make of it."""
    return escape("".join(sign if sign.isprintable() else "_" for sign in name), {'"': "&quot;"})
