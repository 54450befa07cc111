"""Point clouds on the surface of a mesh, with its attributes."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.core.interop.types import MeshLike
from geokit.core.memory.needs import needs
from geokit.mesh._sample_surface import sample_surface, samples_bytes
from geokit.mesh.attributes.interpolation import chosen_names, interpolated, interpolation_bytes
from geokit.mesh.model.data import has_meaning
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.topology.normals import face_normals
from geokit.points._io import PointCloud


def _bytes(mesh: TriangleMesh, count: int | None = None, **options: Any) -> float:
    return samples_bytes(mesh, count, **options) + (interpolation_bytes(mesh) + 40) * (count or 0)


@needs(_bytes, late=True)
def sample(
    mesh: MeshLike, count: int | None = None, *, method: str = "uniform", radius: float | None = None, seed: int = 0
) -> PointCloud:
    """A point cloud on the surface of a mesh, with normals and the attributes of the mesh.

    Points are those of :func:`geokit.mesh.sample_surface`, attributes are interpolated as in
    :meth:`geokit.mesh.Surface.sample_attributes`. ``normal`` is called ``normals``, as in clouds; where the mesh has
    none, they are those of the triangles. ``color`` is called ``rgb``, or ``rgba`` with alpha.

    Args:
        mesh: The triangles.
        count: Number of points, as in :func:`geokit.mesh.sample_surface`; so are the other arguments.
        method: "uniform" or "poisson_disk".
        radius: Minimum distance between any two points [world], for "poisson_disk".
        seed: Seed of the random numbers, 0 or more.
    Returns:
        PointCloud.
    Raises:
        InputError: As for :func:`geokit.mesh.sample_surface`.
        DeviceMemoryError: That many points would not fit in memory.
    Example:
        >>> sample(gk.mesh.load("data/samples/torus.ply"), 100)
        PointCloud(100 points, data: normals)
    """
    mesh = require_mesh(mesh, "mesh", images=False)
    found = sample_surface(mesh, count, method=method, radius=radius, seed=seed)
    data = interpolated(mesh, found.triangle_id, found.barycentric, chosen_names(mesh, None))
    named = {}
    for name, values in data.items():
        if has_meaning(name, values) and name == "normal":
            name = "normals"
        elif has_meaning(name, values) and name == "color":
            name = "rgb" if values.shape[1] == 3 else "rgba"
        named[name] = values
    if "normals" not in named:
        named["normals"] = face_normals(mesh)[found.triangle_id] if len(found.points) else np.empty((0, 3))
    return PointCloud(found.points, named)
