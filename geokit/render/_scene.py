"""Figures of meshes, volumes and points in space."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import atomic_path
from geokit.errors import InputError, MissingDependencyError
from geokit.render._backend import pyvista
from geokit.render._checks import SEQUENTIAL, checked_size, checked_target, checked_values, value_range
from geokit.render._grid import dense_field

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh
    from geokit.volume._model import SparseVolume

__all__ = ["figure"]

SURFACE_COLOR = "#b9c4cf"
POINT_COLOR = "#c0392b"
# Edges sharper than this [degrees] stay sharp under smooth shading.
FEATURE_ANGLE = 35.0
# Samples along the longest side: enough for 800 pixels, at most 10 MB.
SURFACE_RESOLUTION = 160
FOG_RESOLUTION = 128
# Share of the longest side over which the densest fog hides what is behind it.
FOG_DEPTH = 0.05
# Direction from the scene to the camera, in units of right, up and towards the viewer.
VIEW = (0.55, 0.35, 1.0)
VIEW_ANGLE = 28.0
# Share of the picture's height or width that the scene's bounding box may fill; a plate reaches to its corners.
FILL = 0.97
# Share of the width for the color bar.
BAR_SHARE = 0.14
UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class _Look(NamedTuple):
    """Settings of the color map and its bar."""

    colormap: str
    limits: tuple[float, float] | None
    label: str
    height: int

    def colored(self, values: NDArray[np.float64]) -> dict[str, Any]:
        """Keyword arguments of pyvista's add_mesh for coloring by ``values``."""
        return {
            "scalars": values,
            "cmap": self.colormap,
            "clim": value_range(values, self.limits),
            "nan_color": "lightgrey",
            "scalar_bar_args": self.bar(),
        }

    def bar(self) -> dict[str, Any]:
        text = max(12, self.height // 34)
        return {
            "title": self.label or "value",
            "vertical": True,
            "position_x": 0.86,
            "position_y": 0.2,
            "width": 0.06,
            "height": 0.6,
            "title_font_size": text,
            "label_font_size": text,
            "color": "black",
            "fmt": "%.3g",
            "n_labels": 5,
        }


def figure(
    path: str | os.PathLike[str],
    *,
    mesh: "TriangleMesh | None" = None,
    volume: "SparseVolume | None" = None,
    points: Any = None,
    color: Any = None,
    point_color: Any = None,
    size: tuple[int, int] = (800, 600),
    isovalue: float | None = None,
    label: str = "",
    colormap: str = SEQUENTIAL,
    value_limits: tuple[float, float] | None = None,
    opacity: float = 1.0,
    point_size: float | None = None,
    up: str = "y",
    transparent: bool = False,
) -> Path:
    """Draw a mesh, a volume, points, or several of them into a PNG file, without a display.

    A level set is drawn as its surface at ``isovalue``. Any other grid is drawn as fog (vectors by their length), or as
    its surface at ``isovalue`` if one is given.

    Args:
        path: Target, a .png file.
        mesh: Triangles to draw.
        volume: A grid to draw.
        points: Points to draw [world], shape (N, 3).
        color: A color name ("steelblue", "#336699"), or one value for each vertex or face of the mesh, or for each
            point if only points are drawn.
        point_color: A color name or one value for each point, if points are drawn together with a mesh or a volume.
        size: Width and height in pixels.
        isovalue: Value of the volume's surface; None means 0 for level sets, and fog for other grids.
        label: Title of the color bar.
        colormap: A matplotlib color map.
        value_limits: Values at the ends of the color map; None uses the range of the values.
        opacity: Opacity of the mesh or the volume's surface, in (0, 1].
        point_size: Diameter of a point in pixels; None chooses it by the number of points.
        up: The world axis that points up in the picture: "x", "y" or "z".
        transparent: Leave the background transparent instead of white.
    Returns:
        The path that was written.
    Raises:
        InputError: Nothing to draw, values that match no vertices, faces or points, a wrong size, axis, color or file
            name.
        FileAccessError: The target cannot be written.
        MissingDependencyError: No OpenGL library works here; the message names the packages.
    """
    target = checked_target(path)
    width, height = checked_size(size)
    if up not in UP:
        raise InputError(f"up: {up!r} is not one of x, y, z")
    if mesh is None and volume is None and points is None:
        raise InputError("nothing to draw: give mesh=, volume= or points=")
    if not 0.0 < opacity <= 1.0:
        raise InputError(f"opacity: {opacity!r} is outside (0, 1]")
    pv = pyvista()
    plotter = pv.Plotter(off_screen=True, window_size=(width, height), lighting="light kit")
    look = _Look(colormap, value_limits, label, height)
    try:
        plotter.set_background("white")
        if mesh is not None:
            _add_mesh(pv, plotter, mesh, color, opacity, look)
        if volume is not None:
            _add_volume(pv, plotter, volume, color if mesh is None else None, isovalue, opacity, look)
        if points is not None:
            alone = mesh is None and volume is None
            chosen = color if alone and point_color is None else point_color
            _add_points(pv, plotter, points, chosen, point_size, look)
        for bar in plotter.scalar_bars.values():
            bar.SetVerticalTitleSeparation(height // 50)
        _aim(plotter, up)
        plotter.enable_anti_aliasing("ssaa")
        with atomic_path(target) as part:
            plotter.screenshot(str(part), transparent_background=transparent)
    finally:
        plotter.close()
    return target


def _add_mesh(pv: Any, plotter: Any, mesh: "TriangleMesh", color: Any, opacity: float, look: _Look) -> None:
    if len(mesh.faces) == 0:
        raise InputError("mesh: has no faces: there is nothing to draw")
    surface = pv.PolyData.from_regular_faces(np.array(mesh.vertices), np.array(mesh.faces))
    if color is None or isinstance(color, str):
        plotter.add_mesh(_shaded(surface), color=_named_color(pv, color, SURFACE_COLOR), opacity=opacity, **_MATERIAL)
        return
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    what, values = checked_values(color, "color", counts)
    data = surface.point_data if what == "vertices" else surface.cell_data
    data["value"] = values
    # Splitting at sharp edges copies vertices together with their values.
    shaded = _shaded(surface)
    arguments = look.colored(values)
    arguments["scalars"] = "value"
    plotter.add_mesh(shaded, opacity=opacity, **arguments, **_MATERIAL)


_MATERIAL = {"smooth_shading": True, "specular": 0.15, "specular_power": 20.0, "ambient": 0.08}


def _shaded(surface: Any) -> Any:
    """The surface with vertex normals, split at sharp edges."""
    return surface.compute_normals(
        cell_normals=False,
        split_vertices=True,
        feature_angle=FEATURE_ANGLE,
        consistent_normals=False,
        auto_orient_normals=False,
    )


def _add_volume(
    pv: Any, plotter: Any, volume: "SparseVolume", color: Any, isovalue: float | None, opacity: float, look: _Look
) -> None:
    if color is not None and not isinstance(color, str):
        raise InputError("color: a volume is drawn in one colour; give a colour name")
    if isovalue is None and volume.info.grid_class != "level set":
        _add_fog(pv, plotter, volume, look)
        return
    surface = _isosurface(pv, volume, 0.0 if isovalue is None else float(isovalue))
    if surface.n_cells == 0:
        raise InputError(f"isovalue: grid {volume.info.name!r} has no surface at {isovalue or 0.0:g}; choose another")
    plotter.add_mesh(_shaded(surface), color=_named_color(pv, color, SURFACE_COLOR), opacity=opacity, **_MATERIAL)


def _isosurface(pv: Any, volume: "SparseVolume", isovalue: float) -> Any:
    from geokit.mesh._from_volume import from_volume

    try:
        mesh = from_volume(volume, isovalue=isovalue)
    except MissingDependencyError:
        # Without OpenVDB, use VTK's contour of a dense copy that is fine enough for the picture.
        field = dense_field(volume, resolution=SURFACE_RESOLUTION, margin=1)
        return _image_data(pv, field).contour([isovalue], scalars="value")
    return pv.PolyData.from_regular_faces(np.array(mesh.vertices), np.array(mesh.faces))


def _add_fog(pv: Any, plotter: Any, volume: "SparseVolume", look: _Look) -> None:
    field = dense_field(volume, resolution=FOG_RESOLUTION, margin=1)
    low, high = value_range(field.values, look.limits or _fog_limits(field.values))
    named = look._replace(label=look.label or volume.info.name)
    depth = float(np.max(np.multiply(field.spacing, field.values.shape)))
    actor = plotter.add_volume(
        _image_data(pv, field),
        scalars="value",
        cmap=look.colormap,
        clim=(low, high),
        # Transparent at the lowest value: any opacity there would show the grid's bounding box.
        opacity=[0.0, 1.0],
        opacity_unit_distance=FOG_DEPTH * depth,
        shade=False,
        # The GPU mapper draws nothing when the picture is super-sampled.
        mapper="fixed_point",
        scalar_bar_args=named.bar(),
    )
    # By default the mapper samples a ray once per world unit, whatever the size of the volume.
    actor.mapper.SetAutoAdjustSampleDistances(False)
    actor.mapper.SetSampleDistance(0.5 * float(np.min(field.spacing)))


def _fog_limits(values: np.ndarray) -> tuple[float, float] | None:
    """Color limits from 0 to the 99th percentile of the positive values; None if there is no fog."""
    fog = values[values > 0.0]
    return (0.0, float(np.quantile(fog, 0.99))) if fog.size and values.min() >= 0.0 else None


def _image_data(pv: Any, field: Any) -> Any:
    grid = pv.ImageData(dimensions=field.values.shape, spacing=field.spacing, origin=field.origin)
    # In VTK the first axis varies fastest.
    grid.point_data["value"] = field.values.ravel(order="F")
    return grid


def _add_points(pv: Any, plotter: Any, points: Any, color: Any, point_size: float | None, look: _Look) -> None:
    table = np.asarray(points, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != 3:
        raise InputError(f"points: shape {table.shape} is not (N, 3)")
    if len(table) == 0:
        raise InputError("points: empty: there is nothing to draw")
    cloud = pv.PolyData(np.ascontiguousarray(table))
    # Many points are drawn small, few large. Super-sampling halves the size that VTK is given.
    size = 2.0 * (point_size or float(np.clip(0.45 * look.height / np.sqrt(len(table)), 1.0, look.height / 80)))
    shape = {"point_size": size, "render_points_as_spheres": True, "ambient": 0.25}
    if color is None or isinstance(color, str):
        plotter.add_mesh(cloud, style="points", color=_named_color(pv, color, POINT_COLOR), **shape)
        return
    _, values = checked_values(color, "color", {"points": len(table)})
    plotter.add_mesh(cloud, style="points", **look.colored(values), **shape)


def _named_color(pv: Any, color: str | None, default: str) -> Any:
    try:
        return pv.Color(color or default)
    except ValueError as error:
        raise InputError(f"color: {color!r} is not a colour; use a name such as 'steelblue' or '#336699'") from error


def _aim(plotter: Any, up: str) -> None:
    """Look at the whole scene from the front, a little from the right and from above."""
    axis = np.array(UP[up])
    # The right-hand direction in world axes, so that right, up and towards the viewer are a right-handed frame.
    right = np.array((0.0, 0.0, 1.0) if up == "x" else (1.0, 0.0, 0.0))
    view = VIEW[0] * right + VIEW[1] * axis + VIEW[2] * np.cross(right, axis)
    view /= np.linalg.norm(view)
    side = np.cross(axis, view)
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(view, side), view])

    bounds = np.array(plotter.bounds).reshape(3, 2)
    centre = bounds.mean(axis=1)
    corners = np.array(np.meshgrid(*bounds, indexing="ij")).reshape(3, -1).T - centre
    x, y, depth = frame @ corners.T
    # A color bar takes its share of the width, and the scene shifts by half of that.
    share = 1.0 - BAR_SHARE if plotter.scalar_bars else 1.0
    width, height = plotter.window_size
    tangent = np.tan(np.radians(VIEW_ANGLE) / 2.0) * FILL
    reach = np.maximum(np.abs(x) / (tangent * share * width / height), np.abs(y) / tangent)
    distance = float(np.max(depth + reach)) or 1.0

    camera = plotter.camera
    camera.focal_point = centre
    camera.position = centre + view * distance
    camera.up = axis
    camera.view_angle = VIEW_ANGLE
    camera.SetWindowCenter(1.0 - share, 0.0)
    plotter.reset_camera_clipping_range()
