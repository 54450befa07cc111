"""What geokit answers, as one hash for each call: ``python benchmarks/answers.py [--device cpu] [--out FILE]``.

For changes that must not change an answer. Write the lines before the change and compare them afterwards, on the same
machine::

    python benchmarks/answers.py --out before.txt
    python benchmarks/answers.py --compare before.txt

A line is ``name hash``. The hash covers types, names, data types, shapes and bytes of everything that a call returns,
or type and message of the error that it raises. Calls that need OpenVDB or a package that is not installed are
``unavailable``, and any other error is ``ERROR``; neither ends the run.

Only public names are called, so that the file runs unchanged before and after the insides are rearranged. Inputs are
made of sums, products and square roots, which every machine rounds alike, and of seeded random numbers.

Left out, since they are not the same twice: times (``seconds`` of :func:`geokit.volume.plan`, what
:mod:`geokit.accuracy` measures), bytes of .vdb, .3mf, .usdc and .las files (random identifiers, dates), bytes of .nvdb
files that Blosc compressed (blocks in the order in which its threads end), and figures.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import dataclasses
import functools
import hashlib
import importlib.util
import inspect
import json
import lzma
import math
import os
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import geokit as gk
from geokit import native

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / "data" / "samples"
# Hexadecimal digits of a hash that a line shows.
DIGITS = 16
UNAVAILABLE, ERROR = "unavailable", "ERROR"
# What a row needs that is no package.
OPENVDB = "OpenVDB"

wp.set_module_options({"enable_backward": False})


class Row(NamedTuple):
    """A line: its name, the call, and the packages that the call needs besides geokit's own."""

    name: str
    call: Callable[[], Any]
    needs: tuple[str, ...] = ()


Rows = Iterator[Row]


# ---------------------------------------------------------------------------------------------------------------------
# Hashes


class Hasher:
    """SHA-256 of anything that geokit returns; folders of this run are replaced in texts."""

    def __init__(self, folder: Path, left_out: frozenset[str] = frozenset()) -> None:
        self._left_out = left_out
        package = Path(gk.__file__).resolve().parents[1]
        # The longest first: one may lie in the other.
        folders = {str(folder): "<tmp>", str(folder.resolve()): "<tmp>", str(ROOT): "<root>", str(package): "<root>"}
        self._folders = sorted(folders.items(), key=lambda pair: -len(pair[0]))

    def of(self, value: Any) -> str:
        digest = hashlib.sha256()
        for part in self._parts(value):
            digest.update(part)
        return digest.hexdigest()[:DIGITS]

    def text(self, text: str) -> str:
        for folder, name in self._folders:
            text = text.replace(folder, name)
        # Folders are numbered as rows ask for them, and not every run has every row.
        return re.sub(r"<tmp>/\d+", "<tmp>", text)

    def _parts(self, value: Any) -> Iterator[bytes]:
        kind = type(value).__name__
        if isinstance(value, (str, Path)):
            yield self._words("text", self.text(str(value)))
        elif value is None or isinstance(value, (bool, int)):
            yield self._words(kind, repr(value))
        elif isinstance(value, float) and not isinstance(value, np.generic):
            yield self._words(kind, value.hex())
        elif isinstance(value, (bytes, bytearray)):
            yield self._words(kind, str(len(value)))
            yield bytes(value)
        elif isinstance(value, (np.ndarray, np.generic)):
            array = np.asarray(value)
            if array.dtype.hasobject:
                raise TypeError("arrays of objects have no bytes of their own")
            yield self._words("array", array.dtype.str, str(array.dtype.names), str(array.shape))
            yield array.tobytes()
        elif isinstance(value, wp.array):
            # A GPU's name does not matter, that the array is on a GPU does.
            place = "cuda" if value.device.is_cuda else "cpu"
            yield self._words("warp array", str(value.dtype.__name__), str(value.shape), place)
            yield np.ascontiguousarray(value.numpy()).tobytes()
        elif isinstance(value, BaseException):
            yield self._words("error", kind, self.text(str(value)))
        elif isinstance(value, Mapping):
            yield self._words("mapping", str(len(value)))
            for key, item in value.items():
                yield from self._parts(key)
                yield from self._parts(item)
        elif isinstance(value, (tuple, list)):
            names = ",".join(getattr(value, "_fields", ()))
            yield self._words(kind, str(len(value)), names)
            for item in value:
                yield from self._parts(item)
        elif dataclasses.is_dataclass(value):
            names = [field.name for field in dataclasses.fields(value)]
            names += sorted(name for name, entry in inspect.getmembers(type(value)) if isinstance(entry, property))
            names = [name for name in names if not name.startswith("_") and name not in self._left_out]
            yield self._words(kind, *names)
            for name in names:
                yield from self._parts(getattr(value, name))
        else:
            raise TypeError(f"a {kind} has no hash here")

    @staticmethod
    def _words(*words: str) -> bytes:
        return json.dumps(words).encode()


def refused(call: Callable[[], Any]) -> Any:
    """The error with which geokit refuses a call.

    Raises:
        AssertionError: It does not.
    """
    try:
        call()
    except gk.MissingDependencyError:
        raise
    except gk.GeokitError as error:
        return [type(error).__mro__[1].__name__, error]
    raise AssertionError("the call was not refused")


@contextlib.contextmanager
def one_processor() -> Iterator[None]:
    """Threads and processes that begin meanwhile share one processor, and count no more than that one."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def with_warnings(call: Callable[[], Any]) -> Any:
    """What a call returns, and the warnings that it gives."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        answer = call()
    return [answer, [[warning.category.__name__, str(warning.message)] for warning in caught]]


# ---------------------------------------------------------------------------------------------------------------------
# Inputs


def triangles(vertices: Any, faces: Any, name: str, parts: tuple[Any, ...] = ()) -> gk.mesh.TriangleMesh:
    return gk.mesh.TriangleMesh(vertices, faces, name=name, parts=parts)


def joined(name: str, *meshes: gk.mesh.TriangleMesh) -> gk.mesh.TriangleMesh:
    """One mesh of several, each a part of its own."""
    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    firsts = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])
    parts = tuple(
        gk.mesh.MeshPart(mesh.name, int(first), len(mesh.faces)) for mesh, first in zip(meshes, firsts, strict=False)
    )
    faces = np.concatenate([mesh.faces + count for mesh, count in zip(meshes, counts, strict=False)])
    return triangles(np.concatenate([mesh.vertices for mesh in meshes]), faces, name, parts)


def moved(mesh: gk.mesh.TriangleMesh, shift: Any, scale: float = 1.0, name: str = "") -> gk.mesh.TriangleMesh:
    return triangles(mesh.vertices * scale + np.asarray(shift, np.float64), mesh.faces, name or mesh.name, mesh.parts)


def turned(points: np.ndarray) -> np.ndarray:
    """Points turned about the origin by a rotation of rational numbers: no coordinate stays round."""
    x, y, z = points.T
    return np.stack([(2 * x - y + 2 * z) / 3, (2 * x + 2 * y - z) / 3, (2 * y + 2 * z - x) / 3], axis=1)


def unit(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    return points / np.sqrt(x * x + y * y + z * z)[:, None]


def circle(count: int) -> np.ndarray:
    """Points of the unit circle, rounded so far that every machine's cosine gives the same."""
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.round(np.stack([np.cos(angle), np.sin(angle)], axis=1) * 2.0**40) * 2.0**-40


def sphere(level: int, name: str = "sphere") -> gk.mesh.TriangleMesh:
    """An icosahedron whose faces are cut into four ``level`` times, on the unit sphere."""
    g = (1.0 + math.sqrt(5.0)) / 2.0
    corners = [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g], [0, -1, -g], [0, 1, -g],
               [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]]  # fmt: skip
    vertices = unit(np.array(corners, np.float64))
    faces = np.array(
        [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6],
         [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10],
         [8, 6, 7], [9, 8, 1]]
    )  # fmt: skip
    for _ in range(level):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, place = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = (len(vertices) + part for part in np.split(place.reshape(-1), 3))
        vertices = np.concatenate([vertices, unit(vertices[unique[:, 0]] + vertices[unique[:, 1]])])
        a, b, c = faces.T
        faces = np.concatenate(
            [np.stack(corner, axis=1) for corner in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    return triangles(vertices, faces, name)


def scan(level: int = 5) -> gk.mesh.TriangleMesh:
    """A closed body with bumps and noise, as a scanner leaves it."""
    ball = sphere(level)
    x, y, z = ball.vertices.T
    noise = np.random.default_rng(1).random(len(x)) - 0.5
    radius = 1.0 + 0.25 * x * y + 0.2 * z * z * z - 0.3 * x * x * z * z + 0.004 * noise
    return triangles(turned(ball.vertices * radius[:, None]), ball.faces, "scan")


def box(lower: Any, upper: Any, name: str = "box") -> gk.mesh.TriangleMesh:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
             [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    return triangles(np.asarray(lower) + corners * (np.asarray(upper) - np.asarray(lower)), faces, name)


def cylinder(count: int, name: str = "cylinder") -> gk.mesh.TriangleMesh:
    """Long thin triangles around, fans at both ends."""
    rim = circle(count)
    low, high = (np.column_stack([rim, np.full(count, z)]) for z in (-1.0, 2.0))
    vertices = np.concatenate([low, high, [[0, 0, -1.0], [0, 0, 2.0]]])
    i, j = np.arange(count), (np.arange(count) + 1) % count
    bottom, top = np.full(count, 2 * count), np.full(count, 2 * count + 1)
    sides = [[i, j, count + j], [i, count + j, count + i], [bottom, j, i], [top, count + i, count + j]]
    return triangles(vertices, np.concatenate([np.stack(side, axis=1) for side in sides]), name)


def parts() -> gk.mesh.TriangleMesh:
    """Bodies of a drawing: side by side, one in a cavity of another, two that overlap."""
    hollow = sphere(2, "hollow")
    inner = triangles(hollow.vertices * 0.5, hollow.faces[:, ::-1], "cavity")
    bodies = [box([3, 0, 0], [4, 1, 2]), cylinder(48), moved(hollow, [7, 0, 0]), moved(inner, [7, 0, 0]),
              box([-3, -1, -1], [-2, 1, 1], "left"), box([-2.5, -0.5, -2], [-1.25, 0.25, 0.5], "right")]  # fmt: skip
    return joined("parts", *bodies)


def soup() -> gk.mesh.TriangleMesh:
    """Triangles that share nothing, of all sizes."""
    random = np.random.default_rng(2)
    centers = random.random((2000, 1, 3))
    side = random.random((2000, 1, 1))
    sizes = 0.2 * (side * side * side) + 1e-4
    vertices = (centers + sizes * (random.random((2000, 3, 3)) - 0.5)).reshape(-1, 3)
    return triangles(vertices, np.arange(6000).reshape(-1, 3), "soup")


def terrain(size: int = 70) -> gk.mesh.TriangleMesh:
    """Heights over a plane, open on four sides."""
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(size), np.arange(size), indexing="ij"))
    x, y = i / size, j / size
    height = x * y * (1 - x) + 0.1 * (x - 0.5) * (y - 0.3) + 0.01 * np.random.default_rng(3).random(len(x))
    inner = (i < size - 1) & (j < size - 1)
    a = (i * size + j)[inner]
    faces = np.concatenate([np.stack([a, a + size, a + size + 1], 1), np.stack([a, a + size + 1, a + 1], 1)])
    return triangles(np.stack([100 * x, 100 * y, 30 * height], axis=1), faces, "terrain")


def mess() -> gk.mesh.TriangleMesh:
    """What goes wrong in files: flipped, doubled, missing and collapsed faces, vertices twice or unused."""
    body = scan(3)
    random = np.random.default_rng(4)
    faces = body.faces.copy()
    some = random.permutation(len(faces))
    faces[some[:40]] = faces[some[:40], ::-1]
    doubled, collapsed = faces[some[40:60]][:, [1, 2, 0]], faces[some[60:80]][:, [0, 1, 1]]
    faces = np.delete(faces, some[80:95], axis=0)
    copies = body.vertices[:30] + np.where(np.arange(30)[:, None] < 10, 0.0, 1e-5 * random.random((30, 3)))
    count = len(body.vertices)
    faces[faces < 30] += np.where(random.random((faces < 30).sum()) < 0.5, count, 0).astype(np.int32)
    vertices = np.concatenate([body.vertices, copies, [[9.0, 9, 9], [-9, 0, 0]]])
    return triangles(vertices, np.concatenate([faces, doubled, collapsed]), "mess")


def moebius() -> gk.mesh.TriangleMesh:
    """A strip with one side, which cannot be oriented."""
    ring, half = circle(40), circle(80)[:40]
    vertices = np.concatenate(
        [np.column_stack([(1 + w * half[:, 0])[:, None] * ring, w * half[:, 1]]) for w in (0.3, -0.3)]
    )
    i, j = np.arange(40), (np.arange(40) + 1) % 40
    cross = j == 0
    up, down = np.where(cross, 40 + j, j), np.where(cross, j, 40 + j)
    return triangles(vertices, np.concatenate([np.stack([i, up, down], 1), np.stack([i, down, 40 + i], 1)]), "moebius")


MESHES: dict[str, Callable[[], gk.mesh.TriangleMesh]] = {
    "scan": scan,
    "parts": parts,
    "bracket": lambda: gk.mesh.load(SAMPLES / "bracket.obj"),
    "soup": soup,
    "shell": lambda: gk.mesh.load(SAMPLES / "shell.stl"),
    "terrain": terrain,
    "broken": lambda: gk.mesh.load(SAMPLES / "broken.obj"),
    "mess": mess,
    "moebius": moebius,
    "far": lambda: moved(scan(4), [1.0e7, -2.5e6, 3.0e5], name="far"),
    "tiny": lambda: moved(scan(3), [0, 0, 0], 1e-40, "tiny"),
    "huge": lambda: moved(scan(3), [1e40, 0, 0], 1e40, "huge"),
    "single": lambda: triangles([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], "single"),
    "turned": lambda: triangles(scan(3).vertices, scan(3).faces[:, ::-1], "turned"),
    "unmerged": lambda: triangles(scan(3).vertices[scan(3).faces].reshape(-1, 3), np.arange(3840).reshape(-1, 3), "u"),
}
# Meshes for everything that takes longer or has its own idea of a shape.
CLOSED = ("scan", "parts", "bracket")

SHEARED = np.array([[0.1, 0.02, 0.0, 1.5], [0.0, 0.125, -0.03, -2.0], [0.01, 0.0, 0.0625, 0.25], [0, 0, 0, 1.0]])
MIRRORED = np.diag([-0.1, 0.1, 0.1, 1.0])
DISTANT = np.array([[0.1, 0, 0, 1e6], [0, 0.1, 0, -3e6], [0, 0, 0.1, 5e5], [0, 0, 0, 1.0]])

# Grid types that arrays become: what the array holds, and how many numbers a voxel has.
TYPES: dict[str, tuple[Any, int]] = {
    "float": (np.float32, 1), "double": (np.float64, 1), "half": (np.float16, 1), "bool": (np.bool_, 1),
    "mask": (np.bool_, 1), "int16": (np.int16, 1), "int32": (np.int32, 1), "int64": (np.int64, 1),
    "uint8": (np.uint8, 1), "uint32": (np.uint32, 1), "vec3f": (np.float32, 3), "vec3d": (np.float64, 3),
    "vec4f": (np.float32, 4), "vec4d": (np.float64, 4), "vec3u8": (np.uint8, 3), "vec3u16": (np.uint16, 3),
    "rgba8": (np.uint8, 4),
}  # fmt: skip
CODECS = ("fp4", "fp8", "fp16", "fpn")

# A .nvdb file of an index grid of each kind, two leaves, a tile of each level and the channels "density" (float) and
# "velocity" (vec3f), packed: no public call makes such grids.
INDEX_GRIDS = {
    "onindex": (
        "{Wp48S^xk9=GL@E0stWa8~^|S5YJf5>2OB^om~JY7)i$<C?#@zd`DeWwsh%F{D<JDuJU^XHN=*;_O#nc%&sD~Vly%MzZdq(?$4-u(1IcopSF"
        "7a)Rdh6%8c29!gaE9z68qisx?w9C@DLJEh2O>(!K-)@Hv7En4rULaMEE7DHFq2LT`&$U$I)H;UScDUViC%r+E1=bAUByZ*7H9i(j6Z=vH$U^"
        "vaRKOl}T=w~K%+GVv-T9|UiONbcnX*;lH7Gw!sz(Pg2g2o=|)2<@W#1G}j`6}n|Q$%Q}O_^oPCxZO}L3|0>SnQEPb5f@OkIhIcCPp0zTtmDy"
        "E0yGBgrKcDy=dwhoP%Q(o#lRD;Svu!oIrNjwEe(YhaP<J6<Av#jpwUoPzt(-1i?uP*vDj^gb{~CXac)M=ZQw3JbCa2oXbr+Q^GjxJ%q#iD-T"
        "f*PS2Rx^pT4eqF&dw@jWKR;o~I*U>?q5H(Uq8rcK6Rz{$;y$f;xd{FoyHu&Vw>pBG$pm7F0^m^3jj%rD@gYVjh(=POdU(*Ge1wZ{ae(7CM8t"
        "Nt;z7-4Q-834ea050j-LjIgyo0U22`V->UODCp(=SoX4Dg0eS3<M~gRY$}um%2vfZEVXiiH*%ey@$;!>e*(b(FHj>7W>#Z=%TRj!B|zPQHUX"
        "gqUIKU6pjGG78C)98yQKW`2ac0ZPm+E?)T&7u_WgNpydycUp(?h7C(EP2P(Qx!_^|5dP|~U&2at1YK;#cx7U^Jm+O3@L>*?P_w9Xi144S|kH"
        "X%(cxTdNd<Z(w#2=Xm+3QByw{HzEinQo*lyQtu>VSWT*RJsh^`)9h%-;e<RsC?%5Z5nV_Y5%|<&g@qR&~dV6k%gdkV1~O@aG|J98J{wf>&17"
        "0c$*BoGRw{Y00000R=_O(vh%;G00FrL$lxUazTcR{vBYQl0ssI200dcD"
    ),
    "index": (
        "{Wp48S^xk9=GL@E0stWa8~^|S5YJf5>5#_)id_IF7)i$<C?#@zd`DeWwsh%aRsQ2IF-hRTlK(`^$O;60N%1TTqHvNmK*B2(`RR|hn;$_j$^y"
        "(J35Ld94)>0S2=D?+*TFj}aADxVnKfBXpuXwRu(tILJ@q)ec#bNz%tTm*WuT)>r$}&7Y@%nkh3{=GP#NgH13VUp*cP=u<bwQL@4?z1KDPy6M"
        "@(2^WC5_3C|(kq$0UurhtVt3<{nBEttrC3!vN27qqTW^JDnK6dG@j~@Q!ITizsk}T1{61PhKyR`mHOsnL%dD;|<qs4#?Df&I2$Yd8d1<*;K3"
        "`Pb)i~>U!1wLcg5L<NjgK861W+t89v=RtaOL(*ILKf!4{+DW`2oy$7dQE5%+>qUXESc;)l~eXFhaaQcqipi?Otr&4O-in3I;%^EniId76FEs"
        "rGOaGs|lU+gH$h0&Fmihe4Q@+Woo8NddZO_<<<LUFt|W`PB<n+tlx@lu4doc}@HN;hWPULf(t2OQVQ)<C{^7B<qCA%;1rKuZzhpH5%70#pkW"
        "T&`K3A2z*ghs{D`s`w5~{HJJ5z=7^GLhio*u&(_!!U>KEdcy?SJt^LGY%|qjuA3rkv92`~GsfLf{H6srV)19X1URGYGovN{A7jULu8Ms85Ev"
        "7kdLuh{n@^>n`N02^wgl9j)mAz~3jPyyu-{zM;mfvQm1oBw-1nAxU(s3ud=tRi)zmITy!nM=I4o`<Wy=cAnXH)Ahv7lNCOCW`y*Pk`tQIAOR"
        "x?Ws)$YUc`~%HAXU);`&XPJWoNy^nmwqxKv`4+IoAG~rop{2~aDrlPd(7Z{CoDlq`?U~0=k^xG<>2eOQ>UjrZ1)p52GuVB00000oZyB0$UJN"
        "&00E{2$e|_x#M^CbvBYQl0ssI200dcD"
    ),
}


class Inputs:
    """Meshes, surfaces, volumes, clouds and queries, each made when first asked for."""

    def __init__(self, device: str, folder: Path) -> None:
        self.device = device
        self._folder = folder
        self._folders = 0

    def folder(self) -> Path:
        """A new empty folder."""
        self._folders += 1
        path = self._folder / f"{self._folders}"
        path.mkdir()
        return path

    @functools.cache  # noqa: B019 - one object for the whole run
    def mesh(self, name: str) -> gk.mesh.TriangleMesh:
        return MESHES[name]()

    @functools.cache  # noqa: B019
    def surface(self, name: str) -> gk.mesh.Surface:
        return gk.mesh.Surface(self.mesh(name), device=self.device)

    @functools.cache  # noqa: B019
    def queries(self, name: str, count: int = 1500) -> np.ndarray:
        """Points around a mesh, near its surface, and on its vertices and edges."""
        mesh, random = self.mesh(name), np.random.default_rng(5)
        lower, upper = mesh.bounds
        third = count // 3
        around = (lower + upper) / 2 + (random.random((third, 3)) - 0.5) * (upper - lower) * 1.6
        a, b, c = (mesh.vertices[corner] for corner in mesh.faces[random.integers(len(mesh.faces), size=third)].T)
        near = (a + b + c) / 3 + (random.random((third, 3)) - 0.5) * float((upper - lower).max()) * 0.02
        faces = mesh.faces[random.integers(len(mesh.faces), size=count - 2 * third)]
        share = np.where(np.arange(len(faces)) % 2, 0.5, 1.0)[:, None]
        on = mesh.vertices[faces[:, 0]] * share + mesh.vertices[faces[:, 1]] * (1 - share)
        return np.concatenate([around, near, on])

    @functools.cache  # noqa: B019
    def rays(self, name: str, count: int = 1500) -> tuple[np.ndarray, np.ndarray]:
        """Rays in all directions, half of them aimed at vertices and edges."""
        targets, random = self.queries(name, count)[::-1], np.random.default_rng(6)
        lower, upper = self.mesh(name).bounds
        origins = (lower + upper) / 2 + (random.random((count, 3)) - 0.5) * (upper - lower) * 2.0
        length = float((upper - lower).max())
        directions = np.where(
            np.arange(count)[:, None] % 2, targets - origins, (random.random((count, 3)) - 0.5) * length
        )
        return origins, directions

    def containers(self, points: np.ndarray) -> dict[str, Any]:
        """The same rows in every kind of container that is at hand."""
        single = points.astype(np.float32)
        return {
            "float64": points,
            "float32": single,
            "list": points.tolist(),
            "strided": np.asfortranarray(points)[::-1],
            "warp_vec3d": wp.array(points, dtype=wp.vec3d, device=self.device),
            "warp_vec3f": wp.array(single, dtype=wp.vec3f, device=self.device),
            "warp_table": wp.array(points, dtype=wp.float64, device=self.device),
            "none": points[:0],
            "one": points[:1],
        }

    # Volumes

    @functools.cache  # noqa: B019
    def sdf(self, name: str = "scan", voxel_size: float = 0.06) -> gk.volume.SparseVolume:
        return gk.volume.from_mesh(self.surface(name), voxel_size)

    @functools.cached_property
    def sphere_field(self) -> gk.volume.SparseVolume:
        """A level set of another lattice than that of the scan, in float64."""
        index = np.stack(np.meshgrid(*[np.arange(-20, 21)] * 3, indexing="ij"), axis=-1) * 0.07
        distance = np.sqrt((index * index).sum(axis=-1)) - 1.0
        values = np.clip(distance, -0.21, 0.21)
        return gk.volume.from_dense(
            values, voxel_size=0.07, origin=(-20, -20, -20), background=0.21, name="ball", grid_class="level set",
            grid_type="double",
        )  # fmt: skip

    @functools.cached_property
    def fog_values(self) -> np.ndarray:
        x, y, z = np.meshgrid(*(np.linspace(-1, 1, n) for n in (44, 36, 52)), indexing="ij")
        noise = 0.8 + 0.4 * np.random.default_rng(7).random(x.shape)
        return np.where(x * x + y * y + z * z < 0.8, (1 - x * x - y * y) * noise, 0.0).astype(np.float32)

    @functools.cached_property
    def fog(self) -> gk.volume.SparseVolume:
        return gk.volume.from_dense(
            self.fog_values, voxel_size=0.1, origin=(-22, -18, 3), name="density", grid_class="fog volume"
        )

    @functools.cached_property
    def emission(self) -> gk.volume.SparseVolume:
        values = self.fog_values * self.fog_values * 0.5
        return gk.volume.from_dense(values, voxel_size=0.1, origin=(-22, -18, 3), name="light", grid_class="fog volume")

    @functools.cache  # noqa: B019
    def velocity(self, grid_type: str = "vec3f", grid_class: str = "unknown") -> gk.volume.SparseVolume:
        x, y, z = np.meshgrid(*(np.linspace(-1, 1, n) for n in (20, 24, 18)), indexing="ij")
        values = np.stack([y * z, x * x - z, x + y * y * z], axis=-1)
        return gk.volume.from_dense(
            values, voxel_size=0.1, origin=(-8, 0, 4), name="velocity", grid_class=grid_class, grid_type=grid_type
        )

    @functools.cache  # noqa: B019
    def dense(self, name: str) -> np.ndarray:
        """An array for a grid type: much background, a region of one value, numbers of the whole range."""
        dtype, components = TYPES[name]
        random = np.random.default_rng(8)
        shape = (27, 19, 22) if components == 1 else (27, 19, 22, components)
        if np.dtype(dtype).kind == "b":
            values = random.random(shape) < 0.3
        elif np.dtype(dtype).kind in "iu":
            limits = np.iinfo(dtype)
            # Beyond 2^52 samples round the numbers; that is not what is to be seen here.
            values = random.integers(max(limits.min, -(2**40)), min(limits.max, 2**40), shape).astype(dtype)
        else:
            values = (random.random(shape) * 4 - 2).astype(dtype)
        values[random.random(shape[:3]) < 0.4] = 0
        values[8:24, :16, 8:16] = 1
        values[:8, :8] = 0
        return values

    @functools.cache  # noqa: B019
    def typed(self, name: str) -> gk.volume.SparseVolume:
        """A grid of any type but the index grids."""
        if name in CODECS:
            tolerance = {"fpn": 0.01}.get(name)
            return gk.volume.quantize(self.typed("float"), name, tolerance=tolerance)
        return gk.volume.from_dense(self.dense(name), transform=SHEARED, origin=(-9, 3, -12), name=name, grid_type=name)

    @functools.cache  # noqa: B019
    def index_grid(self, name: str) -> gk.volume.SparseVolume:
        path = self.folder() / f"{name}.nvdb"
        path.write_bytes(lzma.decompress(base64.b85decode(INDEX_GRIDS[name])))
        return gk.volume.load(path)

    @functools.cache  # noqa: B019
    def places(self, volume: gk.volume.SparseVolume, count: int = 600) -> np.ndarray:
        """Points in a volume's box and around it [world]: anywhere, at voxels, halfway between them."""
        lower, upper = volume.info.index_bounds
        index = np.random.default_rng(9).random((count, 3)) * (upper - lower + 6) + lower - 3
        third = count // 3
        index[:third] = np.floor(index[:third])
        index[third : 2 * third] = np.floor(index[third : 2 * third]) + 0.5
        return self.to_world(volume, index)

    @staticmethod
    def to_world(volume: gk.volume.SparseVolume, index: np.ndarray) -> np.ndarray:
        x, y, z = index.T
        rows = volume.info.transform[:3]
        return np.stack([row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows], axis=1)

    @functools.cache  # noqa: B019
    def volume_rays(self, volume: gk.volume.SparseVolume, count: int = 600) -> tuple[np.ndarray, np.ndarray]:
        places = self.places(volume, count)
        lower, upper = places.min(axis=0), places.max(axis=0)
        random = np.random.default_rng(10)
        origins = (lower + upper) / 2 + (random.random((count, 3)) - 0.5) * (upper - lower) * 1.8
        return origins, places[::-1] - origins

    # Clouds

    @functools.cache  # noqa: B019
    def cloud(self, name: str) -> np.ndarray:
        random = np.random.default_rng(11)
        if name == "volume":
            return random.random((5000, 3))
        if name == "surface":
            mesh = self.mesh("scan")
            a, b, c = (mesh.vertices[corner] for corner in mesh.faces[random.integers(len(mesh.faces), size=5000)].T)
            u, v = random.random((2, 5000, 1)) * 0.5
            return a + u * (b - a) + v * (c - a)
        if name == "clusters":
            centers = random.random((12, 3)) * 10
            spread = (random.random((4000, 3)) - 0.5) * (random.random((4000, 1)) ** 2)
            return np.concatenate([centers[random.integers(12, size=4000)] + spread, random.random((300, 3)) * 12])
        if name == "lattice":
            return np.stack(np.meshgrid(*[np.arange(14.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        if name == "heap":
            return np.concatenate([np.zeros((400, 3)), random.random((1200, 3)), np.full((300, 3), 0.5)])
        assert name == "far", name
        return self.cloud("surface") + np.array([3.0e8, -1.0e8, 2.0e7])


CLOUDS = {"volume": 0.07, "surface": 0.08, "clusters": 0.3, "lattice": 1.5, "heap": 0.1, "far": 0.08}


# ---------------------------------------------------------------------------------------------------------------------
# Names and parameters


def api_rows(_: Inputs) -> Rows:
    """Each public name with its parameters: names, kinds and defaults."""
    for space in ("mesh", "volume", "points", "threads", "render", "accuracy"):
        for name in sorted(getattr(gk, space).__all__):
            yield Row(f"api.{space}.{name}", functools.partial(shape_of, space, name))
    for name in sorted(gk.errors.__all__):
        error = getattr(gk.errors, name)
        yield Row(f"api.errors.{name}", lambda e=error: [base.__name__ for base in e.__mro__])
    yield Row("api.geokit", lambda: [gk.__version__, sorted(gk.__all__)])


def shape_of(space: str, name: str) -> Any:
    thing = getattr(getattr(gk, space), name)
    if not inspect.isclass(thing):
        return parameters_of(thing)
    if issubclass(thing, (tuple, list)):
        return [name, getattr(thing, "_fields", ()), repr(getattr(thing, "_field_defaults", {}))]
    members = {key: value for key, value in inspect.getmembers(thing) if not key.startswith("_")}
    return [name, parameters_of(thing.__init__), {key: parameters_of(value) for key, value in members.items()}]


def parameters_of(thing: Any) -> Any:
    if not callable(thing):
        return type(thing).__name__
    signature = inspect.signature(thing)
    return [[p.name, p.kind.name, repr(p.default)] for p in signature.parameters.values()]


# ---------------------------------------------------------------------------------------------------------------------
# Meshes


def mesh_rows(given: Inputs) -> Rows:
    for name in MESHES:
        yield Row(f"mesh.TriangleMesh.{name}", lambda n=name: [given.mesh(n), repr(given.mesh(n))])
        yield Row(f"mesh.audit.{name}", lambda n=name: gk.mesh.audit(given.mesh(n), self_intersections=n != "soup"))
        yield Row(f"mesh.orient.{name}", lambda n=name: gk.mesh.orient(given.mesh(n)))
        yield Row(f"mesh.merge_vertices.{name}", lambda n=name: merged(given.mesh(n)))
        yield Row(f"mesh.drop_degenerate.{name}", lambda n=name: dropped(given.mesh(n)))
        yield Row(f"mesh.repair.{name}", lambda n=name: gk.mesh.repair(given.mesh(n)))
        yield Row(f"mesh.remove_self_intersections.{name}", lambda n=name: untangled(given.mesh(n)))
        yield from surface_rows(given, name)
    yield from container_rows(given)
    yield from sampling_rows(given)
    yield from comparison_rows(given)
    yield from from_volume_rows(given)
    yield Row("mesh.Surface.update", lambda: updated(given))
    yield Row("mesh.Surface.id", lambda: own_closest(given))
    yield Row(
        "mesh.TriangleMesh.empty", lambda: [triangles([], [], "empty"), gk.mesh.audit(triangles([], [], "empty"))]
    )


def untangled(mesh: gk.mesh.TriangleMesh) -> Any:
    """The mesh with a few vertices pushed through its middle, and mended."""
    vertices = mesh.vertices.copy()
    vertices[:: max(1, mesh.vertex_count // 4)] *= -1.5
    return gk.mesh.remove_self_intersections(gk.mesh.TriangleMesh(vertices, mesh.faces))


def merged(mesh: gk.mesh.TriangleMesh) -> Any:
    return [gk.mesh.merge_vertices(mesh), gk.mesh.merge_vertices(mesh, tolerance=2e-4 * mesh.diagonal)]


def dropped(mesh: gk.mesh.TriangleMesh) -> Any:
    return [gk.mesh.drop_degenerate(mesh), gk.mesh.drop_degenerate(mesh, duplicates=True, unreferenced=True)]


def surface_rows(given: Inputs, name: str) -> Rows:
    """Every query of a surface, in float64."""

    def ask(method: str, *arguments: Any, **options: Any) -> Callable[[], Any]:
        return lambda: getattr(given.surface(name), method)(*(a() for a in arguments), **options)

    points, origins, directions = (
        lambda: given.queries(name), lambda: given.rays(name)[0], lambda: given.rays(name)[1],
    )  # fmt: skip
    size = {"tiny": 1e-40, "huge": 1e40, "bracket": 20.0, "terrain": 50.0}.get(name, 1.0)
    yield Row(f"mesh.Surface.{name}", lambda: described(given.surface(name)))
    yield Row(f"mesh.closest_point.{name}", ask("closest_point", points))
    yield Row(f"mesh.closest_point.{name}.near", ask("closest_point", points, max_distance=0.05 * size))
    yield Row(f"mesh.furthest_point.{name}", ask("furthest_point", points))
    for sign in ("auto", "winding", "pseudonormal", "parity"):
        yield Row(f"mesh.signed_distance.{name}.{sign}", ask("signed_distance", points, sign=sign))
        yield Row(f"mesh.contains.{name}.{sign}", ask("contains", points, sign=sign))
    yield Row(f"mesh.signed_distance.{name}.near", ask("signed_distance", points, max_distance=0.05 * size))
    yield Row(f"mesh.winding_number.{name}", ask("winding_number", points))
    yield Row(f"mesh.winding_number.{name}.as_given", ask("winding_number", points, as_given=True))
    yield Row(f"mesh.sign_confidence.{name}", ask("sign_confidence", points))
    yield Row(f"mesh.raycast.{name}", ask("raycast", origins, directions))
    yield Row(f"mesh.raycast.{name}.part", ask("raycast", origins, directions, t_min=0.4, max_distance=0.9 * size))
    yield Row(f"mesh.raycast_all.{name}", ask("raycast_all", origins, directions))
    yield Row(f"mesh.raycast_all.{name}.part", ask("raycast_all", origins, directions, t_min=0.4, max_distance=size))
    yield Row(f"mesh.crossing_count.{name}", ask("crossing_count", origins, directions))
    yield Row(f"mesh.occluded.{name}", ask("occluded", origins, directions))
    yield Row(f"mesh.occluded.{name}.part", ask("occluded", origins, directions, t_min=0.4, max_distance=0.9 * size))
    yield Row(
        f"mesh.overlapping.{name}",
        ask("overlapping", lambda: points() - 0.03 * size, lambda: points() + 0.02 * size),
    )
    yield Row(f"mesh.self_intersections.{name}", ask("self_intersections"))
    other = functools.partial(shifted_surface, given, name, size)
    yield Row(f"mesh.intersecting_triangles.{name}", ask("intersecting_triangles", other))


def shifted_surface(given: Inputs, name: str, size: float) -> gk.mesh.Surface:
    return gk.mesh.Surface(moved(given.mesh(name), np.array([0.11, -0.07, 0.005]) * size), device=given.device)


def described(surface: gk.mesh.Surface) -> Any:
    frame = [surface.bounds, surface.origin, surface.scale, surface.device.split(":")[0]]
    sign = [surface.sign_method, surface.sign_reason, surface.is_closed, surface.orientation]
    return [*frame, *sign, surface.audit, repr(surface).replace(surface.device, "")]


def container_rows(given: Inputs) -> Rows:
    """The same questions in other containers, and so many that they are answered in another way."""
    kinds = list(given.containers(np.zeros((2, 3))))
    for kind in kinds:

        def points(k: str = kind, count: int = 1500) -> Any:
            return given.containers(given.queries("scan", count))[k]

        def rays(k: str = kind) -> Any:
            return [given.containers(rows)[k] for rows in given.rays("scan")]

        def boxes(k: str = kind) -> Any:
            rows = given.queries("scan")
            return [given.containers(rows - 0.05)[k], given.containers(rows + 0.05)[k]]

        for method in ("closest_point", "furthest_point", "signed_distance", "contains", "winding_number"):
            yield Row(f"mesh.{method}.scan.{kind}", lambda m=method, p=points: getattr(given.surface("scan"), m)(p()))
        yield Row(f"mesh.sign_confidence.scan.{kind}", lambda p=points: given.surface("scan").sign_confidence(p()))
        for method in ("raycast", "raycast_all", "crossing_count", "occluded"):
            yield Row(f"mesh.{method}.scan.{kind}", lambda m=method, r=rays: getattr(given.surface("scan"), m)(*r()))
        yield Row(f"mesh.overlapping.scan.{kind}", lambda b=boxes: given.surface("scan").overlapping(*b()))
    many = 40_000
    for kind in ("float64", "float32", "warp_vec3d"):

        def rows(which: Callable[[], np.ndarray], k: str = kind) -> Any:
            return given.containers(which())[k]

        for method in ("closest_point", "signed_distance", "winding_number", "contains"):
            yield Row(
                f"mesh.{method}.scan.many_{kind}",
                lambda m=method, r=rows: getattr(given.surface("scan"), m)(r(lambda: given.queries("scan", many))),
            )
        for method in ("raycast", "raycast_all", "crossing_count", "occluded"):
            yield Row(
                f"mesh.{method}.scan.many_{kind}",
                lambda m=method, r=rows: getattr(given.surface("scan"), m)(
                    r(lambda: given.rays("scan", many)[0]), r(lambda: given.rays("scan", many)[1])
                ),
            )
    yield Row("mesh.closest_point.scan.progress", lambda: progress_of(given))
    yield Row("mesh.signed_distance.doubled", lambda: doubled(given).signed_distance(given.queries("scan")))
    yield Row("mesh.closest_point.scan.afar", lambda: given.surface("scan").closest_point(given.queries("scan") * 1e12))
    yield Row(
        "mesh.signed_distance.scan.afar", lambda: given.surface("scan").signed_distance(given.queries("scan") * 1e12)
    )


def thick_plate() -> gk.volume.SparseVolume:
    """Whole leaves between parts of leaves."""
    dense = np.zeros((30, 24, 24), bool)
    dense[3:27] = True
    return gk.volume.from_dense(dense, voxel_size=1.0)


def doubled(given: Inputs) -> gk.mesh.Surface:
    """Every face of a closed body twice, once for each side."""
    body = given.mesh("scan")
    faces = np.concatenate([body.faces, body.faces[:, ::-1]])
    return gk.mesh.Surface(triangles(body.vertices, faces, "doubled"), device=given.device)


def progress_of(given: Inputs) -> Any:
    seen: list[Any] = []
    surface, points = given.surface("scan"), given.queries("scan")
    surface.closest_point(points, progress=lambda done, total: seen.append([done, total]))
    surface.raycast(*given.rays("scan"), progress=lambda done, total: seen.append([done, total]))
    surface.winding_number(points, progress=lambda done, total: seen.append([done, total]))
    return seen


def updated(given: Inputs) -> Any:
    mesh = given.mesh("scan")
    surface = gk.mesh.Surface(mesh, device=given.device)
    points = given.queries("scan")
    before = [surface.signed_distance(points), surface.winding_number(points)]
    surface.update(mesh.vertices * [1.0, 1.25, 0.75] + 0.5)
    after = [surface.signed_distance(points), surface.raycast(*given.rays("scan")), surface.self_intersections()]
    return [before, after, surface.mesh, surface.bounds, surface.winding_number(points)]


def sampling_rows(given: Inputs) -> Rows:
    for name in (*CLOSED, "soup", "terrain", "far", "tiny"):
        mesh = functools.partial(given.mesh, name)
        yield Row(f"mesh.sample_surface.{name}", lambda m=mesh: gk.mesh.sample_surface(m(), 2000, seed=3))
        yield Row(
            f"mesh.sample_surface.{name}.poisson_count",
            lambda m=mesh: gk.mesh.sample_surface(m(), 300, method="poisson_disk", seed=4),
        )
        yield Row(
            f"mesh.sample_surface.{name}.poisson_radius",
            lambda m=mesh: gk.mesh.sample_surface(m(), method="poisson_disk", radius=0.04 * m().diagonal),
        )
    yield Row("mesh.sample_surface.none", lambda: gk.mesh.sample_surface(given.mesh("scan"), 0))


def comparison_rows(given: Inputs) -> Rows:
    for name in (*CLOSED, "shell", "terrain", "far"):
        mesh = functools.partial(given.mesh, name)
        yield Row(
            f"mesh.simplify.{name}.tolerance",
            lambda m=mesh: gk.mesh.simplify(m(), tolerance=0.01 * m().diagonal, device=given.device),
        )
    for name in ("scan", "shell", "terrain"):
        mesh = functools.partial(given.mesh, name)
        yield Row(
            f"mesh.simplify.{name}.face_count",
            lambda m=mesh: gk.mesh.simplify(m(), face_count=600, device=given.device),
        )
    yield Row(
        "mesh.simplify.single",
        lambda: gk.mesh.simplify(given.mesh("single"), tolerance=0.1, device=given.device),
    )
    pairs = {"scan": "mess", "bracket": "parts", "shell": "scan", "soup": "terrain"}
    for a, b in pairs.items():
        yield Row(
            f"mesh.hausdorff.{a}.{b}",
            lambda a=a, b=b: gk.mesh.hausdorff(
                given.mesh(a), given.mesh(b), tolerance=1e-3, samples=5000, seed=2, device=given.device
            ),
        )
    yield Row(
        "mesh.hausdorff.surfaces",
        lambda: gk.mesh.hausdorff(given.surface("scan"), given.surface("turned"), tolerance=1e-5, samples=0),
    )
    yield Row(
        "mesh.hausdorff.itself", lambda: gk.mesh.hausdorff(given.surface("scan"), given.mesh("scan"), samples=100)
    )


def from_volume_rows(given: Inputs) -> Rows:
    sources = {
        "sdf": lambda: given.sdf(),
        "ball": lambda: given.sphere_field,
        "fog": lambda: given.fog,
        "fp8": lambda: given.sdf().quantize("fp8"),
        "sheared": lambda: given.typed("float"),
        "half": lambda: given.typed("half"),
    }
    for name, volume in sources.items():
        isovalue = {"fog": 0.35, "sheared": 0.5, "half": 0.5}.get(name, 0.01)
        for method in ("auto", "surface_nets", "marching_cubes", "dual_contouring", "openvdb"):
            yield Row(
                f"mesh.from_volume.{name}.{method}",
                lambda v=volume, i=isovalue, m=method: tried(
                    lambda: gk.mesh.from_volume(v(), isovalue=i, method=m, device=given.device)
                ),
            )
    sdf = sources["sdf"]
    yield Row("mesh.from_volume.sdf.adaptive", lambda: gk.mesh.from_volume(sdf(), adaptivity=0.5, device=given.device))
    yield Row("mesh.from_volume.sdf.nothing", lambda: gk.mesh.from_volume(sdf(), isovalue=9.0, device=given.device))
    yield Row(
        "mesh.from_volume.sdf.tolerance",
        lambda: gk.mesh.from_volume(sdf(), tolerance=0.02, device=given.device),
        ("vtkmodules",),
    )
    yield Row(
        "mesh.from_volume_with_deviation.sdf",
        lambda: gk.mesh.from_volume_with_deviation(
            sdf(), tolerance=0.02, isovalue=0.03, method="marching_cubes", device=given.device
        ),
        ("vtkmodules",),
    )
    yield Row("mesh.from_volume.sdf.queried", lambda: queried_isosurface(given))
    yield Row(
        "mesh.sample_attributes",
        lambda: [
            gk.mesh.sample_attributes(
                given.mesh("scan"), {"d": given.sdf(), "v": given.velocity()}, order=order, device=given.device
            )
            for order in (0, 1, 2, 3)
        ],
    )


def queried_isosurface(given: Inputs) -> Any:
    """A mesh that is asked before its arrays are read: on a GPU it is still there."""
    mesh = gk.mesh.from_volume(given.sdf(), device=given.device)
    surface = gk.mesh.Surface(mesh, device=given.device)
    counts = [mesh.vertex_count, mesh.face_count, mesh.bounds, mesh.diagonal, repr(mesh)]
    return [counts, surface.closest_point(given.queries("scan")), mesh]


def mesh_refusal_rows(given: Inputs) -> Rows:
    scan, surface = functools.partial(given.mesh, "scan"), functools.partial(given.surface, "scan")
    line = np.array([[0.0, 0, 0], [1, 1, 1]])
    bad = np.array([[0.0, 0, 0], [0, np.nan, 0]])
    cases = {
        "faces_range": lambda: triangles([[0, 0, 0]], [[0, 1, 2]], ""),
        "faces_type": lambda: triangles([[0, 0, 0]], [[0.0, 0, 0]], ""),
        "vertices_shape": lambda: triangles([[0, 0]], [[0, 0, 0]], ""),
        "vertices_finite": lambda: triangles(bad, [[0, 0, 0]], ""),
        "surface_type": lambda: gk.mesh.Surface(line),
        "surface_empty": lambda: gk.mesh.Surface(triangles(line, [], "empty"), device=given.device),
        "surface_device": lambda: gk.mesh.Surface(scan(), device="tpu:7"),
        "closest_nan": lambda: surface().closest_point(bad),
        "closest_shape": lambda: surface().closest_point(line[:, :2]),
        "closest_radius": lambda: surface().closest_point(line, max_distance=-1.0),
        "sign": lambda: surface().signed_distance(line, sign="guess"),
        "signed_nan": lambda: surface().signed_distance(bad, sign="winding"),
        "contains_nan": lambda: surface().contains(bad),
        "winding_nan": lambda: surface().winding_number(bad),
        "rays_length": lambda: surface().raycast(line, line[:1]),
        "rays_zero": lambda: surface().raycast(line, line * 0.0),
        "rays_nan": lambda: surface().raycast_all(bad, line),
        "rays_t_min": lambda: surface().occluded(line, line + 1, t_min=-1.0),
        "boxes": lambda: surface().overlapping(line + 1, line),
        "update": lambda: surface().update(line),
        "other": lambda: surface().intersecting_triangles(scan()),
        "too_large": lambda: gk.mesh.Surface(moved(scan(), 0, 1e80), device=given.device).closest_point(line),
        "tolerance": lambda: gk.mesh.merge_vertices(scan(), tolerance=-1.0),
        "samples": lambda: gk.mesh.sample_surface(scan()),
        "samples_method": lambda: gk.mesh.sample_surface(scan(), 3, method="even"),
        "samples_area": lambda: gk.mesh.sample_surface(triangles(line, [[0, 0, 1]], "line"), 3),
        "simplify": lambda: gk.mesh.simplify(scan(), device=given.device),
        "hausdorff": lambda: gk.mesh.hausdorff(scan(), line, device=given.device),
        "hausdorff_tolerance": lambda: gk.mesh.hausdorff(scan(), scan(), tolerance=0.0, device=given.device),
        "isovalue": lambda: gk.mesh.from_volume(given.fog, isovalue=math.nan),
        "method": lambda: gk.mesh.from_volume(given.fog, method="cubes"),
        "adaptivity": lambda: gk.mesh.from_volume(given.fog, adaptivity=0.5, method="surface_nets"),
        "vectors": lambda: gk.mesh.from_volume(given.velocity()),
        "integers": lambda: gk.mesh.from_volume(given.typed("int32")),
        "attributes": lambda: gk.mesh.sample_attributes(scan(), {"": given.fog}),
    }
    for name, call in cases.items():
        yield Row(f"mesh.refused.{name}", lambda c=call: refused(c))


# Text files that others write, in what they may hold beside triangles.
OBJ = """# two bodies
o first
v 0 0 0 1 0 0
v 1 0 0
v 1.0 1.0 0
v 0 1 1e-3
vt 0 0
vn 0 0 1
f 1/1/1 2/1/1 3//1 4
g second
v 0 0 2
v 2 0 2
v 2 2 2
v 1 0.5 2
f -4 -3 -2 -1
f 1 2 -1
l 1 2
"""
OFF = """OFF
# a pyramid, one face of it with a color
5 5 8
0 0 0
1 0 0
1 1 0
0 1 0
0.5 0.5 1.25
4 3 2 1 0 255 0 0
3 0 1 4
3 1 2 4
3 2 3 4
3 3 0 4
"""
STL = "solid tetra\n" + "".join(
    "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners) + "endloop\nendfacet\n"
    for corners in (
        [(0, 0, 0), (0, 1, 0), (1, 0, 0)], [(0, 0, 0), (1, 0, 0), (0, 0, 1.5)],
        [(0, 0, 0), (0, 0, 1.5), (0, 1, 0)], [(1, 0, 0), (0, 1, 0), (0, 0, 1.5)],
    )
) + "endsolid tetra\n"  # fmt: skip
PLY = """ply
format ascii 1.0
comment a pentagon and a triangle
element vertex 6
property float x
property float y
property double z
property uchar red
element face 2
property list uchar int vertex_indices
property int flags
end_header
0 0 0 1
2 0 0 2
3 1 0 3
1 0.5 0 4
0 2 0 5
0 0 7 6
5 0 1 2 3 4 9
3 0 1 5 8
"""
VTK = """# vtk DataFile Version 3.0
square
ASCII
DATASET POLYDATA
POINTS 4 float
0 0 0 1 0 0 1 1 0 0 1 0
POLYGONS 1 5
4 0 1 2 3
"""


def gltf_text() -> str:
    """Two instances of a triangle, one mirrored."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    indices = np.array([0, 1, 2], np.uint32).tobytes()
    data = base64.b64encode(positions + indices).decode()
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0, 1]}],
            "nodes": [
                {"mesh": 0, "name": "a"},
                {"mesh": 0, "name": "b", "scale": [-1, 2, 1], "translation": [3, 0, 0]},
            ],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
            "accessors": [
                {
                    "bufferView": 0,
                    "componentType": 5126,
                    "count": 3,
                    "type": "VEC3",
                    "min": [0, 0, 0],
                    "max": [1, 1, 0],
                },
                {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
            ],
            "bufferViews": [
                {"buffer": 0, "byteOffset": 0, "byteLength": 36},
                {"buffer": 0, "byteOffset": 36, "byteLength": 12},
            ],
            "buffers": [{"byteLength": 48, "uri": "data:application/octet-stream;base64," + data}],
        }
    )


TRIMESH, VTKS, MESHIO, USD = ("trimesh",), ("pyvista", "vtkmodules"), ("meshio", "h5py"), ("pxr",)
MESH_FORMATS = {
    **dict.fromkeys(("obj", "off", "ply", "stl", "3mf"), ()),
    "glb": TRIMESH,
    **dict.fromkeys(("vtk", "vtp"), VTKS),
    "vtu": (*MESHIO, *VTKS),
    **dict.fromkeys(("msh", "xdmf"), MESHIO),
    **dict.fromkeys(("usd", "usda", "usdc"), USD),
}
SAME_BYTES = ("obj", "off", "ply", "stl", "glb", "vtk", "vtp", "vtu", "msh", "xdmf", "usda")


def mesh_file_rows(given: Inputs) -> Rows:
    for kind, needs in MESH_FORMATS.items():
        for name in ("parts", "far"):
            yield Row(f"mesh.load.{kind}.{name}", lambda k=kind, n=name: mesh_again(given, n, k), needs)
        if kind in SAME_BYTES:
            yield Row(f"mesh.save.{kind}", lambda k=kind: mesh_bytes(given, "parts", k), needs)
    for kind in ("vtk", "vtp", "vtu", "msh", "xdmf"):
        yield Row(f"mesh.save.{kind}.data", lambda k=kind: mesh_bytes(given, "bracket", k, True), MESH_FORMATS[kind])
    texts = {"obj": OBJ, "off": OFF, "stl": STL, "ply": PLY, "vtk": VTK, "gltf": gltf_text()}
    for kind, text in texts.items():
        needs = {"vtk": VTKS, "gltf": TRIMESH}.get(kind, ())
        yield Row(f"mesh.load.{kind}.text", lambda k=kind, t=text: gk.mesh.load(written(given, f"text.{k}", t)), needs)
    yield Row("mesh.load.usdz", lambda: packed_usd(given), USD)
    for name in ("bracket.obj", "broken.obj", "shell.stl", "torus.ply"):
        yield Row(f"mesh.load.sample.{name}", lambda n=name: gk.mesh.load(SAMPLES / n, name="a name"))
    cases = {
        "missing": lambda: gk.mesh.load(given.folder() / "nothing.obj"),
        "extension": lambda: gk.mesh.load(written(given, "a.xml", "")),
        "empty": lambda: gk.mesh.load(written(given, "a.ply", "")),
        "obj_index": lambda: gk.mesh.load(written(given, "a.obj", OBJ.replace("f 1 2 -1", "f 1 2 99"))),
        "obj_number": lambda: gk.mesh.load(written(given, "a.obj", OBJ.replace("1.0 1.0 0", "1.0 one 0"))),
        "obj_no_faces": lambda: gk.mesh.load(written(given, "a.obj", "v 0 0 0\n")),
        "off_short": lambda: gk.mesh.load(written(given, "a.off", OFF[:60])),
        "ply_short": lambda: gk.mesh.load(written(given, "a.ply", PLY[:-20])),
        "ply_header": lambda: gk.mesh.load(written(given, "a.ply", PLY.replace("element face 2", "element face x"))),
        "stl_short": lambda: gk.mesh.load(written(given, "a.stl", STL[:120])),
        "save_extension": lambda: gk.mesh.save(given.folder() / "a.dae", given.mesh("scan")),
        "save_data": lambda: gk.mesh.save(given.folder() / "a.obj", given.mesh("scan"), point_data={"a": [1]}),
        "save_rows": lambda: gk.mesh.save(given.folder() / "a.vtp", given.mesh("scan"), cell_data={"a": [1]}),
        "save_float32": lambda: gk.mesh.save(given.folder() / "a.stl", given.mesh("huge")),
        "save_folder": lambda: gk.mesh.save(given.folder() / "no" / "a.obj", given.mesh("scan")),
        "save_empty": lambda: gk.mesh.save(given.folder() / "a.obj", triangles([], [], "")),
    }
    for name, call in cases.items():
        yield Row(f"mesh.refused.file_{name}", lambda c=call: refused(c))
    damaged = {"vtp": VTKS, "vtu": VTKS, "glb": TRIMESH, "msh": MESHIO, "usdc": USD}
    for kind, needs in damaged.items():
        yield Row(f"mesh.refused.damaged_{kind}", lambda k=kind: type_refused(given, f"a.{k}", "damaged" * 50), needs)


def type_refused(given: Inputs, name: str, text: str) -> Any:
    """The type of the error alone: the sentence is that of another library."""
    return refused(lambda: gk.mesh.load(written(given, name, text)))[0]


def written(given: Inputs, name: str, content: str | bytes) -> Path:
    path = given.folder() / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def saved_mesh(given: Inputs, name: str, kind: str, data: bool = False) -> Path:
    mesh, path = given.mesh(name), given.folder() / f"{name}.{kind}"
    more: dict[str, Any] = {}
    if data:
        heights = mesh.vertices[:, 2]
        more["point_data"] = {"height": heights, "vectors": mesh.vertices.astype(np.float32), "flag": heights > 1}
        more["cell_data"] = {
            "number": np.arange(len(mesh.faces), dtype=np.int16),
            "first": mesh.vertices[mesh.faces[:, 0]],
        }
    gk.mesh.save(path, mesh, **more)
    return path


def mesh_again(given: Inputs, name: str, kind: str) -> Any:
    path = saved_mesh(given, name, kind)
    return [gk.mesh.load(path), sorted(p.name for p in path.parent.iterdir())]


def mesh_bytes(given: Inputs, name: str, kind: str, data: bool = False) -> bytes:
    return saved_mesh(given, name, kind, data).read_bytes()


def packed_usd(given: Inputs) -> gk.mesh.TriangleMesh:
    from pxr import Sdf, UsdUtils

    path = saved_mesh(given, "bracket", "usdc")
    UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(path)), str(path.with_suffix(".usdz")))
    return gk.mesh.load(path.with_suffix(".usdz"))


# ---------------------------------------------------------------------------------------------------------------------
# Volumes


def volume_rows(given: Inputs) -> Rows:
    yield from making_rows(given)
    yield from tolerance_rows(given)
    yield from dense_rows(given)
    for name in (*TYPES, *CODECS):
        yield from reading_rows(given, name)
        yield from type_operation_rows(given, name)
    yield from sampling_volume_rows(given)
    yield from derivative_rows(given)
    yield from volume_ray_rows(given)
    yield from quantize_rows(given)
    yield from channel_rows(given)
    yield from level_set_rows(given)
    yield from field_operation_rows(given)
    yield Row("volume.id", lambda: own_samples(given))


def making_rows(given: Inputs) -> Rows:
    make, scan = gk.volume.from_mesh, functools.partial(given.surface, "scan")
    for name, size in {"scan": 0.05, "parts": 0.1, "bracket": 0.7, "soup": 0.02, "shell": 0.06, "terrain": 1.0,
                       "broken": 0.06, "mess": 0.06, "far": 0.1, "turned": 0.08, "moebius": 0.05}.items():  # fmt: skip
        yield Row(
            f"volume.from_mesh.{name}",
            lambda n=name, s=size: with_warnings(lambda: make(given.mesh(n), s, device=given.device)),
        )
    variants: dict[str, dict[str, Any]] = {
        "wide": {"half_width": 6.0}, "sides": {"half_width": (2.0, 8.0)}, "unsigned": {"sign": "none"},
        "winding": {"sign": "winding"}, "parity": {"sign": "parity"}, "pseudonormal": {"sign": "pseudonormal"},
        "shell": {"thickness": 0.15}, "openvdb": {"method": "openvdb"}, "named": {"name": "a name"},
        "fp8": {"codec": "fp8"}, "fp16": {"codec": "fp16"}, "float": {"codec": "float"},
    }  # fmt: skip
    for variant, options in variants.items():
        yield Row(f"volume.from_mesh.scan.{variant}", lambda o=options: with_warnings(lambda: make(scan(), 0.08, **o)))
    yield Row("volume.from_mesh.scan.fine", lambda: make(scan(), 0.02))
    yield Row("volume.from_mesh.parts.lost", lambda: with_warnings(lambda: make(given.surface("parts"), 0.9)))
    yield Row("volume.from_mesh.soup.shell", lambda: make(given.surface("soup"), 0.02, thickness=0.03))
    for name in ("scan", "shell", "bracket"):
        yield Row(
            f"volume.from_mesh_with_triangles.{name}",
            lambda n=name: gk.volume.from_mesh_with_triangles(given.surface(n), 0.03 * given.mesh(n).diagonal),
        )
    yield Row(
        "volume.from_mesh_with_triangles.options",
        lambda: gk.volume.from_mesh_with_triangles(
            given.surface("scan"), 0.09, half_width=(2, 4), sign="none", name="unsigned"
        ),
    )
    cloud, random = functools.partial(given.cloud, "surface"), np.random.default_rng(12)
    radii = 0.02 + 0.2 * np.square(np.square(np.square(random.random(5000))))
    points = gk.volume.from_points
    yield Row("volume.from_points.one_radius", lambda: points(cloud(), 0.06, voxel_size=0.04, device=given.device))
    yield Row(
        "volume.from_points.radii",
        lambda: points(cloud(), radii, voxel_size=0.03, half_width=4, name="balls", device=given.device),
    )
    yield Row(
        "volume.from_points.float32",
        lambda: points(given.containers(cloud())["warp_vec3f"], 0.1, voxel_size=0.07, device=given.device),
    )
    yield Row("volume.from_points.small", lambda: points(cloud()[:50], 0.004, voxel_size=0.02, device=given.device))
    yield Row("volume.from_points.far", lambda: points(given.cloud("far"), 0.1, voxel_size=0.07, device=given.device))
    function, bounds = gk.volume.from_function, [[-1.5, -1.5, -1.5], [1.5, 1.5, 1.6]]
    yield Row("volume.from_function.ring", lambda: function(ring, bounds, 0.05))
    yield Row("volume.from_function.cut", lambda: function(ring, [[-1.5, 0.1, -1], [0.9, 1.2, 1]], 0.04, name="cut"))
    yield Row("volume.from_function.steep", lambda: function(steep_box, bounds, 0.07, lipschitz=2.0, half_width=4))
    yield Row(
        "volume.from_function.blocks",
        lambda: function(ring, bounds, 0.05, block=1000, grid_class="unknown", half_width=2),
    )


def ring(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    away = np.sqrt(x * x + y * y) - 0.9
    return np.sqrt(away * away + z * z) - 0.35


def steep_box(points: np.ndarray) -> np.ndarray:
    return 2.0 * (np.abs(points) - [0.9, 0.6, 1.1]).max(axis=1)


def tolerance_rows(given: Inputs) -> Rows:
    make, cases = gk.volume.from_mesh, {
        "bracket": ("bracket", 0.2, {}),
        "order_1": ("bracket", 0.3, {"order": 1}),
        "order_3": ("scan", 0.02, {"order": 3, "codec": "float"}),
        "within": ("scan", 0.02, {"within": 0.1, "order": 2}),
        "open": ("shell", 0.02, {"half_width": 3.0}),
        "thickness": ("terrain", 1.0, {"thickness": 2.0}),
        "codec": ("scan", 0.03, {"codec": "fp8", "sign": "winding", "name": "eight"}),
    }  # fmt: skip
    for case, (name, tolerance, options) in cases.items():
        yield Row(
            f"volume.from_mesh.tolerance.{case}",
            lambda n=name, t=tolerance, o=options: with_warnings(
                lambda: made_again(given, make(given.surface(n), tolerance=t, **o))
            ),
        )
    for name, tolerance in {"bracket": 0.3, "scan": 0.02, "shell": 0.03}.items():
        yield Row(f"volume.plan.{name}", lambda n=name, t=tolerance: planned(given, n, t))
    yield Row("volume.plan.options", lambda: planned(given, "scan", 0.03, order=1, codec="fp8", within=0.05))
    for name, tolerance in {"bracket": 0.2, "scan": 0.03, "shell": 0.04}.items():
        yield Row(f"volume.adaptive_from_mesh.{name}", lambda n=name, t=tolerance: adaptive(given, n, t))
    for order in (1, 2, 3):
        yield Row(
            f"volume.adaptive_from_mesh.bracket.{order}",
            lambda o=order: adaptive(given, "bracket", 0.2, order=o, codec="float" if o == 1 else "fp8"),
        )
    yield Row(
        "volume.adaptive_from_mesh.options",
        lambda: gk.volume.adaptive_from_mesh(
            given.surface("bracket"), 0.3, within=0.1, max_levels=5, sign="winding", name="levels"
        ),
    )
    for codec in ("none", "zip", "blosc"):
        yield Row(
            f"volume.load_adaptive.nvdb.{codec}", lambda c=codec: adaptive_again(given, "field.nvdb", c), blosc(codec)
        )
    yield Row("volume.load_adaptive.vdb", lambda: adaptive_again(given, "field.vdb", None))


def made_again(given: Inputs, volume: gk.volume.SparseVolume) -> Any:
    return [volume, volume.info.order, volume.sample(given.places(volume), device=given.device)]


def planned(given: Inputs, name: str, tolerance: float, **options: Any) -> Any:
    return [field._replace(seconds=0.0) for field in gk.volume.plan(given.surface(name), tolerance, **options)]


def adaptive(given: Inputs, name: str, tolerance: float, **options: Any) -> Any:
    field = gk.volume.adaptive_from_mesh(given.surface(name), tolerance, **options)
    rows = given.containers(given.queries(name))
    samples = {kind: field.sample(points, device=given.device) for kind, points in rows.items()}
    slopes = {kind: field.gradient(points, device=given.device) for kind, points in rows.items()}
    return [field, repr(field), samples, slopes]


def adaptive_again(given: Inputs, name: str, codec: str | None) -> gk.volume.AdaptiveSDF:
    path = given.folder() / name
    gk.volume.adaptive_from_mesh(given.surface("bracket"), 0.5, name="field").save(path, codec=codec)
    return gk.volume.load_adaptive(path)


def blosc(codec: str | None) -> tuple[str, ...]:
    return ("blosc",) if codec == "blosc" else ()


def dense_rows(given: Inputs) -> Rows:
    make = gk.volume.from_dense
    for name in TYPES:
        yield Row(f"volume.from_dense.{name}", lambda n=name: [given.typed(n), repr(given.typed(n))])
    fog = lambda: given.fog_values  # noqa: E731
    variants: dict[str, dict[str, Any]] = {
        "float64": {"values": lambda: fog().astype(np.float64)},
        "fortran": {"values": lambda: np.asfortranarray(fog())},
        "int8": {"values": lambda: (fog() * 50).astype(np.int8)},
        "uint16": {"values": lambda: (fog() * 50).astype(np.uint16)},
        "warp": {"values": lambda: wp.array(fog(), dtype=wp.float32, device=given.device)},
        "background": {"values": fog, "background": 0.5},
        "tolerance": {"values": fog, "tolerance": 0.3},
        "origin": {"values": fog, "origin": (-100_000, 5, 2_000_000)},
        "sheared": {"values": fog, "transform": SHEARED},
        "mirrored": {"values": fog, "transform": MIRRORED},
        "distant": {"values": fog, "transform": DISTANT},
        "three_sizes": {"values": fog, "voxel_size": (0.1, 0.2, 0.3)},
        "fog": {"values": fog, "grid_class": "fog volume", "name": "fog"},
        "level_set": {"values": lambda: 0.4 - fog(), "grid_class": "level set", "background": 0.4},
        "nothing": {"values": lambda: np.zeros((9, 9, 9))},
    }
    for variant, options in variants.items():
        yield Row(f"volume.from_dense.variant.{variant}", lambda o=options: from_dense_of(make, dict(o)))
    sources = {"sdf": lambda: given.sdf(), "fog": lambda: given.fog, "velocity": lambda: given.velocity()}
    for name, volume in sources.items():
        yield Row(f"volume.to_dense.{name}", lambda v=volume: v().to_dense(device=given.device))
        yield Row(
            f"volume.to_dense.{name}.box",
            lambda v=volume: gk.volume.to_dense(
                v(), bounds=[[-9, -7, 1], [12, 20, 40]], dtype=np.float64, device=given.device
            ),
        )


def from_dense_of(make: Any, options: dict[str, Any]) -> Any:
    values = options.pop("values")()
    if "transform" not in options:
        options.setdefault("voxel_size", 0.1)
    return make(values, **options)


def reading_rows(given: Inputs, name: str) -> Rows:
    """Samples, gradients, active states and dense arrays of one type, under a sheared transform."""
    volume = functools.partial(given.typed, name)
    for order in (0, 1, 2, 3):
        yield Row(
            f"volume.sample.{name}.order_{order}",
            lambda v=volume, o=order: v().sample(given.places(v()), order=o, device=given.device),
        )
        if order:
            yield Row(
                f"volume.gradient.{name}.order_{order}",
                lambda v=volume, o=order: v().gradient(given.places(v()), order=o, device=given.device),
            )
    yield Row(f"volume.active_at.{name}", lambda v=volume: v().active_at(given.places(v()), device=given.device))
    yield Row(f"volume.to_dense.{name}", lambda v=volume: v().to_dense(device=given.device))


def tried(call: Callable[[], Any]) -> Any:
    """What a call returns, or the error with which it is refused: both are behavior."""
    try:
        return call()
    except gk.MissingDependencyError:
        raise
    except gk.GeokitError as error:
        return error


def type_operation_rows(given: Inputs, name: str) -> Rows:
    """Operations that take grids of every type, and files of one type."""
    volume = functools.partial(given.typed, name)
    bounds = [[0.9, -2.5, -1.0], [2.6, 0.4, 1.2]]
    other = np.diag([0.17, 0.11, 0.2, 1.0])
    calls: dict[str, Callable[[Any], Any]] = {
        "prune": lambda v: [gk.volume.prune(v), gk.volume.prune(v, 0.75)],
        "clip": lambda v: gk.volume.clip(v, bounds),
        "connected_components": lambda v: gk.volume.connected_components(v, device=given.device),
        "segment": lambda v: gk.volume.segment(v, device=given.device),
        "statistics": gk.volume.statistics,
        "dilate": lambda v: gk.volume.dilate(v, voxels=2, device=given.device),
        "erode": lambda v: gk.volume.erode(v, voxels=1, neighbors="edges", device=given.device),
        "opening": lambda v: gk.volume.opening(v, voxels=1, device=given.device),
        "closing": lambda v: gk.volume.closing(v, voxels=2, neighbors="vertices", device=given.device),
        "resample": lambda v: gk.volume.resample(v, transform=other, order=0, device=given.device),
        "raycast": lambda v: gk.volume.raycast(v, *given.volume_rays(v), isovalue=0.5, device=given.device),
        "hessian": lambda v: gk.volume.hessian(v, given.places(v), device=given.device),
        "gradient_field": lambda v: gk.volume.gradient_field(v, device=given.device),
        "divergence": lambda v: gk.volume.divergence(v, device=given.device),
        "nvdb": lambda v: volume_again(given, "grid.nvdb", [v]),
        "vdb": lambda v: volume_again(given, "grid.vdb", [v]),
    }
    for operation, call in calls.items():
        yield Row(f"volume.{operation}.{name}", lambda c=call, v=volume: tried(lambda: c(v())))


def sampling_volume_rows(given: Inputs) -> Rows:
    """Other transforms, spaces, containers and numbers of points."""
    volumes: dict[str, Callable[[], gk.volume.SparseVolume]] = {
        "sdf": lambda: given.sdf(),
        "fog": lambda: given.fog,
        "mirrored": lambda: gk.volume.from_dense(given.fog_values, transform=MIRRORED),
        "distant": lambda: gk.volume.from_dense(given.fog_values, transform=DISTANT),
        "staggered": lambda: given.velocity("vec3f", "staggered"),
        "staggered_double": lambda: given.velocity("vec3d", "staggered"),
    }
    for name, volume in volumes.items():
        cached = functools.cache(volume)
        for order in (0, 1, 2, 3):
            yield Row(
                f"volume.sample.{name}.order_{order}",
                lambda v=cached, o=order: gk.volume.sample(v(), given.places(v()), order=o, device=given.device),
            )
        for order in (1, 2, 3):
            yield Row(
                f"volume.gradient.{name}.order_{order}",
                lambda v=cached, o=order: gk.volume.gradient(v(), given.places(v()), order=o, device=given.device),
            )
        for count, dtype in ((30_000, np.float64), (30_000, np.float32)):
            suffix = np.dtype(dtype).name
            yield Row(
                f"volume.sample.{name}.many_{suffix}",
                lambda v=cached, n=count, d=dtype: v().sample(given.places(v(), n).astype(d), device=given.device),
            )
            yield Row(
                f"volume.gradient.{name}.many_{suffix}",
                lambda v=cached, n=count, d=dtype: v().gradient(given.places(v(), n).astype(d), device=given.device),
            )
        yield Row(
            f"volume.sample.{name}.index",
            lambda v=cached: [
                v().sample(
                    np.random.default_rng(13).random((500, 3)) * 30 - 10, order=o, space="index", device=given.device
                )
                for o in (0, 1, 2, 3)
            ],
        )
    for kind in given.containers(np.zeros((2, 3))):
        for call in ("sample", "gradient", "active_at"):
            yield Row(
                f"volume.{call}.sdf.{kind}",
                lambda c=call, k=kind: getattr(given.sdf(), c)(
                    given.containers(given.queries("scan"))[k], device=given.device
                ),
            )
        for call in ("raycast", "integrate"):
            yield Row(
                f"volume.{call}.fog.{kind}",
                lambda c=call, k=kind: getattr(given.fog, c)(
                    *(given.containers(rows)[k] for rows in given.volume_rays(given.fog)), device=given.device
                ),
            )
        for call in ("hessian", "curvature"):
            yield Row(
                f"volume.{call}.sdf.{kind}",
                lambda c=call, k=kind: getattr(given.sdf(), c)(
                    given.containers(given.places(given.sdf()))[k], device=given.device
                ),
            )


def derivative_rows(given: Inputs) -> Rows:
    scalars: dict[str, Callable[[], gk.volume.SparseVolume]] = {
        "sdf": lambda: given.sdf(),
        "ball": lambda: given.sphere_field,
        "sheared": lambda: given.typed("float"),
        "quantized": lambda: given.fog.quantize("fp16"),
    }
    for name, volume in scalars.items():
        for order in (2, 3):
            yield Row(
                f"volume.hessian.{name}.order_{order}",
                lambda v=volume, o=order: [
                    gk.volume.hessian(v(), given.places(v()), order=o, space=space, device=given.device)
                    for space in ("world", "index")
                ],
            )
            yield Row(
                f"volume.curvature.{name}.order_{order}",
                lambda v=volume, o=order: gk.volume.curvature(v(), given.places(v()), order=o, device=given.device),
            )
        yield Row(f"volume.gradient_field.{name}", lambda v=volume: gk.volume.gradient_field(v(), device=given.device))
        yield Row(f"volume.laplacian.{name}", lambda v=volume: gk.volume.laplacian(v(), device=given.device))
    for grid_type in ("vec3f", "vec3d"):
        for grid_class in ("unknown", "staggered"):
            for call in ("divergence", "curl"):
                yield Row(
                    f"volume.{call}.{grid_type}.{grid_class}",
                    lambda c=call, t=grid_type, g=grid_class: tried(
                        lambda: getattr(gk.volume, c)(given.velocity(t, g), device=given.device)
                    ),
                )


def volume_ray_rows(given: Inputs) -> Rows:
    volumes: dict[str, Callable[[], gk.volume.SparseVolume]] = {
        "sdf": lambda: given.sdf(),
        "ball": lambda: given.sphere_field,
        "fog": lambda: given.fog,
        "sheared": lambda: given.typed("float"),
        "fpn": lambda: given.typed("fpn"),
        "distant": lambda: gk.volume.from_dense(given.fog_values, transform=DISTANT),
    }
    for name, volume in volumes.items():
        cached = functools.cache(volume)
        level = 0.0 if name in ("sdf", "ball") else 0.4
        for count in (600, 20_000):
            yield Row(
                f"volume.raycast.{name}.{count}",
                lambda v=cached, n=count, i=level: gk.volume.raycast(
                    v(), *given.volume_rays(v(), n), isovalue=i, device=given.device
                ),
            )
        yield Row(
            f"volume.raycast.{name}.part",
            lambda v=cached, i=level: v().raycast(
                *given.volume_rays(v()), isovalue=i + 0.01, t_min=0.3, max_distance=1.5, device=given.device
            ),
        )
    fogs: dict[str, Callable[[], gk.volume.SparseVolume]] = {
        "fog": lambda: given.fog,
        "sheared": lambda: given.typed("float"),
        "double": lambda: given.typed("double"),
        "fp8": lambda: given.fog.quantize("fp8"),
    }
    for name, volume in fogs.items():
        cached = functools.cache(volume)
        yield Row(
            f"volume.integrate.{name}",
            lambda v=cached: gk.volume.integrate(v(), *given.volume_rays(v()), extinction=3.0, device=given.device),
        )
        yield Row(
            f"volume.integrate.{name}.part",
            lambda v=cached: v().integrate(
                *given.volume_rays(v()), extinction=0.5, t_min=0.2, max_distance=2.0, device=given.device
            ),
        )
    yield Row(
        "volume.integrate.emission",
        lambda: given.fog.integrate(
            *given.volume_rays(given.fog), extinction=2.0, emission=given.emission, device=given.device
        ),
    )


def quantize_rows(given: Inputs) -> Rows:
    volumes = {"sdf": lambda: given.sdf(), "fog": lambda: given.fog, "double": lambda: given.typed("double")}
    for name, volume in volumes.items():
        for codec in ("float", "fp4", "fp8", "fp16"):
            for dither in (False, True):
                yield Row(
                    f"volume.quantize.{name}.{codec}" + ".dither" * dither,
                    lambda v=volume, c=codec, d=dither: gk.volume.quantize(v(), c, dither=d),
                )
        yield Row(f"volume.quantize.{name}.fpn", lambda v=volume: v().quantize("fpn", tolerance=1e-3))
        yield Row(f"volume.quantize.{name}.chosen", lambda v=volume: v().quantize(tolerance=2e-2, dither=True))
    for a in CODECS:
        yield Row(f"volume.quantize.{a}.again", lambda a=a: tried(lambda: given.typed(a).quantize("fp8")))
    yield Row("volume.quantize.refused", lambda: refused(lambda: given.fog.quantize("fp4", tolerance=1e-6)))


def channel_rows(given: Inputs) -> Rows:
    places = np.random.default_rng(14).random((400, 3)) * [30, 14, 300] - [12, 3, 3]
    for name in INDEX_GRIDS:
        volume = functools.partial(given.index_grid, name)
        yield Row(f"volume.channel_names.{name}", lambda v=volume: [gk.volume.channel_names(v()), v()])
        for channel in (0, "velocity"):
            yield Row(
                f"volume.from_channel.{name}.{channel}", lambda v=volume, c=channel: gk.volume.from_channel(v(), c)
            )
            yield Row(
                f"volume.sample.{name}.{channel}",
                lambda v=volume, c=channel: [
                    v().sample(places, order=o, channel=c, device=given.device) for o in (0, 1, 2, 3)
                ],
            )
        yield Row(f"volume.gradient.{name}", lambda v=volume: v().gradient(places, order=2, device=given.device))
        yield Row(f"volume.active_at.{name}", lambda v=volume: v().active_at(places, device=given.device))
        yield Row(
            f"volume.to_dense.{name}",
            lambda v=volume: v().to_dense(bounds=[[-9, -1, -1], [9, 9, 17]], channel="density", device=given.device),
        )
        yield Row(f"volume.nvdb.{name}", lambda v=volume: volume_again(given, "index.nvdb", [v()]))
        yield Row(
            f"volume.refused.{name}",
            lambda v=volume: [
                refused(lambda: gk.volume.from_channel(v(), "heat")),
                refused(lambda: gk.volume.prune(v())),
                refused(lambda: v().raycast([[0.0, 0, 0]], [[1.0, 0, 0]], device=given.device)),
            ],
        )


def level_set_rows(given: Inputs) -> Rows:
    volumes: dict[str, Callable[[], gk.volume.SparseVolume]] = {
        "sdf": lambda: given.sdf(),
        "ball": lambda: given.sphere_field,
        "bracket": lambda: given.sdf("bracket", 1.0),
        "sdf_fp16": lambda: given.sdf().quantize("fp16"),
    }
    for name, volume in volumes.items():
        cached = functools.cache(volume)
        size = {"bracket": 1.0}.get(name, 0.06)
        calls: dict[str, Callable[[Any], Any]] = {
            "offset.out": lambda v, s=size: gk.volume.offset(v, 1.3 * s, device=given.device),
            "offset.in": lambda v, s=size: gk.volume.offset(v, -2.1 * s, device=given.device),
            "offset.wide": lambda v, s=size: gk.volume.offset(v, 5.0 * s, device=given.device),
            "dilate": lambda v, s=size: gk.volume.dilate(v, 1.2 * s, device=given.device),
            "erode": lambda v, s=size: gk.volume.erode(v, 1.2 * s, device=given.device),
            "opening": lambda v, s=size: gk.volume.opening(v, 2.0 * s, device=given.device),
            "closing": lambda v, s=size: gk.volume.closing(v, 2.0 * s, device=given.device),
            "renormalize": lambda v: gk.volume.renormalize(v, device=given.device),
            "renormalize.wide": lambda v: gk.volume.renormalize(v, half_width=5.0, device=given.device),
            "clip": lambda v, s=size: gk.volume.clip(v, [[-3 * s, -5 * s, -4 * s], [9 * s, 12 * s, 10 * s]]),
            "prune": lambda v, s=size: gk.volume.prune(v, 0.5 * s),
            "connected_components": lambda v: gk.volume.connected_components(v, device=given.device),
            "segment": lambda v: gk.volume.segment(v, device=given.device),
            "statistics": gk.volume.statistics,
            "resample.size": lambda v, s=size: gk.volume.resample(v, voxel_size=1.4 * s, device=given.device),
            "resample.fine": lambda v, s=size: gk.volume.resample(v, voxel_size=0.7 * s, order=3, device=given.device),
            "resample.moved": lambda v, s=size: gk.volume.resample(
                v, transform=[[s, 0, 0, 0.31 * s], [0, s, 0, 0.2 * s], [0, 0, s, 0], [0, 0, 0, 1]], device=given.device
            ),
        }
        for operation, call in calls.items():
            yield Row(f"volume.{operation}.{name}", lambda c=call, v=cached: tried(lambda: c(v())))
        for method in ("gaussian", "mean", "median", "mean_curvature", "laplacian"):
            yield Row(
                f"volume.smooth.{name}.{method}",
                lambda v=cached, m=method: gk.volume.smooth(v(), m, width=2, iterations=2),
            )
    for call in ("union", "intersection", "difference"):
        combine = getattr(gk.volume, call)
        sdf, ball = (lambda: given.sdf()), (lambda: given.sphere_field)
        small = lambda: gk.volume.from_function(steep_half_box, [[-1, -1, -1], [1, 1, 1]], 0.06)  # noqa: E731
        yield Row(f"volume.{call}.two", lambda c=combine, a=sdf, b=ball: c(a(), b()))
        yield Row(f"volume.{call}.three", lambda c=combine, a=sdf, b=ball, s=small: c(a(), s(), b()))
        yield Row(f"volume.{call}.smooth", lambda c=combine, a=sdf, s=small: c(a(), s(), smooth=0.2))
        yield Row(f"volume.{call}.quantized", lambda c=combine, a=sdf, b=ball: c(a().quantize("fp8"), b()))
        yield Row(f"volume.{call}.masks", lambda c=combine: c(*masks()))


def steep_half_box(points: np.ndarray) -> np.ndarray:
    return 0.5 * steep_box(points)


def masks() -> list[gk.volume.SparseVolume]:
    found = []
    for seed in (0, 1, 2):
        values = np.random.default_rng(seed).random((40, 30, 20)) < 0.4
        values[8:32, 8:24, :8] = seed != 1
        found.append(
            gk.volume.from_dense(values, voxel_size=0.5, origin=(-9, seed, 0), background=False, grid_type="mask")
        )
    return found


def field_operation_rows(given: Inputs) -> Rows:
    fields: dict[str, Callable[[], gk.volume.SparseVolume]] = {
        "fog": lambda: given.fog,
        "velocity": lambda: given.velocity(),
        "double": lambda: given.typed("double"),
        "fp8": lambda: given.fog.quantize("fp8"),
    }
    for name, volume in fields.items():
        cached = functools.cache(volume)
        for order in (0, 1, 2, 3):
            yield Row(
                f"volume.resample.{name}.order_{order}",
                lambda v=cached, o=order: gk.volume.resample(v(), voxel_size=0.13, order=o, device=given.device),
            )
        yield Row(
            f"volume.resample.{name}.sheared",
            lambda v=cached: gk.volume.resample(v(), transform=SHEARED, device=given.device),
        )
        for method in ("gaussian", "mean", "median"):
            yield Row(
                f"volume.smooth.{name}.{method}",
                lambda v=cached, m=method: tried(lambda: gk.volume.smooth(v(), m, width=1, iterations=2)),
            )
    for neighbors in ("faces", "edges", "vertices"):
        for call in ("dilate", "erode", "opening", "closing"):
            yield Row(
                f"volume.{call}.fog.{neighbors}",
                lambda c=call, n=neighbors: getattr(gk.volume, c)(
                    given.fog, voxels=2, neighbors=n, device=given.device
                ),
            )
    yield Row("volume.statistics.fog", lambda: gk.volume.statistics(given.fog))
    yield Row(
        "volume.segment.fog", lambda: gk.volume.segment(gk.volume.erode(given.fog, voxels=4, device=given.device))
    )
    yield Row("volume.segment.close", lambda: gk.volume.segment(close_balls(), device=given.device))
    yield Row(
        "volume.connected_components.tiles",
        lambda: gk.volume.connected_components(gk.volume.prune(thick_plate()), device=given.device),
    )
    yield Row("volume.prune.fog", lambda: gk.volume.prune(given.fog, 0.5))
    yield Row("volume.clip.fog", lambda: gk.volume.clip(given.fog, [[-1, -1, 1], [1.5, 0.5, 4]]))


def close_balls() -> gk.volume.SparseVolume:
    """Level set of four balls whose bands meet, and of one that stands apart."""
    centers = np.array([[-0.4, 0, 0], [0.35, 0.1, 0], [0.0, -0.7, 0.1], [0.1, 0.1, 0.7], [2.0, 2.0, 2.0]])

    def distance(points: Any) -> Any:
        return np.min([np.linalg.norm(points - center, axis=1) for center in centers], axis=0) - 0.3

    return gk.volume.from_function(distance, [[-1.0] * 3, [2.6] * 3], 0.05)


def volume_file_rows(given: Inputs) -> Rows:
    several = lambda: [  # noqa: E731
        given.sdf(), given.fog, given.fog, given.velocity(), given.typed("int64"), given.typed("bool"),
    ]  # fmt: skip
    for codec in ("none", "zip", "blosc"):
        if codec != "blosc":
            yield Row(f"volume.save.nvdb.{codec}", lambda c=codec: saved_volumes(given, several(), c).read_bytes())
        for kind in ("nvdb", "vdb"):
            yield Row(
                f"volume.load_all.{kind}.{codec}",
                lambda k=kind, c=codec: volume_again(given, f"several.{k}", several(), codec=c),
                blosc(codec),
            )
    yield Row("volume.load_all.vdb.half", lambda: volume_again(given, "half.vdb", several(), half=True))
    yield Row("volume.load.vdb.trusted", lambda: trusted(given, several()))
    yield Row("volume.save.made_of_loaded", lambda: operated(given))
    for name in ("smoke.vdb", "torus.vdb"):
        yield Row(f"volume.load_all.sample.{name}", lambda n=name: loaded(SAMPLES / n))
        yield Row(f"volume.inspect.sample.{name}", lambda n=name: gk.volume.inspect(SAMPLES / n))
    yield Row("volume.load.sample.torus", lambda: loaded(SAMPLES / "torus.vdb", gk.volume.load))
    load_density = functools.partial(gk.volume.load, grid="density")
    yield Row("volume.load.sample.density", lambda: loaded(SAMPLES / "smoke.vdb", load_density))
    yield Row("volume.integrate.sample.smoke", lambda: smoke_of(given))
    cases: dict[str, Callable[[], Any]] = {
        "missing": lambda: gk.volume.load(given.folder() / "a.nvdb"),
        "extension": lambda: gk.volume.load(given.folder() / "a.txt"),
        "empty": lambda: gk.volume.load(written(given, "a.nvdb", b"")),
        "magic": lambda: gk.volume.load(written(given, "a.nvdb", b"not a grid" * 100)),
        "name": lambda: gk.volume.load(saved_volumes(given, several()), grid="heat"),
        # Of those with a grid "density", load takes that.
        "several": lambda: gk.volume.load(saved_volumes(given, [v for v in several() if v.info.name != "density"])),
        "short": lambda: gk.volume.load_all(shortened(given, several())),
        "flipped": lambda: gk.volume.load_all(flipped(given, several())),
        "codec": lambda: gk.volume.save(given.folder() / "a.nvdb", given.fog, codec="rar"),
        "nothing": lambda: gk.volume.save(given.folder() / "a.nvdb"),
        "half": lambda: gk.volume.save(given.folder() / "a.nvdb", given.fog, half=True),
        "adaptive": lambda: gk.volume.load_adaptive(saved_volumes(given, several())),
    }
    for name, call in cases.items():
        yield Row(f"volume.refused.file_{name}", lambda c=call: refused(c))
    yield Row("volume.refused.file_vdb", lambda: refused(lambda: gk.volume.load(written(given, "a.vdb", b"no" * 100))))


def loaded(path: Path, load: Callable[[Path], Any] | None = None) -> Any:
    return (load or gk.volume.load_all)(path)


def saved_volumes(given: Inputs, volumes: list[Any], codec: str | None = None) -> Path:
    path = given.folder() / "several.nvdb"
    gk.volume.save(path, *volumes, codec=codec)
    return path


def shortened(given: Inputs, volumes: list[Any]) -> Path:
    path = saved_volumes(given, volumes)
    path.write_bytes(path.read_bytes()[:5000])
    return path


def flipped(given: Inputs, volumes: list[Any]) -> Path:
    """A bit of the first grid's tree turned over."""
    path = saved_volumes(given, volumes)
    content = bytearray(path.read_bytes())
    content[3000] ^= 64
    path.write_bytes(content)
    return path


def volume_again(given: Inputs, name: str, volumes: list[Any], **options: Any) -> Any:
    path = given.folder() / name
    gk.volume.save(path, *volumes, **options)
    about = gk.volume.inspect(path)
    if path.suffix == ".vdb" or options.get("codec"):
        # Of a file's compressed bytes: those are the library's.
        about = [dataclasses.replace(info, byte_count=0) for info in about]
    return [gk.volume.load_all(path), about]


def trusted(given: Inputs, volumes: list[Any]) -> Any:
    path = given.folder() / "trusted.vdb"
    gk.volume.save(path, *volumes)
    return [gk.volume.load(path, grid="scan", trusted=True), gk.volume.load_all(path, trusted=True)]


def operated(given: Inputs) -> Any:
    """Metadata through a chain of operations and files."""
    path = given.folder() / "chain.nvdb"
    gk.volume.save(path, given.sdf().quantize(tolerance=1e-3), codec="zip")
    return gk.volume.clip(gk.volume.load(path), [[-1, -1, -1], [1, 0.2, 1]])


def smoke_of(given: Inputs) -> Any:
    grids = loaded(SAMPLES / "smoke.vdb")
    density, velocity = grids["density"], grids["velocity"]
    rays, places = given.volume_rays(density), given.places(density)
    seen = [density.integrate(*rays, extinction=20.0, device=given.device), density.sample(places, device=given.device)]
    slopes = [velocity.sample(places, order=3, device=given.device), gk.volume.curl(velocity, device=given.device)]
    return [*seen, *slopes, gk.volume.statistics(velocity)]


def volume_refusal_rows(given: Inputs) -> Rows:
    scan, fog = functools.partial(given.surface, "scan"), lambda: given.fog
    point, bad = [[0.0, 0, 0]], [[0.0, math.inf, 0]]
    make, dense = gk.volume.from_mesh, gk.volume.from_dense
    cases: dict[str, Callable[[], Any]] = {
        "from_mesh_nothing": lambda: make(scan()),
        "from_mesh_both": lambda: make(scan(), 0.1, tolerance=0.1),
        "from_mesh_size": lambda: make(scan(), -0.1),
        "from_mesh_small": lambda: make(scan(), 1e-12),
        "from_mesh_width": lambda: make(scan(), 0.1, half_width=0.5),
        "from_mesh_sign": lambda: make(scan(), 0.1, sign="guess"),
        "from_mesh_codec": lambda: make(scan(), 0.1, codec="jpeg"),
        "from_mesh_method": lambda: make(scan(), 0.1, method="magic"),
        "from_mesh_order": lambda: make(scan(), 0.1, order=1),
        "from_mesh_tolerance": lambda: make(scan(), tolerance=0.0),
        "from_points_none": lambda: gk.volume.from_points(np.zeros((0, 3)), 1.0, voxel_size=0.1),
        "from_points_radius": lambda: gk.volume.from_points(point, [-1.0], voxel_size=0.1),
        "from_function_slope": lambda: gk.volume.from_function(steep_box, [[-1, -1, -1], [1, 1, 1]], 0.1),
        "from_function_bounds": lambda: gk.volume.from_function(ring, [[1, 1, 1], [0, 0, 0]], 0.1),
        "from_dense_shape": lambda: dense(np.zeros((3, 3)), voxel_size=1.0),
        "from_dense_nan": lambda: dense(np.full((3, 3, 3), np.nan), voxel_size=1.0),
        "from_dense_type": lambda: dense(np.zeros((3, 3, 3)), voxel_size=1.0, grid_type="fp8"),
        "from_dense_class": lambda: dense(np.zeros((3, 3, 3), bool), voxel_size=1.0, grid_class="staggered"),
        "from_dense_transform": lambda: dense(np.zeros((3, 3, 3)), transform=np.zeros((4, 4))),
        "to_dense_bounds": lambda: fog().to_dense(bounds=[[1, 1, 1], [0, 0, 0]], device=given.device),
        "sample_order": lambda: fog().sample(point, order=4, device=given.device),
        "sample_space": lambda: fog().sample(point, space="moon", device=given.device),
        "sample_nan": lambda: fog().sample(bad, device=given.device),
        "sample_channel": lambda: fog().sample(point, channel=0, device=given.device),
        "gradient_nan": lambda: fog().gradient(bad * 200, device=given.device),
        "raycast_zero": lambda: fog().raycast(point, point, device=given.device),
        "raycast_nan": lambda: fog().raycast(bad, point, device=given.device),
        "raycast_vectors": lambda: given.velocity().raycast(point, [[1.0, 0, 0]], device=given.device),
        "integrate_background": lambda: given.sdf().integrate(point, [[1.0, 0, 0]], device=given.device),
        "quantize_codec": lambda: fog().quantize("jpeg"),
        "quantize_type": lambda: given.typed("int32").quantize("fp8"),
        "resample_both": lambda: gk.volume.resample(fog(), voxel_size=1.0, transform=SHEARED),
        "resample_order": lambda: gk.volume.resample(given.typed("int32"), voxel_size=1.0, order=1),
        "offset_fog": lambda: gk.volume.offset(fog(), 0.1),
        "offset_far": lambda: gk.volume.offset(given.sdf(), 100.0),
        "dilate_both": lambda: gk.volume.dilate(fog(), 0.1, voxels=1),
        "dilate_voxels": lambda: gk.volume.dilate(given.sdf(), voxels=1),
        "dilate_neighbors": lambda: gk.volume.dilate(fog(), voxels=1, neighbors="all"),
        "adaptive_sign": lambda: gk.volume.adaptive_from_mesh(scan(), 0.1, sign="none"),
        "adaptive_levels": lambda: gk.volume.adaptive_from_mesh(scan(), 0.1, max_levels=0),
        "curvature_order": lambda: fog().curvature(point, order=1, device=given.device),
        "hessian_vectors": lambda: given.velocity().hessian(point, device=given.device),
        "divergence": lambda: gk.volume.divergence(fog(), device=given.device),
        "plan": lambda: gk.volume.plan(scan(), -1.0),
        "not_a_volume": lambda: gk.volume.statistics("fog"),
    }
    for name, call in cases.items():
        yield Row(f"volume.refused.{name}", lambda c=call: refused(c))
    openvdb: dict[str, Callable[[], Any]] = {
        "union_fog": lambda: gk.volume.union(fog(), given.sdf()),
        "clip": lambda: gk.volume.clip(fog(), [[1, 1, 1], [0, 0, 0]]),
        "prune": lambda: gk.volume.prune(fog(), -1.0),
        "smooth": lambda: gk.volume.smooth(fog(), "laplacian"),
    }
    for name, call in openvdb.items():
        yield Row(f"volume.refused.{name}", lambda c=call: refused(c))


# ---------------------------------------------------------------------------------------------------------------------
# Points


def point_rows(given: Inputs) -> Rows:
    for name, radius in CLOUDS.items():
        yield from neighbor_rows(given, name, radius)
        yield from cloud_rows(given, name, radius)
    kinds = given.containers(np.zeros((2, 3)))
    for kind in kinds:
        yield from point_container_rows(given, kind)
    yield from register_rows(given)
    yield Row("points.NeighborGrid.id", lambda: own_neighbors(given))
    yield Row("points.PointCloud", lambda: point_cloud(given))


def neighbor_rows(given: Inputs, name: str, radius: float) -> Rows:
    @functools.cache
    def grid(own: bool = True) -> gk.points.NeighborGrid:
        return gk.points.NeighborGrid(given.cloud(name), radius if own else None, device=given.device)

    def queries() -> np.ndarray:
        points = given.cloud(name)
        return points[::3] + (np.random.default_rng(15).random((len(points[::3]), 3)) - 0.5) * radius

    def radii() -> np.ndarray:
        return radius * np.random.default_rng(16).random(len(queries()))

    label = f"points.{{}}.{name}".format
    yield Row(label("NeighborGrid"), lambda: [len(grid()), grid().radius, grid(False).radius, repr(grid())[:40]])
    yield Row(label("count"), lambda: [grid().count(), grid().count(queries()), grid().count(exclude_self=True)])
    yield Row(label("count") + ".radii", lambda: grid().count(queries(), radius=radii()))
    for order in ("index", "distance", "any"):
        yield Row(
            label("radius_search") + f".{order}",
            lambda o=order: [grid().radius_search(order=o), grid().radius_search(queries(), order=o)],
        )
    yield Row(
        label("radius_search") + ".other",
        lambda: [
            grid().radius_search(queries(), radius=0.3 * radius),
            grid().radius_search(queries()[:400], radius=2.5 * radius, order="distance"),
            grid().radius_search(radius=0.0, exclude_self=True),
            grid().radius_search(queries(), radius=radii()),
            grid(False).radius_search(queries()[:400]),
        ],
    )
    yield Row(
        label("radius_search_blocks"),
        lambda: list(grid().radius_search_blocks(queries(), memory=30_000, order="distance")),
    )
    yield Row(label("pairs"), lambda: [grid().pairs(), grid().pairs(radius=0.4 * radius)])
    for k in (1, 8, 40):
        yield Row(label("knn") + f".{k}", lambda k=k: [grid().knn(queries(), k), grid(False).knn(k=k)])
    yield Row(label("knn") + ".others", lambda: grid().knn(k=5, exclude_self=True))
    yield Row(
        label("hybrid"),
        lambda: [grid().hybrid(queries(), 6), grid().hybrid(k=9, radius=0.5 * radius, exclude_self=True),
                 grid().hybrid(queries(), 4, radius=radii())],
    )  # fmt: skip


def cloud_rows(given: Inputs, name: str, radius: float) -> Rows:
    points, device = functools.partial(given.cloud, name), given.device
    label = f"points.{{}}.{name}".format
    yield Row(label("normals"), lambda: gk.points.normals(points(), device=device))
    yield Row(label("normals") + ".k", lambda: gk.points.normals(points(), k=7, orientation="none", device=device))
    yield Row(label("normals") + ".radius", lambda: gk.points.normals(points(), radius=radius, device=device))
    yield Row(
        label("normals") + ".viewpoint",
        lambda: gk.points.normals(
            points(), radius=radius, orientation="viewpoint", viewpoint=[0.1, 0.2, 9.0], device=device
        ),
    )
    for kernel in ("count", "cubic_spline", "wendland_c2", "poly6"):
        yield Row(
            label("density") + f".{kernel}",
            lambda k=kernel: gk.points.density(points(), radius=radius, kernel=k, device=device),
        )
    yield Row(
        label("density") + ".queries",
        lambda: gk.points.density(
            points(), radius=radius, kernel="poly6", mass=np.arange(len(points())) % 7 + 0.5,
            queries=points()[::5] + 0.3 * radius, device=device,
        ),
    )  # fmt: skip
    yield Row(label("outliers"), lambda: gk.points.outliers(points(), k=10, ratio=1.5, device=device))
    yield Row(
        label("outliers") + ".radius",
        lambda: gk.points.outliers(points(), method="radius", radius=radius, minimum_count=4, device=device),
    )
    yield Row(
        label("cluster"),
        lambda: [gk.points.cluster(points(), radius=radius * s, minimum_count=n, device=device)
                 for s, n in ((0.6, 3), (1.0, 8))],
    )  # fmt: skip
    for option, value in (("voxel_size", 2 * radius), ("count", 200), ("radius", radius), ("tolerance", 2 * radius)):
        yield Row(
            label("downsample") + f".{option}",
            lambda o=option, v=value: gk.points.downsample(points(), **{o: v}, device=device),
        )
    yield Row(label("downsample") + ".start", lambda: gk.points.downsample(points(), count=50, start=17, device=device))
    yield Row(
        label("downsample") + ".seed", lambda: gk.points.downsample(points(), radius=radius, seed=5, device=device)
    )
    yield Row(label("cover"), lambda: gk.points.cover(points(), tolerance=2 * radius, seed=1, device=device))
    other = lambda: points()[1::2] + 0.37 * radius  # noqa: E731
    yield Row(label("chamfer"), lambda: gk.points.chamfer(points(), other(), device=device))
    yield Row(label("hausdorff"), lambda: gk.points.hausdorff(points()[::2], other(), device=device))


def point_container_rows(given: Inputs, kind: str) -> Rows:
    """The same cloud in other containers."""
    device = given.device

    def points() -> Any:
        return given.containers(given.cloud("surface"))[kind]

    def plain() -> gk.points.NeighborGrid:
        return gk.points.NeighborGrid(given.cloud("surface"), 0.08, device=device)

    calls: dict[str, Callable[[], Any]] = {
        "NeighborGrid": lambda: [
            gk.points.NeighborGrid(points(), 0.08, device=device).radius_search(),
            gk.points.NeighborGrid(points(), device=device).knn(k=3),
            gk.points.NeighborGrid(points(), 0.08, device=device).pairs(),
        ],
        "radius_search": lambda: plain().radius_search(points()),
        "count": lambda: plain().count(points()),
        "knn": lambda: plain().knn(points(), 5),
        "hybrid": lambda: plain().hybrid(points(), 5),
        "normals": lambda: gk.points.normals(points(), device=device),
        "density": lambda: gk.points.density(points(), radius=0.1, kernel="cubic_spline", device=device),
        "outliers": lambda: gk.points.outliers(points(), device=device),
        "cluster": lambda: gk.points.cluster(points(), radius=0.05, device=device),
        "downsample.voxel_size": lambda: gk.points.downsample(points(), voxel_size=0.1, device=device),
        "downsample.radius": lambda: gk.points.downsample(points(), radius=0.1, device=device),
        "downsample.count": lambda: tried(lambda: gk.points.downsample(points(), count=40, device=device)),
        "cover": lambda: tried(lambda: gk.points.cover(points(), tolerance=0.2, device=device)),
        "chamfer": lambda: tried(lambda: gk.points.chamfer(points(), given.cloud("surface")[::2], device=device)),
        "hausdorff": lambda: tried(lambda: gk.points.hausdorff(points(), given.cloud("surface")[::2], device=device)),
    }
    for name, call in calls.items():
        yield Row(f"points.{name}.surface.{kind}", call)


def register_rows(given: Inputs) -> Rows:
    def source(name: str = "surface") -> np.ndarray:
        """The cloud turned by a few degrees, by a rotation of rational numbers, and moved."""
        points, center = given.cloud(name), given.cloud(name)[0]
        x, y, z = (points - center).T
        c, s = 399.0 / 401.0, 40.0 / 401.0
        return np.stack([c * x - s * y + 0.02, s * x + c * y - 0.01, z + 0.03], axis=1) + center

    targets: dict[str, Callable[[], Any]] = {
        "cloud": lambda: given.cloud("surface"),
        "surface": lambda: given.surface("scan"),
        "mesh": lambda: given.mesh("scan"),
        "volume": lambda: given.sdf(),
    }
    for name, target in targets.items():
        for method in ("point_to_plane", "point_to_point"):
            yield Row(
                f"points.register.{name}.{method}",
                lambda t=target, m=method: gk.points.register(
                    source(), t(), method=m, max_distance=0.3, max_iterations=15, device=given.device
                ),
            )
    start = np.eye(4)
    start[:3, 3] = [-0.01, 0.0, -0.02]
    yield Row(
        "points.register.options",
        lambda: gk.points.register(
            source().astype(np.float32), given.cloud("surface"), initial=start, tolerance=1e-4, max_distance=0.05,
            target_normals=unit(given.cloud("surface")), device=given.device,
        ),
    )  # fmt: skip
    flat = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0), [0.0]), axis=-1).reshape(-1, 3)
    yield Row(
        "points.register.plane", lambda: gk.points.register(flat + np.array([0.2, 0.1, 0.3]), flat, device=given.device)
    )
    yield Row(
        "points.register.far",
        lambda: gk.points.register(source("far"), given.cloud("far"), max_iterations=10, device=given.device),
    )


def point_cloud(given: Inputs) -> Any:
    points = given.cloud("lattice")
    data = {"number": np.arange(len(points)), "pair": np.zeros((len(points), 2), np.int8)}
    cloud = gk.points.PointCloud(points, data)
    return [len(cloud), repr(cloud), cloud]


POINT_FORMATS = {
    **dict.fromkeys(("csv", "npz", "pcd", "ply", "pts", "xyz"), ()),
    "vtp": VTKS, "las": ("laspy",), "laz": ("laspy", "lazrs"),
}  # fmt: skip


def point_data(count: int, kind: str) -> dict[str, Any]:
    random = np.random.default_rng(17)
    colors = random.integers(0, 256, (count, 3)).astype(np.uint8)
    if kind == "pts":
        return {"intensity": random.integers(0, 4096, count).astype(np.float64), "rgb": colors}
    if kind in ("las", "laz"):
        return {"intensity": random.integers(0, 4096, count).astype(np.uint16), "rgb": colors.astype(np.uint16),
                "weight": random.random(count)}  # fmt: skip
    return {"normals": random.random((count, 3)), "rgb": colors, "label": np.arange(count, dtype=np.int32),
            "weight": random.random(count).astype(np.float32)}  # fmt: skip


def saved_points(given: Inputs, name: str, kind: str, data: bool = True, **options: Any) -> Path:
    path, points = given.folder() / f"{name}.{kind}", given.cloud(name)
    gk.points.save(path, points, data=point_data(len(points), kind) if data else None, **options)
    return path


def point_file_rows(given: Inputs) -> Rows:
    for kind, needs in POINT_FORMATS.items():
        for name in ("clusters", "far"):
            for data in (False, True):
                yield Row(
                    f"points.load.{kind}.{name}" + ".data" * data,
                    lambda k=kind, n=name, d=data: gk.points.load(saved_points(given, n, k, d)),
                    needs,
                )
        if kind not in ("las", "laz"):
            yield Row(f"points.save.{kind}", lambda k=kind: saved_points(given, "lattice", k).read_bytes(), needs)
    for encoding in ("ascii", "binary", "binary_compressed"):
        yield Row(
            f"points.save.pcd.{encoding}",
            lambda e=encoding: saved_points(given, "clusters", "pcd", encoding=e).read_bytes(),
        )
        yield Row(
            f"points.load.pcd.{encoding}",
            lambda e=encoding: gk.points.load(saved_points(given, "clusters", "pcd", encoding=e)),
        )
    yield Row("points.save.pcd.float32", lambda: saved_single(given))
    for kind in ("xyz", "csv", "pts", "txt"):
        yield Row(f"points.load.{kind}.long", lambda k=kind: gk.points.load(long_text(given, k)))
    yield Row("points.load.npy", lambda: gk.points.load(saved_array(given)))
    yield Row("points.load.npz.one", lambda: gk.points.load(saved_arrays(given, {"a": given.cloud("heap")})))
    texts = {
        "obj": "v 0 0 1\nv 1.5 2 -3e-2\nf 1 2 1\n",
        "txt": "# a comment\n0 0 1 7\n1.5 2 -3e-2 8\n",
        "csv": "id,z,y,x,nx,ny,nz\n1,2,3,4,0,0,1\n2,0.1,1e300,-0.0,1,0,0\n",
        "pts": "2\n0 0 1 -100 255 0 9\n1 2 3 5 1 2 3\n",
        "ply": PLY,
        "pcd": "VERSION .7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\n"
        "POINTS 2\nDATA ascii\n0 0 1 4.2108e+06\n1 2 nan 0\n",
    }
    for kind, text in texts.items():
        yield Row(
            f"points.load.{kind}.text",
            lambda k=kind, t=text: gk.points.load(written(given, f"text.{k}", t), finite_only=True),
        )
    yield Row("points.load.sample.cloud", lambda: gk.points.load(SAMPLES / "cloud.ply"))
    yield from ray_file_rows(given)
    cases: dict[str, Callable[[], Any]] = {
        "missing": lambda: gk.points.load(given.folder() / "a.xyz"),
        "extension": lambda: gk.points.load(written(given, "a.xml", "")),
        "words": lambda: gk.points.load(written(given, "a.xyz", "0 0 0\n1 one 1\n")),
        "columns": lambda: gk.points.load(written(given, "a.xyz", "0 0\n1 1\n")),
        "ragged": lambda: gk.points.load(written(given, "a.csv", "x,y,z\n0,0,0\n1,1\n")),
        "finite": lambda: gk.points.load(written(given, "a.pcd", texts["pcd"])),
        "pcd_header": lambda: gk.points.load(written(given, "a.pcd", texts["pcd"].replace("POINTS 2", "POINTS 3"))),
        "pcd_short": lambda: gk.points.load(shorter(saved_points(given, "heap", "pcd"))),
        "pcd_compressed": lambda: gk.points.load(
            shorter(saved_points(given, "heap", "pcd", encoding="binary_compressed"))
        ),
        "ply_short": lambda: gk.points.load(shorter(saved_points(given, "heap", "ply"))),
        "npz": lambda: gk.points.load(saved_arrays(given, {"a": np.zeros((3, 3)), "b": np.zeros((3, 3))})),
        "pts_count": lambda: gk.points.load(written(given, "a.pts", "9\n0 0 0\n")),
        "save_extension": lambda: gk.points.save(given.folder() / "a.obj", [[0.0, 0, 0]]),
        "save_rows": lambda: gk.points.save(given.folder() / "a.ply", [[0.0, 0, 0]], data={"a": [1, 2]}),
        "save_encoding": lambda: gk.points.save(given.folder() / "a.ply", [[0.0, 0, 0]], encoding="ascii"),
        "save_name": lambda: gk.points.save(given.folder() / "a.npz", [[0.0, 0, 0]], data={"points": [1]}),
        "save_pts": lambda: gk.points.save(given.folder() / "a.pts", [[0.0, 0, 0]], data={"label": [1]}),
        "save_nan": lambda: gk.points.save(given.folder() / "a.ply", [[0.0, math.nan, 0]]),
        "rays": lambda: gk.points.load_rays(written(given, "a.csv", "ox,oy,oz\n0,0,0\n")),
        "rays_zero": lambda: gk.points.load_rays(written(given, "a.xyz", "0 0 0 0 0 0\n")),
    }
    for name, call in cases.items():
        yield Row(f"points.refused.file_{name}", lambda c=call: refused(c))


def ray_file_rows(given: Inputs) -> Rows:
    rays = np.random.default_rng(18).random((200, 6)) - 0.5
    lines = "".join(" ".join(map(repr, row)) + "\n" for row in rays.tolist())
    columns = "dx,dy,dz,weight,OX,oy,oz\n" + "".join(
        ",".join(map(repr, [*row[3:], 1.0, *row[:3]])) + "\n" for row in rays.tolist()
    )
    arrays = {"origins": rays[:, :3], "directions": rays[:, 3:].astype(np.float32)}
    files: dict[str, Callable[[], Path]] = {
        "xyz": lambda: written(given, "rays.xyz", lines),
        "txt": lambda: written(given, "rays.txt", lines),
        "csv": lambda: written(given, "rays.csv", columns),
        "npz": lambda: saved_arrays(given, arrays),
        "npz.table": lambda: saved_arrays(given, {"rays": rays}),
        "npy": lambda: saved_array(given, rays),
    }
    for kind, path in files.items():
        yield Row(f"points.load_rays.{kind}", lambda p=path: gk.points.load_rays(p()))


def saved_single(given: Inputs) -> bytes:
    path = given.folder() / "single.pcd"
    gk.points.save(path, given.cloud("surface").astype(np.float32))
    return path.read_bytes()


def saved_array(given: Inputs, rows: Any = None) -> Path:
    path = given.folder() / "rows.npy"
    np.save(path, np.column_stack([given.cloud("heap"), np.arange(1900.0)]) if rows is None else rows)
    return path


def saved_arrays(given: Inputs, arrays: dict[str, Any]) -> Path:
    path = given.folder() / "arrays.npz"
    np.savez(path, **arrays)
    return path


def shorter(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[:-100])
    return path


def long_text(given: Inputs, kind: str) -> Path:
    """Numbers of every length and exponent, more than a megabyte: those are read by a kernel."""
    random = np.random.default_rng(19)
    rows = (random.random((25_000, 3)) - 0.5) * 10.0 ** random.integers(-12, 13, (25_000, 3))
    gap = "," if kind == "csv" else " "
    head = {"csv": "x,y,z\n", "pts": "25000\n"}.get(kind, "")
    lines = (gap.join((repr(x), f"{y:.6f}", f"{z:.17e}")) + "\n" for x, y, z in rows.tolist())
    return written(given, f"long.{kind}", head + "".join(lines))


def point_refusal_rows(given: Inputs) -> Rows:
    points, bad, device = np.zeros((4, 3)), np.array([[0.0, 0, 0], [math.nan, 0, 0]]), given.device
    grid = lambda: gk.points.NeighborGrid(points, 1.0, device=device)  # noqa: E731
    cases: dict[str, Callable[[], Any]] = {
        "grid_shape": lambda: gk.points.NeighborGrid(points[:, :2], 1.0, device=device),
        "grid_nan": lambda: gk.points.NeighborGrid(bad, 1.0, device=device),
        "grid_radius": lambda: gk.points.NeighborGrid(points, -1.0, device=device),
        "queries_nan": lambda: grid().count(bad),
        "radii": lambda: grid().count(points, radius=[1.0, 2.0]),
        "order": lambda: grid().radius_search(points, order="size"),
        "exclude": lambda: grid().count(points[:2], exclude_self=True),
        "memory": lambda: list(grid().radius_search_blocks(memory=-1)),
        "k": lambda: grid().knn(points, 0),
        "k_large": lambda: grid().knn(points, 1025),
        "normals_k": lambda: gk.points.normals(points, k=2, device=device),
        "normals_viewpoint": lambda: gk.points.normals(points, orientation="viewpoint", device=device),
        "density_kernel": lambda: gk.points.density(points, radius=1.0, kernel="box", device=device),
        "density_mass": lambda: gk.points.density(points, radius=1.0, mass=[1.0], device=device),
        "outliers_method": lambda: gk.points.outliers(points, method="far", device=device),
        "cluster_count": lambda: gk.points.cluster(points, radius=1.0, minimum_count=0, device=device),
        "downsample_none": lambda: gk.points.downsample(points, device=device),
        "downsample_count": lambda: gk.points.downsample(points, count=9, device=device),
        "cover_empty": lambda: gk.points.cover(points[:0], tolerance=1.0, device=device),
        "register_method": lambda: gk.points.register(points, points, method="guess", device=device),
        "register_initial": lambda: gk.points.register(points, points, initial=2 * np.eye(4), device=device),
        "register_far": lambda: gk.points.register(points, points + 9, max_distance=1.0, device=device),
        "chamfer_empty": lambda: gk.points.chamfer(points, points[:0], device=device),
        "cloud_data": lambda: gk.points.PointCloud(points, {"a": [1]}),
    }
    for name, call in cases.items():
        yield Row(f"points.refused.{name}", lambda c=call: refused(c))


# ---------------------------------------------------------------------------------------------------------------------
# The user's own kernels, and teams of threads


@wp.kernel
def own_closest_kernel(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3f),
    out_distance: wp.array(dtype=float),
    out_face: wp.array(dtype=int),
):
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e10)
    out_face[i] = query.face
    out_distance[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


@wp.kernel
def own_sample_kernel(volume: wp.uint64, points: wp.array(dtype=wp.vec3f), out_value: wp.array(dtype=float)):
    i = wp.tid()
    out_value[i] = wp.volume_sample_f(volume, wp.volume_world_to_index(volume, points[i]), wp.Volume.LINEAR)


@wp.kernel
def own_count_kernel(grid: wp.uint64, radius: float, points: wp.array(dtype=wp.vec3f), out_count: wp.array(dtype=int)):
    i = wp.tid()
    count = wp.int32(0)
    for j in wp.hash_grid_query(grid, points[i], radius):
        if wp.length(points[j] - points[i]) <= radius:
            count += 1
    out_count[i] = count


@wp.kernel
def scale_kernel(share: gk.threads.Share, factor: float, values: wp.array(dtype=float)):
    for k in range(wp.tid(), share.count, share.step):
        values[gk.threads.item(share, k)] *= factor


@wp.kernel
def diffuse_kernel(share: gk.threads.Share, steps: int, values: wp.array2d(dtype=wp.int64)):
    count = values.shape[1]
    for s in range(steps):
        for k in range(wp.tid(), share.count, share.step):
            i = gk.threads.item(share, k)
            left, right = values[s % 2, (i + count - 1) % count], values[s % 2, (i + 1) % count]
            values[1 - s % 2, i] = (left * wp.int64(3) + right * wp.int64(5)) % wp.int64(1000003)
        gk.threads.barrier(share)


def own_closest(given: Inputs) -> Any:
    surface = given.surface("scan")
    local = (given.queries("scan") - surface.origin) / surface.scale
    points = wp.array(local, dtype=wp.vec3f, device=given.device)
    distance = wp.empty(len(points), dtype=float, device=given.device)
    face = wp.empty(len(points), dtype=int, device=given.device)
    inputs = [wp.uint64(surface.id), points]
    wp.launch(own_closest_kernel, len(points), inputs=inputs, outputs=[distance, face], device=given.device)
    return [distance.numpy(), face.numpy()]


def own_samples(given: Inputs) -> Any:
    volume = given.sdf()
    points = wp.array(given.queries("scan"), dtype=wp.vec3f, device=given.device)
    value = wp.empty(len(points), dtype=float, device=given.device)
    inputs = [wp.uint64(volume.id(given.device)), points]
    wp.launch(own_sample_kernel, len(points), inputs=inputs, outputs=[value], device=given.device)
    return [value.numpy(), volume.on(given.device).get_voxel_size()]


def own_neighbors(given: Inputs) -> Any:
    grid = gk.points.NeighborGrid(given.cloud("volume"), 0.07, device=given.device)
    points = wp.array(given.cloud("volume"), dtype=wp.vec3f, device=given.device)
    count = wp.empty(len(points), dtype=int, device=given.device)
    inputs = [wp.uint64(grid.id), 0.07, points]
    wp.launch(own_count_kernel, len(points), inputs=inputs, outputs=[count], device=given.device)
    return count.numpy()


def thread_rows(given: Inputs) -> Rows:
    for threads in (1, 2, 3):
        yield Row(f"threads.Team.run.{threads}", lambda t=threads: scaled(given, t))
        yield Row(f"threads.Team.barrier.{threads}", lambda t=threads: diffused(given, t))
    cases: dict[str, Callable[[], Any]] = {
        "threads": lambda: gk.threads.Team(0, device=given.device),
        "device": lambda: gk.threads.Team(device="tpu:1"),
        "kernel": lambda: gk.threads.Team(2, device=given.device).run(own_sample_kernel, 3, []),
        "count": lambda: gk.threads.Team(2, device=given.device).run(scale_kernel, -3, []),
    }
    for name, call in cases.items():
        yield Row(f"threads.refused.{name}", lambda c=call: refused(c))


def scaled(given: Inputs, threads: int) -> Any:
    team = gk.threads.Team(threads, device=given.device)
    values = wp.array(np.arange(1000, dtype=np.float32), dtype=float, device=given.device)
    team.run(scale_kernel, 1000, [1.5, values], block=7)
    once = team.record(scale_kernel, 500, [0.25, values])
    once()
    team.sequence([once, team.record(scale_kernel, 100, [3.0, values], block=10)])()
    return [team.threads, values.numpy()]


def diffused(given: Inputs, threads: int) -> Any:
    # On a GPU there is no barrier between threads: each step is a launch of its own.
    steps = [20] if given.device == "cpu" else [1] * 20
    values = np.zeros((2, 501), np.int64)
    values[0] = np.arange(501) * 7919 % 1000003
    team, rows = gk.threads.Team(threads, device=given.device), wp.array(values, dtype=wp.int64, device=given.device)
    for count in steps:
        team.run(diffuse_kernel, 501, [count, rows], block=16)
        if count == 1:
            table = rows.numpy()[::-1]
            rows = wp.array(np.ascontiguousarray(table), dtype=wp.int64, device=given.device)
    return rows.numpy()[0]


# ---------------------------------------------------------------------------------------------------------------------
# Accuracy: what it computes beside times


def accuracy_rows(given: Inputs) -> Rows:
    accuracy = gk.accuracy
    random = np.random.default_rng(20)
    seconds, errors = random.random(200), np.square(np.square(random.random(200)))
    errors[::17], errors[::31] = 0.0, math.nan
    yield Row("accuracy.front", lambda: [accuracy.front(seconds, errors, resolution=r) for r in (0.0, 0.3)])
    yield Row("accuracy.knee", lambda: knee_of(seconds, errors))
    yield Row("accuracy.write_table", lambda: table_again(given, measurements()))
    yield Row("accuracy.Results", lambda: list(accuracy.Results(measurements())))
    yield Row("accuracy.default_subjects", subjects, (OPENVDB,))
    found = accuracy.sweeps(given.device)
    yield Row(
        "accuracy.sweeps",
        lambda: [[s.name, s.method, s.parameter, s.unit, s.values, s.logarithmic] for s in found],
        (OPENVDB,),
    )
    for sweep in found:
        yield Row(f"accuracy.follow.{sweep.name}", lambda s=sweep: followed(s))
    if not native.available():
        # The sweep that is left out there.
        yield Row("accuracy.follow.smooth_gaussian_radius", lambda: None, (OPENVDB,))
    yield Row(
        "accuracy.refused", lambda: [refused(lambda: accuracy.front([1.0], [])), refused(lambda: accuracy.knee([], []))]
    )


def knee_of(seconds: np.ndarray, errors: np.ndarray) -> int:
    rows = gk.accuracy.front(seconds, errors)
    return int(gk.accuracy.knee(seconds[rows], errors[rows]))


def measurements() -> list[Any]:
    return [
        gk.accuracy.Measurement(
            chart="closest_point", subject="scan", method=f"method {i}", setting="device='cpu'", device="cpu",
            seconds=0.001 * (i + 1), spread=0.1, rate=1e6 / (i + 1), peak_bytes=1000 * i, byte_count=10 + i,
            checked=100, max_error=10.0**-i, rms_error=10.0 ** (-i - 1), p999_error=0.5 * 10.0**-i,
            wrong_share=0.25 * (i == 2), unit="world", parameters={"k": i, "name": "a,b"},
        )
        for i in range(4)
    ]  # fmt: skip


def table_again(given: Inputs, rows: list[Any]) -> Any:
    path = gk.accuracy.write_table(rows, given.folder() / "table.csv")
    return [path.read_bytes(), gk.accuracy.read_table(path)]


def subjects() -> Any:
    with one_processor():
        return list(gk.accuracy.default_subjects())


def followed(sweep: Any) -> Any:
    """Two values: the mildest and one on the way to failure."""
    return gk.accuracy.follow(sweep, [sweep.values[0], sweep.values[len(sweep.values) // 2]])


FAMILIES: tuple[Callable[[Inputs], Rows], ...] = (
    api_rows,
    mesh_rows,
    mesh_refusal_rows,
    mesh_file_rows,
    volume_rows,
    volume_refusal_rows,
    volume_file_rows,
    point_rows,
    point_refusal_rows,
    point_file_rows,
    thread_rows,
    accuracy_rows,
)


# ---------------------------------------------------------------------------------------------------------------------
# The run


def rows_of(family: Callable[[Inputs], Rows], given: Inputs) -> Rows:
    """The rows of a family; where no more can be made, one that says why."""
    try:
        yield from family(given)
    except Exception as error:
        yield Row(family.__name__, functools.partial(raised, error))


def raised(error: Exception) -> None:
    raise error


def line_of(row: Row, hasher: Hasher) -> str:
    """The line of a row, whatever happens."""
    if not all(native.available() if name == OPENVDB else importlib.util.find_spec(name) for name in row.needs):
        return f"{row.name} {UNAVAILABLE}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return f"{row.name} {hasher.of(row.call())}"
    except gk.MissingDependencyError:
        return f"{row.name} {UNAVAILABLE}"
    except Exception as error:
        message = hasher.text(" ".join(f"{type(error).__name__}: {error}".split()))
        return f"{row.name} {ERROR} {message[:300]}"


def parsed(lines: list[str]) -> dict[str, str]:
    rows = (line.split(" ", 1) for line in lines if line.strip() and not line.startswith("#"))
    return {name: rest.strip() for name, rest in rows}


def compare(before: dict[str, str], after: dict[str, str]) -> int:
    """Print what differs; the number of such rows."""
    differing, unavailable = [], []
    for name in [*before, *(name for name in after if name not in before)]:
        a, b = before.get(name, "missing"), after.get(name, "missing")
        if UNAVAILABLE in (a, b):
            if a != b:
                unavailable.append(f"{name}: {a} before, {b} now")
        elif a != b:
            differing.append(f"{name}: {a} before, {b} now")
    if unavailable:
        print(f"{len(unavailable)} rows not compared, unavailable on one side only, {unavailable[0]}")
    print("\n".join(differing) or f"{len(after)} rows, none differs")
    return len(differing)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, ...")
    parser.add_argument("--out", type=Path, help="write the lines to this file")
    parser.add_argument("--compare", type=Path, help="print rows that differ from those of this file; exit 1 if any")
    parser.add_argument("--only", default="", help="only rows whose name contains this")
    parser.add_argument(
        "--leave-out", nargs="*", default=[], metavar="NAME",
        help="fields without a part in the hash; between processors of two makes: vertex_normals (NumPy's arctan2)",
    )  # fmt: skip
    parser.add_argument("--times", action="store_true", help="print the slowest rows to standard error")
    options = parser.parse_args()
    before = parsed(options.compare.read_text(encoding="utf-8").splitlines()) if options.compare else {}
    print(f"geokit {gk.__version__} of {gk.__file__}, {options.device}", file=sys.stderr)
    wp.config.log_level = wp.LOG_WARNING
    print(f"OpenVDB is {'there' if native.available() else 'not there'}", file=sys.stderr)
    lines, times, began = [], [], time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        given, hasher = Inputs(options.device, Path(folder)), Hasher(Path(folder), frozenset(options.leave_out))
        for row in (row for family in FAMILIES for row in rows_of(family, given) if options.only in row.name):
            start = time.perf_counter()
            lines.append(line_of(row, hasher))
            times.append((time.perf_counter() - start, row.name))
            if not options.compare:
                print(lines[-1], flush=True)
    if options.times:
        for seconds, name in sorted(times, reverse=True)[:40]:
            print(f"{seconds:7.2f} s {name}", file=sys.stderr)
    names = [line.split(" ")[0] for line in lines]
    if len(set(names)) < len(names):
        print("rows of one name:", sorted({name for name in names if names.count(name) > 1}), file=sys.stderr)
        return 1
    if options.out:
        options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    errors = sum(line.split(" ")[1] == ERROR for line in lines)
    missing = sum(line.endswith(UNAVAILABLE) for line in lines)
    took = time.perf_counter() - began
    print(f"{len(lines)} rows, {missing} unavailable, {errors} errors, {took:.0f} s", file=sys.stderr)
    if options.compare:
        wanted = {name: rest for name, rest in before.items() if options.only in name}
        return min(compare(wanted, parsed(lines)), 1)
    return min(errors, 1)


if __name__ == "__main__":
    sys.exit(main())
