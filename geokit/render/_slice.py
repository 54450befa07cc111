"""Figures of a plane through a volume, colored by value, with contour lines."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop.types import Device
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import described, read_array, require_choice
from geokit.errors import InputError
from geokit.render._image import new_axes, save_figure
from geokit.render.looks.checks import (
    DIVERGING,
    FLAT,
    SEQUENTIAL,
    chart_bytes,
    checked_label,
    checked_size,
    checked_target,
    value_range,
)
from geokit.volume.tree.leaves import require_volume

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

AXES = "xyz"
# Default number of contour lines; more of them hide the colors.
CONTOUR_COUNT = 9
# A level this close to zero, relative to the range, is the zero contour up to rounding.
ZERO_LEVEL = 1e-9

# An interpolated background value differs from the background by rounding.
BAND_EDGE = 1.0 - 1e-6
# Gray values of the inside and the outside, beyond the narrow band of a level set.
INSIDE, OUTSIDE = 0.82, 1.0


@of_constants
@needs(chart_bytes, fatal=True)
def slice_figure(
    path: str | os.PathLike[str],
    volume: "SparseVolume",
    *,
    axis: str = "z",
    position: float | None = None,
    contours: Sequence[float] | None = None,
    label: str = "",
    title: str = "",
    size: tuple[int, int] = (800, 600),
    device: Device = None,
) -> Path:
    """Draw the values of ``volume`` on a plane perpendicular to a world axis.

    Level sets have a diverging color map, white at zero, and a bold zero contour. Beyond the narrow band the inside is
    gray and the outside white. Other grids are colored from low to high, vectors by their length.

    Args:
        path: Target, a .png, .svg or .pdf file.
        volume: The grid.
        axis: The axis that the plane is perpendicular to: "x", "y" or "z".
        position: Coordinate of the plane on the axis [world]; None uses the middle of the active voxels.
        contours: Values of the contour lines; None spreads nine over the range.
        label: Text beside the color bar; by default the name of the grid, of vectors as ``|name|``.
        title: Text above the figure.
        size: Width and height of the figure in pixels.
        device: The device that samples the plane.
    Returns:
        The path that was written.
    Raises:
        InputError: An unknown axis, a grid without active voxels, a wrong size or file name.
        FileAccessError: The target cannot be written.
    """
    target = checked_target(path, FLAT)
    width, height = checked_size(size)
    require_choice(axis, "axis", tuple(AXES))
    for text, name in ((label, "label"), (title, "title")):
        checked_label(text, name)
    require_volume(volume, "volume")
    levels = None if contours is None else read_array(contours, "contours", np.float64)
    if levels is not None and (levels.ndim != 1 or not np.isfinite(levels).all()):
        raise InputError(f"contours: {described(levels.tolist())} is not a list of finite numbers; give one")
    bounds = volume.info.world_bounds
    if bounds is None:
        raise InputError(f"grid {volume.info.name!r} has no active voxels: there is nothing to draw")
    across = AXES.index(axis)
    right, up = [other for other in range(3) if other != across]
    where = float(bounds[:, across].mean()) if position is None else require_finite_scalar(position, "position")
    u, v = _samples(bounds[:, right], bounds[:, up], width, height)
    positions = np.empty((len(v), len(u), 3))
    positions[..., right], positions[..., up] = np.meshgrid(u, v)
    positions[..., across] = where
    values = np.asarray(volume.sample(positions.reshape(-1, 3), device=device), dtype=np.float64)
    name = volume.info.name.encode("utf-8", "replace").decode()
    shown = name
    if values.ndim == 2:
        values, shown = np.linalg.norm(values, axis=1), f"|{name}|"
    values = values.reshape(len(v), len(u))

    signed = volume.info.grid_class == "level set"
    low, high = value_range(values, None, centered=signed)
    figure, (panel,) = new_axes((width, height), 1)
    figure.set_layout_engine("compressed")  # the plane keeps its shape, and the bar stands beside it
    placed: dict[str, Any] = {"origin": "lower", "extent": (u[0], u[-1], v[0], v[-1])}
    # Beyond the narrow band a level set only holds the sign; no number is beyond NaN.
    beyond = np.abs(values) >= (abs(float(volume.info.background)) * BAND_EDGE if signed else np.nan)
    drawn = panel.imshow(
        np.ma.array(values, mask=beyond),
        cmap=DIVERGING if signed else SEQUENTIAL,
        vmin=low,
        vmax=high,
        interpolation="nearest",
        **placed,
    )
    if beyond.any():
        shade = np.ma.array(np.where(values < 0.0, INSIDE, OUTSIDE), mask=~beyond)
        panel.imshow(shade, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest", **placed)
    _draw_contours(panel, u, v, values, levels, (low, high), signed)
    panel.set(xlabel=AXES[right], ylabel=AXES[up], title=title or f"{name} at {axis} = {where:.4g}")
    figure.colorbar(drawn, ax=panel, label=label or shown)
    return save_figure(figure, target)


def _samples(u_bounds: Any, v_bounds: Any, width: int, height: int) -> tuple[Any, Any]:
    # About one sample per pixel; more would not be visible.
    extent_u, extent_v = float(np.ptp(u_bounds)) or 1.0, float(np.ptp(v_bounds)) or 1.0
    step = max(extent_u / width, extent_v / height)
    count_u, count_v = (max(2, int(extent / step) + 1) for extent in (extent_u, extent_v))
    return np.linspace(u_bounds[0], u_bounds[1], count_u), np.linspace(v_bounds[0], v_bounds[1], count_v)


def _draw_contours(
    panel: Any, u: Any, v: Any, values: Any, contours: np.ndarray | None, limits: tuple[float, float], signed: bool
) -> None:
    low, high = limits
    levels = np.linspace(low, high, CONTOUR_COUNT + 2)[1:-1] if contours is None else contours
    # A level that no sample reaches would make matplotlib warn.
    inside = np.unique(levels[(levels > values.min()) & (levels < values.max())])
    if signed:
        inside = inside[np.abs(inside) > ZERO_LEVEL * high]  # drawn bold below
    if inside.size:
        panel.contour(u, v, values, levels=inside, colors="0.35", linewidths=0.6, linestyles="solid")
    if signed and values.min() < 0.0 < values.max():
        panel.contour(u, v, values, levels=[0.0], colors="black", linewidths=1.8)
