"""``geokit render``: draws a file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from geokit.cli._console import announce_compiling
from geokit.cli._kinds import kind_of_input, load_grid, may_write
from geokit.errors import InputError

__all__ = ["render"]

Flag = Annotated[bool, Parameter(negative="")]
AXES = "xyz"


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
    up: Literal["x", "y", "z"] = "y",
    transparent: Flag = False,
    force: Flag = False,
) -> None:
    """Draw a mesh, a volume or a point cloud into a PNG file, off-screen.

    Args:
        source: A mesh, a volume or a point cloud.
        output: The .png file to write.
        size: Width and height in pixels.
        color: A color (steelblue, "#336699"), a coordinate (x, y, z), or for a point cloud the name of an array.
        grid: Name of the grid, if the file holds several.
        isovalue: Value of the volume's surface; by default 0 for level sets, while other grids are drawn as fog.
        slice: Draw a slice through the middle of a volume instead, perpendicular to this axis.
        up: The axis that points up in the picture.
        transparent: Leave the background transparent.
        force: Replace an existing output.
    """
    kind = kind_of_input(source)
    pixels = _parse_size(size)
    if kind != "volume" and (grid is not None or isovalue is not None or slice is not None):
        raise InputError(f"--grid, --isovalue and --slice are for volumes, and {source} is a {kind}; leave them out")
    may_write(output, force=force)
    announce_compiling()
    scene: dict[str, Any] = {"size": pixels, "up": up, "transparent": transparent}
    from geokit import render as drawing

    if kind == "volume":
        field = load_grid(source, grid)
        if slice is not None:
            drawing.slice(output, field, axis=slice, size=pixels)
        else:
            drawing.figure(output, volume=field, color=color, isovalue=isovalue, **scene)
    elif kind == "mesh":
        from geokit.mesh import load

        mesh = load(source)
        drawing.figure(output, mesh=mesh, **_coordinate(mesh.vertices, color), **scene)
    else:
        from geokit.points import load as load_points

        cloud = load_points(source)
        chosen = _array_or_color(cloud, color, source)
        drawing.figure(output, points=cloud.points, **chosen, **scene)
    print(f"{output}: {pixels[0]} x {pixels[1]} pixels, {output.stat().st_size} bytes")


def _parse_size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)\s*[x,]\s*(\d+)", text.strip().lower())
    if match is None:
        raise InputError(f"--size: {text!r} is not WIDTHxHEIGHT in pixels, such as 800x600")
    return int(match[1]), int(match[2])


def _coordinate(positions: Any, color: str | None) -> dict[str, Any]:
    if color is not None and color in tuple(AXES):
        return {"color": positions[:, AXES.index(color)], "label": color}
    return {"color": color}


def _array_or_color(cloud: Any, color: str | None, source: Path) -> dict[str, Any]:
    import numpy as np

    if color in cloud.data:
        values = np.asarray(cloud.data[color], dtype=np.float64)
        return {"color": np.linalg.norm(values, axis=1) if values.ndim == 2 else values, "label": color}
    return _coordinate(cloud.points, color)
