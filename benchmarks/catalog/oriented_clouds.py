"""Random points of bodies with their analytic outward normals, and the spacing: the side of a point's share."""

from __future__ import annotations

import numpy as np

COUNT = 2500


def box(random, half, count=COUNT):
    half = np.asarray(half, float)
    area = half.prod() / half
    axis = random.choice(3, count, p=area / area.sum())
    side = np.where(random.random(count) < 0.5, 1.0, -1.0)
    points = random.uniform(-1.0, 1.0, (count, 3)) * half
    normal = np.zeros((count, 3))
    points[np.arange(count), axis], normal[np.arange(count), axis] = side * half[axis], side
    return points, normal, np.sqrt(8.0 * area.sum() / count)


def plate(random, thickness, count=COUNT):
    """A square plate, so many spacings thick."""
    half = 0.05
    for _ in range(20):
        half = 0.5 * thickness * np.sqrt(8.0 * (0.65**2 + 1.3 * half) / count)
    return box(random, [0.65, 0.65, half], count)


def sphere(random, radius=1.0, count=COUNT):
    normal = random.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return radius * normal, normal, radius * np.sqrt(4.0 * np.pi / count)


def torus(random, minor, count=COUNT):
    u, v = random.random((2, 8 * count)) * 2.0 * np.pi
    kept = random.random(8 * count) < (1.0 + minor * np.cos(v)) / (1.0 + minor)
    u, v = u[kept][:count], v[kept][:count]
    normal = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
    center = np.stack([np.cos(u), np.sin(u), np.zeros(count)], axis=1)
    return center + minor * normal, normal, 2.0 * np.pi * np.sqrt(minor / count)


def cone(random, half_angle, count=COUNT):
    """A closed cone with its tip at the origin, opening downwards."""
    angle, height, turn = np.radians(half_angle), np.sqrt(random.random(count)), random.random(count) * 2.0 * np.pi
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    is_base = random.random(count) < np.sin(angle) / (1.0 + np.sin(angle))
    points = height[:, None] * np.tan(angle) * around - np.where(is_base, 1.0, height)[:, None] * up
    normal = np.where(is_base[:, None], -up, np.cos(angle) * around + np.sin(angle) * up)
    area = np.pi * np.tan(angle) * (1.0 / np.cos(angle) + np.tan(angle))
    return points, normal, np.sqrt(area / count)


def nested_spheres(random, gap):
    """Two spheres, the inner one so many spacings inside the other, and the number of the sphere."""
    outer, normal, spacing = sphere(random)
    radius = 1.0 - gap * spacing
    inner, inner_normal, _ = sphere(random, radius, int(COUNT * radius**2))
    part = np.repeat([0, 1], [len(outer), len(inner)])
    return (np.concatenate([outer, inner]), np.concatenate([normal, inner_normal]), spacing), part


def parallel_sheets(random, gap):
    """Two squares so many spacings apart, and the number of the square."""
    points = np.concatenate([random.random((COUNT, 2)), np.zeros((COUNT, 1))], axis=1)
    spacing, part = np.sqrt(2.0 / COUNT), np.arange(COUNT) % 2
    points[:, 2] = part * gap * spacing
    return (points, np.tile([0.0, 0.0, 1.0], (COUNT, 1)), spacing), part


def uneven(random, shape, axis, ratio):
    """COUNT of a shape's points, so many times as dense at one end of the axis as at the other."""
    points, normal, spacing = shape
    low, high = points[:, axis].min(), points[:, axis].max()
    weight = ratio ** ((points[:, axis] - low) / (high - low))
    chosen = random.choice(len(points), COUNT, replace=False, p=weight / weight.sum())
    return points[chosen], normal[chosen], spacing * np.sqrt(len(points) / COUNT)
