"""The triangle mesh that every geokit function takes and gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.errors import InputError

__all__ = ["MeshPart", "TriangleMesh"]


class MeshPart(NamedTuple):
    """A named range of faces, one for each body that was joined into the mesh."""

    name: str
    first_face: int
    face_count: int


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles over shared vertices, checked when made.

    Args:
        vertices: Vertex positions [world], shape (V, 3); kept as read-only float64.
        faces: Vertex indices of each triangle, shape (F, 3); kept as read-only int32.
        name: A name for files and reports.
        parts: Named face ranges where several bodies were joined; empty for a single body.
    Raises:
        InputError: A wrong shape, a non-finite vertex, or an index outside ``[0, V)``; the first bad row is named.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    name: str = ""
    parts: tuple[MeshPart, ...] = ()

    def __init__(
        self, vertices: ArrayLike, faces: ArrayLike, *, name: str = "", parts: tuple[MeshPart, ...] = ()
    ) -> None:
        vertices = _table(vertices, "vertices", np.float64)
        faces = _indices(faces, len(vertices))
        bad = ~np.isfinite(vertices).all(axis=1)
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                f"vertices: row {row} is not finite ({vertices[row].tolist()}); remove it and the faces that use it"
            )
        object.__setattr__(self, "vertices", _read_only(vertices))
        object.__setattr__(self, "faces", _read_only(faces))
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "parts", tuple(parts))

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Box around the vertices that faces use [world], shape (2, 3); NaN where there are no faces."""
        if len(self.faces) == 0:
            return np.full((2, 3), np.nan)
        used = np.zeros(len(self.vertices), bool)
        used[self.faces.ravel()] = True
        # Axis by axis: a reduction over rows of three is many times slower.
        axes = [axis[used] for axis in self.vertices.T]
        return np.array([[axis.min() for axis in axes], [axis.max() for axis in axes]])

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal [world]; NaN where there are no faces."""
        lower, upper = self.bounds
        return float(np.linalg.norm(upper - lower))

    def __repr__(self) -> str:
        label = f"{self.name!r}, " if self.name else ""
        return f"TriangleMesh({label}{len(self.vertices)} vertices, {len(self.faces)} faces)"


def _table(values: ArrayLike, name: str, dtype: Any) -> NDArray[Any]:
    try:
        table = np.ascontiguousarray(values, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: cannot be read as numbers ({error})") from error
    if table.size == 0:
        table = table.reshape(0, 3)
    if table.ndim != 2 or table.shape[1] != 3:
        raise InputError(f"{name}: shape {table.shape} is not (N, 3); give one row of three for each")
    return table


def _indices(values: ArrayLike, vertex_count: int) -> NDArray[np.int32]:
    given = np.asarray(values)
    if given.size and given.dtype.kind not in "iu":
        raise InputError(f"faces: dtype {given.dtype} is not an integer type; convert the indices to int32")
    faces = _table(given, "faces", given.dtype if given.size else np.int32)
    bad = ((faces < 0) | (faces >= vertex_count)).any(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"faces: row {row} is {faces[row].tolist()}, outside the {vertex_count} vertices; "
            "indices count from 0 to V - 1"
        )
    return np.ascontiguousarray(faces, dtype=np.int32)


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    # A view, so that an array which belongs to the caller stays writable for the caller.
    view = array.view()
    view.flags.writeable = False
    return view
