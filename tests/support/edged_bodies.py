"""Bodies with sharp edges, eroded, dilated, opened and closed: signed distances in closed form, in float64.

A body is a profile in two dimensions made of segments and arcs, extruded or turned about an axis. Erosion and dilation
by a ball of an extruded or turned profile are those of the profile by a disc, away from the ends of what is extruded.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.support.analytic_volumes import Field

Points = NDArray[np.float64]


def turned(distance: Field, angles: tuple[float, float, float], center: tuple[float, float, float]) -> Field:
    """The body turned about x, then y, then z [radians], and moved."""
    (a, b, c), at = angles, np.array(center)
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    matrix = z @ y @ x
    return lambda points: distance((points - at) @ matrix)


def cuboid(half: NDArray[np.float64]) -> Field:
    """Signed distance from a box with the half edges ``half``, exact on both sides."""

    def distance(points: Points) -> Points:
        beyond = np.abs(points) - half
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)

    return distance


def polygon(corners: list[tuple[float, float]]) -> Field:
    """Signed distance from a polygon, counterclockwise."""
    start = np.array(corners, float)
    return outline(start, np.roll(start, -1, axis=0), np.zeros((0, 5)), lambda p: _winds_around(start, p))


def outline(start: Points, end: Points, arcs: Points, inside: Field) -> Field:
    """Distance from segments and arcs; negative where ``inside``.

    Args:
        start, end: Ends of the segments, (S, 2).
        arcs: Center x and y, radius, and the first and last angle, (A, 5).
        inside: Whether points (N, 2) are inside.
    """

    def distance(points: Points) -> Points:
        nearest = np.full(len(points), np.inf)
        for a, b in zip(start, end, strict=True):
            along = np.clip((points - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
            nearest = np.minimum(nearest, np.linalg.norm(points - a - along[:, None] * (b - a), axis=1))
        for x, y, radius, first, last in arcs:
            step = points - (x, y)
            angle = np.mod(np.arctan2(step[:, 1], step[:, 0]) - first, 2 * np.pi)
            away = np.where(angle <= last - first, np.abs(np.linalg.norm(step, axis=1) - radius), np.inf)
            nearest = np.minimum(nearest, away)
        return np.where(inside(points), -nearest, nearest)

    return distance


def extruded(profile: Field, half: float) -> Field:
    """A profile in x and y between -half and half along z."""

    def distance(points: Points) -> Points:
        beyond = np.stack([profile(points[:, :2]), np.abs(points[:, 2]) - half], axis=1)
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)

    return distance


def revolved(profile: Field) -> Field:
    """A profile in distance from the z axis and z."""
    return lambda points: profile(np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], axis=1))


def _winds_around(start: Points, points: Points) -> NDArray[np.bool_]:
    inside = np.zeros(len(points), bool)
    for a, b in zip(start, np.roll(start, -1, axis=0), strict=True):
        crosses = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
        rise = np.where(a[1] == b[1], 1.0, b[1] - a[1])
        inside ^= crosses & (points[:, 0] < a[0] + (points[:, 1] - a[1]) / rise * (b[0] - a[0]))
    return inside
