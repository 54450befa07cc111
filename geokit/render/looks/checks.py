"""Argument checks and color maps that all figures share."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.files import require_extension
from geokit.core.require import described, read_array, require_path, require_table, require_text, whole_number
from geokit.errors import InputError
from geokit.formats.attributes.images import pixel_count
from geokit.render.looks.color_maps import HELD

# Perceptually uniform, readable in gray and by most color-blind readers.
SEQUENTIAL = "viridis"
# For signed quantities: white at zero.
DIVERGING = "RdBu_r"

# Formats of flat figures: pixels, and lines of any size.
FLAT = (".png", ".svg", ".pdf")

# Smallest and largest side in pixels: below, nothing is readable; above, software renderers refuse the frame buffer.
SMALLEST, LARGEST = 64, 8192
# Of a texture: decoded by Pillow and as an array, then VTK's copy, the renderer's, and its smaller copies.
BYTES_PER_PIXEL = 20
# Of the picture, and of the samples of smoke, which are at most so many.
FRAME_BYTES, SMOKE_BYTES, SMOKE_VOXELS = 92, 46, 192**3
# Libraries, and what their threads reserve.
PYVISTA_BYTES, OPENGL_BYTES = 220 << 20, 680 << 20


def figure_bytes(
    *_: object, mesh: Any = None, volume: Any = None, size: Any = (800, 600), look: str = "values", **__: object
) -> int:
    """Memory of a figure: the libraries that draw, mapped at the first one, their buffers, and what is drawn."""
    libraries = 0 if "pyvista" in sys.modules else PYVISTA_BYTES
    if look == "smoke":  # which is drawn without OpenGL
        box = volume.info.index_bounds
        voxels = min(float((box[1] - box[0] + 1).prod(dtype=float)), SMOKE_VOXELS)
        return libraries + FRAME_BYTES * size[0] * size[1] + int(SMOKE_BYTES * voxels) + (42 << 20)
    libraries += 0 if "vtkmodules.vtkRenderingOpenGL2" in sys.modules else OPENGL_BYTES
    textures = {id(each.texture): each.texture for each in getattr(mesh, "materials", ()) if each.texture is not None}
    pixels = sum(pixel_count(texture) for texture in textures.values())
    drawn = 170 * getattr(mesh, "face_count", 0) + BYTES_PER_PIXEL * pixels
    return libraries + FRAME_BYTES * size[0] * size[1] + drawn + (24 << 20)


def chart_bytes(*_: object, **__: object) -> int:
    """Memory of a chart, likewise."""
    return (20 if "matplotlib.pyplot" in sys.modules else 42) << 20


def checked_target(path: str | os.PathLike[str] | None, kinds: tuple[str, ...] = (".png",)) -> Path:
    if path is None:
        raise InputError(
            "path: a figure is a file; give its name first, as in figure('part.png', mesh=mesh). mesh.show() and "
            "render.view(mesh) show a mesh, a cloud or a volume without one"
        )
    require_extension(path, kinds, "figure")
    return require_path(path)


def checked_size(size: tuple[int, int]) -> tuple[int, int]:
    sides = [whole_number(side) for side in size] if isinstance(size, (tuple, list)) else []
    if len(sides) != 2 or None in sides:
        raise InputError(f"size: {described(size)} is not (width, height) in pixels; give two whole numbers")
    width, height = (side or 0 for side in sides)
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST):
        raise InputError(f"size: {described(size)} is outside {SMALLEST} to {LARGEST} pixels a side; choose another")
    return width, height


def checked_label(text: str, name: str) -> str:
    """A text that can be drawn.

    Raises:
        InputError: It is not a str, or has half a surrogate pair.
    """
    if require_text(text, name).encode("utf-8", "replace").decode() != text:
        raise InputError(f"{name}: {described(text)} has characters that no font has; use others")
    return text


def require_drawable(values: NDArray[np.float64], name: str) -> None:
    """Refuse numbers that float32 does not hold, as renderers use it; NaN is left out of pictures.

    Raises:
        InputError: A number is beyond; the message names the first row.
    """
    beyond = np.abs(values) > np.finfo(np.float32).max
    if beyond.any():
        row = int(np.argmax(beyond.reshape(len(values), -1).any(axis=1)))
        raise InputError(f"{name}: row {row} is beyond float32, which pictures are drawn in; scale the values")


def checked_colormap(colormap: str) -> str:
    """Name of a color map of matplotlib.

    Raises:
        InputError: matplotlib has none of that name.
    """
    if require_text(colormap, "colormap") not in HELD and colormap not in require_package("matplotlib").colormaps:
        raise InputError(f"colormap: {colormap!r} is not known to matplotlib; use one such as 'viridis'")
    return colormap


def checked_values(color: Any, counts: dict[str, int]) -> tuple[str, NDArray[np.float64]]:
    """Match an array of values to the items that it describes, by their number.

    Args:
        color: One number for each item; it need not be finite.
        counts: Number of items by kind, such as vertices and faces.
    Returns:
        The kind of item, and the values as float64.
    Raises:
        InputError: The values are not numbers, or no kind in ``counts`` has as many items.
    """
    array = read_array(color, "color", np.float64, kinds="fiub")
    if array.ndim == 1:
        for what, count in counts.items():
            if len(array) == count:
                return what, array
    have = ", ".join(f"{count} {what}" for what, count in counts.items())
    raise InputError(f"color: shape {array.shape} does not match {have}; give one value for each")


def value_range(
    values: NDArray[np.float64], given: tuple[float, float] | None, *, centered: bool = False
) -> tuple[float, float]:
    """Color limits: the given ones, else the range of the finite values, else (0, 1)."""
    if given is not None:
        low, high = require_table(given, "value_limits", (2,)).tolist()
        if not low < high:
            raise InputError(f"value_limits: {described(given)} is not (low, high) with low < high; give that")
        return low, high
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    if centered:
        high = max(abs(low), abs(high))
        low = -high
    # A constant field still needs a range of some width.
    return (low, high) if high > low else (low - 0.5, high + 0.5)
