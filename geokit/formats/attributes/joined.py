"""Attributes of the bodies of a file, joined into those of one mesh."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.formats.file_content.body import Body, FileMaterial
from geokit.mesh.attributes.derived import turned_normals
from geokit.mesh.model.data import Material, Texture, full_scale, has_meaning, with_alpha

# Most reasons in a warning.
MOST_NOTES = 5
_KINDS = ("vertex_data", "face_data", "corner_data")


class JoinedData:
    """Collects the attributes of the bodies, one after the other."""

    def __init__(self) -> None:
        self._counts: list[tuple[int, int, int]] = []
        self._pieces: list[tuple[dict[str, NDArray[Any]], ...]] = []
        self._notes: dict[str, None] = {}
        self._first: Body | None = None

    def add(self, body: Body, polygon: NDArray[np.int64], corners: NDArray[np.int64] | None, *, reverse: bool) -> None:
        """Add a body.

        Args:
            body: The body.
            polygon: The polygon of each of its triangles, (T,).
            corners: The place of each corner in the body's indices, (T, 3); None where all polygons are triangles.
            reverse: Whether the corners of all triangles then change their order.
        """
        self._first = self._first or body
        self._notes.update(dict.fromkeys(body.notes))
        self._counts.append((len(body.points), len(polygon), len(polygon)))
        vertex = self._read(body.vertex_data, len(body.points))
        face = {name: values[polygon] for name, values in self._read(body.polygon_data, len(body.counts)).items()}
        corner = self._read(body.corner_data, len(body.indices))
        if corner:
            rows = np.arange(len(body.indices)).reshape(-1, 3) if corners is None else corners
            corner = {name: values[rows[:, ::-1] if reverse else rows] for name, values in corner.items()}
        if body.transform is not None:
            linear = np.asarray(body.transform, np.float64)[:3, :3]
            vertex, face = (dict(turned_normals(data, linear)) for data in (vertex, face))
            corner = dict(turned_normals(corner, linear, axes=2))
        self._pieces.append((vertex, face, corner))

    def arguments(self, path: Path) -> dict[str, Any]:
        """Arguments for the mesh; one warning says what was left out."""
        if self._first is None:
            return {}
        found: dict[str, Any] = {}
        for at, kind in enumerate(_KINDS):
            pieces, counts = [data[at] for data in self._pieces], [count[at] for count in self._counts]
            found[kind] = self._concatenated(pieces, counts, axes=2 if kind == "corner_data" else 1)
        found["materials"] = tuple(map(self._material, self._first.materials))
        found["meters_per_unit"] = self._first.meters_per_unit
        found["up_axis"] = self._first.up_axis
        if self._notes:
            said = list(self._notes)[:MOST_NOTES]
            more = [f"and {len(self._notes) - MOST_NOTES} more"] if len(self._notes) > MOST_NOTES else []
            warn(f"{path}: {'; '.join([*said, *more])}")
        return {name: value for name, value in found.items() if value}

    def _material(self, given: FileMaterial) -> Material:
        color, cutoff = given.color, given.alpha_cutoff
        if color is not None and not (len(color) == 4 and all(map(math.isfinite, color))):
            self._notes[f"the color of material {given.name!r} is left out: it is not four numbers"] = None
            color = None
        if cutoff is not None and not math.isfinite(cutoff):
            self._notes[f"the alpha cutoff of material {given.name!r} is left out: it is no number"] = None
            cutoff = None
        texture = Texture(given.texture_name, given.texture) if given.texture else None
        return Material(given.name, color, texture, cutoff)

    def _read(self, data: Mapping[str, Any], count: int) -> dict[str, NDArray[Any]]:
        read: dict[str, NDArray[Any]] = {}
        for name, given in data.items():
            values, label = np.asarray(given), name.strip() or "unnamed"
            if values.dtype.kind not in "fiub" or not values.ndim or len(values) != count or not values[:1].size:
                if values.size:
                    self._notes[f"the array {label!r} of shape {values.shape} and type {values.dtype} is left out"] = (
                        None
                    )
                continue
            read[label] = values if values.ndim <= 2 else values.reshape(count, -1)
        return read

    def _concatenated(
        self, pieces: list[dict[str, NDArray[Any]]], counts: list[int], axes: int
    ) -> dict[str, NDArray[Any]]:
        joined: dict[str, NDArray[Any]] = {}
        for name in dict.fromkeys(name for data in pieces for name in data):
            held = [data[name] for data in pieces if name in data]
            if all(has_meaning(name, values, axes) for values in held) and name == "color":
                held = _like_colors(held)
            if len({values.shape[axes:] for values in held}) > 1:
                self._notes[f"the array {name!r} is left out: it has not the same width in all bodies"] = None
                continue
            dtype = np.result_type(*held)
            missing = {"f": np.nan, "i": -1 if name == "material" else 0}.get(dtype.kind, 0)
            rows = iter(held)
            joined[name] = np.concatenate(
                [
                    next(rows) if name in data else np.full((count, *held[0].shape[1:]), missing, dtype)
                    for data, count in zip(pieces, counts, strict=True)
                ]
            )
        return joined


def _like_colors(held: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Colors of one scale and with alpha, if one of them has it."""
    if len({values.dtype for values in held}) > 1:
        held = [values / full_scale(values.dtype) if values.dtype.kind in "iu" else values for values in held]
    alpha = max(values.shape[-1] for values in held) == 4
    return [with_alpha(values) if alpha else values for values in held]
