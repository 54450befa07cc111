"""Reading and writing volumes: .vdb through OpenVDB, .nvdb by geokit itself, others by formats/images."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit import native
from geokit.core.content_limit import content_limit
from geokit.core.files import extension, named_damage, refuse_empty, require_file, size_of
from geokit.core.interop.user_arrays import FROM_ZERO, require_finite_scalar
from geokit.core.memory.needs import file_size, needs
from geokit.core.require import require_choice, require_flag, require_path, require_text
from geokit.errors import FileAccessError, InputError, UnsupportedGridError
from geokit.formats.foreign import require_format
from geokit.formats.images.image import Image
from geokit.formats.table import SPARSE, STAGES, extensions, image_module, volume_kind, with_formats
from geokit.volume._dense import native_of, to_dense
from geokit.volume._topology import clip, require_box
from geokit.volume.images.build import info_of_image, volume_of_image
from geokit.volume.images.save import save_image
from geokit.volume.images.stage import named_field, opened, placed, placed_info, save_stage
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb import file
from geokit.volume.nanovdb.checks import check_grid, mark_checked
from geokit.volume.nanovdb.codecs import CODECS
from geokit.volume.nanovdb.grid_info import GridInfo
from geokit.volume.nanovdb.header import HEAD_SIZE, grid_name, info_of, voxel_size_of
from geokit.volume.nanovdb.types import INDEX_TYPES
from geokit.volume.retyped.from_channel import from_channel
from geokit.volume.tree.typed_writer import WIDENED, widened

# NanoVDB readers are often built without zlib and Blosc. All of them read uncompressed files, which are also the
# fastest.
DEFAULT_NVDB_CODEC = "none"
# A file up to this size [bytes] is read whole if no grid is named. That is faster than a separate process that lists
# the names first, and is wasted only if the file has several grids.
READ_AT_ONCE = 64 << 20
# The grid that is meant where a file of smoke holds several.
USUAL = "density"
# OpenVDB's own default; Debian and Ubuntu ship no OpenVDB without Blosc.
DEFAULT_VDB_CODEC = "blosc"
# Beyond every voxel [voxels].
FARTHEST = 2.0**40


def _read_bytes(path: Any, *, trusted: bool = False, bounds: Any = None, **_: Any) -> float:
    """Of a .vdb file OpenVDB's tree and the grid, whose values are packed in the file; dense ones are read in parts."""
    kind = extension(path)
    if kind == ".nvdb" and bounds is not None:
        return 0.0  # what meets the box, which is known inside
    # In this process also OpenVDB's threads: Blosc ends the process where it gets no memory.
    in_process = 12 << 20 if trusted and kind == ".vdb" else 0
    return file_size(path) * {".vdb": 3, ".nvdb": 1, ".vti": 3}.get(kind, 0) + in_process


# Dense volumes.
_DENSE = tuple(kind for kind in extensions("volume", "r") if kind not in (*SPARSE, *STAGES))


@needs(_read_bytes, fatal=True)
@with_formats("volume", "r", dense=_DENSE)
def load(
    path: str | os.PathLike[str],
    *,
    grid: str | None = None,
    bounds: ArrayLike | None = None,
    background: Any = None,
    tolerance: float = 0.0,
    grid_type: str | None = None,
    trusted: bool = False,
    memory_limit: int | None = None,
) -> SparseVolume:
    """Load one grid of a file: a .vdb or .nvdb, or the voxels of a dense volume ({dense}).

    Every offset in the grid is checked, and its checksum if it has one: a damaged file raises an error and never gives
    a wrong volume. Unless it is trusted, a .vdb file is read in a separate process with a limit on time and memory.

    Of a USD stage the fields of its Volume prims are read, which lie in .vdb files of its folder or inside a .usdz, at
    the places that the prims give them; "geokit:unit" (or "geokit:meters_per_unit") and "geokit:up_axis" in
    ``info.metadata`` are what the stage says.

    DICOM is a folder with the slices, or a .dcm file; zarr is a folder.

    A dense volume becomes a sparse one as by :func:`from_dense`: voxels of the background take no memory. Its slices
    are read a few at a time, so that the dense array is never whole in memory. Positions are those of the file: NIfTI
    counts x to the right and y to the front (RAS), DICOM and MetaImage the opposite (LPS), NRRD says it; "geokit:space"
    and "geokit:unit" in ``info.metadata`` are what the file says. Values that are not finite become background, with
    a warning. Points in time and channels are grids "0", "1", ...; arrays of a .vti have their names.

    Args:
        path: {formats}.
        grid: Name of the grid; None if the file has a single grid, or one called "density", as simulations write it
            beside temperature, velocity and others. Of several grids with one name, the second is
            "name[1]", the third "name[2]".
        bounds: Lower and upper corner [world], shape (2, 3), of the part that is wanted: the result is that of
            :func:`clip`. Of a .nvdb file that is not compressed only the nodes in the box are read, so that it may be
            larger than memory; its checksum is not compared then.
        background: Of a dense volume: value of voxels that are not stored, as for :func:`from_dense`. None for what the
            file says, else the negative value that more than half of the border of its first slice has (air in CT),
            else 0.
        tolerance: Of a dense volume: largest difference from the background that still counts as background.
        grid_type: Of a dense volume: type of the grid, as for :func:`from_dense`; None for that of the values. Whole
            numbers have no isosurface: take "float".
        trusted: Whether the .vdb file is known to be sound. It is then read in this process, which saves a copy; no
            limit applies.
        memory_limit: Largest size of the decompressed content [bytes]; None is a hundred times the file's size, at
            least 1 GiB, and at most half of the free memory. The process that reads a .vdb may take twice as much.
            Of a compressed dense file the copies of what is read at a time, eight planes, count too. One that is not
            compressed has no limit but the memory.

    Returns:
        The grid; values, transform and metadata as in the file.

    Raises:
        InputError: The extension is none of these, there is no such grid, or no name is given and there are several
            grids, not one of them called "density"; or bounds, background, tolerance or grid_type is invalid, or one of
            the last three is given for a .vdb or .nvdb.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is damaged, truncated or not of the format that its extension names.
        UnsupportedGridError: geokit cannot represent the grid's type or transform.
        MissingDependencyError: .vdb without the OpenVDB extension, Blosc-compressed .nvdb without blosc, or a dense
            volume without the package of its format.
        DeviceMemoryError: The content is larger than memory_limit, or the grid does not fit into memory.

    Example:
        >>> load("data/samples/smoke.vdb", grid="density").info.grid_class
        'fog volume'
    """
    path = _known(path, trusted)
    if grid is not None:
        require_text(grid, "grid")
    how = {"background": background, "tolerance": tolerance, "grid_type": grid_type}
    if bounds is None:
        return _load(path, grid, how, trusted, memory_limit)
    box = require_box(bounds)
    if extension(path) == ".nvdb":
        _is_dense(path, **how)
        index = _index_of(grid, unique_names(file.names(path)), path)
        found = _from_nvdb(file.read_part(path, index, lambda info: _voxels_of(info, box), memory_limit=memory_limit))
        return clip(found, box)
    return clip(_load(path, grid, how, trusted, memory_limit), box)


def _voxels_of(info: GridInfo, box: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last voxel of a box around a box [world], and of one voxel more for what rounding does."""
    corners = np.array(list(itertools.product(*box.T)))
    with np.errstate(over="ignore", invalid="ignore"):
        index = np.linalg.solve(info.transform[:3, :3], (corners - info.transform[:3, 3]).T).T
    index = np.clip(np.nan_to_num(index, nan=0.0), -FARTHEST, FARTHEST)
    return np.floor(index.min(axis=0)).astype(np.int64) - 1, np.ceil(index.max(axis=0)).astype(np.int64) + 1


def _load(path: Path, grid: str | None, how: dict[str, Any], trusted: bool, memory_limit: int | None) -> SparseVolume:
    if _is_dense(path, **how):
        images = _images(path, memory_limit)
        image = images[_index_of(grid, unique_names([info_of_image(one, path).name for one in images]), path)]
        return _of_image(image, path, how, memory_limit)
    if extension(path) in STAGES:
        return _read_stage(path, trusted, memory_limit, lambda names: [_index_of(grid, names, path)])[0]
    if extension(path) == ".nvdb":
        index = _index_of(grid, unique_names(file.names(path)), path)
        return _from_nvdb(file.read(path, [index], memory_limit=memory_limit)[0])
    if grid is None:
        if path.stat().st_size <= READ_AT_ONCE:
            # An unreadable grid, for one, must not hide the error that a name is missing.
            with contextlib.suppress(UnsupportedGridError):
                volumes = _read_vdb(path, None, trusted, memory_limit)
                return volumes[_index_of(None, unique_names([volume.info.name for volume in volumes]), path)]

        names = [header["name"] for header in native.inspect_vdb(path)]
        grid = names[_index_of(None, unique_names(names), path)]
    # If several grids have one name, OpenVDB returns all of them, in the file's order.
    return _read_vdb(path, [grid], trusted, memory_limit)[0]


@needs(_read_bytes, fatal=True)
@with_formats("volume", "r")
def load_all(
    path: str | os.PathLike[str],
    *,
    background: Any = None,
    tolerance: float = 0.0,
    grid_type: str | None = None,
    trusted: bool = False,
    memory_limit: int | None = None,
) -> dict[str, SparseVolume]:
    """Load every grid of a file, by name and in the file's order.

    Args:
        path: {formats}.
        background: As for :func:`load`.
        tolerance: As for :func:`load`.
        grid_type: As for :func:`load`.
        trusted: As for :func:`load`.
        memory_limit: As for :func:`load`, for all grids together.

    Returns:
        Volumes by name; of several grids with one name, the second is "name[1]", the third "name[2]".

    Raises:
        InputError: The extension is none of these; or background, tolerance or grid_type as for :func:`load`.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is damaged, truncated or not of the format that its extension names.
        UnsupportedGridError: geokit cannot represent a grid's type or transform.
        MissingDependencyError: As for :func:`load`.
        DeviceMemoryError: The content is larger than memory_limit.
    """
    path = _known(path, trusted)
    how = {"background": background, "tolerance": tolerance, "grid_type": grid_type}
    if _is_dense(path, **how):
        volumes = [_of_image(image, path, how, memory_limit) for image in _images(path, memory_limit)]
    elif extension(path) in STAGES:
        volumes = _read_stage(path, trusted, memory_limit, lambda names: list(range(len(names))))
    elif extension(path) == ".nvdb":
        volumes = [_from_nvdb(grid) for grid in file.read(path, memory_limit=memory_limit)]
    else:
        volumes = _read_vdb(path, None, trusted, memory_limit)
    return dict(zip(unique_names([volume.info.name for volume in volumes]), volumes, strict=True))


@needs()
@with_formats("volume", "r")
def inspect(path: str | os.PathLike[str]) -> list[GridInfo]:
    """Describe the grids of a file without reading voxels (those of a .vti are read).

    Grids that cannot be loaded are listed too. Anything that the file does not state is None: the background of index
    grids, and the number of active voxels in .vdb files written without statistics. The transform of a frustum is NaN.
    Compressed .nvdb grids come without metadata, since it stands at their end. Of a dense volume the box is the whole
    array, the number of active voxels is None, and so is the background, unless the file states it.

    Args:
        path: {formats}.

    Returns:
        One GridInfo per grid, in the file's order; ``byte_count`` is the grid's size in memory for .nvdb, in the file
        for .vdb, and that of the dense array for others.

    Raises:
        InputError: The extension is none of these.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is damaged, truncated or not of the format that its extension names.
        MissingDependencyError: .vdb without the OpenVDB extension, or Blosc-compressed .nvdb without blosc.
    """
    path = _known(path)
    if _is_dense(path):
        return [info_of_image(image, path) for image in _images(path, None)]
    if extension(path) == ".nvdb":
        return file.inspect(path)
    if extension(path) in STAGES:
        return _inspect_stage(path)
    return [_info_of_vdb(header) for header in native.inspect_vdb(path)]


@needs(lambda path, *volumes, **_: 2 * sum(v.info.byte_count for v in volumes), fatal=True)
@with_formats("volume", "w")
def save(path: str | os.PathLike[str], *volumes: SparseVolume, codec: str | None = None, half: bool = False) -> None:
    """Write volumes to one file. The file appears complete or not at all.

    In .vdb and .nvdb values, masks, transforms, names and metadata are kept bit for bit (except with ``half``).
    In .vdb quantized grids become float grids, and grids of 8-bit and 16-bit integers int32 grids, of the same values.

    A grid that a .vdb file held with 16 bits ("is_saved_as_half_float" in its metadata) is written with 16 bits again
    where they hold each value exactly, as those of a copy or a clip. Where values were computed, as by
    :func:`resample`, it is written whole, unless ``half`` is given. Metadata of the .vdb file itself stand as
    "geokit:file:NAME" in ``info.metadata`` of its grids, and become those of the new file; where volumes of several
    files differ, the first decides.

    A USD stage gets one Volume prim; its grids go into ``NAME_grids.vdb`` beside it, or inside a .usdz.

    In other formats one volume is written as a dense array of the box around its active voxels, a few slices at a time.
    Positions are kept: a volume that is known to lie in LPS is turned to RAS for NIfTI, and the other way round for
    MetaImage, and lengths of a known unit are converted to those of NIfTI and MRC. NIfTI and MRC hold places in
    float32. geokit also notes name, class, type and background in the file, and finds them there again.

    Args:
        path: Target, {formats}; an existing file is replaced.
        volumes: One or more volumes; only one for dense formats.
        codec: "none", "zip" or "blosc". None means "blosc" for .vdb and USD and "none", which every reader supports,
            for .nvdb; .nrrd and .tif are zipped unless it is "none", .mhd and .mha are if it is "zip".
        half: Store the floating-point values of a .vdb file with 16 bits, also of that of a USD stage, and also where
            that rounds them.

    Raises:
        InputError: The extension, the codec or a volume is invalid, half is given with another format than .vdb and
            USD, or the format holds no such values or transform.
        FileAccessError: The target cannot be written.
        UnsupportedGridError: .vdb has no such grid type.
        MissingDependencyError: .vdb without the OpenVDB extension, codec "blosc" without blosc, or another format
            without its package.

    Example:
        >>> save("out.nvdb", load("data/samples/torus.vdb"), codec="zip")
    """
    kind = require_format(path, "volume", "w")
    path = require_path(path)
    require_flag(half, "half")
    if codec is not None:
        require_choice(codec, "codec", CODECS)
    if not volumes:
        raise InputError(f"{require_path(path)}: no volumes to save; give at least one")
    for i, volume in enumerate(volumes):
        if not isinstance(volume, SparseVolume):
            raise InputError(f"volumes[{i}]: {type(volume).__name__} is not a SparseVolume; load or make one first")
    if kind not in (*SPARSE, *STAGES):
        if half:
            raise InputError(f"half: {kind} has no half-precision storage of float grids; leave half out")
        if len(volumes) > 1:
            raise InputError(f"{require_path(path)}: {kind} holds one volume, and {len(volumes)} are given; choose one")
        (volume,) = volumes
        volume = from_channel(volume, 0) if volume.info.grid_type in INDEX_TYPES else volume
        save_image(path, volume, *native_of(volume), lambda box: to_dense(volume, bounds=box).values, codec)
        return
    if kind == ".nvdb":
        if half:
            raise InputError("half: .nvdb has no half-precision storage of float grids; save as .vdb or leave half out")
        from geokit.volume.nanovdb.write import write

        write(path, volumes, codec=codec or DEFAULT_NVDB_CODEC)
        return
    volumes = tuple(widened(volume) if volume.info.grid_type in WIDENED else volume for volume in volumes)
    if kind in STAGES:
        names = unique_names([volume.info.name or "grid" for volume in volumes])
        save_stage(require_path(path), volumes, names, lambda target, named: _write_vdb(target, named, codec, half))
        return
    _write_vdb(path, volumes, codec, half)


def _write_vdb(path: str | os.PathLike[str], volumes: Sequence[SparseVolume], codec: str | None, half: bool) -> None:
    grids = [native.VdbGrid(volume.nanovdb, {**volume.info.metadata, "name": volume.info.name}) for volume in volumes]
    native.write_vdb(path, grids, compression=codec or DEFAULT_VDB_CODEC, half=half)


def _known(path: str | os.PathLike[str], trusted: bool = False) -> Path:
    require_flag(trusted, "trusted")
    path = require_path(path)
    if volume_kind(path) in extensions("volume", "r"):
        return path
    kind = require_format(path, "volume", "r")
    if kind == ".zarr":
        raise FileAccessError(f"{path}: no such folder; check the path")
    return require_file(path)


def _is_dense(path: Path, background: Any = None, tolerance: Any = 0.0, grid_type: Any = None) -> bool:
    """Whether a file holds a dense volume, for which alone there are a background, a tolerance and a type."""
    if grid_type is not None:
        require_text(grid_type, "grid_type")
    require_finite_scalar(tolerance, "tolerance", low=FROM_ZERO)
    if _kind(path) not in (*SPARSE, *STAGES):
        return True
    given = {"background": background is not None, "tolerance": tolerance != 0.0, "grid_type": grid_type is not None}
    for name, is_given in given.items():
        if is_given:
            raise InputError(f"{name}: has no effect on {extension(path)}, which stores what is active; leave it out")
    return False


def _images(path: Path, memory_limit: int | None) -> list[Image]:
    if path.is_file():
        refuse_empty(path)
    limit = content_limit(size_of(path), memory_limit)
    with named_damage(path):
        images: list[Image] = image_module(_kind(path)).open_images(path, limit)
    return images


def _kind(path: Path) -> str:
    return volume_kind(path) or extension(path)


def _of_image(image: Image, path: Path, how: dict[str, Any], memory_limit: int | None) -> SparseVolume:
    how = how | {"tolerance": float(how["tolerance"])}
    return volume_of_image(image, path, **how, limit=content_limit(size_of(path), memory_limit, held=False))


def unique_names(names: Sequence[str]) -> list[str]:
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
        if names.count(USUAL) == 1:
            return names.index(USUAL)
        if len(names) != 1:
            raise InputError(f"{path}: has {len(names)} grids ({_listed(names)}); choose one with grid=")
        return 0
    if grid not in names:
        raise InputError(f"{path}: no grid named {grid!r}; the file holds {_listed(names)}")
    return names.index(grid)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names) or "none"


def _read_stage(
    path: Path, trusted: bool, memory_limit: int | None, choose: Callable[[list[str]], list[int]]
) -> list[SparseVolume]:
    """The volumes of the fields of a stage that are chosen by the numbers of their names."""
    refuse_empty(path)
    volumes = []
    with opened(path, content_limit(path.stat().st_size, memory_limit), trusted) as fields:
        names = unique_names([field.name for field in fields])
        for index in choose(names):
            field = fields[index]
            with named_field(path, field):
                found = _read_vdb(require_file(field.file), [field.grid] if field.grid else None, trusted, memory_limit)
                own = unique_names([volume.info.name for volume in found])
                volume = placed(found[_index_of(None, own, field.file) if not field.grid else 0], field)
                volumes.append(volume)
    return volumes


def _inspect_stage(path: Path) -> list[GridInfo]:
    refuse_empty(path)
    infos = []
    with opened(path, content_limit(path.stat().st_size)) as fields:
        for field in fields:
            with named_field(path, field):
                found = [_info_of_vdb(header) for header in native.inspect_vdb(require_file(field.file))]
                names = unique_names([info.name for info in found])
                infos.append(placed_info(found[_index_of(field.grid or None, names, field.file)], field))
    return infos


def _from_nvdb(grid: file.NvdbGrid) -> SparseVolume:
    # Devices keep copies of the buffer, so it must not change afterwards.
    grid.buffer.setflags(write=False)
    info = info_of(grid.buffer, grid.metadata, name=grid.name)
    return _checked(grid.buffer, info)


def _read_vdb(path: Path, grids: list[str] | None, trusted: bool, memory_limit: int | None) -> list[SparseVolume]:
    from geokit.native import _openvdb

    volumes = []
    limit = _openvdb.WORKER_COPIES * content_limit(path.stat().st_size, memory_limit)
    for grid in _openvdb._read_unchecked(path, grids=grids, trusted=trusted, memory_limit=limit):
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
