"""What the page draws: a record for each object, in a frame whose numbers float32 holds well."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop.objects import points_of, polygons_of
from geokit.errors import InputError
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.surfaces.surface import Surface
from geokit.points._io import PointCloud
from geokit.render.looks.checks import DIVERGING
from geokit.render.looks.color_maps import HELD, color_table
from geokit.render.viewer.surfaces import cloud_record, mesh_record, require_content
from geokit.render.viewer.volumes import volume_record
from geokit.volume.model.sparse_volume import SparseVolume

if TYPE_CHECKING:
    from geokit.render.viewer.arrays import Arrays

__all__ = ["Frame", "read_thing", "scene_record"]


class Frame(NamedTuple):
    """The page's own frame: world minus ``center``, divided by ``scale``; the scene lies within about 1 of zero."""

    center: NDArray[np.float64]
    scale: float

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        return ((points - self.center) / self.scale).astype(np.float32)

    def matrix(self, transform: NDArray[np.float64]) -> NDArray[np.float64]:
        """A transform to the world (4, 4) as one to this frame."""
        found = transform.copy()
        found[:3, 3] -= self.center
        found[:3] /= self.scale
        return found


def read_thing(thing: Any, where: str) -> TriangleMesh | PointCloud | SparseVolume:
    """What is given, as one of geokit's own objects.

    Raises:
        InputError: It cannot be drawn; the message names ``where``.
    """
    if isinstance(thing, (TriangleMesh, PointCloud, SparseVolume)):
        return thing
    if isinstance(thing, Surface):
        return thing.mesh
    # A list of two rows is two points, a tuple of two arrays a mesh.
    if not isinstance(thing, list) and polygons_of(thing, where) is not None:
        return require_mesh(thing, where)
    points = points_of(thing, where)
    if points is thing and not isinstance(thing, (list, tuple)) and not hasattr(thing, "shape"):
        raise InputError(
            f"{where}: {type(thing).__name__} cannot be drawn; give a mesh, a volume, a cloud, or points (N, 3)"
        )
    try:
        return PointCloud(thing)
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix('points: ')}") from error


def _bounds(thing: TriangleMesh | PointCloud | SparseVolume, where: str) -> NDArray[np.float64]:
    if isinstance(thing, SparseVolume):
        bounds = thing.info.world_bounds
        if bounds is None:
            raise InputError(f"{where}: grid {thing.info.name!r} has no active voxels: there is nothing to draw")
        # Of one voxel there is something to see, too.
        return bounds + np.array([[-1.0], [1.0]]) * np.abs(thing.info.transform[:3, :3]).sum(axis=1)
    if isinstance(thing, TriangleMesh):
        require_content(thing.face_count, thing.bounds, where, "faces")
        return thing.bounds
    points = thing.points
    bounds = np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 3))
    require_content(len(points), bounds, where, "points")
    return bounds


def scene_record(
    things: list[TriangleMesh | PointCloud | SparseVolume],
    names: list[str],
    arrays: Arrays,
    *,
    title: str,
    colormap: str,
    up: str,
    max_voxels: int,
    device: Any,
) -> dict[str, Any]:
    """The scene as JSON, which names the arrays that it uses."""
    boxes = [_bounds(thing, f"things[{row}]") for row, thing in enumerate(things)]
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    frame = Frame(0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)) or 1.0)
    records = []
    for thing, name in zip(things, names, strict=True):
        if isinstance(thing, TriangleMesh):
            records.append(mesh_record(thing, name, frame, arrays))
        elif isinstance(thing, PointCloud):
            records.append(cloud_record(thing, name, frame, arrays))
        else:
            records.append(volume_record(thing, name, frame, arrays, max_voxels=max_voxels, device=device))
    maps = list(dict.fromkeys((colormap, *HELD)))
    return {
        "title": title,
        "up": up,
        "center": frame.center.tolist(),
        "scale": frame.scale,
        "low": frame.local(low).tolist(),
        "high": frame.local(high).tolist(),
        "colormap": colormap,
        "diverging": DIVERGING,
        "maps": maps,
        "colors": arrays.add(np.stack([color_table(name) for name in maps])),
        "objects": records,
    }
