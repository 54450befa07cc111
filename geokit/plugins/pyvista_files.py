"""Volumes as files of PyVista: ``pyvista.read("smoke.vdb")`` and ``dataset.save("smoke.nvdb")``."""

from __future__ import annotations

import os
from typing import Any

from geokit.core.require import require_choice, require_count
from geokit.errors import InputError
from geokit.plugins._grids import MOST_BYTES, require_fits


def read(
    path: str | os.PathLike[str], *, grid: str | None = None, kind: str = "auto", most_bytes: int = MOST_BYTES
) -> Any:
    """Read one grid of a .vdb or .nvdb file for PyVista.

    Args:
        path: The file.
        grid: Name of the grid; None as for :func:`geokit.volume.load`.
        kind: "image" for the voxels of the box around the active ones, "surface" for the isosurface at 0, "auto": the
            surface of a level set, and the image of any other grid.
        most_bytes: Largest image [bytes].
    Returns:
        pyvista.ImageData or pyvista.PolyData.
    Raises:
        InputError: As for :func:`geokit.volume.load`, or kind is none of these.
        FileAccessError, FileFormatError: The file is missing or damaged.
        DeviceMemoryError: The image is larger than most_bytes.
    """
    from geokit.mesh._convert import to_pyvista as mesh_to_pyvista
    from geokit.mesh.volumes.from_volume import from_volume
    from geokit.volume._convert import to_pyvista
    from geokit.volume._io import load

    require_choice(kind, "kind", ("auto", "image", "surface"))
    require_count(most_bytes, "most_bytes", 1)
    volume = load(path, grid=grid)
    if kind == "surface" or (kind == "auto" and volume.info.grid_class == "level set"):
        return mesh_to_pyvista(from_volume(volume))
    require_fits(volume, path, most_bytes, remedy="read a part with geokit.volume.to_pyvista(volume, bounds=...)")
    return to_pyvista(volume)


def write(dataset: Any, path: str | os.PathLike[str], **options: Any) -> None:
    """Write an image as a grid of a .vdb or .nvdb file, or a closed surface as a level set.

    Args:
        dataset: pyvista.ImageData, whose active scalars become the grid, or pyvista.PolyData.
        path: The file.
        options: As for :func:`geokit.volume.from_dense` of an image (name, background, grid_class, ...), or
            :func:`geokit.volume.from_mesh` of a surface, which needs voxel_size or tolerance.
    Raises:
        InputError: The data set is neither, or an option does not fit.
        FileAccessError: The target cannot be written.
    """
    from geokit.core.interop.objects import has_faces, image_of
    from geokit.volume._dense import from_dense
    from geokit.volume._io import save
    from geokit.volume.distance_fields.from_mesh import from_mesh

    try:
        if image_of(dataset, "dataset") is not None:
            volume = from_dense(dataset, **options)
        elif has_faces(dataset, "dataset"):
            volume = from_mesh(dataset, **options)
        else:
            raise InputError(f"dataset: {type(dataset).__name__} is neither an image nor a surface; sample it first")
    except TypeError as error:  # an option that neither has
        raise InputError(f"options: {error}") from error
    save(path, volume)
