"""Where the camera of a scene stands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# From the front to the camera, to the right and upwards [degrees].
AZIMUTH, ELEVATION = 28.8, 17.0
VIEW_ANGLE = 28.0
# Share of the picture's height or width that the scene's bounding box may fill; a plate reaches to its corners.
FILL = 0.97
# Smaller zooms draw the same point, and their angle would overflow.
LEAST_ZOOM = 1e-9
UP = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}


class View(NamedTuple):
    """What was asked for: the axis that points up, angles in radians, the distance or None, and the zoom."""

    up: str
    azimuth: float
    elevation: float
    distance: float | None
    zoom: float


class Camera(NamedTuple):
    """A camera that looks at a point.

    Attributes:
        center: What it looks at (3,).
        distance: From there to the camera.
        frame: Unit vectors to the right of, above and towards the camera (3, 3).
        tangent: Of half the angle of the picture's height.
    """

    center: NDArray[np.float64]
    distance: float
    frame: NDArray[np.float64]
    tangent: float

    @property
    def position(self) -> NDArray[np.float64]:
        return self.center + self.frame[2] * self.distance


def view_of(up: str, azimuth: Any, elevation: Any, distance: Any, zoom: Any) -> View:
    """Check what was asked for; None is the default.

    Raises:
        InputError: A number is not finite or out of its range.
    """
    angles = {"azimuth": (azimuth, AZIMUTH), "elevation": (elevation, ELEVATION)}
    turned, raised = (
        require_finite_scalar(default if at is None else at, name) for name, (at, default) in angles.items()
    )
    if not -90.0 <= raised <= 90.0:
        raise InputError(f"elevation: {raised:g} is not from -90 (from below) to 90 (from above); give degrees")
    away = None if distance is None else require_finite_scalar(distance, "distance", low=0.0)
    return View(up, np.radians(turned), np.radians(raised), away, require_finite_scalar(zoom, "zoom", low=0.0))


def camera_of(view: View, bounds: Any, size: tuple[int, int], share: float = 1.0) -> Camera:
    """Look at the middle of a box, and fit all of it unless the distance is given.

    Args:
        view: What was asked for.
        bounds: Least and greatest coordinate on each axis (3, 2).
        size: Width and height of the picture.
        share: Share of the width for the scene.
    """
    axis = np.array(UP[view.up])
    # The right-hand direction in world axes, so that right, up and towards the viewer are a right-handed frame.
    right = np.array((0.0, 0.0, 1.0) if view.up[-1] == "x" else (1.0, 0.0, 0.0))
    front = np.cross(right, axis)
    ahead = np.sin(view.azimuth) * right + np.cos(view.azimuth) * front
    towards = np.cos(view.elevation) * ahead + np.sin(view.elevation) * axis
    # Perpendicular to the view, so that looking straight down has a direction that is up.
    upwards = np.cos(view.elevation) * axis - np.sin(view.elevation) * ahead
    frame = np.stack([np.cross(upwards, towards), upwards, towards])

    center = np.mean(bounds, axis=1)
    corners = np.array(np.meshgrid(*bounds, indexing="ij")).reshape(3, -1).T - center
    x, y, depth = frame @ corners.T
    width, height = size
    half = np.tan(np.radians(VIEW_ANGLE) / 2.0)
    tangent = half * FILL
    reach = np.maximum(np.abs(x) / (tangent * share * width / height), np.abs(y) / tangent)
    distance = view.distance or float(np.max(depth + reach)) or 1.0
    return Camera(center, distance, frame, half / max(view.zoom, LEAST_ZOOM))


# A shape stands on a plane if what touches it spans this share of its footprint, and so many times that of the usual
# plane. Of 23 models of known up axis none was turned wrongly.
STANDS, CLEARLY = 0.2, 4.0
# Pictures and plates, whose height is less than this share of their length, are hung up as often as laid down.
FLAT = 0.1
# What is this near to the lowest plane touches it, as a share of the height.
TOUCHES = 0.005
# Enough for a shape, in every so many points.
MOST_POINTS = 200_000


@np.errstate(all="ignore")  # bodies of 1e200 have no axis that can be told
def up_of(mesh: TriangleMesh, usual: str = "y") -> str:
    """The axis that points up: the mesh's own, else the usual one, unless it stands on its base along the other only.

    Args:
        mesh: The mesh.
        usual: The axis that is up in most files of that kind.
    """
    other = {"y": "z", "z": "y"}.get(usual)
    points = mesh.vertices
    if mesh.up_axis or other is None or not len(points):
        return mesh.up_axis or usual
    sides = np.ptp(points, axis=0)
    if sides["xyz".index(other)] < FLAT * sides.max():
        return usual
    points = points[:: -(-len(points) // MOST_POINTS)]
    found = _support(points, other)
    return other if found > STANDS and found > CLEARLY * _support(points, usual) else usual


@np.errstate(all="ignore")  # bodies of 1e200 have no axis that can be told
def up_of_points(points: NDArray[np.float64], usual: str = "y") -> str:
    """The axis that points up: that of a camera's frame, "-y", if it would see all points, else the usual one.

    Depth cameras stand in the origin and write x to the right, y down, and z ahead.
    """
    if not len(points) or points[:, 2].min() <= 0.0:
        return usual
    flat = points[:, :2]
    is_around = bool(np.all(flat.min(axis=0) < 0.0) and np.all(flat.max(axis=0) > 0.0))
    return "-y" if is_around and bool(np.all(np.abs(flat) < points[:, 2:])) else usual


def _support(points: NDArray[np.float64], up: str) -> float:
    """Area of the hull of the lowest points over that of the box around all, seen from above."""
    axis = "xyz".index(up)
    flat = np.delete(points, axis, axis=1)
    low = points[:, axis] <= points[:, axis].min() + TOUCHES * np.ptp(points[:, axis])
    turns = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    touching = flat[low] - flat.min(axis=0)
    corners = touching[np.argmax(touching @ np.stack([np.cos(turns), np.sin(turns)]), axis=0)]
    following = np.roll(corners, -1, axis=0)
    area = 0.5 * np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0])
    box = float(np.prod(np.ptp(flat, axis=0)))
    return float(area) / box if box > 0.0 else 0.0
