"""Content of a mesh file, as its reader returns it. Standard library only: reader processes wait for this import."""

from __future__ import annotations

from typing import Any, NamedTuple

__all__ = ["Body"]


class Body(NamedTuple):
    """One body of a file. Arrays are NumPy's, or in a reader process any object with a buffer of numbers.

    Args:
        points: Vertex positions in the body's own frame, shape (V, 3).
        counts: Number of corners of each polygon, shape (P,).
        indices: Vertex indices of all corners, polygon after polygon, shape (sum(counts),).
        name: The file's name for the body.
        transform: Matrix (4, 4) from the body's frame to the world, for column vectors; None is the identity.
        clockwise: The file winds its polygons clockwise as seen from outside.
        groups: (name, first polygon, polygon count) of the named parts; empty if the body is one part.
    """

    points: Any
    counts: Any
    indices: Any
    name: str = ""
    transform: Any = None
    clockwise: bool = False
    groups: tuple[tuple[str, int, int], ...] = ()
