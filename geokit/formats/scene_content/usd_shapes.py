"""The shapes of USD that are no meshes, as polygons, and the times at which a stage is read.

Standard library only, and usd-core is imported in the functions: reader processes wait for this import.
"""

from __future__ import annotations

import itertools
import math
from array import array
from collections.abc import Callable
from typing import Any

from geokit.formats.file_content.body import Body

# Corners around an axis, and rings of a half sphere. All vertices lie on the shape, and the faces within 0.13% of its
# radius: 1 - cos(pi / 64).
AROUND, RINGS = 64, 16

# A point on the outline of a body of revolution: distance from the axis, and height.
Outline = list[tuple[float, float]]


def shape_body(prim: Any, matrix: list[list[float]]) -> Body:
    """Polygons of a Cube, Sphere, Cylinder, Cone, Capsule or Plane prim; its vertices lie on the shape.

    Args:
        prim: The prim.
        matrix: From the prim's frame to the world, for column vectors.
    """

    def read(name: str) -> Any:
        return value_of(prim.GetAttribute(name))

    kind = str(prim.GetTypeName())
    points, polygons = SHAPES[kind](read)
    axis = str(read("axis")) if prim.HasAttribute("axis") else "Z"
    # Turns that take the z axis to another one.
    order = {"X": (2, 0, 1), "Y": (1, 2, 0)}.get(axis, (0, 1, 2))
    flat = array("d", (point[at] for point in points for at in order))
    return Body(
        memoryview(flat).cast("B").cast("d", (len(points), 3)),
        array("q", map(len, polygons)),
        array("q", (corner for polygon in polygons for corner in polygon)),
        name=str(prim.GetPath()),
        transform=matrix,
    )


def _cube(read: Callable[[str], Any]) -> Any:
    half = 0.5 * float(read("size"))
    points = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (-half, half)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return points, faces


def _sphere(read: Callable[[str], Any]) -> Any:
    radius = float(read("radius"))
    return _revolved([*_arc(radius, 0.0, -90.0, 0.0), *_arc(radius, 0.0, 0.0, 90.0)[1:]])


def _cylinder(read: Callable[[str], Any]) -> Any:
    radius, half = float(read("radius")), 0.5 * float(read("height"))
    return _revolved([(0.0, -half), (radius, -half), (radius, half), (0.0, half)])


def _cone(read: Callable[[str], Any]) -> Any:
    radius, half = float(read("radius")), 0.5 * float(read("height"))
    return _revolved([(0.0, -half), (radius, -half), (0.0, half)])


def _capsule(read: Callable[[str], Any]) -> Any:
    radius, half = float(read("radius")), 0.5 * float(read("height"))
    lower = _arc(radius, -half, -90.0, 0.0)
    return _revolved([*lower, *_arc(radius, half, 0.0, 90.0)[0 if half > 0.0 else 1 :]])


def _plane(read: Callable[[str], Any]) -> Any:
    x, y = 0.5 * float(read("width")), 0.5 * float(read("length"))
    # Its width is that along x, or along z if x is the axis.
    x, y = (x, y) if str(read("axis")) == "Z" else (y, x)
    return [(-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)], [(0, 1, 2, 3)]


SHAPES = {
    "Cube": _cube, "Sphere": _sphere, "Cylinder": _cylinder, "Cone": _cone, "Capsule": _capsule, "Plane": _plane,
}  # fmt: skip


def _arc(radius: float, height: float, first: float, last: float) -> Outline:
    """A quarter of a circle, with poles exactly on the axis."""
    angles = [math.radians(first + (last - first) * ring / RINGS) for ring in range(RINGS + 1)]
    points = [(radius * math.cos(angle), height + radius * math.sin(angle)) for angle in angles]
    return [(0.0 if abs(x) < 1e-12 * radius else x, z) for x, z in points]


def _revolved(outline: Outline) -> tuple[list[tuple[float, ...]], list[tuple[int, ...]]]:
    """Points and polygons around the z axis; the outline runs upwards, from the axis to the axis."""
    points: list[tuple[float, ...]] = []
    rings: list[list[int]] = []
    for radius, height in outline:
        count = AROUND if radius > 0.0 else 1
        rings.append([len(points) + at for at in range(count)])
        angles = (2.0 * math.pi * at / AROUND for at in range(count))
        points += [(radius * math.cos(angle), radius * math.sin(angle), height) for angle in angles]
    polygons: list[tuple[int, ...]] = []
    for below, above in itertools.pairwise(rings):
        for at in range(AROUND):
            corners = (
                below[at % len(below)],
                below[(at + 1) % len(below)],
                above[(at + 1) % len(above)],
                above[at % len(above)],
            )
            # A ring of one point makes a triangle of the quad.
            polygons.append(tuple(dict.fromkeys(corners)))
    return points, polygons


def time_of(*attributes: Any) -> Any:
    """The default time, or the earliest where one of the attributes has samples and no default.

    ``Get()`` would give the fallback of the schema there, such as a radius of 1.
    """
    from pxr import Usd

    default = Usd.TimeCode.Default()
    for attribute in attributes:
        unset = (Usd.ResolveInfoSourceNone, Usd.ResolveInfoSourceFallback)
        if (
            attribute.GetResolveInfo(default).GetSource() in unset
            and attribute.GetResolveInfo().GetSource() not in unset
        ):
            return Usd.TimeCode.EarliestTime()
    return default


def value_of(attribute: Any) -> Any:
    """The value at the default time, or the first sample; None if there is none."""
    return attribute.Get(time_of(attribute))


def is_animated(prim: Any) -> bool:
    """Whether samples change a prim's shape, its place or what moves its bones."""
    from pxr import UsdGeom, UsdSkel

    kinds = (UsdGeom.Boundable, UsdGeom.Xform, UsdSkel.Animation)
    return any(map(prim.IsA, kinds)) and any(one.ValueMightBeTimeVarying() for one in prim.GetAuthoredAttributes())
