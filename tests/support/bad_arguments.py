"""Values that users pass by mistake, each with the kinds of parameters for which it may be right after all."""

from __future__ import annotations

import decimal
import fractions
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyvista
import trimesh
import warp as wp

import geokit as gk

__all__ = ["BAD", "NUMBERS", "Bad"]


class Bad(NamedTuple):
    """A value.

    Attributes:
        make: Makes it, from a valid mesh, a valid volume and an empty folder.
        fits: Kinds of parameters that may take it: text, path, flag, count, number, numbers (tables and rows of them),
            object (of a class of geokit), mapping, sequence, picture, device, devices, dtype, callable, none.
    """

    make: Callable[[gk.mesh.TriangleMesh, gk.volume.SparseVolume, Path], Any]
    fits: frozenset[str]


class Raising:
    """An object whose every protocol fails in its own way."""

    def _fail(self, *_: Any, **__: Any) -> Any:
        raise ZeroDivisionError("this object fails")

    __array__ = __bool__ = __eq__ = __float__ = __fspath__ = __index__ = __int__ = __iter__ = __len__ = _fail
    __dlpack__ = __dlpack_device__ = __repr__ = __str__ = keys = _fail
    __hash__ = None  # type: ignore[assignment]


class WrongArray:
    """An object with an array interface of nonsense."""

    @property
    def __array_interface__(self) -> dict[str, Any]:
        return {"shape": (2, 3), "typestr": "<f8", "data": "nowhere", "version": 3}


class WrongCuda:
    """An object with an interface of CUDA memory that is not there."""

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        return {"shape": (1, 3), "typestr": "<f8", "data": (8, False), "version": 3}


class WrongPath:
    def __fspath__(self) -> Any:
        return 3


class LyingNumber:
    def __float__(self) -> Any:
        return "3"

    def __index__(self) -> Any:
        return "3"


def _counting() -> Iterator[int]:
    yield from range(3)


def _cyclic() -> list[Any]:
    found: list[Any] = []
    found.append(found)
    return found


def _masked(_mesh: Any, _volume: Any, _folder: Path) -> Any:
    return np.ma.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], mask=[[1, 1, 1], [0, 0, 0]])


def _rows(value: float) -> Callable[..., Any]:
    return lambda *_: np.full((1, 3), value)


def _always(value: Any) -> Callable[..., Any]:
    return lambda *_: value


def _bad_volume(_mesh: Any, volume: gk.volume.SparseVolume, _folder: Path) -> Any:
    return gk.volume.SparseVolume(np.zeros(4096, np.uint8), volume.info)


def _table(*kinds: str) -> dict[str, frozenset[str]]:
    return {kind: frozenset({kind}) for kind in kinds}


# By kinds of parameters that may take them. A value that may be taken is still refused where it is out of range.
_BY_KINDS: dict[str, dict[str, Callable[..., Any]]] = {
    "none": {"None": _always(None)},
    "flag": {"True": _always(True), "numpy.False_": _always(np.False_)},
    "count number numbers": {
        "-1": _always(-1),
        "0": _always(0),
        "2**31": _always(2**31),
        "2**63": _always(2**63),
        "10**400": _always(10**400),
        "10**5000": _always(10**5000),
        "numpy.int64(-3)": _always(np.int64(-3)),
        "numpy.uint8(3)": _always(np.uint8(3)),
    },
    "number numbers": {
        "0.5": _always(0.5),
        "-0.0": _always(-0.0),
        "1e-320": _always(1e-320),
        "1e6": _always(1e6),
        "1e200": _always(1e200),
        "-1e308": _always(-1e308),
        "inf": _always(np.inf),
        "Decimal": _always(decimal.Decimal("1.5")),
        "Fraction": _always(fractions.Fraction(1, 3)),
        "numpy.float32(2.5)": _always(np.float32(2.5)),
        "array of no dimension": _always(np.array(1.5)),
    },
    "": {
        "nan": _always(np.nan),
        "numpy.nan": _always(np.float32(np.nan)),
        "array of nan": _always(np.array(np.nan)),
        "1j": _always(1j),
        "numpy.complex64": _always(np.complex64(1)),
        "Decimal nan": _always(decimal.Decimal("nan")),
        "datetime64": _always(np.datetime64("2020-01-01")),
        "timedelta64": _always(np.timedelta64(3, "s")),
        "Ellipsis": _always(...),
        "NotImplemented": _always(NotImplemented),
        "object": lambda *_: object(),
        "raising": lambda *_: Raising(),
        "lying number": lambda *_: LyingNumber(),
        "wrong path": lambda *_: WrongPath(),
        "wrong array": lambda *_: WrongArray(),
        "wrong cuda array": lambda *_: WrongCuda(),
        "module": _always(np),
        "slice": _always(slice(3)),
        "ragged list": lambda *_: [[1.0, 2.0, 3.0], [1.0]],
        "cyclic list": lambda *_: _cyclic(),
        "list of lists of text": lambda *_: [["1", "2", "3"]],
        "rows of inf": _rows(np.inf),
        "rows of complex": lambda *_: np.ones((2, 3), complex),
        "rows of objects": lambda *_: np.array([[1.0, None, "x"]], object),
        "rows of Decimal": lambda *_: np.full((2, 3), decimal.Decimal(1), object),
        "rows of datetime64": lambda *_: np.zeros((2, 3), "datetime64[s]"),
        "structured array": lambda *_: np.zeros(2, [("x", float), ("y", float), ("z", float)]),
        "masked rows": _masked,
        "numpy.ma.masked": _always(np.ma.masked),
        "array of no dimension, object": lambda *_: np.array(None, object),
        "five dimensions": lambda *_: np.zeros((1, 1, 1, 1, 3)),
        "volume of nothing": lambda *_: gk.volume.SparseVolume(b"", None),  # type: ignore[arg-type]
    },
    "devices": {"list of None": lambda *_: [None, None, None]},
    "picture": {
        "rows of nan": _rows(np.nan),
        "rows of bool": lambda *_: np.ones((2, 3), bool),
        "warp array of bool": lambda *_: wp.zeros((2, 3), dtype=wp.bool, device="cpu"),
        "warp array of quaternions": lambda *_: wp.zeros(2, dtype=wp.quatf, device="cpu"),
    },
    "text path": {"text": _always("1.0"), "empty text": _always(""), "numpy.str_": _always(np.str_("nan"))},
    "text path control": {"zero byte": _always("a\0b.ply"), "surrogate": _always("\ud800.ply")},
    "path": {
        "bytes": _always(b"1"),
        "folder": lambda mesh, volume, folder: folder,
        "missing file": lambda mesh, volume, folder: folder / "missing" / "x.ply",
    },
    "text path name": {"~": _always("~/x.nothing"), "long path": _always("x" * 5000 + ".ply")},
    "bytes": {"bytearray": lambda *_: bytearray(b"1.5"), "memoryview": lambda *_: memoryview(b"1.5")},
    "sequence mapping numbers": {"empty list": lambda *_: [], "empty tuple": _always(())},
    "sequence": {"set": _always({1, 2})},
    "sequence mapping": {"empty dict": lambda *_: {}},
    "mapping": {"dict of numbers": lambda *_: {1: 2}, "dict of text": lambda *_: {"a": "b"}},
    "sequence numbers": {
        "list": lambda *_: [1.0, 2.0],
        "no rows": lambda *_: np.zeros((0, 3)),
        "list of text": lambda *_: ["a", "b"],
        "range": _always(range(3)),
        "generator": lambda *_: _counting(),
    },
    "numbers": {
        "rows of two": lambda *_: np.zeros((2, 2)),
        "rows of 1e200": _rows(1e200),
        "rows of -1e308": _rows(-1e308),
        "rows of 1e-320": _rows(1e-320),
        "rows of longdouble": lambda *_: np.ones((2, 3), np.longdouble),
        "rows of float16": lambda *_: np.ones((2, 3), np.float16),
        "rows backward": lambda *_: np.ones((2, 3))[::-1, ::-1],
        "rows big-endian": lambda *_: np.ones((2, 3), ">f4"),
        "rows of int": lambda *_: np.zeros((2, 3), np.int64),
        "box upside down": lambda *_: np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]),
        "zeros (4, 4)": lambda *_: np.zeros((4, 4)),
        "warp array": lambda *_: wp.zeros(2, dtype=wp.vec3, device="cpu"),
    },
    "callable": {"function": _always(lambda *_: 3), "raising function": lambda *_: Raising()._fail},
    "dtype callable": {"class": _always(int)},
    "dtype text path": {"dtype": _always("float32")},
    "object": {
        "mesh": lambda mesh, volume, folder: mesh,
        "surface": lambda mesh, volume, folder: gk.mesh.Surface(mesh, device="cpu"),
        "mesh without faces": lambda *_: gk.mesh.TriangleMesh(np.zeros((3, 3)), np.zeros((0, 3), int)),
        "mesh without area": lambda *_: gk.mesh.TriangleMesh(np.ones((3, 3)), [[0, 1, 2]]),
        "mesh of 1e200": lambda mesh, volume, folder: gk.mesh.TriangleMesh(mesh.vertices * 1e200, mesh.faces),
        "mesh of 1e-200": lambda mesh, volume, folder: gk.mesh.TriangleMesh(mesh.vertices * 1e-200, mesh.faces),
        "mesh at 1e15": lambda mesh, volume, folder: gk.mesh.TriangleMesh(mesh.vertices + 1e15, mesh.faces),
        "volume": lambda mesh, volume, folder: volume,
        "volume of zeros": _bad_volume,
        "volume of int64": lambda *_: gk.volume.from_dense(np.ones((2, 2, 2), np.int64), voxel_size=1.0),
        "volume of vec3f": lambda *_: gk.volume.from_dense(np.ones((2, 2, 2, 3), np.float32), voxel_size=1.0),
        "volume of nothing active": lambda *_: gk.volume.from_dense(np.zeros((2, 2, 2)), voxel_size=1.0),
    },
    "object numbers": {
        "points": lambda *_: gk.points.PointCloud(np.zeros((2, 3))),
        "mesh of trimesh": lambda *_: trimesh.creation.box(),
        "cloud of trimesh": lambda *_: trimesh.PointCloud(np.zeros((2, 3))),
        "pair of arrays": lambda *_: (np.eye(3), np.array([[0, 1, 2]])),
    },
    "object numbers sequence": {"image of pyvista": lambda *_: pyvista.ImageData(dimensions=(2, 2, 2))},
    "device text path": {"no device": _always("cuda:77"), "cpu": _always("cpu")},
}

BAD: dict[str, Bad] = {
    name: Bad(make, frozenset(kinds.split())) for kinds, values in _BY_KINDS.items() for name, make in values.items()
}
NUMBERS = frozenset({"count", "number", "numbers"})
