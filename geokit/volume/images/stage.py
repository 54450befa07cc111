"""Volumes of USD stages: the grids of .vdb files, at the places that the stage gives them."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.base.private_folder import private_folder, temporary_parent
from geokit.core.files import atomic_path, extension
from geokit.core.require import require_one_world
from geokit.errors import FileFormatError, GeokitError, InputError, UnsupportedGridError
from geokit.formats.file_content.references import allowed_folders
from geokit.formats.reader import process, trusted
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import mark_checked
from geokit.volume.nanovdb.checksum import partial_checksum
from geokit.volume.nanovdb.grid_info import GridInfo
from geokit.volume.nanovdb.header import (
    GRID_DATA,
    HEAD_SIZE,
    TREE_OFFSET,
    aligned_buffer,
    checked_transform,
    grid_header,
    voxel_size_of,
    write_transform,
)
from geokit.volume.nanovdb.provenance import METERS_PER_UNIT, UNIT, world_metadata
from geokit.volume.tree.grid_head import root_spans
from geokit.volume.tree.statistics import NO_BOX

_READER = "geokit.formats.usd_volumes"
# USD's name of a grid's type by geokit's; the role of vectors.
_TYPES = {"vec3f": ("float3", "Raw"), "vec3d": ("double3", "Raw"), "int32": ("int", ""), "int64": ("int64", "")}
_TYPES |= {"double": ("double", ""), "bool": ("bool", ""), "mask": ("mask", "")}


class StageField(NamedTuple):
    """A field of a stage.

    Args:
        name: Its name.
        file: The .vdb.
        grid: Name of the grid in it; "" for the only one.
        matrix: From the frame of the file to the world, (4, 4).
        label: The file in messages.
        stated: ``meters_per_unit`` and ``up_axis`` of the stage, None where it does not say them.
    """

    name: str
    file: Path
    grid: str
    matrix: NDArray[np.float64]
    label: str
    stated: tuple[float | None, str | None]


@contextlib.contextmanager
def named_field(path: Path, field: StageField) -> Iterator[None]:
    """Name the stage and the field in errors of the block, which name the file."""
    try:
        yield
    except (FileFormatError, UnsupportedGridError, InputError) as error:
        told = str(error).removeprefix(f"{field.file}: ")
        raise type(error)(f"{path}: field {field.name!r} ({field.label}): {told}") from error


def _facts(path: Path, limit: int, is_trusted: bool) -> tuple[dict[str, Any], list[tuple[str, NDArray[Any]]]]:
    folders = [str(folder) for folder in allowed_folders(None)]
    if is_trusted:
        module = importlib.import_module(_READER)
        found: tuple[dict[str, Any], Any] = trusted._read(path, lambda real: module.read_grids(real, folders))
        return found
    return process.read_grids(path, _READER, limit, folders)


@contextlib.contextmanager
def opened(path: Path, limit: int, is_trusted: bool = False) -> Iterator[list[StageField]]:
    """The fields of a stage, in its order; files of a .usdz exist within the block.

    Args:
        path: The stage.
        limit: Largest size of what a .usdz holds, in bytes.
        is_trusted: Whether to read in this process.
    Raises:
        FileAccessError: A .vdb is missing, or lies outside the folders of :func:`allowed_folders`.
        FileFormatError: The stage is damaged, or holds no volume.
        MissingDependencyError: usd-core is not installed.
        UnsupportedGridError: A field is placed by no affine transform that can be inverted.
    """
    facts, arrays = _facts(path, limit, is_trusted)
    if facts["notes"]:
        warn(f"{path}: {'; '.join(facts['notes'])}")
    if not facts["fields"]:
        shapes = ", ".join(facts["shapes"])
        what = f"; it holds {shapes}: load it with geokit.mesh.load" if shapes else ""
        raise FileFormatError(f"{path}: has no visible Volume prim with fields of .vdb files{what}")
    stated = facts["meters_per_unit"], facts["up_axis"]
    fields, packed = [], iter(arrays)
    with private_folder(temporary_parent()) if arrays else contextlib.nullcontext() as folder:
        for number, field in enumerate(facts["fields"]):
            file = Path(field["file"])
            if folder is not None and not field["file"]:
                file = folder / f"{number}.vdb"
                file.write_bytes(next(packed)[1].tobytes())
            try:
                matrix = checked_transform(np.array(field["matrix"]))
            except InputError as error:
                raise UnsupportedGridError(f"{path}: field {field['name']!r}: {error}") from None
            fields.append(StageField(field["name"], file, field["grid"], matrix, field["label"], stated))
        yield fields


def has_volumes_only(path: Path, limit: int) -> bool:
    """Whether a stage has fields of volumes and no other visible shape."""
    facts, _ = _facts(path, limit, False)
    return bool(facts["fields"]) and not facts["shapes"]


def placed(volume: SparseVolume, field: StageField) -> SparseVolume:
    """The volume of a field's grid, at its place in the stage."""
    info = replace(volume.info, name=field.name, metadata=_said(volume.info, field))
    buffer = volume.nanovdb
    if not np.array_equal(field.matrix, np.eye(4)):
        transform = checked_transform(field.matrix @ volume.info.transform)
        buffer = aligned_buffer(len(buffer))
        buffer[:] = volume.nanovdb
        grid = grid_header(buffer)
        write_transform(grid, transform)
        box = volume.info.index_bounds
        boxes = NO_BOX if box is None else box[None].astype(np.int32)
        root_spans(buffer[:TREE_OFFSET].view(GRID_DATA), boxes)
        grid["checksum"] = partial_checksum(buffer[:HEAD_SIZE], buffer)
        buffer.setflags(write=False)
        info = replace(info, transform=transform, voxel_size=voxel_size_of(transform))
    moved = SparseVolume(buffer, info)
    mark_checked(moved)
    return moved


def placed_info(info: GridInfo, field: StageField) -> GridInfo:
    """What :func:`placed` makes of a grid's description."""
    transform = field.matrix @ info.transform
    said = _said(info, field)
    return replace(info, name=field.name, metadata=said, transform=transform, voxel_size=voxel_size_of(transform))


def _said(info: GridInfo, field: StageField) -> Mapping[str, Any]:
    """Metadata of a grid in a stage: what the stage says of its world goes before what the grid says."""
    said = world_metadata(*field.stated)
    other = METERS_PER_UNIT if UNIT in said else UNIT if METERS_PER_UNIT in said else ""
    return MappingProxyType({**{key: value for key, value in info.metadata.items() if key != other}, **said})


def save_stage(
    path: Path,
    volumes: Sequence[SparseVolume],
    names: Sequence[str],
    write_vdb: Callable[[Path, Sequence[SparseVolume]], None],
) -> None:
    """Write a stage with one Volume prim, and its grids into a .vdb: beside it, or inside a .usdz.

    Args:
        path: The stage.
        volumes: Its fields.
        names: Different names for them, which the grids get.
        write_vdb: Writes volumes to a .vdb.
    Raises:
        FileAccessError: The target cannot be written.
        InputError: A name is no text in UTF-8, or units or up axes are known and differ.
        MissingDependencyError: usd-core or OpenVDB is not there.
    """
    from geokit.formats.usd_volumes import NewField, write_stage

    # The stem alone may be the name of the file that the volumes were read from.
    asset = f"{path.stem}_grids.vdb"
    for name in (asset, *names):
        try:
            name.encode()
        except UnicodeEncodeError:
            raise InputError(f"{path}: USD takes only names in UTF-8, and {name!r} is none; choose another") from None
    fields = [
        NewField(name, name, *_TYPES.get(volume.info.grid_type, ("float", "")))
        for name, volume in zip(names, volumes, strict=True)
    ]
    named = [SparseVolume(v.nanovdb, replace(v.info, name=name)) for name, v in zip(names, volumes, strict=True)]
    boxes = [box for volume in volumes if (box := volume.info.world_bounds) is not None]
    extent = np.stack([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]]) if boxes else None
    said = require_one_world(**{f"volumes[{number}]": one.info for number, one in enumerate(volumes)})
    world: Any = extent, said["up_axis"], said["meters_per_unit"]
    with atomic_path(path) as part:
        try:
            if extension(path) == ".usdz":
                inner = part.with_name("grids.vdb")
                write_vdb(inner, named)
                write_stage(part, inner, asset, fields, *world)
                inner.unlink()
            else:
                write_vdb(path.with_name(asset), named)
                write_stage(part, None, asset, fields, *world)
        except GeokitError as error:
            raise type(error)(str(error).replace(str(part.with_name("grids.vdb")), str(path))) from error
