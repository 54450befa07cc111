"""Meshes and point clouds as the page has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.mesh.model.data import MEANINGS, has_meaning
from geokit.mesh.topology.connectivity import position_corners
from geokit.render.looks.checks import require_drawable, value_range
from geokit.render.looks.painted import SURFACE_COLOR, bytes_of, corner_alpha, corner_colors, is_painted

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.points._io import PointCloud
    from geokit.render.viewer.arrays import Arrays
    from geokit.render.viewer.scene import Frame

__all__ = ["cloud_record", "mesh_record", "require_content"]

_RED, _GREEN, _BLUE = bytes.fromhex(SURFACE_COLOR[1:])
PLAIN = (_RED / 255.0, _GREEN / 255.0, _BLUE / 255.0)
# Arrays of a cloud that are its colors, if they have three or four columns.
COLOR_NAMES = ("color", "colors", "rgb", "rgba")


def mesh_record(mesh: TriangleMesh, name: str, frame: Frame, arrays: Arrays) -> dict[str, Any]:
    corners, position_count = position_corners(mesh)
    tables = (("vertex", mesh.vertex_data), ("face", mesh.face_data), ("corner", mesh.corner_data))
    return {
        "kind": "mesh",
        "name": name,
        "vertices": arrays.add(frame.local(mesh.vertices)),
        "faces": arrays.add(mesh.faces, differences=True),
        # Normals are smooth across vertices at one position.
        "positions": None if corners is mesh.faces else arrays.add(corners, differences=True),
        "position_count": position_count,
        "colors": _mesh_colors(mesh, arrays),
        "attributes": [record for at, data in tables for record in _attributes(data, at, arrays, MEANINGS)],
    }


def cloud_record(cloud: PointCloud, name: str, frame: Frame, arrays: Arrays) -> dict[str, Any]:
    colors = next((key for key in COLOR_NAMES if key in cloud.data and cloud.data[key].shape[1:] in ((3,), (4,))), None)
    return {
        "kind": "cloud",
        "name": name,
        "vertices": arrays.add(frame.local(cloud.points)),
        "colors": None if colors is None else {"at": "vertex", "values": arrays.add(bytes_of(cloud.data[colors]))},
        "attributes": list(_attributes(cloud.data, "vertex", arrays, () if colors is None else (colors,))),
    }


def _mesh_colors(mesh: TriangleMesh, arrays: Arrays) -> dict[str, Any] | None:
    colors = mesh.vertex_data.get("color")
    if not is_painted(mesh):
        return None
    opacity = corner_alpha(mesh)
    alpha = None if opacity is None else arrays.add(np.rint(255.0 * np.clip(opacity, 0.0, 1.0)).astype(np.uint8))
    if colors is not None and has_meaning("color", colors) and not mesh.materials and "color" not in mesh.corner_data:
        return {"at": "vertex", "values": arrays.add(bytes_of(colors)), "alpha": alpha}
    return {"at": "corner", "values": arrays.add(bytes_of(corner_colors(mesh, PLAIN))), "alpha": alpha}


def _attributes(data: Mapping[str, NDArray[Any]], at: str, arrays: Arrays, left_out: Any) -> list[dict[str, Any]]:
    """Arrays that can be shown by a color map: numbers, and vectors by their length."""
    found = []
    axes = 2 if at == "corner" else 1
    for name, values in data.items():
        if name in left_out and (name not in MEANINGS or has_meaning(name, values, axes)):
            continue
        numbers = _numbers(values if values.ndim == axes else np.linalg.norm(values.astype(np.float64), axis=-1))
        low, high = value_range(numbers.astype(np.float64), None)
        record = {"name": name, "at": at, "values": arrays.add(numbers), "low": low, "high": high}
        found.append(record if values.ndim == axes else {**record, "vector": True})
    return found


def _numbers(values: NDArray[Any]) -> NDArray[Any]:
    """Numbers of up to 4 bytes: integers as they are where they fit in int32, all others as float32."""
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind in "iu" and values.size:
        if values.dtype.itemsize <= 4:
            return values
        limits = np.iinfo(np.int32)
        if limits.min <= values.min() and values.max() <= limits.max:
            return values.astype(np.int32)
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def require_content(count: int, bounds: NDArray[np.float64], where: str, what: str) -> None:
    """Refuse what has nothing to draw, or lies beyond float32.

    Raises:
        InputError: The message names ``where``.
    """
    if count == 0:
        raise InputError(f"{where}: has no {what}: there is nothing to draw")
    require_drawable(bounds, where)
