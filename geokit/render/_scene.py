"""Figures of meshes, volumes and points in space."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.interrupts import signals_held
from geokit.core.files import atomic_path
from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop.types import MeshLike, Rows
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_choice, require_flag, require_instance, require_one_world
from geokit.errors import InputError, MissingDependencyError
from geokit.points._io import PointCloud
from geokit.render._backend import pyvista
from geokit.render._camera import UP, View, camera_of, up_of, up_of_points, view_of
from geokit.render._grid import dense_field
from geokit.render._shadow import add_shadow
from geokit.render.looks.checks import (
    SEQUENTIAL,
    checked_colormap,
    checked_label,
    checked_size,
    checked_target,
    checked_values,
    figure_bytes,
    require_drawable,
    value_range,
)
from geokit.render.looks.painted import SURFACE_COLOR, bytes_of, is_painted, own_colors, painted, shaded, surface_of

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.volume.model.sparse_volume import SparseVolume

# Layers that can be seen through each other; those behind are left out.
MOST_LAYERS = 12

POINT_COLOR = "#c0392b"
# Samples along the longest side: enough for 800 pixels, at most 10 MB.
SURFACE_RESOLUTION = 160
FOG_RESOLUTION = 128
# Share of the longest side over which the densest fog hides what is behind it.
FOG_DEPTH = 0.05
# Share of the width for the color bar.
BAR_SHARE = 0.14
# Of the color bar, as shares of the picture.
BAR_LEFT, BAR_BOTTOM = 0.86, 0.2
# Between labels of a color bar.
MOST_SPACES = 5
EDGE_COLOR = "#2c3e50"
LOOKS = ("values", "smoke")


class _Look(NamedTuple):
    """Settings of the color map and its bar."""

    colormap: str
    limits: tuple[float, float] | None
    label: str
    height: int
    # By the title of a bar: lowest and highest value that it colors.
    ranges: dict[str, tuple[float, float]]

    def note(self, values: NDArray[Any]) -> None:
        """Remember the range of values that a bar colors: bars say where they end within it."""
        finite = values[np.isfinite(values)]
        if finite.size:
            low, high = self.ranges.get(self.title, (np.inf, -np.inf))
            self.ranges[self.title] = (min(low, float(finite.min())), max(high, float(finite.max())))

    @property
    def title(self) -> str:
        return self.label or "value"

    def colored(self, values: NDArray[np.float64]) -> dict[str, Any]:
        """Keyword arguments of pyvista's add_mesh for coloring by ``values``."""
        self.note(values)
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
            "title": self.title,
            "vertical": True,
            "position_x": BAR_LEFT,
            "position_y": BAR_BOTTOM,
            "width": 0.06,
            "height": 0.6,
            "title_font_size": text,
            "label_font_size": text,
            "color": "black",
            "fmt": "%.3g",
            "n_labels": 5,
        }


@of_constants
@needs(figure_bytes, fatal=True)
def figure(
    path: str | os.PathLike[str] | None = None,
    *,
    mesh: MeshLike | None = None,
    volume: "SparseVolume | None" = None,
    points: Rows | None = None,
    color: Any = None,
    point_color: Any = None,
    size: tuple[int, int] = (800, 600),
    isovalue: float | None = None,
    label: str = "",
    colormap: str = SEQUENTIAL,
    value_limits: tuple[float, float] | None = None,
    opacity: float = 1.0,
    point_size: float | None = None,
    up: str | None = None,
    transparent: bool = False,
    azimuth: float | None = None,
    elevation: float | None = None,
    distance: float | None = None,
    zoom: float = 1.0,
    edges: bool = False,
    shadow: bool = False,
    look: str = "values",
) -> Path:
    """Draw a mesh, a volume, points, or several of them into a PNG file, without a display.

    A mesh is drawn with its textures, colors, materials' colors and normals where it has them, unless ``color`` is
    given; what has alpha is seen through. A level set is drawn as its surface at ``isovalue``. Any other grid is drawn
    as fog (vectors by their length), or as its surface at ``isovalue`` if one is given.

    Args:
        path: Target, a .png file; required. ``mesh.show()`` and :func:`geokit.render.view` show without a file.
        mesh: Triangles to draw.
        volume: A grid to draw.
        points: Points to draw [world], shape (N, 3), or a cloud, which is drawn in its own colors.
        color: A color name ("steelblue", "#336699"), or one value for each vertex or face of the mesh, or for each
            point if only points are drawn; None for the own colors of the mesh or the cloud.
        point_color: A color name or one value for each point, if points are drawn together with a mesh or a volume.
        size: Width and height in pixels.
        isovalue: Value of the volume's surface; None means 0 for level sets, and fog for other grids.
        label: Title of the color bar.
        colormap: A matplotlib color map.
        value_limits: Values at the ends of the color map; None uses the range of the values.
        opacity: Opacity of the mesh or the volume's surface, in (0, 1].
        point_size: Diameter of a point in pixels; None chooses it by the number of points.
        up: The world axis that points up in the picture: "x", "y", "z", or "-x", "-y", "-z" for its other end. None is
            the ``up_axis`` of the mesh, else of the volume, else z for a mesh that stands on a base along z and not
            along y, "-y" for points in the frame of a depth camera, and y for all else.
        transparent: Leave the background transparent instead of white.
        azimuth: Angle around the up axis from the front to the camera, to the right [degrees]; None is 28.8.
        elevation: Angle of the camera above the horizon [degrees], from -90 to 90; None is 17.
        distance: From the middle of the scene to the camera [world]; None fits the whole scene.
        zoom: Size in the picture; 2 draws twice as large.
        edges: Draw the edges of the triangles, of a volume's surface too.
        shadow: Draw the soft shadow that surfaces and points throw on the ground below them under an even sky. Its
            darkness is the share of the sky that the darkest horizontal slice of the scene hides, times 0.8.
        look: How fog is drawn: "values" by the color map; "smoke" in white (or ``color``), lit from above left, with
            its own shadow, in front of the dark. Smoke is drawn alone, and without OpenGL.
    Returns:
        The path that was written.
    Raises:
        InputError: Nothing to draw, values that match no vertices, faces or points, a wrong size, axis, color, look or
            file name, smoke beside a mesh, points or a volume's surface, a shadow of fog, or units or up axes
            that are known and differ.
        FileAccessError: The target cannot be written.
        MissingDependencyError: No OpenGL library works here; the message names the packages.
    """
    from geokit.mesh.surfaces.objects import require_mesh
    from geokit.volume.model.sparse_volume import SparseVolume

    target = checked_target(path)
    width, height = checked_size(size)
    if up is not None:
        require_choice(up, "up", UP)
    checked_label(label, "label")
    checked_colormap(colormap)
    require_flag(transparent, "transparent")
    require_flag(edges, "edges")
    require_flag(shadow, "shadow")
    require_choice(look, "look", LOOKS)
    view = view_of(up or "y", azimuth, elevation, distance, zoom)
    value_range(np.empty(0), value_limits)
    opacity = require_finite_scalar(opacity, "opacity", low=0.0)
    if isovalue is not None:
        isovalue = require_finite_scalar(isovalue, "isovalue")
    if point_size is not None:
        point_size = require_finite_scalar(point_size, "point_size", low=0.0)
    if mesh is None and volume is None and points is None:
        raise InputError("nothing to draw: give mesh=, volume= or points=")
    if point_color is not None and points is None:
        raise InputError("point_color: there are no points to color; give points=, or leave it out")
    if opacity > 1.0:
        raise InputError(f"opacity: {opacity} is outside (0, 1]; give a share")
    if mesh is not None:
        mesh = require_mesh(mesh, "mesh")
    if volume is not None:
        require_instance(volume, "volume", SparseVolume, "load or make one first")
    if mesh is not None and volume is not None:
        require_one_world(mesh=mesh, volume=volume.info)
    if points is not None:
        points = _cloud(points)
    if up is None and mesh is not None:
        view = view._replace(up=up_of(mesh))
    elif up is None and volume is not None:
        view = view._replace(up=volume.info.up_axis or view.up)
    elif up is None and points is not None:
        view = view._replace(up=up_of_points(points.points))
    if shadow and volume is not None and not _is_surface(volume, isovalue):
        raise InputError("shadow: fog throws none here; give an isovalue, or look='smoke', which shades itself")
    if look == "smoke":
        if volume is None or mesh is not None or points is not None or _is_surface(volume, isovalue):
            raise InputError("look: smoke is drawn alone; give a volume= that is no level set, and no isovalue")
        return _write_smoke(target, volume, color, view, (width, height), value_limits, transparent)
    pv = pyvista()
    with signals_held():  # it imports modules of VTK, which crash where an interrupt comes within
        plotter = pv.Plotter(off_screen=True, window_size=(width, height), lighting="light kit")
    shown = _Look(colormap, value_limits, label, height, {})
    material: dict[str, Any] = {"opacity": opacity, **_MATERIAL}
    if edges:
        # Super-sampling halves the width that VTK is given.
        material |= {"show_edges": True, "edge_color": EDGE_COLOR, "line_width": 2.0 * max(1.0, height / 900)}
    try:
        plotter.set_background("white")
        if mesh is not None:
            _add_mesh(pv, plotter, mesh, color, material, shown)
        if volume is not None:
            _add_volume(pv, plotter, volume, color if mesh is None else None, isovalue, material, shown)
        if points is not None:
            alone = mesh is None and volume is None
            chosen = color if alone and point_color is None else point_color
            _add_points(pv, plotter, points, chosen, point_size, shown)
        for title, bar in plotter.scalar_bars.items():
            bar.SetVerticalTitleSeparation(height // 50)
            _label_round_values(pv, bar)
            _say_ends(plotter, bar, title, shown.ranges.get(title))
        _aim(plotter, view, add_shadow(pv, plotter, view.up) if shadow else np.array(plotter.bounds).reshape(3, 2))
        smooth_edges(plotter)
        with atomic_path(target) as part:
            plotter.screenshot(str(part), transparent_background=transparent)
    finally:
        plotter.close()
    return target


def _label_round_values(pv: Any, bar: Any) -> None:
    """Label a color bar at round values, in place of fifths of its range."""
    values = round_values(*bar.GetLookupTable().GetRange())
    if len(values) > 1:
        bar.SetUseCustomLabels(True)
        bar.SetCustomLabels(pv.convert_array(values))


def _say_ends(plotter: Any, bar: Any, title: str, values: tuple[float, float] | None) -> None:
    """Write beyond the ends of a color bar which values have their colors, where some lie beyond."""
    low, high = bar.GetLookupTable().GetRange()
    least, most = values or (low, high)
    slack = 1e-6 * (high - low)
    if most > high + slack:
        bar.SetTitle(f"{title}\n\u2265 {high:.3g}")
    if least < low - slack:
        size = bar.GetLabelTextProperty().GetFontSize()
        below = plotter.add_text(
            f"\u2264 {low:.3g}",
            position=(BAR_LEFT, BAR_BOTTOM - 1.6 * size / plotter.window_size[1]),
            viewport=True,
            color="black",
        )
        below.prop.font_size = size


def round_values(low: float, high: float) -> NDArray[np.float64]:
    """Up to six multiples of 1, 2 or 5 times a power of ten between two limits."""
    from matplotlib.ticker import MaxNLocator

    values = np.asarray(MaxNLocator(MOST_SPACES, steps=[1, 2, 5, 10]).tick_values(low, high))
    slack = 1e-6 * (values[1] - values[0])
    values[np.abs(values) < slack] = 0.0
    return values[(values >= low - slack) & (values <= high + slack)]


def _add_mesh(pv: Any, plotter: Any, mesh: "TriangleMesh", color: Any, material: dict[str, Any], look: _Look) -> None:
    if len(mesh.faces) == 0:
        raise InputError("mesh: has no faces: there is nothing to draw")
    require_drawable(mesh.bounds, "mesh.bounds")
    if color is None and is_painted(mesh):
        for part in painted(pv, mesh, pv.Color(SURFACE_COLOR).float_rgb):
            plotter.add_mesh(part.surface, scalars="rgb", rgb=True, texture=part.texture, **material)
        return
    surface = surface_of(pv, mesh.vertices, mesh.faces)
    if color is None or isinstance(color, str):
        plotter.add_mesh(shaded(surface), color=_named_color(pv, color, SURFACE_COLOR), **material)
        return
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    what, values = checked_values(color, counts)
    data = surface.point_data if what == "vertices" else surface.cell_data
    data["value"] = values
    # Splitting at sharp edges copies vertices together with their values.
    arguments = look.colored(values)
    arguments["scalars"] = "value"
    plotter.add_mesh(shaded(surface), **arguments, **material)


_MATERIAL = {"smooth_shading": True, "specular": 0.15, "specular_power": 20.0, "ambient": 0.08}


def _add_volume(
    pv: Any, plotter: Any, volume: "SparseVolume", color: Any, isovalue: float | None, material: Any, look: _Look
) -> None:
    _require_one_color(color)
    if not _is_surface(volume, isovalue):
        _add_fog(pv, plotter, volume, look)
        return
    surface = _isosurface(pv, volume, 0.0 if isovalue is None else isovalue)
    if surface.n_cells == 0:
        raise InputError(f"isovalue: grid {volume.info.name!r} has no surface at {isovalue or 0.0:g}; choose another")
    plotter.add_mesh(shaded(surface), color=_named_color(pv, color, SURFACE_COLOR), **material)


def _is_surface(volume: "SparseVolume", isovalue: float | None) -> bool:
    return isovalue is not None or volume.info.grid_class == "level set"


def _require_one_color(color: Any) -> None:
    if color is not None and not isinstance(color, str):
        raise InputError("color: a volume is drawn in one color; give a color name")


def _write_smoke(
    target: Path,
    volume: "SparseVolume",
    color: Any,
    view: View,
    size: tuple[int, int],
    limits: tuple[float, float] | None,
    transparent: bool,
) -> Path:
    from geokit.render._smoke import draw_smoke

    _require_one_color(color)
    bounds = volume.info.world_bounds
    if bounds is None:
        raise InputError(f"grid {volume.info.name!r} has no active voxels: there is nothing to draw")
    limits = None if limits is None else value_range(np.empty(0), limits)
    camera = camera_of(view, bounds.T, size)
    pixels = draw_smoke(volume, camera, size, limits=limits, color=color, transparent=transparent)
    from matplotlib.image import imsave

    anonymous: Any = {"Software": None}  # the same bytes with every matplotlib

    with atomic_path(target) as part:
        imsave(part, pixels if transparent else pixels[..., :3], format="png", metadata=anonymous)
    return target


def _isosurface(pv: Any, volume: "SparseVolume", isovalue: float) -> Any:
    from geokit.mesh.volumes.from_volume import from_volume

    try:
        mesh = from_volume(volume, isovalue=isovalue)
    except MissingDependencyError:
        # Without OpenVDB, use VTK's contour of a dense copy that is fine enough for the picture.
        field = dense_field(volume, resolution=SURFACE_RESOLUTION, margin=1)
        return _image_data(pv, field).contour([isovalue], scalars="value")
    return surface_of(pv, mesh.vertices, mesh.faces)


def _add_fog(pv: Any, plotter: Any, volume: "SparseVolume", look: _Look) -> None:
    field = dense_field(volume, resolution=FOG_RESOLUTION, margin=1)
    low, high = value_range(field.values, look.limits or _fog_limits(field.values))
    named = look._replace(label=look.label or volume.info.name.encode("utf-8", "replace").decode())
    named.note(field.values)
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


def _add_points(pv: Any, plotter: Any, points: PointCloud, color: Any, point_size: float | None, look: _Look) -> None:
    table = points.points
    # Many points are drawn small, few large. Super-sampling halves the size that VTK is given.
    size = 2.0 * (point_size or float(np.clip(0.45 * look.height / np.sqrt(len(table)), 1.0, look.height / 80)))
    shape = {"point_size": size, "render_points_as_spheres": True, "ambient": 0.25}
    cloud = pv.PolyData(np.ascontiguousarray(table))
    own = own_colors(points, len(table)) if color is None else None
    if own is not None:
        cloud.point_data["rgb"] = bytes_of(own)
        # Their light is in the colors already.
        plotter.add_mesh(cloud, style="points", scalars="rgb", rgb=True, lighting=False, **shape)
        return
    if color is None or isinstance(color, str):
        plotter.add_mesh(cloud, style="points", color=_named_color(pv, color, POINT_COLOR), **shape)
        return
    _, values = checked_values(color, {"points": len(table)})
    plotter.add_mesh(cloud, style="points", **look.colored(values), **shape)


def _cloud(points: Any) -> PointCloud:
    cloud = points if isinstance(points, PointCloud) else PointCloud(points)
    if len(cloud) == 0:
        raise InputError("points: empty: there is nothing to draw")
    require_drawable(cloud.points, "points")
    return cloud


def _named_color(pv: Any, color: str | None, default: str) -> Any:
    try:
        return pv.Color(color or default)
    except ValueError as error:
        raise InputError(f"color: {color!r} is not a color; use a name such as 'steelblue' or '#336699'") from error


def _aim(plotter: Any, view: View, bounds: NDArray[np.float64]) -> None:
    # A color bar takes its share of the width, and the scene shifts by half of that.
    share = 1.0 - BAR_SHARE if plotter.scalar_bars else 1.0
    placed = camera_of(view, bounds, plotter.window_size, share)
    camera = plotter.camera
    camera.focal_point = placed.center
    camera.position = placed.position
    camera.up = placed.frame[1]
    camera.view_angle = np.degrees(2.0 * np.arctan(placed.tangent))
    camera.SetWindowCenter(1.0 - share, 0.0)
    plotter.reset_camera_clipping_range()


def smooth_edges(plotter: Any) -> None:
    """Draw with super-sampling, and translucent surfaces by depth peeling, which does not depend on their order.

    VTK's own switch for depth peeling has no effect together with super-sampling.
    """
    translucent = any(actor.HasTranslucentPolygonalGeometry() for actor in plotter.renderer.actors.values())
    if not translucent:
        plotter.enable_anti_aliasing("ssaa")
        return
    from vtkmodules import vtkRenderingOpenGL2 as vtk

    plotter.render_window.SetAlphaBitPlanes(1)
    plotter.render_window.SetMultiSamples(0)
    peeling, steps, smooth = vtk.vtkDepthPeelingPass(), vtk.vtkRenderStepsPass(), vtk.vtkSSAAPass()
    peeling.SetTranslucentPass(vtk.vtkTranslucentPass())
    peeling.SetMaximumNumberOfPeels(MOST_LAYERS)
    peeling.SetOcclusionRatio(0.0)
    steps.SetTranslucentPass(peeling)
    smooth.SetDelegatePass(steps)
    plotter.renderer.SetPass(smooth)
