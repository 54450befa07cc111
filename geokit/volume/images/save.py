"""A sparse volume as a dense file: the box around the active voxels, slab after slab."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.files import atomic_path, extension, folder_beside, is_there, sync
from geokit.errors import FileAccessError, GeokitError, InputError
from geokit.formats.images.image import LARGEST_COSINE, METERS, Image, affine
from geokit.formats.images.stream import rows_at_a_time
from geokit.formats.table import FORMATS, ZARR, image_module
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.provenance import SPACE, UNIT, world_metadata
from geokit.volume.nanovdb.types import QUANTIZED

# Reads a box (2, 3) of voxels.
Read = Callable[[NDArray[np.int64]], NDArray[Any]]


def save_image(
    path: str | os.PathLike[str],
    volume: SparseVolume,
    dtype: np.dtype[Any],
    components: int,
    read: Read,
    codec: str | None,
) -> None:
    """Write the box around the active voxels of a volume.

    Args:
        path: The target.
        volume: The volume.
        dtype: Type of its values.
        components: Numbers in a voxel.
        read: Reads a box of voxels.
        codec: Compression; None for the format's own.
    Raises:
        InputError: The format holds no such type or transform, or the volume has no active voxel.
        FileAccessError: The target cannot be written.
        MissingDependencyError: The format's package is not installed.
    """
    kind = extension(path)
    info = volume.info
    if info.index_bounds is None:
        raise InputError(f"{path}: grid {info.name!r} has no active voxel, and a dense file holds a box of voxels")
    low, high = info.index_bounds
    module = image_module(kind)
    axis = 0 if kind == ".npy" else 2
    transform = info.transform @ affine(np.eye(3), low)
    order, flips = _way_to_world(transform) if getattr(module, "STRAIGHT", False) else ([0, 1, 2], [False] * 3)
    sizes = (high - low + 1)[order]
    shape = (int(sizes[0]), int(sizes[1]), int(sizes[2]))
    along = order[axis]

    def slabs() -> Iterator[NDArray[Any]]:
        step = rows_at_a_time(math.prod(shape) // shape[axis] * components * dtype.itemsize)
        for first in range(0, shape[axis], step):
            box = np.stack([low, high])
            ends = first, min(first + step, shape[axis]) - 1
            box[:, along] = (
                [high[along] - end for end in ends[::-1]] if flips[axis] else [low[along] + end for end in ends]
            )
            values = read(box)
            yield np.flip(values.transpose(*order, *range(3, values.ndim)), tuple(at for at in range(3) if flips[at]))

    corner = np.zeros(3)
    corner[order] = np.where(flips, sizes - 1, 0)
    columns = transform[:3, order] * np.where(flips, -1.0, 1.0)
    moved = order != [0, 1, 2] or any(flips)
    background = info.background
    space, meters = str(info.metadata.get(SPACE, "")), info.meters_per_unit
    unit = world_metadata(meters, None).get(UNIT, "")
    placed = affine(columns, transform[:3, :3] @ corner + transform[:3, 3])
    if not meters and FORMATS[kind].default_unit:
        warn(f"{path}: the unit of the volume is not known, and the file says {FORMATS[kind].default_unit}")
    if meters and not unit:
        # Inches, feet and others have no name in most of these files.
        unit = "mm"
        placed[:3] *= meters / METERS[unit]
    image = Image(
        shape=shape,
        dtype=dtype,
        transform=placed,
        slabs=slabs,
        axis=axis,
        components=components,
        name=info.name,
        unit=unit,
        space=space if len(space) == 3 and set(space) <= set("RLAPSI") else "",
        note={
            "name": info.name,
            "class": info.grid_class,
            "type": "float" if info.grid_type in QUANTIZED else info.grid_type,
            "background": list(background) if isinstance(background, tuple) else background,
            "origin": [0, 0, 0] if moved else low.tolist(),
        },
    )
    if kind == ".npy" and not np.array_equal(image.transform, np.eye(4)):
        warn(f"{path}: .npy holds no place and no voxel size; left out")
    with _atomic_folder(Path(path)) if kind == ".zarr" else atomic_path(path) as part:
        stem: Any = {"stem": Path(path).with_suffix("")} if FORMATS[kind].references else {}
        try:
            module.write_image(part, image, codec, **stem)
        except GeokitError as error:
            raise type(error)(str(error).replace(str(part), str(path))) from error


def _way_to_world(transform: NDArray[np.float64]) -> tuple[list[int], list[bool]]:
    """The index axis along each axis of the world, and whether it runs backwards; as they are if some lie between."""
    linear = transform[:3, :3]
    order = np.abs(linear).argmax(axis=1)
    main = linear[np.arange(3), order]
    rest = linear.copy()
    rest[np.arange(3), order] = 0.0
    if sorted(order.tolist()) != [0, 1, 2] or np.abs(rest).max() > LARGEST_COSINE * np.abs(main).min():
        return [0, 1, 2], [False] * 3
    return order.tolist(), (main < 0.0).tolist()


@contextlib.contextmanager
def _atomic_folder(target: Path) -> Iterator[Path]:
    """A folder that replaces ``target``, which must not exist or be a folder of zarr, if the block succeeds.

    Raises:
        FileAccessError: Something else stands there, or it cannot be written.
    """
    if is_there(target) and not any((target / name).is_file() for name in ZARR):
        raise FileAccessError(f"{target}: exists and is no zarr folder; choose another name")
    real = Path(os.path.realpath(target))
    with folder_beside(real, target) as folder:
        part = folder / "part.zarr"
        yield part
        for one in (*part.rglob("*"), part):
            sync(one)
        _replace_folder(part, real, folder / "old")


def _replace_folder(part: Path, real: Path, old: Path) -> None:
    if real.exists() and _exchanged(part, real):
        return
    try:
        if real.exists():
            os.replace(real, old)
        os.replace(part, real)
    finally:
        # An interrupt or a full disk between the two must not take what was there.
        if old.exists() and not real.exists():
            os.replace(old, real)


def _exchanged(one: Path, other: Path) -> bool:
    """Let two folders change places in one step; False where the system has no such step."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return rename is not None and rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0
