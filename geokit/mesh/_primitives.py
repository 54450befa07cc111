"""Simple bodies: box, sphere, cylinder, torus, cone, plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_count, require_table
from geokit.errors import InputError
from geokit.mesh.model.triangle_mesh import TriangleMesh

# Most segments: faces grow with their square.
MOST_SEGMENTS = 1 << 14
# What arrays of their indices and vertices take while they are made.
BYTES_PER_QUAD = 400
_ORIGIN = (0.0, 0.0, 0.0)


@needs()
def box(size: ArrayLike = (1.0, 1.0, 1.0), *, center: ArrayLike = _ORIGIN) -> TriangleMesh:
    """A box along the axes, of 12 triangles.

    Args:
        size: Its lengths along x, y and z [world].
        center: Its middle [world].
    Returns:
        TriangleMesh, closed, wound outwards.
    Raises:
        InputError: A length is not positive, or a number is not finite.
    Example:
        >>> gk.mesh.box((1, 2, 3)).volume
        6.0
    """
    lengths = require_table(size, "size", (3,))
    if lengths.min() <= 0.0:
        raise InputError(f"size: {lengths.tolist()} has a length that is not positive; give three lengths")
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return _placed(signs * lengths, faces, center, "box")


@needs(lambda *_, segments=48, **__: BYTES_PER_QUAD * segments * (segments // 2))
def sphere(radius: float = 1.0, *, segments: int = 48, center: ArrayLike = _ORIGIN) -> TriangleMesh:
    """A sphere of circles of latitude around z; vertices lie on it to 4 roundings.

    Faces lie within ``radius * (1 - cos(pi / segments) ** 2)`` of it.

    Args:
        radius: Its radius [world].
        segments: Triangles around it, at least 3; half as many, rounded up, from pole to pole.
        center: Its middle [world].
    Returns:
        TriangleMesh, closed, wound outwards.
    Raises:
        InputError: radius is not positive and finite, segments is not a whole number from 3 up, or center is not three
            finite numbers.
    Example:
        >>> bool(abs(gk.mesh.sphere(2.0, segments=100).area / (16 * np.pi) - 1) < 2e-3)
        True
    """
    radius = _length(radius, "radius")
    angle = np.linspace(0.0, np.pi, -(-_segments(segments) // 2) + 1)
    profile = radius * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    profile[[0, -1], 0] = 0.0
    return _revolved(profile, segments, center, "sphere")


@needs(lambda *_, segments=48, **__: 3 * BYTES_PER_QUAD * segments)
def cylinder(
    radius: float = 1.0, height: float = 1.0, *, segments: int = 48, center: ArrayLike = _ORIGIN
) -> TriangleMesh:
    """A cylinder around z with its caps; faces lie within ``radius * (1 - cos(pi / segments))`` of it.

    Args:
        radius: Its radius [world].
        height: Its length along z [world].
        segments: Quads around it, at least 3.
        center: Its middle [world].
    Returns:
        TriangleMesh, closed, wound outwards.
    Raises:
        InputError: As for :func:`sphere`, or height is not positive and finite.
    Example:
        >>> gk.mesh.cylinder(1.0, 2.0).bounds[:, 2]
        array([-1.,  1.])
    """
    radius, half = _length(radius, "radius"), _length(height, "height") / 2.0
    return _revolved([[0.0, -half], [radius, -half], [radius, half], [0.0, half]], segments, center, "cylinder")


@needs(lambda *_, segments=48, **__: 2 * BYTES_PER_QUAD * segments)
def cone(radius: float = 1.0, height: float = 1.0, *, segments: int = 48, center: ArrayLike = _ORIGIN) -> TriangleMesh:
    """A cone around z with its base below and its tip above.

    Faces lie within ``radius * (1 - cos(pi / segments))`` of it.

    Args:
        radius: Radius of the base [world].
        height: Its length along z [world].
        segments: Triangles around it, at least 3.
        center: The middle between base and tip [world].
    Returns:
        TriangleMesh, closed, wound outwards.
    Raises:
        InputError: As for :func:`cylinder`.
    Example:
        >>> gk.mesh.cone(1.0, 2.0, segments=4).volume
        1.3333333333333333
    """
    radius, half = _length(radius, "radius"), _length(height, "height") / 2.0
    return _revolved([[0.0, -half], [radius, -half], [0.0, half]], segments, center, "cone")


@needs(lambda *_, segments=48, tube_segments=24, **__: BYTES_PER_QUAD * segments * tube_segments)
def torus(
    radius: float = 1.0,
    tube_radius: float = 0.25,
    *,
    segments: int = 48,
    tube_segments: int = 24,
    center: ArrayLike = _ORIGIN,
) -> TriangleMesh:
    """A torus around z.

    Faces lie within ``(radius + tube_radius) * (1 - cos(pi / segments)) + tube_radius * (1 - cos(pi / tube_segments))``
    of it.

    Args:
        radius: Distance of the tube's middle from the axis [world].
        tube_radius: Radius of the tube [world], less than ``radius``.
        segments: Quads around the axis, at least 3.
        tube_segments: Quads around the tube, at least 3.
        center: Its middle [world].
    Returns:
        TriangleMesh, closed, wound outwards.
    Raises:
        InputError: As for :func:`sphere`, or the tube is as wide as the torus.
    Example:
        >>> gk.mesh.audit(gk.mesh.torus()).euler_number
        0
    """
    radius, tube_radius = _length(radius, "radius"), _length(tube_radius, "tube_radius")
    if tube_radius >= radius:
        raise InputError(f"tube_radius: {tube_radius:g} is not less than the radius, {radius:g}; give a thinner tube")
    angle = 2.0 * np.pi * np.arange(_segments(tube_segments, "tube_segments")) / tube_segments
    profile = np.stack([radius + tube_radius * np.cos(angle), tube_radius * np.sin(angle)], axis=1)
    return _revolved(profile, segments, center, "torus", closed=True)


@needs(lambda *_, segments=1, **__: BYTES_PER_QUAD // 2 * segments**2)
def plane(size: ArrayLike = (1.0, 1.0), *, segments: int = 1, center: ArrayLike = _ORIGIN) -> TriangleMesh:
    """A rectangle of the plane z = 0 that faces upwards.

    Args:
        size: Its lengths along x and y [world].
        segments: Quads along each side, at least 1.
        center: Its middle [world].
    Returns:
        TriangleMesh, open.
    Raises:
        InputError: A length is not positive, segments is not a whole number from 1 up, or a number is not finite.
    Example:
        >>> gk.mesh.plane((2, 3)).area
        6.0
    """
    lengths = require_table(size, "size", (2,))
    if lengths.min() <= 0.0:
        raise InputError(f"size: {lengths.tolist()} has a length that is not positive; give two lengths")
    count = require_count(segments, "segments", 1, MOST_SEGMENTS)
    at = np.arange(count + 1) / count - 0.5
    x, y = np.meshgrid(at * lengths[0], at * lengths[1], indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], axis=2).reshape(-1, 3)
    return _placed(vertices, _quads(count + 1, count + 1, wrap=(False, False)), center, "plane")


def _revolved(profile: ArrayLike, segments: int, center: ArrayLike, name: str, *, closed: bool = False) -> TriangleMesh:
    """The surface of a profile (P, 2) of distances from the axis and heights, upwards on the outer side, around z."""
    around = _segments(segments)
    table = np.asarray(profile)
    angle = 2.0 * np.pi * np.arange(around) / around
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.empty((around, len(table), 3))
    points[..., :2] = ring[:, None] * table[None, :, :1]
    points[..., 2] = table[:, 1]
    faces = _quads(around, len(table), wrap=(True, closed))
    number = np.arange(around * len(table)).reshape(around, len(table))
    # Points on the axis are one vertex each.
    number[:, table[:, 0] == 0.0] = number[0, table[:, 0] == 0.0]
    faces = number.ravel()[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, faces = np.unique(faces, return_inverse=True)
    return _placed(points.reshape(-1, 3)[used], faces.reshape(-1, 3), center, name)


def _quads(rows: int, columns: int, wrap: tuple[bool, bool]) -> NDArray[np.int64]:
    """Triangles of a grid of vertices, two for each quad; its sides meet where ``wrap`` says so."""
    i, j = np.meshgrid(np.arange(rows - (not wrap[0])), np.arange(columns - (not wrap[1])), indexing="ij")
    a, b = i * columns + j, (i + 1) % rows * columns + j
    c, d = (i + 1) % rows * columns + (j + 1) % columns, i * columns + (j + 1) % columns
    return np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2).reshape(-1, 3)


def _placed(vertices: NDArray[np.float64], faces: NDArray[np.int64], center: ArrayLike, name: str) -> TriangleMesh:
    return TriangleMesh(vertices + require_table(center, "center", (3,)), faces, name=name)


def _length(value: float, name: str) -> float:
    return require_finite_scalar(value, name, low=0.0)


def _segments(value: int, name: str = "segments") -> int:
    return require_count(value, name, 3, MOST_SEGMENTS)
