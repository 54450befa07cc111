"""The triangle mesh that every geokit function takes and gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.object_cache import CacheAttribute
from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.mesh._device_mesh import DeviceArrays

__all__ = ["MeshPart", "TriangleMesh"]


class MeshPart(NamedTuple):
    """A named range of faces, one for each body that was joined into the mesh."""

    name: str
    first_face: int
    face_count: int


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles over shared vertices; the arrays are checked on construction.

    A mesh that was made on a GPU stays there until its arrays are read. The first access to ``vertices`` or ``faces``
    (also by a copy, a pickle, or a function that works on the host) copies both to the host and frees the memory on
    the GPU. Until then a :class:`geokit.mesh.Surface` on that GPU uses the arrays in place and keeps them alive.
    ``vertex_count``, ``face_count``, ``bounds``, ``diagonal`` and ``repr`` do not trigger the copy.

    Args:
        vertices: Vertex positions [world], shape (V, 3); kept as read-only float64.
        faces: Vertex indices of each triangle, shape (F, 3); kept as read-only int32.
        name: A name for files and reports.
        parts: Named face ranges where several bodies were joined; empty for a single body.
    Raises:
        InputError: A wrong shape, a non-finite vertex, or an index outside ``[0, V)``; the first bad row is named.

    Held by: tests/mesh/test_model.py, tests/mesh/test_device_mesh.py
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    name: str = ""
    parts: tuple[MeshPart, ...] = ()
    # Hash, area, pieces, creases: what fields around the mesh have asked for.
    _cache: ClassVar[CacheAttribute] = CacheAttribute()
    # In place of vertices and faces until these are read.
    _on_device: ClassVar[DeviceArrays | None] = None

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
        object.__setattr__(self, "vertices", read_only(vertices))
        object.__setattr__(self, "faces", read_only(faces))
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "parts", tuple(parts))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            # Python calls this only for missing attributes: the arrays of a mesh that is still on a device.
            if name in ("vertices", "faces"):
                self._fetch()
                if name in self.__dict__:
                    return self.__dict__[name]
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __reduce__(self) -> Any:
        return _trusted_mesh, (self.vertices, self.faces, self.name, self.parts)

    def _fetch(self) -> None:
        """Copy both arrays to the host, if they are still on the device, and free the memory there."""
        device_arrays = self._on_device
        if device_arrays is None:
            return
        with device_arrays.lock:
            if self._on_device is None:  # another thread copied them meanwhile
                return
            vertices, faces = device_arrays.download()
            self.__dict__.update(vertices=read_only(vertices), faces=read_only(faces))
            del self.__dict__["_on_device"]

    @property
    def vertex_count(self) -> int:
        """Number of vertices V."""
        device_arrays = self._on_device
        return len(self.vertices) if device_arrays is None else len(device_arrays.vertices)

    @property
    def face_count(self) -> int:
        """Number of faces F."""
        device_arrays = self._on_device
        return len(self.faces) if device_arrays is None else len(device_arrays.faces) // 3

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Bounding box of the vertices that faces use [world], shape (2, 3); NaN for a mesh without faces."""
        device_arrays = self._on_device
        if device_arrays is not None:
            return device_arrays.bounds()
        if len(self.faces) == 0:
            return np.full((2, 3), np.nan)
        used = np.zeros(len(self.vertices), bool)
        used[self.faces.ravel()] = True
        # Axis by axis: a reduction over rows of three is many times slower.
        axes = [axis[used] for axis in self.vertices.T]
        return np.array([[axis.min() for axis in axes], [axis.max() for axis in axes]])

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal [world]; NaN for a mesh without faces."""
        lower, upper = self.bounds
        return float(np.linalg.norm(upper - lower))

    def __repr__(self) -> str:
        label = f"{self.name!r}, " if self.name else ""
        return f"TriangleMesh({label}{self.vertex_count} vertices, {self.face_count} faces)"


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


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    # A view, so that the caller's own array stays writable.
    view = array.view()
    view.flags.writeable = False
    return view


def _trusted_mesh(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], name: str, parts: tuple[MeshPart, ...]
) -> TriangleMesh:
    """A mesh from arrays that were checked before: validating each row again takes longer than copying them."""
    mesh = TriangleMesh.__new__(TriangleMesh)
    mesh.__dict__.update(vertices=read_only(vertices), faces=read_only(faces), name=name, parts=parts)
    return mesh
