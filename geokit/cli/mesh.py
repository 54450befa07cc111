"""``geokit mesh``: simple bodies, pieces, affine maps and attributes of meshes, from file to file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import App, Parameter

from geokit import mesh
from geokit.cli._kinds import Device, may_write
from geokit.cli._program.console import announce_compiling, print_json, say, step
from geokit.cli._results import DEFAULTS, Changed, Common, Source, deliver_mesh
from geokit.errors import InputError
from geokit.formats.foreign import require_format

app = App(name="mesh", help="Make simple bodies; split, move and color meshes.")

Point = tuple[float, float, float]
Target = Annotated[Path, Parameter(name="OUT")]


@Parameter(name="*")
@dataclass(frozen=True)
class Placed(Common):
    """Options of all simple bodies."""

    center: Point = (0, 0, 0)
    """Its middle; of a cone that between base and tip."""


PLACED = Placed()


def _write(target: Path, common: Placed, body: str, *sizes: Any, **options: Any) -> None:
    """Write a simple body of ``geokit.mesh``."""
    deliver_mesh(getattr(mesh, body)(*sizes, **options, center=common.center), target, common)


@app.command
def box(target: Changed, /, *, size: Point, common: Placed = PLACED) -> None:
    """Write a box along the axes.

    Args:
        size: Its lengths along x, y and z.
    """
    _write(target, common, "box", size)


@app.command
def sphere(target: Changed, /, *, radius: float, segments: int = 48, common: Placed = PLACED) -> None:
    """Write a sphere.

    Args:
        radius: Its radius.
        segments: Triangles around it.
    """
    _write(target, common, "sphere", radius, segments=segments)


@app.command
def cylinder(target: Changed, /, *, radius: float, height: float, segments: int = 48, common: Placed = PLACED) -> None:
    """Write a cylinder around z.

    Args:
        radius: Its radius.
        height: Its length along z.
        segments: Quads around it.
    """
    _write(target, common, "cylinder", radius, height, segments=segments)


@app.command
def cone(target: Changed, /, *, radius: float, height: float, segments: int = 48, common: Placed = PLACED) -> None:
    """Write a cone around z, with its tip above.

    Args:
        radius: Radius of its base.
        height: Its length along z.
        segments: Triangles around it.
    """
    _write(target, common, "cone", radius, height, segments=segments)


@app.command
def torus(
    target: Changed,
    /,
    *,
    radius: float,
    tube_radius: float,
    segments: int = 48,
    tube_segments: int = 24,
    common: Placed = PLACED,
) -> None:
    """Write a torus around z.

    Args:
        radius: Distance of the tube's middle from the axis.
        tube_radius: Radius of the tube.
        segments: Quads around the axis.
        tube_segments: Quads around the tube.
    """
    _write(target, common, "torus", radius, tube_radius, segments=segments, tube_segments=tube_segments)


@app.command
def plane(target: Changed, /, *, size: tuple[float, float], segments: int = 1, common: Placed = PLACED) -> None:
    """Write a rectangle that faces along z.

    Args:
        size: Its lengths along x and y.
        segments: Quads along each side.
    """
    _write(target, common, "plane", size, segments=segments)


@app.command
def split(source: Source, target: Target, /, *, by: str = "components", common: Common = DEFAULTS) -> None:
    """Write the pieces of a mesh, each to a file of its own: OUT-1.ply, OUT-2.ply, ... for OUT.ply.

    Args:
        source: The mesh to read.
        target: The name of the files to write, to which the numbers are added.
        by: What a piece is: components (connected faces), parts (named ranges of faces) or materials.
    """
    from geokit.mesh import load, save
    from geokit.mesh import split as split_mesh

    require_format(target, "mesh", "w")
    with step(f"splitting {source}", quiet=common.json) as splitting:
        pieces = split_mesh(load(source), by=by)
        splitting.result = f"{len(pieces)} pieces"
        digits = len(str(len(pieces)))
        targets = [target.with_stem(f"{target.stem}-{number + 1:0{digits}}") for number in range(len(pieces))]
        for path in targets:
            may_write(path, force=common.force)
        for path, piece in zip(targets, pieces, strict=True):
            save(path, piece)
    rows = [{"target": str(p), "name": m.name, "faces": len(m)} for p, m in zip(targets, pieces, strict=True)]
    if common.json:
        print_json({"source": str(source), "pieces": rows})
    else:
        for row in rows:
            say(f"{row['target']}: name {row['name']}, faces {row['faces']}")


@app.command
def keep_largest(
    source: Source, target: Changed, /, *, count: int = 1, share: float | None = None, common: Common = DEFAULTS
) -> None:
    """Keep the connected components with the largest area.

    Args:
        source: The mesh to read.
        count: How many to keep.
        share: Keep all with at least this share of the largest one's area, from 0 to 1, whatever --count is.
    """
    may_write(target, "mesh", force=common.force)
    with step(f"splitting {source}", quiet=common.json):
        found = mesh.keep_largest(mesh.load(source), count, share=share)
    deliver_mesh(found, target, common)


@app.command
def transform(
    source: Source,
    target: Changed,
    /,
    *,
    move: Point = (0, 0, 0),
    scale: float = 1.0,
    rotate: tuple[float, float, float, float] | None = None,
    matrix: Annotated[list[float] | None, Parameter(consume_multiple=True, negative="")] = None,
    common: Common = DEFAULTS,
) -> None:
    """Scale a mesh, then rotate it, then move it; or apply a matrix. Normals follow.

    Args:
        source: The mesh to read.
        move: Distances along x, y and z.
        scale: Factor; a negative one mirrors.
        rotate: Axis and angle in degrees: x y z angle.
        matrix: The 16 numbers of a matrix for column vectors, row by row, in place of the others.
    """
    may_write(target, "mesh", force=common.force)
    if matrix is None:
        table = np.eye(4)
        table[:3, :3] = scale * _rotation(rotate)
        table[:3, 3] = move
    elif len(matrix) != 16 or rotate is not None or (move, scale) != ((0, 0, 0), 1.0):
        raise InputError(f"--matrix: {len(matrix)} numbers are given; give 16, and no --move, --scale or --rotate")
    else:
        table = np.reshape(matrix, (4, 4))
    with step(f"reading {source}", quiet=common.json):
        found = mesh.load(source)
    deliver_mesh(mesh.transform(found, table), target, common)


def _rotation(given: tuple[float, float, float, float] | None) -> Any:
    """The matrix (3, 3) of an axis and an angle in degrees."""
    if given is None:
        return np.eye(3)
    axis, angle = np.array(given[:3]), np.radians(given[3])
    length = float(np.linalg.norm(axis))
    if not 0.0 < length < np.inf:
        raise InputError(f"--rotate: {given[0]:g} {given[1]:g} {given[2]:g} is not an axis; give a direction")
    x, y, z = axis / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


@app.command
def transfer(
    source: Source,
    other: Annotated[Path, Parameter(name="FROM")],
    target: Changed,
    /,
    *,
    name: Annotated[list[str] | None, Parameter(negative="")] = None,
    device: Device = None,
    common: Common = DEFAULTS,
) -> None:
    """Give a mesh the attributes of another one at closest points of the same side: colors, any array.

    Args:
        source: The mesh that gets them.
        other: The mesh that has them.
        name: An attribute; may be given several times. By default all.
    """
    may_write(target, "mesh", force=common.force)
    announce_compiling()
    with step(f"taking attributes from {other}", quiet=common.json):
        found = mesh.transfer_attributes(mesh.load(source), mesh.load(other), names=name, device=device)
    deliver_mesh(found, target, common)
