"""What public functions take and give, for type checkers: devices, rows, meshes of any library, arrays of answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol, TypeAlias

from numpy.typing import ArrayLike, NDArray

from geokit.core.base.late_warp import wp


class _TypedDevice(Protocol):
    """torch.device."""

    @property
    def type(self) -> str: ...
    @property
    def index(self) -> Any: ...


class _NumberedDevice(Protocol):
    """jax.Device and cupy.cuda.Device."""

    @property
    def id(self) -> int: ...


# Where to compute: an alias ("cpu", "cuda:0"), or a device of warp, torch, JAX or CuPy; None for the first GPU, else
# the CPU. See :func:`geokit.core.launcher.resolve_device`.
Device: TypeAlias = "str | wp.Device | _TypedDevice | _NumberedDevice | None"
# One of these, several, or "cuda:*" for all GPUs.
Devices: TypeAlias = "Device | Sequence[Device]"


class _Exporter(Protocol):
    """Arrays of torch, JAX, CuPy and warp."""

    def __dlpack__(self, *_: Any, **__: Any) -> Any: ...


class _CudaExporter(Protocol):
    """Arrays on a GPU of Numba and others."""

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]: ...


class _Points(Protocol):
    """geokit's PointCloud, pyvista.PolyData, meshio.Mesh and open3d.geometry.PointCloud."""

    @property
    def points(self) -> Any: ...


class _Vertices(Protocol):
    """trimesh.PointCloud."""

    @property
    def vertices(self) -> Any: ...


class _Positions(Protocol):
    """open3d.t.geometry.PointCloud."""

    @property
    def point(self) -> Any: ...


# Rows of numbers, or an object that holds points: :func:`geokit.core.interop.objects.points_of` reads these attributes.
Rows: TypeAlias = "ArrayLike | _Exporter | _CudaExporter | _Points | _Vertices | _Positions"


class _Indexed(_Vertices, Protocol):
    """geokit's TriangleMesh, trimesh.Trimesh, and most others."""

    @property
    def faces(self) -> Any: ...


class _Triangles(_Vertices, Protocol):
    """open3d.geometry.TriangleMesh."""

    @property
    def triangles(self) -> Any: ...


class _Tensors(Protocol):
    """open3d.t.geometry.TriangleMesh."""

    @property
    def vertex(self) -> Any: ...
    @property
    def triangle(self) -> Any: ...


class _Faces(_Points, Protocol):
    """pyvista.PolyData."""

    @property
    def faces(self) -> Any: ...


class _Cells(_Points, Protocol):
    """meshio.Mesh."""

    @property
    def cells(self) -> Any: ...


class _Scene(Protocol):
    """trimesh.Scene."""

    @property
    def geometry(self) -> Any: ...


# What functions take for a mesh, for type checkers: :func:`geokit.core.interop.objects.polygons_of` reads them.
MeshLike: TypeAlias = _Indexed | _Triangles | _Tensors | _Faces | _Cells | _Scene | tuple[Any, Any]


class Array(Protocol):
    """An answer, in the container of the rows: an array of NumPy, torch, JAX, CuPy or warp.

    Checkers know what these share; a number, text, a path or a volume it is not. All else is what the container has:
    ``backward`` of torch, ``at`` of JAX. ``np.asarray`` or ``torch.as_tensor`` tells which one it is.
    """

    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def ndim(self) -> int: ...
    @property
    def dtype(self) -> Any: ...
    def __getattr__(self, name: str, /) -> Any: ...
    def __array__(self) -> NDArray[Any]: ...
    def __dlpack__(self, *_: Any, **__: Any) -> Any: ...
    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[Array]: ...
    def __getitem__(self, key: Any, /) -> Array: ...
    def __setitem__(self, key: Any, value: Any, /) -> None: ...  # not of JAX
    def __float__(self) -> float: ...
    def __int__(self) -> int: ...
    def __index__(self) -> int: ...
    def __add__(self, other: Any, /) -> Array: ...

    __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __add__  # type: ignore[misc]
    __floordiv__ = __mod__ = __pow__ = __rpow__ = __matmul__ = __rmatmul__ = __add__  # type: ignore[misc]
    __and__ = __or__ = __xor__ = __lt__ = __le__ = __gt__ = __ge__ = __add__  # type: ignore[misc]

    def __eq__(self, other: object, /) -> Array: ...  # type: ignore[override]
    def __ne__(self, other: object, /) -> Array: ...  # type: ignore[override]
    def __neg__(self) -> Array: ...
    def __invert__(self) -> Array: ...
    def __abs__(self) -> Array: ...
