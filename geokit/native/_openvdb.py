"""Calls of OpenVDB: .vdb files, volumes and meshes. This module alone imports the compiled extension."""

from __future__ import annotations

import functools
import importlib
import itertools
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit._packages import DISTRIBUTION
from geokit.core.base.private_folder import private_folder
from geokit.core.content_limit import content_limit
from geokit.core.files import atomic_path, refuse_empty, require_file
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory import available_memory
from geokit.core.memory.needs import file_size, needs
from geokit.core.require import read_array, require_choice, require_count, require_flag, require_items
from geokit.errors import DeviceMemoryError, FileAccessError, InputError, MissingDependencyError
from geokit.formats.reader.process import reading_seconds
from geokit.native import _served, _worker
from geokit.native._failures import raise_failure
from geokit.native._metadata import RawMetadata, decode_grids, decode_header, encode_all, split

__all__ = [
    "PolygonMesh",
    "RawMetadata",
    "VdbGrid",
    "available",
    "build_facts",
    "inspect_vdb",
    "mesh_to_level_set",
    "read_vdb",
    "require",
    "versions",
    "volume_to_mesh",
    "write_vdb",
]

_PACKAGES = "g++ libopenvdb-dev libnanovdb-dev libtbb-dev libblosc-dev libboost-iostreams-dev libimath-dev"

# Time limit above which no limit is meant [s]: eleven days. The system counts milliseconds in 31 bits.
LONGEST_SECONDS = 1e6
# Alignment of a NanoVDB buffer.
_ALIGNMENT = 32

# Small files are read by forks of a process that has OpenVDB ready, once there are so many that its start pays: linking
# OpenVDB takes a new worker longer than reading them.
SMALL_BYTES = 1 << 20
FIRST_FILES = 5
_small_files = itertools.count()

# The worker holds a grid twice, as OpenVDB's tree and as a NanoVDB buffer.
WORKER_COPIES = 2

_Result = TypeVar("_Result")


class VdbGrid(NamedTuple):
    """One grid of a .vdb file.

    Attributes:
        nanovdb: NanoVDB buffer: uint8, starting at a 32-byte boundary, one grid, no file header. It holds the values,
            the name, the class, the transform and the background.
        metadata: The other OpenVDB metadata by name. The Python type of a value stands for its OpenVDB type; see
            ``geokit.native._metadata``. Some keys are special. "name" overrides the buffer's name on writing. "class"
            overrides its class; after reading it is present if a NanoVDB grid of this type cannot hold the class (a
            level set of integers). "geokit:value_type" is "vec3i" if the file holds integer vectors, which NanoVDB
            lacks and the buffer holds as vec3d. "is_saved_as_half_float" is True if the file holds the values with 16
            bits, and "geokit:file:NAME" is NAME of the file's own metadata: on writing they become that again.
    """

    nanovdb: NDArray[np.uint8]
    metadata: dict[str, Any]


class PolygonMesh(NamedTuple):
    """Mesh from :func:`volume_to_mesh`.

    Attributes:
        points: The vertices [world], shape (V, 3).
        triangles, quads: Vertices of each face, shape (T, 3) and (Q, 4).
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int32]
    quads: NDArray[np.int32]


@functools.cache
def _load() -> tuple[ModuleType | None, str]:
    try:
        return importlib.import_module("geokit.native._bridge"), ""
    except ImportError as error:
        return None, str(error)


def _extension() -> ModuleType:
    require()
    return _load()[0]  # type: ignore[return-value]


def _worker_path() -> Path:
    return Path(str(_extension().__file__)).with_name("geokit_vdb_worker")


def available() -> bool:
    """Whether the extension was built and can be loaded."""
    return _load()[0] is not None


def require() -> None:
    """Check that the extension is available.

    Raises:
        MissingDependencyError: It is not; the message names the packages to install and the build command.
    """
    module, reason = _load()
    if module is None:
        raise MissingDependencyError(
            f"this geokit came without OpenVDB ({reason}), which .vdb files and OpenVDB operations need; install its "
            "wheel for Linux x86-64, which has OpenVDB inside; or, on Debian or Ubuntu: apt install "
            f"{_PACKAGES}; then, in geokit's source folder: pip install --force-reinstall --no-deps ."
        )


def versions() -> dict[str, str]:
    """Versions of "openvdb" and "nanovdb" that the extension was built with.

    Raises:
        MissingDependencyError: The extension is not available.
    """
    openvdb, nanovdb = _extension().versions()
    return {"openvdb": openvdb, "nanovdb": nanovdb}


def build_facts() -> dict[str, str]:
    """How the extension was built: "extension" ("yes", or why it cannot be loaded), and if it can, "openvdb",
    "nanovdb", "tbb", "compiler", "python" ("stable ABI" or "this version only") and "libraries" ("inside the wheel" or
    "of the system").
    """
    module, reason = _load()
    if module is None:
        return {"extension": reason}
    path = Path(str(module.__file__))
    libraries = path.parents[2] / f"{DISTRIBUTION.replace('-', '_')}.libs"  # where auditwheel puts them
    return {
        "extension": "yes",
        **versions(),
        **dict(module.build_facts()),
        "python": "stable ABI" if ".abi3." in path.name else "this version only",
        "libraries": "inside the wheel" if libraries.is_dir() else "of the system",
    }


@needs(lambda path, **_: 4 * file_size(path), fatal=True)
def read_vdb(
    path: str | os.PathLike[str],
    *,
    grids: Sequence[str] | None = None,
    trusted: bool = False,
    time_limit: float | None = None,
    memory_limit: int | None = None,
) -> list[VdbGrid]:
    """Read grids of a .vdb file as NanoVDB buffers.

    Exact: every value (active or not), state, tile, transform and metadata item is kept bit for bit.

    Args:
        path: The file.
        grids: Names of the grids to read. A name that several grids share means all of them, "name[1]" the second. None
            reads every grid.
        trusted: Read in this process. This is slightly faster, but a damaged file can crash the process. The limits do
            not apply.
        time_limit: Wall-clock limit of the worker [s]; by default 15 s and 2 s for each megabyte of the file.
        memory_limit: Limit for the memory of the worker and for the size of its results [bytes]; by default two hundred
            times the file's size, at least 2 GiB, and at most the free memory.

    Returns:
        The grids in the order of the file.

    Raises:
        FileAccessError: The file is missing or not readable.
        FileFormatError: It is not a .vdb file, is damaged, or reading it exceeded a limit.
        UnsupportedGridError: A requested grid has a type (points, strings) or a transform (frustum) that NanoVDB
            lacks. To read the other grids of such a file, name them in ``grids``.
        InputError: No grid has one of the names (the message lists the existing ones), or a limit is not positive.
        MissingDependencyError: The extension is not available.
    """
    found = _read_unchecked(path, grids=grids, trusted=trusted, time_limit=time_limit, memory_limit=memory_limit)
    if not trusted:
        # A worker whose memory a damaged file has overwritten may hand back a tree that leads astray.
        for grid in found:
            _call(path, functools.partial(_extension().check, grid.nanovdb))
    return found


def _read_unchecked(
    path: str | os.PathLike[str],
    *,
    grids: Sequence[str] | None = None,
    trusted: bool = False,
    time_limit: float | None = None,
    memory_limit: int | None = None,
) -> list[VdbGrid]:
    """As :func:`read_vdb`, for callers that check the buffers themselves before anything follows their offsets."""
    source = require_file(path)
    refuse_empty(source)
    require_flag(trusted, "trusted")
    names = _checked_names(grids)
    limits = _checked_limits(source, time_limit, memory_limit)
    if grids is not None and not names:
        return []
    _worker.warn_of_version(source)
    if trusted:
        extension = _extension()
        output, buffers = _call(source, lambda: extension.read(os.fsencode(source), names))
        result = json.loads(output.decode("utf-8", "surrogateescape"))
    else:
        result, buffers = _read_in_worker(source, names, *limits)
    return [VdbGrid(*grid) for grid in zip(buffers, decode_grids(result), strict=True)]


@needs(fatal=True)
def inspect_vdb(
    path: str | os.PathLike[str], *, time_limit: float | None = None, memory_limit: int | None = None
) -> list[dict[str, Any]]:
    """Read the headers of a .vdb file's grids, without the voxels, in the worker.

    Args:
        path: The file.
        time_limit: Wall-clock limit of the worker [s]; by default 15 s and 2 s for each megabyte of the file.
        memory_limit: Memory limit of the worker [bytes].

    Returns:
        A dict per grid, in the file's order: "name", "grid_type" ("float", "vec3f", ..., or "points"; OpenVDB's
        own name for a type that geokit does not read), "grid_class", "transform" ((4, 4) float64, None for a frustum),
        "background" (None if unknown), "active_voxel_count" and "index_bounds" ((2, 3) int64; both None if the file
        does not hold them), "compression" (text from the file), "half", "convertible", "byte_count" (in the file),
        "metadata".

    Raises:
        FileAccessError, FileFormatError, InputError, MissingDependencyError: As :func:`read_vdb`.
    """
    source = require_file(path)
    refuse_empty(source)
    limits = _checked_limits(path, time_limit, memory_limit)
    _worker.warn_of_version(source)
    result = _worker.run_worker(_worker_path(), "inspect", source, [], time_limit=limits[0], memory_limit=limits[1])
    if "error" in result:
        raise_failure(result["error"], str(source))
    return list(map(decode_header, result["grids"], decode_grids(result)))


@needs(lambda path, grids, **_: 3 * sum(len(grid.nanovdb) for grid in grids), fatal=True)
def write_vdb(
    path: str | os.PathLike[str], grids: Sequence[VdbGrid], *, compression: str = "blosc", half: bool = False
) -> None:
    """Write grids into a .vdb file atomically: a reader sees the old file or the complete new one.

    Exact except with ``half`` and for quantized grids (fp4, fp8, fp16, fpn), which are written as float grids of the
    decoded values. Grids whose metadata say "is_saved_as_half_float" are written with 16 bits if that changes no value.
    Types vec4f, vec4d and uint32 are written, although other programs may not read them.

    Args:
        path: The file; an existing one is replaced.
        grids: At least one grid.
        compression: "blosc" (with OpenVDB's active mask), "zip" (the same) or "none".
        half: Store floating-point values of all grids with 16 bits, also where that rounds them.

    Raises:
        InputError: No grid, an invalid buffer, an unknown compression, metadata without an OpenVDB type, or a transform
            that OpenVDB rejects as singular.
        UnsupportedGridError: A grid type without an OpenVDB counterpart.
        FileAccessError: The target cannot be written.
        MissingDependencyError: The extension is not available.
    """
    extension = _extension()
    grids = require_items(grids, "grids", VdbGrid)
    if not grids:
        raise InputError(f"{path}: no grids to write; pass at least one")
    require_choice(compression, "compression", ("blosc", "zip", "none"))
    half = require_flag(half, "half")
    own, of_file = split(grid.metadata for grid in grids)
    prepared = [(_aligned(grid.nanovdb), encode_all(metadata)) for grid, metadata in zip(grids, own, strict=True)]
    rest = (encode_all(of_file), compression, half)
    with atomic_path(path) as part:
        _call(path, lambda: extension.write(os.fsencode(part), prepared, *rest), is_argument=True)


@needs(lambda nanovdb, **_: 3 * len(nanovdb), fatal=True)
def volume_to_mesh(nanovdb: NDArray[np.uint8], *, isovalue: float = 0.0, adaptivity: float = 0.0) -> PolygonMesh:
    """Extract an isosurface with OpenVDB's dual contouring.

    Points are computed as float32 in index space relative to the grid's corner, then mapped to world space in float64.
    Their rounding error is about 1e-5 voxel, wherever the grid is.

    Args:
        nanovdb: Buffer of a float, double or quantized grid.
        isovalue: Value of the surface.
        adaptivity: 0 keeps one point per voxel that the surface crosses, 1 merges the most.

    Returns:
        PolygonMesh. Polygons are counter-clockwise seen from the side of greater values, which is the outside of a
        signed distance field.

    Raises:
        InputError: isovalue is not finite, adaptivity outside 0..1, or the buffer is not a NanoVDB grid.
        UnsupportedGridError: The grid type has no isosurface.
        MissingDependencyError: The extension is not available.
    """
    extension = _extension()
    isovalue = require_finite_scalar(isovalue, "isovalue")
    adaptivity = require_finite_scalar(adaptivity, "adaptivity")
    if not 0.0 <= adaptivity <= 1.0:
        raise InputError(f"adaptivity: {adaptivity} is not from 0 to 1; pass such a number")
    buffer = _aligned(nanovdb)
    return PolygonMesh(
        *_call("nanovdb", lambda: extension.volume_to_mesh(buffer, isovalue, adaptivity), is_argument=True)
    )


def _field_bytes(vertices: Any, faces: Any, *, voxel_size: float, half_width: float = 3.0) -> float:
    """By the area of the surface in voxels."""
    step = max(1, len(faces) // 4096)
    a, b, c = (np.asarray(vertices)[np.asarray(faces)[::step]] / voxel_size).transpose(1, 0, 2)
    area = 0.5 * step * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    # Where indices of voxels would pass 2^30, the voxel size is refused instead.
    return 400 * len(faces) + (60 * half_width * area if max(np.abs(one).max() for one in (a, b, c)) < 2**30 else 0)


@needs(_field_bytes, fatal=True)
def mesh_to_level_set(
    vertices: ArrayLike, faces: ArrayLike, *, voxel_size: float, half_width: float = 3.0
) -> NDArray[np.uint8]:
    """Build a narrow-band signed distance field of a closed mesh with OpenVDB, negative inside.

    It serves as a comparison. The band is not exact: after OpenVDB's renormalization it is up to 0.4 voxel off.

    Args:
        vertices: Positions [world], shape (V, 3).
        faces: Vertex indices, shape (F, 3).
        voxel_size: Edge length of a voxel [world].
        half_width: Width of the band on each side of the surface [voxels], at least 1.

    Returns:
        NanoVDB buffer of a float level set.

    Raises:
        InputError: Wrong shapes, no faces, indices out of range, values that are not finite, a voxel size that is not
            positive or too small for OpenVDB or for the mesh's extent, or a half width below 1.
        DeviceMemoryError: The field needs more memory than is available.
        MissingDependencyError: The extension is not available.
    """
    extension = _extension()
    points = np.ascontiguousarray(read_array(vertices, "vertices"), dtype=np.float64)
    triangles = read_array(faces, "faces")
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise InputError(f"vertices {points.shape} and faces {triangles.shape} must have shapes (V, 3) and (F, 3)")
    if triangles.dtype.kind not in "iu":
        raise InputError(f"faces have type {triangles.dtype}; pass integers")
    if len(triangles) == 0:
        raise InputError("the mesh has no faces; pass at least one triangle")
    if not np.isfinite(points).all():
        raise InputError(f"vertices: row {int(np.argmin(np.isfinite(points).all(axis=1)))} is not finite; remove it")
    bad = ((triangles < 0) | (triangles >= len(points))).any(axis=1)
    if bad.any():
        raise InputError(f"faces: row {int(np.argmax(bad))} names a vertex outside 0..{len(points) - 1}; correct it")
    voxel_size = require_finite_scalar(voxel_size, "voxel_size", low=0.0)
    half_width = require_finite_scalar(half_width, "half_width")
    if half_width < 1.0:
        raise InputError(f"half_width is {half_width}; pass a number of voxels of at least 1")
    # OpenVDB's voxel coordinates are 32-bit integers; beyond their range its flood fill writes out of bounds.
    if float(np.abs(points).max()) / voxel_size + half_width > 2**30:
        raise InputError(
            f"voxel_size {voxel_size} is too small for vertices this far from the origin; use a larger one"
        )
    # Whatever the mesh, its band is no smaller than a ball of that radius.
    what = f"half_width: a band of {half_width:g} voxels needs"
    available_memory.require_room(4.0 * 4.18 * half_width**3, what, "use a smaller one")
    indices = np.ascontiguousarray(triangles, dtype=np.int32)
    return _call("mesh", lambda: extension.mesh_to_level_set(points, indices, voxel_size, half_width), is_argument=True)


def _read_in_worker(
    path: Path, names: list[str], time_limit: float, memory_limit: int
) -> tuple[dict[str, Any], list[NDArray[np.uint8]]]:
    worker = _worker_path()
    # Names that are no Unicode text go to the program as they are.
    small = path.stat().st_size <= SMALL_BYTES and "".join(names).isascii()
    if small and next(_small_files) >= FIRST_FILES:
        return _served.read(path, names, time_limit, memory_limit)
    for parent in _worker.spool_folders(path.stat().st_size):
        with private_folder(parent) as folder:
            result = _worker.run_worker(
                worker, "read", path, [str(folder), *names], time_limit=time_limit, memory_limit=memory_limit
            )
            if "error" not in result:
                buffers = [_worker.map_file(grid["path"], grid["size"]) for grid in result["grids"]]
                return result, buffers
            if result["error"]["kind"] == "memory":
                _worker.refuse_small_files(path, memory_limit)
            if result["error"]["kind"] != "spool":
                raise_failure(result["error"], str(path))
    raise FileAccessError(
        f"{path}: no room for the voxels in shared memory or in the temporary folder ({result['error']['message']}); "
        "free some, set TMPDIR to a larger folder, or pass trusted=True for a file you trust"
    )


def _checked_names(grids: Sequence[str] | None) -> list[str]:
    if isinstance(grids, str):
        raise InputError(f"grids is the string {grids!r}; pass a list of names")
    names = [] if grids is None else require_items(grids, "grids", str)
    for name in names:
        try:
            name.encode("utf-8", "surrogateescape")
        except UnicodeEncodeError as error:
            raise InputError(f"grids: {name!r} has characters that no file can hold; use others") from error
        if "\0" in name:
            raise InputError(f"grids: {name!r} is not a grid name; pass strings")
    return names


def _checked_limits(
    path: str | os.PathLike[str], time_limit: float | None, memory_limit: int | None
) -> tuple[float, int]:
    seconds = reading_seconds(Path(os.fsdecode(path)))
    if time_limit is not None:
        seconds = min(require_finite_scalar(time_limit, "time_limit", low=0.0), LONGEST_SECONDS)
    if memory_limit is None:
        return seconds, WORKER_COPIES * content_limit(os.stat(path).st_size)
    return seconds, require_count(memory_limit, "memory_limit", 1)


def _aligned(nanovdb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    buffer = np.ascontiguousarray(read_array(nanovdb, "nanovdb"))
    if buffer.dtype != np.uint8 or buffer.ndim != 1:
        raise InputError(f"nanovdb has type {buffer.dtype} and shape {buffer.shape}; pass one dimension of uint8")
    if buffer.ctypes.data % _ALIGNMENT == 0:
        return buffer
    room = np.empty(buffer.size + _ALIGNMENT, dtype=np.uint8)
    start = -room.ctypes.data % _ALIGNMENT
    room[start : start + buffer.size] = buffer
    return room[start : start + buffer.size]


def _call(what: str | os.PathLike[str], function: Callable[[], _Result], *, is_argument: bool = False) -> _Result:
    """Run a function of the extension and convert its errors to geokit's exceptions."""
    extension = _extension()
    try:
        return function()
    except extension.BridgeError as error:
        raise_failure(
            json.loads(error.args[0].decode("utf-8", "surrogateescape"))["error"], os.fspath(what), is_argument
        )
    except MemoryError as error:
        raise DeviceMemoryError(
            f"{os.fspath(what)}: more memory is needed than there is; use a coarser grid"
        ) from error
    except (RuntimeError, ValueError, ArithmeticError, LookupError) as error:
        # OpenVDB's own exceptions: a transform or a background that it cannot hold.
        message = f"OpenVDB refuses the grid ({error}); correct its transform or its background"
        raise_failure({"kind": "damaged", "message": message}, os.fspath(what), is_argument)
