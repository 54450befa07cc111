"""The soft shadow of a scene on the ground below it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.render._camera import UP

# Pixels of the maps of heights, and of the shadow, on each side.
RESOLUTION = 256
# Horizontal slices of the scene, from this share of its height to the top.
SLICES, LOWEST = 16, 0.01
# How far the ground reaches beyond the scene, as a share of its longest side: there less than a tenth is hidden.
REACH = 1.0
# How far the picture reaches beyond it.
SHOWN = 0.1
DARKNESS = 0.8
# Slices nearer to the ground than so many pixels are taken for one at that height.
SMOOTH = 1.5
# Smaller spheres [pixels] are not drawn at all.
LEAST_POINT = 2.0
# The ground lies lower than the scene by this share of its size, so that flat bases and the ground do not mix.
GAP = 1e-3


def add_shadow(pv: Any, plotter: Any, up: str) -> NDArray[np.float64]:
    """Lay the shadow of all that a plotter has below it; what it has must not be translucent fog.

    Args:
        pv: The module pyvista.
        plotter: The plotter, before its camera is placed and its edges are smoothed.
        up: The axis that points up.
    Returns:
        The box to show, least and greatest coordinate on each axis (3, 2).
    """
    bounds = np.array(plotter.bounds).reshape(3, 2)
    axis, sign = "xyz".index(up[-1]), -1.0 if up[0] == "-" else 1.0
    center, size = bounds.mean(axis=1), float(np.ptp(bounds, axis=1).max()) or 1.0
    flat = np.delete(np.ptp(bounds, axis=1), axis)
    half = 0.5 * float(flat.max()) + REACH * size
    ground = sign * bounds[axis, 0 if sign > 0.0 else 1] - GAP * size
    low, high = _heights(plotter, up, center, half, size)
    hidden = hidden_sky(low - ground, high - ground, 2.0 * half / RESOLUTION)
    # Nothing at the border of the ground, and no edge anywhere.
    place = np.linspace(-1.0, 1.0, RESOLUTION)
    fade = np.clip(2.0 * (1.0 - np.hypot(place[:, None], place)), 0.0, 1.0)
    fade *= fade * (3.0 - 2.0 * fade)
    pixels = np.zeros((RESOLUTION, RESOLUTION, 4), np.uint8)
    pixels[..., 3] = np.rint(255.0 * DARKNESS * hidden * fade)

    right, ahead = _plane(up)
    middle = center.copy()
    middle[axis] = sign * ground
    corners = np.array([middle + half * (x * right + y * ahead) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    floor = pv.PolyData(corners, faces=[4, 0, 1, 2, 3])
    floor.active_texture_coordinates = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    texture = pv.Texture(pixels)
    texture.interpolate = True
    # From below the ground cannot be seen.
    plotter.add_mesh(floor, texture=texture, lighting=False, culling="back", show_edges=False, reset_camera=False)
    shown = bounds.copy()
    for other in {0, 1, 2} - {axis}:
        shown[other] += np.array([-SHOWN, SHOWN]) * size
    return shown


def _plane(up: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions to the right and ahead on the ground, as seen from above."""
    axis = np.array(UP[up])
    right = np.array((0.0, 0.0, 1.0) if up[-1] == "x" else (1.0, 0.0, 0.0))
    return right, np.cross(axis, right)


def _heights(
    plotter: Any, up: str, center: NDArray[np.float64], half: float, size: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest point above each pixel of a square [world, along up], NaN where there is none.

    They are read from the depths of two parallel projections. Rows run from the back, columns to the right.
    """
    window, camera = plotter.window_size, plotter.camera
    actors = [actor for actor in plotter.renderer.actors.values() if hasattr(actor, "ForceOpaqueOn")]
    sizes = [actor.prop.point_size for actor in actors]
    axis = np.array(UP[up])
    _, ahead = _plane(up)
    reach = 2.0 * size
    near, far = reach - size, reach + size
    found = []
    try:
        for actor, points in zip(actors, sizes, strict=True):
            actor.ForceOpaqueOn()
            # Points have a size in pixels, and twice that where edges are smoothed.
            actor.prop.point_size = max(LEAST_POINT, 0.5 * points * RESOLUTION / window[1] * size / (2.0 * half))
        plotter.window_size = (RESOLUTION, RESOLUTION)
        camera.parallel_projection = True
        camera.parallel_scale = half
        for side in (-1.0, 1.0):
            camera.focal_point = center
            camera.position = center + side * reach * axis
            camera.up = ahead
            camera.clipping_range = (near, far)
            plotter.render_window.Render()
            depth = _depths(plotter)
            height = center @ axis + side * (reach - (near + depth * (far - near)))
            height[depth >= 1.0] = np.nan
            # From below, right is left.
            found.append(height[:, ::-1] if side < 0.0 else height)
    finally:
        for actor, points in zip(actors, sizes, strict=True):
            actor.ForceOpaqueOff()
            actor.prop.point_size = points
        camera.parallel_projection = False
        plotter.window_size = window
    return found[0], found[1]


def _depths(plotter: Any) -> NDArray[np.float64]:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkFloatArray

    values = vtkFloatArray()
    plotter.render_window.GetZbufferData(0, 0, RESOLUTION - 1, RESOLUTION - 1, values)
    return vtk_to_numpy(values).astype(np.float64).reshape(RESOLUTION, RESOLUTION)[::-1]


def hidden_sky(low: NDArray[np.float64], high: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Share of an even sky that columns hide from the ground, by the worst of their horizontal slices.

    A slice at height h hides ``h^2 / (pi (h^2 + r^2)^2)`` of the light for each unit of its area at the horizontal
    distance r.

    Args:
        low: Where the column above each pixel begins (N, N) [world above the ground], NaN where there is none.
        high: Where it ends.
        step: Side of a pixel [world].
    Returns:
        Shares from 0 to 1 (N, N).
    """
    hidden = np.zeros(low.shape)
    top = float(np.nanmax(high, initial=0.0))
    if top <= 0.0:
        return hidden
    count = len(low)
    place = step * np.minimum(np.arange(2 * count), 2 * count - np.arange(2 * count))
    square = place[:, None] ** 2 + place**2
    heights = np.geomspace(LOWEST * top, top, SLICES)
    for below, height in zip((0.0, *heights), heights, strict=False):
        is_there = (low <= height) & (high > below)
        if not is_there.any():
            continue
        # Narrower than the pixels, the kernel would show them.
        height = max(height, SMOOTH * step)
        kernel = 1.0 / (height**2 + square) ** 2
        kernel *= min(1.0, height**2 * step**2 * float(kernel.sum()) / np.pi) / float(kernel.sum())
        padded = np.fft.rfft2(is_there, (2 * count, 2 * count)) * np.fft.rfft2(kernel)
        hidden = np.maximum(hidden, np.fft.irfft2(padded, (2 * count, 2 * count))[:count, :count])
    return np.clip(hidden, 0.0, 1.0)
