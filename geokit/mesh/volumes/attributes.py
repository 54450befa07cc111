"""Vertex attributes from volumes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.core.download import download
from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop.types import Device, MeshLike
from geokit.core.memory.needs import needs
from geokit.core.require import require_mapping, require_one_world
from geokit.mesh.model.device_mesh import vertices_near
from geokit.mesh.surfaces.objects import require_mesh
from geokit.volume.tree.leaves import require_volume

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume


@of_constants
@needs(lambda mesh, volumes, **_: 40 * mesh.vertex_count * len(volumes))
def sample_attributes(
    mesh: MeshLike, volumes: Mapping[str, SparseVolume], *, order: int | None = 1, device: Device = None
) -> dict[str, NDArray[np.float64]]:
    """Sample volumes at the vertices of a mesh, such as the temperature on an isosurface of the density.

    Volumes may differ in transform, resolution and type. Values are those of ``volume.sample``, with its error bounds;
    outside the active voxels they are the volume's background.

    Args:
        mesh: The mesh.
        volumes: A grid for each attribute's name.
        order: Order of the interpolation, as in :func:`geokit.volume.sample`; None for each volume's own.
        device: Where to compute; None for the first GPU, else the CPU.

    Returns:
        A float64 array for each name, in the order of the names: shape (V,) for scalar grids, (V, 3) or (V, 4) for
        grids of vectors and colors. Suits ``geokit.mesh.save(path, mesh, point_data=...)``.

    Raises:
        InputError: A name is empty or not text, a value is not a volume, the order is not supported, or units or up
            axes are known and differ.
        UnsupportedGridError: A grid stores indices or points instead of values.

    Example:
        >>> sdf = gk.volume.from_mesh(gk.mesh.load("data/samples/bracket.obj"), 0.5)
        >>> surface = gk.mesh.from_volume(sdf)
        >>> distance = gk.mesh.sample_attributes(surface, {"distance": sdf})["distance"]
        >>> bool(abs(distance).max() < 0.5)
        True
    """
    mesh = require_mesh(mesh, "mesh")
    volumes = require_mapping(volumes, "volumes")
    for name, volume in volumes.items():
        require_volume(volume, f"volumes[{name!r}]")
    require_one_world(mesh=mesh, **{f"volumes[{name!r}]": volume.info for name, volume in volumes.items()})
    points = vertices_near(mesh, device) if volumes else None
    sampled = {name: volume.sample(points, order=order, device=device) for name, volume in volumes.items()}
    return {name: values if isinstance(values, np.ndarray) else download(values)[0] for name, values in sampled.items()}
