"""Conversions of point clouds: to volumes, to meshes, and from meshes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit._warn import warn
from geokit.cli._program.console import note
from geokit.core.files import extension
from geokit.errors import InputError
from geokit.formats.table import FORMATS

if TYPE_CHECKING:
    from geokit.cli._storage import Storage
    from geokit.points._io import PointCloud
    from geokit.volume.model.sparse_volume import SparseVolume

__all__ = ["DEFAULT_COUNT", "cloud_to_mesh", "cloud_to_volume", "mesh_to_cloud", "save_cloud"]

# Points on a mesh, if their number is not given.
DEFAULT_COUNT = 100_000
# Radius of the balls, in distances to the fourth neighbor: most neighbors overlap, and the voxels see it.
SPREAD = 1.5
NEIGHBORS = 5
# Voxels in a radius: below 0.87 balls are lost.
VOXELS_PER_RADIUS = 1.5


def mesh_to_cloud(source: Path, target: Path, count: int | None, radius: float | None) -> dict[str, Any]:
    """Points on a mesh, with its attributes: random ones, or evenly spread if a radius is given."""
    from geokit.mesh import load
    from geokit.points import sample

    if radius is None:
        cloud = sample(load(source), DEFAULT_COUNT if count is None else count)
    elif count is None:
        cloud = sample(load(source), method="poisson_disk", radius=radius)
    else:
        raise InputError("--count: follows from --radius; leave one of them out")
    save_cloud(target, cloud)
    return {"points": len(cloud.points)}


def cloud_to_volume(
    cloud: PointCloud, target: Path, how: dict[str, Any], storage: Storage, *, quiet: bool
) -> dict[str, Any]:
    """The level set of balls around the points."""
    from geokit.volume import save

    volume = storage.applied(_balls(cloud, **how, quiet=quiet))
    save(target, volume, codec=storage.compression)
    active = volume.info.active_voxel_count
    return {"points": len(cloud), "active_voxels": active, **storage.described([volume])}


def cloud_to_mesh(cloud: PointCloud, target: Path, how: dict[str, Any], *, quiet: bool) -> dict[str, Any]:
    """The surface of balls around the points."""
    from geokit.mesh import from_volume, from_volume_with_deviation, save

    device = how["device"]
    volume = _balls(cloud, how["radius"], how["voxel_size"], device=device, quiet=quiet)
    method = {} if how["method"] is None else {"method": how["method"]}
    if how["tolerance"] is None:
        mesh = from_volume(volume, **method, device=device)
    else:
        options = {**method, "device": device, "progress": how["progress"]}
        mesh = from_volume_with_deviation(volume, tolerance=how["tolerance"], **options).mesh
    save(target, mesh)
    return {"points": len(cloud), "vertices": len(mesh.vertices), "faces": len(mesh.faces)}


def _balls(
    cloud: PointCloud,
    radius: float | None,
    voxel_size: float | None,
    half_width: float | None = None,
    device: Any = None,
    *,
    quiet: bool,
) -> SparseVolume:
    from geokit.volume import from_points

    if radius is None:
        radius = _joining_radius(cloud, device) if voxel_size is None else VOXELS_PER_RADIUS * voxel_size
    if voxel_size is None:
        voxel_size = float(f"{radius / VOXELS_PER_RADIUS:.1e}")
    if not quiet:
        note(f"balls of radius {radius:g} in voxels of {voxel_size:g}; --radius and --voxel-size set them")
    width: dict[str, Any] = {} if half_width is None else {"half_width": half_width}
    return from_points(cloud, radius, voxel_size=voxel_size, **width, device=device)


def _joining_radius(cloud: PointCloud, device: Any) -> float:
    """A radius at which the balls of neighbors overlap, by the median of the distances to the fourth neighbor."""
    from geokit.points import NeighborGrid

    distance = np.zeros(1)
    if len(cloud) > 1:
        nearest = NeighborGrid(cloud, device=device).knn(cloud, min(NEIGHBORS, len(cloud)))
        distance = np.asarray(nearest.distance[:, -1])
    radius = SPREAD * float(np.median(distance[distance > 0.0])) if (distance > 0.0).any() else 0.0
    if radius == 0.0:
        raise InputError("--radius: the points have no distances from which to choose it; give one")
    return float(f"{radius:.2g}")


def save_cloud(target: Path, cloud: PointCloud) -> None:
    """Save a cloud with those of its arrays that the format holds; one warning names the others."""
    from geokit.points import PointCloud, save

    held = FORMATS[extension(target)].arrays or tuple(cloud.data)
    lost = ", ".join(repr(name) for name in cloud.data if name not in held)
    if lost:
        warn(f"{target}: {extension(target)} does not hold {lost}; left out")
    data = {name: values for name, values in cloud.data.items() if name in held}
    save(target, PointCloud(cloud.points, data, cloud.coordinate_system))
