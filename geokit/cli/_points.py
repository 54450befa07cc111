"""What conversions of point clouds choose: balls around points, and the arrays that a format holds."""

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
    from geokit.points._io import PointCloud
    from geokit.volume.model.sparse_volume import SparseVolume

# Points on a mesh, if their number is not given.
DEFAULT_COUNT = 100_000
# Radius of the balls, in distances to the fourth neighbor: most neighbors overlap, and the voxels see it.
SPREAD = 1.5
NEIGHBORS = 5
# Voxels in a radius: below 0.87 balls are lost.
VOXELS_PER_RADIUS = 1.5


def balls(
    cloud: PointCloud,
    radius: float | None,
    voxel_size: float | None,
    half_width: float | None = None,
    device: Any = None,
    *,
    quiet: bool,
) -> SparseVolume:
    """The level set of balls around the points, of a radius and in voxels that are chosen where they are not given."""
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
