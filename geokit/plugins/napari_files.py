"""Volumes and meshes as layers of napari, which finds these readers by napari.yaml. napari is not imported."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import extension
from geokit.formats.table import SPARSE, extensions
from geokit.plugins._grids import MOST_BYTES, dense_of

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
Layer = tuple[Any, dict[str, Any], str]
Reader = Callable[[Paths], list[Layer]]

COLORS = ("rgba8", "vec3u8")
# Axes of images as napari counts them: z, y, x.
REVERSED = [2, 1, 0, 3]


def volume_reader(path: Paths) -> Reader | None:
    """The function that reads these files; None where one of them is not .vdb or .nvdb."""
    return read_volumes if all(extension(one) in SPARSE for one in _listed(path)) else None


def mesh_reader(path: Paths) -> Reader | None:
    """The function that reads these files; None where one of them is no mesh format of geokit."""
    return read_meshes if all(extension(one) in extensions("mesh", "r") for one in _listed(path)) else None


def read_volumes(path: Paths) -> list[Layer]:
    """Layers for every grid: a level set is a surface, any other grid an image, and a vector grid three images.

    Axes are in napari's order, z, y, x, and units are those of the world.

    Args:
        path: A .vdb or .nvdb file, or several.
    Returns:
        Tuples of data, arguments and kind of each layer.
    Raises:
        FileAccessError, FileFormatError: A file is missing or damaged.
        DeviceMemoryError: The box around the active voxels of a grid is larger than 4 GiB.
        UnsupportedGridError: A grid stores no values.
    """
    from geokit.mesh.volumes.from_volume import from_volume
    from geokit.volume._io import load_all

    layers = []
    for one in _listed(path):
        for name, volume in load_all(one).items():
            name = name or _stem(one)
            if volume.info.grid_class == "level set":
                layers.append(_surface(from_volume(volume), name))
            else:
                layers += _images(volume, one, name)
    return layers


def read_meshes(path: Paths) -> list[Layer]:
    """A surface layer for each file, with its axes in napari's order, z, y, x.

    Args:
        path: A mesh file, or several.
    Returns:
        Tuples of data, arguments and kind of each layer.
    Raises:
        FileAccessError, FileFormatError: A file is missing or damaged.
    """
    from geokit.mesh._io import load

    return [_surface(load(one), _stem(one)) for one in _listed(path)]


def _surface(mesh: Any, name: str) -> Layer:
    # Reversed axes mirror the mesh; reversed corners keep its normals outward.
    return (mesh.vertices[:, ::-1], mesh.faces[:, ::-1]), {"name": name}, "surface"


def _images(volume: Any, path: str | os.PathLike[str], name: str) -> list[Layer]:
    dense = dense_of(volume, path, MOST_BYTES)
    place = _place(dense.array_transform[REVERSED][:, REVERSED])
    placed = {"metadata": {"grid_class": volume.info.grid_class}, **place}
    values = dense.values.transpose(2, 1, 0, *range(3, dense.values.ndim))
    if values.ndim == 3 or volume.info.grid_type in COLORS:
        return [(values, {"name": name, **placed, **({"rgb": True} if values.ndim == 4 else {})}, "image")]
    parts = zip("xyzw", np.moveaxis(values, 3, 0), strict=False)
    return [(part, {"name": f"{name} {axis}", **placed}, "image") for axis, part in parts]


def _place(transform: NDArray[np.float64]) -> dict[str, Any]:
    """Where an image lies: scale and translation as napari's rulers read them, where these are enough."""
    scale = np.diag(transform)[:3]
    if np.array_equal(np.diag(scale), transform[:3, :3]) and (scale > 0.0).all():
        return {"scale": scale, "translate": transform[:3, 3]}
    return {"affine": transform}


def _listed(path: Paths) -> list[str | os.PathLike[str]]:
    return [path] if isinstance(path, (str, os.PathLike)) else list(path)


def _stem(path: str | os.PathLike[str]) -> str:
    return os.path.splitext(os.path.basename(os.fspath(path)))[0]
