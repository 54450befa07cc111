"""``geokit`` on data sets of PyVista: ``polydata.geokit.signed_distance(points)``, ``image.geokit.to_volume()``.

PyVista imports this module by its entry point when ``geokit`` of a data set is used first; its versions before 0.48
have none, and :func:`geokit.register` then does it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.mesh.queries.points import ClosestPoints
    from geokit.mesh.sign.queries import SignedDistances
    from geokit.mesh.surfaces.surface import Surface
    from geokit.volume.model.sparse_volume import SparseVolume

# A vertex lies in a box if it is no farther outside than this [voxel].
ROUNDING = 1e-6


class SurfaceAccessor:
    """``polydata.geokit``: the mesh, and queries of it.

    Nothing is kept between calls, since a data set may change at any time: for many queries take :meth:`surface` once.
    """

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset

    @property
    def mesh(self) -> TriangleMesh:
        """The triangles, with their arrays; as :func:`geokit.mesh.as_mesh`."""
        from geokit.mesh.surfaces.objects import as_mesh

        return as_mesh(self._dataset)

    def surface(self, *, device: Any = None) -> Surface:
        """The mesh prepared for queries; as :class:`geokit.mesh.Surface`."""
        from geokit.mesh.surfaces.surface import Surface

        return Surface(self._dataset, device=device)

    def closest_point(self, points: Any, **options: Any) -> ClosestPoints:
        """The nearest points of the surface; as :meth:`geokit.mesh.Surface.closest_point`."""
        return self.surface().closest_point(points, **options)

    def signed_distance(self, points: Any, **options: Any) -> SignedDistances:
        """Distances to the surface, negative inside; as :meth:`geokit.mesh.Surface.signed_distance`."""
        return self.surface().signed_distance(points, **options)

    def to_volume(self, voxel_size: Any = None, **options: Any) -> SparseVolume:
        """A level set of the surface; as :func:`geokit.volume.from_mesh`."""
        from geokit.volume.distance_fields.from_mesh import from_mesh

        return from_mesh(self._dataset, voxel_size, **options)


class ImageAccessor:
    """``image.geokit``: the active scalars as a sparse volume, and their isosurface."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset

    def to_volume(self, **options: Any) -> SparseVolume:
        """The active scalars as a sparse volume; as :func:`geokit.volume.from_dense`."""
        from geokit.volume._dense import from_dense

        return from_dense(self._dataset, **options)

    def isosurface(self, value: float, **options: Any) -> Any:
        """The surface where the active scalars have a value.

        It ends at the border of the image, as PyVista's ``contour`` does. ``geokit.mesh.from_volume`` of
        :meth:`to_volume` closes it there instead, where the image's values are on the other side of the value than the
        background.

        Args:
            value: The isovalue, in the units of the scalars.
            options: As for :func:`geokit.mesh.from_volume`, whose method is "marching_cubes" here.
        Returns:
            pyvista.PolyData of triangles; normals point toward increasing values.
        Raises:
            InputError: The image has no active scalars, they are vectors, or value is not finite.
        """
        from geokit.core.interop.objects import image_of
        from geokit.mesh._convert import to_pyvista
        from geokit.mesh.model.triangle_mesh import TriangleMesh
        from geokit.mesh.volumes.from_volume import from_volume

        volume = self.to_volume(grid_type="float")
        mesh = from_volume(volume, isovalue=value, **{"method": "marching_cubes", **options})
        image: Any = image_of(self._dataset, "dataset")
        first = np.array(image.origin)
        last = first + image.values.shape - 1
        index = np.linalg.solve(image.transform, np.c_[mesh.vertices, np.ones(mesh.vertex_count)].T)[:3].T
        inside = ((index >= first - ROUNDING) & (index <= last + ROUNDING)).all(axis=1)
        used, corners = np.unique(mesh.faces[inside[mesh.faces].all(axis=1)], return_inverse=True)
        return to_pyvista(TriangleMesh(mesh.vertices[used], corners.reshape(-1, 3), name=mesh.name))


ACCESSORS = {"PolyData": SurfaceAccessor, "ImageData": ImageAccessor}


def attach() -> None:
    """Give PyVista's classes the accessor ``geokit``; a second time changes nothing."""
    import pyvista

    for name, accessor in ACCESSORS.items():
        target = getattr(pyvista, name)
        if hasattr(pyvista, "register_dataset_accessor"):  # since 0.48
            pyvista.register_dataset_accessor("geokit", target)(accessor)
        else:
            target.geokit = property(accessor)


attach()
