"""The triangle mesh that every geokit function takes and gives."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.base.object_cache import CacheAttribute
from geokit.core.interop.notebook import repr_html, show
from geokit.core.memory.needs import needs
from geokit.core.require import (
    described,
    read_array,
    require_choice,
    require_count,
    require_items,
    require_number,
    require_text,
)
from geokit.errors import InputError
from geokit.mesh.model.data import NOTHING, Data, Material, checked_data, checked_materials, read_only

if TYPE_CHECKING:
    from geokit.mesh.model.device_mesh import DeviceArrays


class MeshPart(NamedTuple):
    """A named range of faces, one for each body that was joined into the mesh.

    Attributes:
        name: The name of the body.
        first_face, face_count: It has the faces from ``first_face`` to before ``first_face + face_count``.
    """

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

    Attributes are arrays of any name on vertices, faces and corners. These names have a meaning if they have this
    shape: ``normal`` (.., 3), ``uv`` (.., 2) from the lower left corner of the image, ``color`` (.., 3 or 4), full at 1
    or at the largest number of an integer type, and on faces ``material``, a row of ``materials`` or -1.

    Two meshes are equal if all of this is equal, names included. ``len(mesh)`` is the number of faces.

    Args:
        vertices: Vertex positions [world], shape (V, 3); kept as read-only float64.
        faces: Vertex indices of each triangle, shape (F, 3); kept as read-only int32.
        name: A name for files and reports.
        parts: Named face ranges where several bodies were joined; empty for a single body.
        vertex_data: Numbers or bools by name, shape (V,) or (V, k); kept read-only, in their type.
        face_data: The same for faces, shape (F,) or (F, k).
        corner_data: The same for corners, shape (F, 3) or (F, 3, k); corner k of face f is that at ``faces[f, k]``.
        materials: Materials that ``face_data["material"]`` counts.
        meters_per_unit: Length of the world's unit [m]; None where it is not known.
        up_axis: The axis that points up, "x", "y" or "z"; None where it is not known.
    Raises:
        InputError: A wrong shape, a non-finite vertex, or an index outside ``[0, V)``; the first bad row is named.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    name: str = ""
    parts: tuple[MeshPart, ...] = ()
    vertex_data: Data = field(default_factory=dict)
    face_data: Data = field(default_factory=dict)
    corner_data: Data = field(default_factory=dict)
    materials: tuple[Material, ...] = ()
    meters_per_unit: float | None = None
    up_axis: str | None = None
    # Hash, area, pieces, creases: what fields around the mesh have asked for.
    _cache: ClassVar[CacheAttribute] = CacheAttribute()
    # In place of vertices and faces until these are read.
    _on_device: ClassVar[DeviceArrays | None] = None

    @needs()
    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        name: str = "",
        parts: tuple[MeshPart, ...] = (),
        vertex_data: Mapping[str, ArrayLike] | None = None,
        face_data: Mapping[str, ArrayLike] | None = None,
        corner_data: Mapping[str, ArrayLike] | None = None,
        materials: Sequence[Material] = (),
        meters_per_unit: float | None = None,
        up_axis: str | None = None,
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
        object.__setattr__(self, "name", require_text(name, "name"))
        object.__setattr__(
            self, "parts", parts if type(parts) is tuple and not parts else _checked_parts(parts, len(faces))
        )
        count = len(faces)
        found: dict[str, Any] = {
            "vertex_data": checked_data(vertex_data, "vertex_data", (len(vertices),), "vertices"),
            "face_data": checked_data(face_data, "face_data", (count,), "faces"),
            "corner_data": checked_data(corner_data, "corner_data", (count, 3), "faces"),
            "meters_per_unit": None if meters_per_unit is None else _checked_unit(meters_per_unit),
            "up_axis": None if up_axis is None else require_choice(up_axis, "up_axis", ("x", "y", "z")),
        }
        found["materials"] = checked_materials(materials, found["face_data"])
        self.__dict__.update(found)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            # Python calls this only for missing attributes: the arrays of a mesh that is still on a device.
            if name in ("vertices", "faces"):
                self._fetch()
                if name in self.__dict__:
                    return self.__dict__[name]
            elif name in _MORE:  # meshes that only have vertices and faces do not store them
                return NOTHING
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __reduce__(self) -> Any:
        given = {name: value for name in _MORE if (value := getattr(self, name))}
        more = {name: dict(value) if isinstance(value, MappingProxyType) else value for name, value in given.items()}
        return trusted_mesh, (self.vertices, self.faces, self.name, self.parts, more)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TriangleMesh):
            return NotImplemented
        names = ("name", "parts", "materials", "meters_per_unit", "up_axis")
        return self is other or (
            (self.vertex_count, self.face_count) == (other.vertex_count, other.face_count)
            and all(getattr(self, name) == getattr(other, name) for name in names)
            and all(_same(getattr(self, name), getattr(other, name)) for name in _MORE[:3])
            and np.array_equal(self.faces, other.faces)
            and np.array_equal(self.vertices, other.vertices)
        )

    def __hash__(self) -> int:
        # Equal meshes must have one hash; reading all vertices for more than that would cost more than it saves.
        return hash((self.vertex_count, self.face_count, self.name))

    def __len__(self) -> int:
        return self.face_count

    def __bool__(self) -> bool:
        # As of any object: a mesh without faces is a mesh.
        return True

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
        axes = list(self.vertices.T) if used.all() else [axis[used] for axis in self.vertices.T]
        return np.array([[axis.min() for axis in axes], [axis.max() for axis in axes]])

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal [world]; NaN for a mesh without faces."""
        return math.dist(*self.bounds)

    @property
    def area(self) -> float:
        """Sum of the triangles' areas [world^2], as in :func:`geokit.mesh.audit`."""
        return self._measures()[0]

    @property
    def volume(self) -> float:
        """Signed volume [world^3], positive where faces wind counterclockwise seen from outside.

        It means something only for closed and oriented meshes; see :func:`geokit.mesh.audit`.
        """
        return self._measures()[1]

    def _measures(self) -> tuple[float, float]:
        from geokit.mesh.topology.audit import area_and_volume
        from geokit.mesh.topology.measures import measure_faces

        return self._cache.find("measures", lambda: area_and_volume(measure_faces(self, self.bounds)))

    @property
    def face_normals(self) -> NDArray[np.float64]:
        """Unit normals of the triangles from their positions, (F, 3); zero without area."""
        from geokit.mesh.topology.normals import face_normals

        return face_normals(self)

    @property
    def vertex_normals(self) -> NDArray[np.float64]:
        """Unit normals of the vertices from the positions, (V, 3): the faces' by their angles; zero without faces.

        Vertices at one position have one normal. Normals of a file are in ``vertex_data`` or ``corner_data``.
        """
        from geokit.mesh.topology.normals import vertex_normals

        return vertex_normals(self)

    @needs(lambda self, *_, **__: 56 * self.vertex_count)
    def transform(self, matrix: ArrayLike) -> TriangleMesh:
        """The mesh under an affine map ``matrix``, shape (4, 4); see :func:`geokit.mesh.transform`."""
        from geokit.mesh._transform import transform

        return transform(self, matrix)

    _repr_html_ = repr_html
    show = show

    def __repr__(self) -> str:
        label = f"{self.name!r}, " if self.name else ""
        kinds = {"vertex": self.vertex_data, "face": self.face_data, "corner": self.corner_data}
        held = [f"{kind} {' '.join(data)}" for kind, data in kinds.items() if data]
        more = "".join(f", {text}" for text in [*held, *([f"{len(self.materials)} materials"] * bool(self.materials))])
        return f"TriangleMesh({label}{self.vertex_count} vertices, {self.face_count} faces{more})"


# Attributes that only some meshes have.
_MORE = ("vertex_data", "face_data", "corner_data", "materials", "meters_per_unit", "up_axis")


def _same(one: Data, other: Data) -> bool:
    """Whether both have the same arrays, types included; NaN equals NaN."""
    return one.keys() == other.keys() and all(
        values.dtype == other[name].dtype and np.array_equal(values, other[name], equal_nan=values.dtype.kind == "f")
        for name, values in one.items()
    )


def _checked_unit(value: Any) -> float:
    number = require_number(value, "meters_per_unit")
    if not 0.0 < number < np.inf:
        raise InputError(f"meters_per_unit: {described(value)} is not a length; give meters, as in 0.001")
    return number


def _table(values: ArrayLike, name: str, dtype: Any) -> NDArray[Any]:
    table = np.ascontiguousarray(read_array(values, name), dtype=dtype)
    if table.size == 0 and table.ndim <= 2:
        table = table.reshape(0, 3)
    if table.ndim != 2 or table.shape[1] != 3:
        raise InputError(f"{name}: shape {table.shape} is not (N, 3); give one row of three for each")
    return table


def _indices(values: ArrayLike, vertex_count: int) -> NDArray[np.int32]:
    given = read_array(values, "faces")
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


def _checked_parts(parts: Any, face_count: int) -> tuple[MeshPart, ...]:
    found = require_items(parts, "parts", MeshPart)
    for row, part in enumerate(found):
        require_text(part.name, f"parts[{row}].name")
        first = require_count(part.first_face, f"parts[{row}].first_face", 0, face_count)
        require_count(part.face_count, f"parts[{row}].face_count", 0, face_count - first)
    return tuple(found)


def trusted_mesh(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    name: str,
    parts: tuple[MeshPart, ...],
    more: dict[str, Any] | None = None,
) -> TriangleMesh:
    """A mesh from arrays that were checked before: validating each row again takes longer than copying them.

    Args:
        vertices: Shape (V, 3), float64.
        faces: Shape (F, 3), int32.
        name: The name.
        parts: The parts.
        more: Data on vertices, faces and corners, materials, meters_per_unit and up_axis, by their names.
    """
    mesh = TriangleMesh.__new__(TriangleMesh)
    mesh.__dict__.update(vertices=read_only(vertices), faces=read_only(faces), name=name, parts=parts)
    for key, value in (more or {}).items():
        if isinstance(value, Mapping):
            value = MappingProxyType({of: read_only(values) for of, values in value.items()})
        mesh.__dict__[key] = value
    return mesh
