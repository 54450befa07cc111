"""Volumes as files of trimesh: ``trimesh.load_mesh("ball.vdb")`` after ``geokit.register("trimesh")``."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from geokit.core.require import require_number
from geokit.errors import InputError
from geokit.plugins._grids import MOST_BYTES, dense_of

# trimesh looks for a type among its loaders of meshes first, so that voxels have a type of their own.
MESH_TYPES = ("vdb", "nvdb")
VOXEL_TYPES = ("vdb_voxels", "nvdb_voxels")


def load_mesh(
    file_obj: Any,
    file_type: str = "vdb",
    *,
    grid: str | None = None,
    isovalue: float | None = None,
    metadata: dict[str, Any] | None = None,
    resolver: Any = None,
    **_: Any,
) -> dict[str, Any]:
    """An isosurface, as trimesh's loaders of meshes return them.

    Args:
        file_obj: An open file.
        file_type: "vdb" or "nvdb".
        grid: Name of the grid; None as for :func:`geokit.volume.load`.
        isovalue: Value of the surface; None is 0 for a level set, and other grids need one.
        metadata: Of the caller.
        resolver: Not used.
    Returns:
        The arguments of trimesh.Trimesh.
    Raises:
        InputError: As for :func:`geokit.volume.load`, or isovalue is missing.
        FileAccessError, FileFormatError: The file is missing or damaged.
    """
    from geokit.mesh.volumes.from_volume import from_volume

    volume, path = _read(file_obj, file_type, grid)
    if isovalue is None and volume.info.grid_class != "level set":
        raise InputError(
            f"{path}: grid {volume.info.name!r} is no level set; give isovalue=, or read its voxels with "
            f"file_type='{file_type}_voxels'"
        )
    mesh = from_volume(volume, isovalue=isovalue or 0.0)
    return {"vertices": mesh.vertices, "faces": mesh.faces, "metadata": {"name": mesh.name, **(metadata or {})}}


def load_voxels(
    file_obj: Any,
    file_type: str = "vdb_voxels",
    *,
    grid: str | None = None,
    isovalue: float = 0.0,
    most_bytes: int = MOST_BYTES,
    resolver: Any = None,
    **_: Any,
) -> Any:
    """The filled voxels of a grid, as trimesh's loaders of voxels return them.

    Filled are the voxels of a level set whose value is at most isovalue, and those of other grids whose value is above.

    Args:
        file_obj: An open file.
        file_type: "vdb_voxels" or "nvdb_voxels".
        grid: Name of the grid; None as for :func:`geokit.volume.load`.
        isovalue: The value that tells filled voxels.
        most_bytes: Largest array of the box around the active voxels [bytes].
        resolver: Not used.
    Returns:
        trimesh.voxel.VoxelGrid of the box around the active voxels.
    Raises:
        InputError: As for :func:`geokit.volume.load`, or the values are vectors.
        FileAccessError, FileFormatError: The file is missing or damaged.
        DeviceMemoryError: The array is larger than most_bytes.
    """
    from trimesh.voxel import VoxelGrid

    isovalue = require_number(isovalue, "isovalue")
    volume, path = _read(file_obj, file_type.removesuffix("_voxels"), grid)
    dense = dense_of(volume, path, most_bytes)
    if dense.values.ndim != 3:
        raise InputError(f"{path}: grid {volume.info.name!r} holds vectors, which fill nothing; choose scalars")
    filled = dense.values <= isovalue if volume.info.grid_class == "level set" else dense.values > isovalue
    return VoxelGrid(filled, dense.array_transform, metadata={"name": volume.info.name})


def _read(file_obj: Any, kind: str, grid: str | None) -> tuple[Any, str | os.PathLike[str]]:
    from geokit.volume._io import load

    with _path_of(file_obj, kind) as path:
        return load(path, grid=grid), path


@contextmanager
def _path_of(file_obj: Any, kind: str) -> Iterator[str | os.PathLike[str]]:
    """Where an open file lies; what lies nowhere, such as in an archive, is written to a file first."""
    name = getattr(file_obj, "name", None)
    if isinstance(name, str) and name.lower().endswith(f".{kind}") and os.path.isfile(name):
        yield name
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"grid.{kind}")
        path.write_bytes(file_obj.read())
        yield path
