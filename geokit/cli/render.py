"""``geokit render``: draws a file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from cyclopts import CycloptsError, Parameter

from geokit import render as drawing
from geokit.cli._kinds import Columns, FiniteOnly, Flag, UpAxis, kind_of_input, load_shown, may_write, refuse_unused
from geokit.cli._program.console import announce_compiling, say, step
from geokit.core.files import extension
from geokit.errors import InputError

AXES = "xyz"
_DEFAULTS = {
    "azimuth": None,
    "elevation": None,
    "distance": None,
    "zoom": 1.0,
    "edges": False,
    "shadow": False,
    "look": "values",
}


def render(
    source: Annotated[Path, Parameter(name="IN")],
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    size: str = "800x600",
    color: str | None = None,
    grid: str | None = None,
    isovalue: float | None = None,
    slice: Literal["x", "y", "z"] | None = None,
    up: UpAxis | None = None,
    azimuth: float | None = None,
    elevation: float | None = None,
    distance: float | None = None,
    zoom: float = 1.0,
    edges: Flag = False,
    shadow: Flag = False,
    look: Literal["values", "smoke"] = "values",
    transparent: Flag = False,
    finite_only: FiniteOnly = True,
    columns: Columns = None,
    force: Flag = False,
) -> None:
    """Draw a mesh, a volume or a point cloud into a PNG file, off-screen.

    Args:
        source: A mesh, a volume or a point cloud.
        output: The .png file to write; with --slice also .svg or .pdf.
        size: Width and height in pixels.
        color: A color (steelblue, "#336699"), a coordinate (x, y, z), or the name of an array of the mesh or the cloud;
            by default the mesh's textures and colors.
        grid: Name of the grid, if the file holds several.
        isovalue: Value of the volume's surface; by default 0 for level sets, while other grids are drawn as fog.
        slice: Draw a slice through the middle of a volume instead, perpendicular to this axis.
        up: The axis that points up in the picture; by default the one that the file names, else the one along which a
            mesh stands on its base, or -y for points in the frame of a depth camera, else the one that files of this
            format use most.
        azimuth: Angle around the up axis from the front to the camera, to the right, in degrees.
        elevation: Angle of the camera above the horizon, in degrees.
        distance: From the middle of the scene to the camera; by default all of the scene fits.
        zoom: Size in the picture; 2 draws twice as large.
        edges: Draw the edges of the triangles.
        shadow: Draw a soft shadow on the ground below a mesh, a cloud or a volume's surface.
        look: How fog is drawn: by the color map, or as white smoke, lit, in front of the dark.
        transparent: Leave the background transparent.
        force: Replace an existing output.
    """
    kind = kind_of_input(source, grid)
    pixels = _parse_size(size)
    named = grid is not None and extension(source) != ".vdb"  # which may hold points
    if kind != "volume" and (named or isovalue is not None or slice is not None):
        raise InputError(f"--grid, --isovalue and --slice are for volumes, and {source} is a {kind}; leave them out")
    if kind != "cloud":
        refuse_unused(f"on a {kind}", columns=columns)
    camera: dict[str, Any] = {"azimuth": azimuth, "elevation": elevation, "distance": distance, "zoom": zoom}
    camera |= {"edges": edges, "shadow": shadow, "look": look}
    if slice is not None and camera != _DEFAULTS:
        raise InputError(f"{', '.join(f'--{name}' for name in _DEFAULTS)} are for scenes, not for --slice")
    from geokit.render.looks.checks import FLAT, checked_target

    checked_target(output, *((FLAT,) if slice is not None else ()))
    may_write(output, force=force)
    announce_compiling()
    with step(f"drawing {source}"):
        held, axis = load_shown(source, kind, grid, finite_only, columns, up)
        scene: dict[str, Any] = {"size": pixels, "up": axis, "transparent": transparent, **camera}
        if slice is not None:
            drawing.slice(output, held, axis=slice, size=pixels)
        elif kind == "volume":
            drawing.figure(output, volume=held, color=color, isovalue=isovalue, **scene)
        elif kind == "mesh":
            drawing.figure(output, mesh=held, **_array_or_color(held, held.vertices, color), **scene)
        else:
            own = color in ("rgb", "rgba") and color in held.data
            drawing.figure(output, points=held, **_array_or_color(held, held.points, None if own else color), **scene)
    say(f"{output}: {pixels[0]} x {pixels[1]} pixels, {output.stat().st_size} bytes")


def _parse_size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)\s*[x,]\s*(\d+)", text.strip().lower())
    if match is None:
        raise CycloptsError(msg=f"--size: {text!r} is not WIDTHxHEIGHT in pixels, such as 800x600")
    return int(match[1]), int(match[2])


def _array_or_color(held: Any, positions: Any, color: str | None) -> dict[str, Any]:
    """What to color by: an array of the mesh or the cloud, vectors by their length, else a coordinate or a color."""
    arrays = held.data if hasattr(held, "data") else {**held.face_data, **held.vertex_data}
    if color in arrays:
        values = np.asarray(arrays[color], dtype=np.float64)
        return {"color": np.linalg.norm(values, axis=1) if values.ndim == 2 else values, "label": color}
    if color is not None and color in tuple(AXES):
        return {"color": positions[:, AXES.index(color)], "label": color}
    return {"color": color}
