"""Point clouds for other libraries; each library is imported when it is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit._packages import require_package
from geokit._warn import warn
from geokit.core.memory.needs import needs, rows
from geokit.errors import MissingDependencyError
from geokit.points._io import PointCloud

if TYPE_CHECKING:
    import open3d
    import pyvista
    import trimesh

# Largest value of a color channel by the type of its array; floats are taken as shares.
_WHITE = {"u1": 255.0, "u2": 65535.0}


def _bytes(points: Any) -> int:
    data = points.data if isinstance(points, PointCloud) else {}
    return 48 * rows(points) + 2 * sum(values.nbytes for values in data.values())


@needs(_bytes, fatal=True)
def to_pyvista(points: PointCloud) -> pyvista.PolyData:
    """A ``pyvista.PolyData`` of points, with their arrays as point data.

    Args:
        points: A PointCloud, positions (N, 3), or a cloud of another library.
    Returns:
        pyvista.PolyData with copies of all arrays.
    Raises:
        InputError: points holds no points (N, 3).
        MissingDependencyError: PyVista is not installed.
    """
    cloud = _cloud(points)
    pyvista = require_package("pyvista")
    found = pyvista.PolyData(np.array(cloud.points)) if len(cloud) else pyvista.PolyData()
    for name, values in cloud.data.items():
        found.point_data[name] = np.array(values)
    return found


@needs(_bytes)
def to_open3d(points: PointCloud) -> open3d.geometry.PointCloud:
    """An ``open3d.geometry.PointCloud`` of points, with ``normals`` and ``rgb`` or ``rgba`` if it has them.

    Open3D's colors are shares of 1. Other arrays have no place there and are left out, which a UserWarning says; the
    tensor cloud (``open3d.t.geometry.PointCloud``) has room for them.

    Args:
        points: A PointCloud, positions (N, 3), or a cloud of another library.
    Returns:
        open3d.geometry.PointCloud with copies of the arrays, float64.
    Raises:
        InputError: points holds no points (N, 3).
        MissingDependencyError: Open3D is not installed.
    """
    cloud = _cloud(points)
    try:
        import open3d
    except ImportError as error:
        raise MissingDependencyError(
            f"to_open3d needs the package open3d ({error}); install it with: pip install open3d"
        ) from None
    vectors, lost = open3d.utility.Vector3dVector, list[str]()
    found = open3d.geometry.PointCloud(vectors(np.array(cloud.points)))
    for name, values in cloud.data.items():
        if name == "normals" and values.shape == cloud.points.shape:
            found.normals = vectors(np.array(values, np.float64))
        elif name in ("rgb", "rgba") and values.shape == (len(cloud), len(name)) and not len(found.colors):
            shares = _shares(values)
            found.colors = vectors(np.ascontiguousarray(shares[:, :3]))
            lost += ["the alpha of rgba"] if np.any(shares[:, 3:] != 1.0) else []
        else:
            lost.append(name)
    _say(lost, "Open3D")
    return found


@needs(_bytes)
def to_trimesh(points: PointCloud) -> trimesh.PointCloud:
    """A ``trimesh.PointCloud`` of points, with the array ``rgb`` or ``rgba`` as colors of 8 bits where there is one.

    It has no place for other arrays; a UserWarning names them.

    Args:
        points: A PointCloud, positions (N, 3), or a cloud of another library.
    Returns:
        trimesh.PointCloud with copies of the arrays, float64.
    Raises:
        InputError: points holds no points (N, 3).
    """
    cloud = _cloud(points)
    import trimesh

    held = next((name for name in ("rgb", "rgba") if name in cloud.data), None)
    _say([name for name in cloud.data if name != held], "trimesh")
    colors = None if held is None else np.rint(255.0 * np.clip(_shares(cloud.data[held]), 0.0, 1.0)).astype(np.uint8)
    return trimesh.PointCloud(np.array(cloud.points), colors=colors)


def _shares(colors: Any) -> Any:
    """Colors as shares of full brightness."""
    white = _WHITE.get(colors.dtype.str[1:], 1.0)
    # Many .las files hold bytes in numbers of 16 bits.
    white = 255.0 if white > 255.0 and colors.max(initial=0) < 256 else white
    return np.nan_to_num(np.asarray(colors, np.float64)) / white


def _cloud(points: Any) -> PointCloud:
    return points if isinstance(points, PointCloud) else PointCloud(points)


def _say(lost: list[str], library: str) -> None:
    if lost:
        held = ", ".join(map(repr, lost))
        warn(f"{library} has no place for {held} of points; left out")
