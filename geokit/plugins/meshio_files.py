"""Volumes as files of meshio: ``meshio.read("smoke.vdb")`` after ``geokit.register("meshio")``.

A level set is its surface in triangles. Other grids are hexahedra, one for each voxel that is not background, with the
values on the cells: they keep a voxel's size and its neighbors, as solvers and ``.vtu`` files need it, which a cloud of
vertices would lose.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from geokit.core.memory.row_products import row_product
from geokit.core.require import require_choice
from geokit.errors import DeviceMemoryError
from geokit.plugins._grids import MOST_BYTES, dense_of

# meshio's name of each format, and its extensions.
FORMATS = {"vdb": [".vdb"], "nvdb": [".nvdb"]}
# Of a hexahedron: its corners as indices, twice while they are made, and as points.
BYTES_PER_HEXAHEDRON = 400
# In the order of VTK and meshio: around the lower face, then around the upper.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


def read(
    path: str | os.PathLike[str], *, grid: str | None = None, kind: str = "auto", most_bytes: int = MOST_BYTES
) -> Any:
    """Read one grid of a .vdb or .nvdb file for meshio.

    Args:
        path: The file.
        grid: Name of the grid; None as for :func:`geokit.volume.load`.
        kind: "voxels" for a hexahedron around each voxel that differs from the background, "surface" for the isosurface
            at 0, "auto": the surface of a level set, and the voxels of any other grid.
        most_bytes: Largest array of the box around the active voxels, and of the hexahedra [bytes].
    Returns:
        meshio.Mesh of "triangle", or of "hexahedron" with the values in ``cell_data`` under the grid's name, or
        "value".
    Raises:
        InputError: As for :func:`geokit.volume.load`, or kind is none of these.
        FileAccessError, FileFormatError: The file is missing or damaged.
        DeviceMemoryError: The voxels take more than most_bytes.
    """
    from geokit.mesh._convert import to_meshio
    from geokit.mesh.volumes.from_volume import from_volume
    from geokit.volume._io import load

    require_choice(kind, "kind", ("auto", "voxels", "surface"))
    volume = load(path, grid=grid)
    if kind == "surface" or (kind == "auto" and volume.info.grid_class == "level set"):
        return to_meshio(from_volume(volume))
    import meshio

    dense = dense_of(volume, path, most_bytes)
    differs = dense.values != np.asarray(volume.info.background, dense.values.dtype)
    places = np.argwhere(differs if differs.ndim == 3 else differs.any(axis=-1))
    need = len(places) * BYTES_PER_HEXAHEDRON
    if need > most_bytes:
        raise DeviceMemoryError(
            f"{path}: the hexahedra of {len(places)} voxels need {need >> 20} MiB; raise most_bytes, or read a part "
            "with geokit.volume.clip",
            need=need,
        )
    shape = np.array(dense.values.shape[:3]) + 1
    at = places[:, None] + CORNERS
    used, cells = np.unique((at[..., 0] * shape[1] + at[..., 1]) * shape[2] + at[..., 2], return_inverse=True)
    # A voxel reaches half a step from its index to each side.
    index = np.stack(np.unravel_index(used, shape), axis=1) + dense.origin - 0.5
    points = row_product(index, dense.transform[:3, :3].T, dense.transform[:3, 3])
    values = dense.values[tuple(places.T)]
    values = values.astype(np.uint8) if values.dtype == bool else values  # meshio's formats have no bool
    return meshio.Mesh(
        points, [("hexahedron", cells.reshape(-1, 8))], cell_data={volume.info.name or "value": [values]}
    )


def write(path: str | os.PathLike[str], mesh: Any, **options: Any) -> None:
    """Write a closed surface of meshio as a level set.

    Args:
        path: The file, .vdb or .nvdb.
        mesh: meshio.Mesh with triangles, quads or polygons.
        options: As for :func:`geokit.volume.from_mesh`, which needs voxel_size or tolerance.
    Raises:
        InputError: The mesh has no polygons, or an option does not fit.
        FileAccessError: The target cannot be written.
    """
    from geokit.plugins.pyvista_files import write as write_level_set

    write_level_set(mesh, path, **options)
