"""Reading and writing volumes: .vdb through OpenVDB, .nvdb by geokit itself."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import extension, require_extension, require_file
from geokit.errors import InputError, UnsupportedGridError
from geokit.formats.table import extensions
from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb import file
from geokit.volume.nanovdb.checks import check_grid, mark_checked
from geokit.volume.nanovdb.codecs import CODECS
from geokit.volume.nanovdb.grid_info import GridInfo
from geokit.volume.nanovdb.header import HEAD_SIZE, grid_name, info_of, voxel_size_of

__all__ = ["inspect", "load", "load_all", "save"]

# NanoVDB readers are often built without zlib and Blosc. All of them read uncompressed files, which are also the
# fastest.
DEFAULT_NVDB_CODEC = "none"
# A file up to this size [bytes] is read whole if no grid is named. That is faster than a separate process that lists
# the names first, and is wasted only if the file has several grids.
READ_AT_ONCE = 64 << 20
# OpenVDB's own default; Debian and Ubuntu ship no OpenVDB without Blosc.
DEFAULT_VDB_CODEC = "blosc"


def load(path: str | os.PathLike[str], *, grid: str | None = None, trusted: bool = False) -> SparseVolume:
    """Load one grid of a .vdb or .nvdb file.

    Every offset in the grid is checked, and its checksum if it has one: a damaged file raises an error and never gives
    a wrong volume. Unless it is trusted, a .vdb file is read in a separate process with a limit on time and memory.

    Args:
        path: A .vdb or .nvdb file.
        grid: Name of the grid; None if the file has a single grid. Of several grids with one name, the second is
            "name[1]", the third "name[2]".
        trusted: Whether the .vdb file is known to be sound. It is then read in this process, which saves a copy.

    Returns:
        The grid; values, transform and metadata as in the file.

    Raises:
        InputError: The extension is neither, there is no such grid, or no name is given and there are several grids.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is damaged, truncated or not of the format that its extension names.
        UnsupportedGridError: geokit cannot represent the grid's type or transform.
        MissingDependencyError: .vdb without the OpenVDB extension, or Blosc-compressed .nvdb without blosc.
        DeviceMemoryError: The grid does not fit into memory.

    Example:
        >>> load("data/samples/smoke.vdb", grid="density").info.grid_class
        'fog volume'
    """
    path = _known(path)
    if extension(path) == ".nvdb":
        index = _index_of(grid, _unique(file.names(path)), path)
        return _from_nvdb(file.read(path, [index])[0])
    if grid is None:
        from geokit import native

        if path.stat().st_size <= READ_AT_ONCE:
            # An unreadable grid, for one, must not hide the error that a name is missing.
            with contextlib.suppress(UnsupportedGridError):
                volumes = _read_vdb(path, None, trusted)
                return volumes[_index_of(None, _unique([volume.info.name for volume in volumes]), path)]

        names = [header["name"] for header in native.inspect_vdb(path)]
        grid = names[_index_of(None, _unique(names), path)]
    # If several grids have one name, OpenVDB returns all of them, in the file's order.
    return _read_vdb(path, [grid], trusted)[0]


def load_all(path: str | os.PathLike[str], *, trusted: bool = False) -> dict[str, SparseVolume]:
    """Load every grid of a .vdb or .nvdb file, by name and in the file's order.

    Args:
        path: A .vdb or .nvdb file.
        trusted: As for :func:`load`.

    Returns:
        Volumes by name; of several grids with one name, the second is "name[1]", the third "name[2]".

    Raises:
        InputError: The extension is neither.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is damaged, truncated or not of the format that its extension names.
        UnsupportedGridError: geokit cannot represent a grid's type or transform.
        MissingDependencyError: As for :func:`load`.
        DeviceMemoryError: A grid does not fit into memory.
    """
    path = _known(path)
    if extension(path) == ".nvdb":
        volumes = [_from_nvdb(grid) for grid in file.read(path)]
    else:
        volumes = _read_vdb(path, None, trusted)
    return dict(zip(_unique([volume.info.name for volume in volumes]), volumes, strict=True))


def inspect(path: str | os.PathLike[str]) -> list[GridInfo]:
    """Describe the grids of a .vdb or .nvdb file without reading voxels.

    Grids that cannot be loaded are listed too. Anything that the file does not state is None: the background of index
    grids, and the number of active voxels in .vdb files written without statistics. The transform of a frustum is NaN.
    Compressed .nvdb grids come without metadata, since it stands at their end.

    Args:
        path: A .vdb or .nvdb file.

    Returns:
        One GridInfo per grid, in the file's order; ``byte_count`` is the grid's size in memory for .nvdb and in the
        file for .vdb.

    Raises:
        InputError: The extension is neither.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is damaged, truncated or not of the format that its extension names.
        MissingDependencyError: .vdb without the OpenVDB extension, or Blosc-compressed .nvdb without blosc.
    """
    path = _known(path)
    if extension(path) == ".nvdb":
        return file.inspect(path)
    from geokit import native

    return [_info_of_vdb(header) for header in native.inspect_vdb(path)]


def save(path: str | os.PathLike[str], *volumes: SparseVolume, codec: str | None = None, half: bool = False) -> None:
    """Write volumes to one .vdb or .nvdb file. The file appears complete or not at all.

    Values, masks, transforms, names and metadata are kept bit for bit (except with ``half``). Quantized grids become
    float grids with the same values in .vdb.

    Args:
        path: Target, .vdb or .nvdb; an existing file is replaced.
        volumes: One or more volumes.
        codec: "none", "zip" or "blosc". None means "blosc" for .vdb and "none", which every reader supports, for .nvdb.
        half: Store the floating-point values of a .vdb file with 16 bits.

    Raises:
        InputError: The extension, the codec or a volume is invalid, or half is given with .nvdb.
        FileAccessError: The target cannot be written.
        UnsupportedGridError: .vdb has no such grid type.
        MissingDependencyError: .vdb without the OpenVDB extension, or codec "blosc" without blosc.

    Example:
        >>> save("out.nvdb", load("data/samples/torus.vdb"), codec="zip")
    """
    kind = require_extension(path, extensions("volume", "w"), "volume")
    if codec is not None and codec not in CODECS:
        raise InputError(f"codec: {codec!r} is unknown; use one of {', '.join(CODECS)}")
    if not volumes:
        raise InputError(f"{Path(path)}: no volumes to save; give at least one")
    for i, volume in enumerate(volumes):
        if not isinstance(volume, SparseVolume):
            raise InputError(f"volumes[{i}]: {type(volume).__name__} is not a SparseVolume; load or make one first")
    if kind == ".nvdb":
        if half:
            raise InputError("half: .nvdb has no half-precision storage of float grids; save as .vdb or leave half out")
        from geokit.volume.nanovdb.write import write

        write(path, volumes, codec=codec or DEFAULT_NVDB_CODEC)
        return
    from geokit import native

    grids = [native.VdbGrid(volume.nanovdb, {**volume.info.metadata, "name": volume.info.name}) for volume in volumes]
    native.write_vdb(path, grids, compression=codec or DEFAULT_VDB_CODEC, half=half)


def _known(path: str | os.PathLike[str]) -> Path:
    require_extension(path, extensions("volume", "r"), "volume")
    return require_file(path)


def _unique(names: Sequence[str]) -> list[str]:
    own = set(names)
    given: dict[str, None] = {}
    for name in names:
        candidate, number = name, 0
        # A grid whose real name is "name[1]" keeps that name.
        while candidate in given or (number and candidate in own):
            number += 1
            candidate = f"{name}[{number}]"
        given[candidate] = None
    return list(given)


def _index_of(grid: str | None, names: list[str], path: Path) -> int:
    if grid is None:
        if len(names) != 1:
            raise InputError(f"{path}: has {len(names)} grids ({_listed(names)}); choose one with grid=")
        return 0
    if grid not in names:
        raise InputError(f"{path}: no grid named {grid!r}; the file holds {_listed(names)}")
    return names.index(grid)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names) or "none"


def _from_nvdb(grid: file.NvdbGrid) -> SparseVolume:
    # Devices keep copies of the buffer, so it must not change afterwards.
    grid.buffer.setflags(write=False)
    info = info_of(grid.buffer, grid.metadata, name=grid.name)
    return _checked(grid.buffer, info)


def _read_vdb(path: Path, grids: list[str] | None, trusted: bool) -> list[SparseVolume]:
    from geokit import native

    volumes = []
    for grid in native._read_unchecked(path, grids=grids, trusted=trusted):
        # The worker's result for a damaged file may even lack a header.
        name = grid_name(grid.nanovdb) if len(grid.nanovdb) >= HEAD_SIZE else ""
        check_grid(grid.nanovdb, f"{path}: grid {name!r}")
        volumes.append(_checked(grid.nanovdb, info_of(grid.nanovdb, grid.metadata)))
    return volumes


def _checked(buffer: NDArray[np.uint8], info: GridInfo) -> SparseVolume:
    """A volume of a grid that :func:`check_grid` has accepted."""
    # A class that NanoVDB does not allow for the type (a level set of integers) arrives as metadata.
    volume = SparseVolume(buffer, replace(info, grid_class=str(info.metadata.get("class", info.grid_class))))
    mark_checked(volume)
    return volume


def _info_of_vdb(header: Mapping[str, Any]) -> GridInfo:
    transform = header["transform"]
    if transform is None:  # a frustum, which has no matrix
        transform = np.full((4, 4), np.nan)
    return GridInfo(
        name=header["name"],
        grid_type=header["grid_type"],
        grid_class=header["grid_class"],
        transform=transform,
        voxel_size=voxel_size_of(transform),
        background=header["background"],
        active_voxel_count=header["active_voxel_count"],
        index_bounds=header["index_bounds"],
        byte_count=header["byte_count"],
        metadata=MappingProxyType(dict(header["metadata"])),
    )
