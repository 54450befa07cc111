"""Content of a mesh file, as its reader returns it. Standard library only: reader processes wait for this import."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

_NOTHING: Mapping[str, Any] = MappingProxyType({})


class FileMaterial(NamedTuple):
    """A material of a file: the fields of geokit's Material, with the texture's name and bytes."""

    name: str
    color: tuple[float, ...] | None = None
    texture_name: str = ""
    texture: bytes = b""
    alpha_cutoff: float | None = None


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
        vertex_data: Arrays with V rows by name; those of a wrong shape or type are left out with a warning.
        polygon_data: Arrays with P rows; ``material`` is a row of the first body's ``materials``, or -1.
        corner_data: Arrays with a row for each of ``indices``.
        materials: Those of the whole file, on its first body.
        meters_per_unit: Length of the file's unit [m], on its first body; None if the file does not say.
        up_axis: The axis that points up, "x", "y" or "z", on its first body; None if the file does not say.
        notes: What was left out and why, for a warning.
    """

    points: Any
    counts: Any
    indices: Any
    name: str = ""
    transform: Any = None
    clockwise: bool = False
    groups: tuple[tuple[str, int, int], ...] = ()
    vertex_data: Mapping[str, Any] = _NOTHING
    polygon_data: Mapping[str, Any] = _NOTHING
    corner_data: Mapping[str, Any] = _NOTHING
    materials: tuple[FileMaterial, ...] = ()
    meters_per_unit: float | None = None
    up_axis: str | None = None
    notes: tuple[str, ...] = ()
