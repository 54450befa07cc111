"""Scenes by kind, with the rays that a picture of them needs; all random choices are seeded.

A scene of about ``triangles`` triangles is what its kind makes hard: huge triangles beside tiny ones (hall), many thin
ones that occlude each other (foliage), slivers (pipes), no connection at all (soup). Lengths are meters; coordinates
are rounded to float32, so that peers of either precision have the same mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks import inputs
from geokit.mesh import Surface, TriangleMesh

Rays = tuple[np.ndarray, np.ndarray]

# Corners of a unit box, x slowest, and its twelve triangles, which face outward.
BOX = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5], indexing="ij"), axis=-1).reshape(-1, 3)
BOX_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)
# Share of the longest side of the box by which bounces start off the surface.
OFFSET = 1e-5


class View(NamedTuple):
    """A camera: where it is, what it looks at, and half its picture's height at a distance of one."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    half: float = 0.5


class Scene(NamedTuple):
    mesh: TriangleMesh
    view: View


def hall(triangles: int = 260_000, seed: int = 0) -> Scene:
    """A hall of 40 by 25 by 8 m, walls of two triangles each, pillars, and turned boxes of 5 cm to 2 m in it."""
    rng = np.random.default_rng(seed)
    count = max(1, triangles // 12 - 13)
    size = 0.05 * (40 ** (rng.random(count) ** 4))[:, None] * rng.uniform(0.4, 1.0, (count, 3))
    stacked = np.where(rng.random(count) < 0.5, 0.0, rng.integers(1, 4, count) * 0.9)
    place = np.stack([rng.uniform(-19, 19, count), rng.uniform(-11.5, 11.5, count), stacked + size[:, 2] / 2], axis=1)
    i, j = np.meshgrid(np.arange(6), np.arange(2))
    pillars = np.stack([-17.5 + 7.0 * i.ravel(), -5.0 + 10.0 * j.ravel(), np.full(12, 4.0)], axis=1)
    boxes = _boxes(
        np.concatenate([[[0, 0, 4]], pillars, place]),
        np.concatenate([[[40, 25, 8]], np.tile([0.6, 0.6, 8.0], (12, 1)), size]),
        np.concatenate([np.zeros(13), rng.uniform(0, np.pi, count)]),
    )
    return Scene(boxes, View((-18.5, -10.0, 2.2), (8, 3, 1.5)))


def lobes(triangles: int = 82_000, seed: int = 0) -> Scene:
    """A smooth closed body with lobes, as a scan of an organ or a casting has."""
    across = max(3, round((triangles / 4) ** 0.5))
    around = 2 * across
    turn, tilt = np.arange(around) / around * 2 * np.pi, (np.arange(across) + 0.5) / across * np.pi
    u, v = np.meshgrid(turn, tilt, indexing="ij")
    radius = 1 + 0.25 * np.sin(3 * u) * np.sin(v) ** 3 + 0.15 * np.cos(5 * v + 2 * np.sin(u)) * np.sin(v)
    points = np.stack([radius * np.sin(v) * np.cos(u), radius * np.sin(v) * np.sin(u), radius * np.cos(v)], axis=-1)
    faces = _grid_faces(around, across, closed=True)
    ends = np.array([points[:, 0].mean(axis=0), points[:, -1].mean(axis=0)])
    ring = np.arange(around) * across
    after, north = np.roll(ring, -1), around * across
    caps = [np.stack([np.full(around, north), ring, after], axis=1)]
    caps.append(np.stack([np.full(around, north + 1), after + across - 1, ring + across - 1], axis=1))
    return Scene(
        _mesh(np.concatenate([points.reshape(-1, 3), ends]), np.concatenate([faces, *caps]), "lobes"),
        View((0.5, -3.0, 1.0), (0, 0, 0)),
    )


def foliage(triangles: int = 260_000, seed: int = 0) -> Scene:
    """Leaves of two triangles in the crowns of trees above a ground of two."""
    rng = np.random.default_rng(seed)
    count = max(1, triangles // 2 - 1)
    trees = np.concatenate([rng.uniform(-15, 15, (40, 2)), rng.uniform(3, 7, (40, 1))], axis=1)
    way = rng.normal(size=(count, 3))
    way *= rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(way, axis=1, keepdims=True)
    center = trees[rng.integers(40, size=count)] + way * [2.0, 2.0, 2.5]
    along, aside = rng.normal(size=(2, count, 3))
    along *= rng.uniform(0.02, 0.08, (count, 1)) / np.linalg.norm(along, axis=1, keepdims=True)
    aside = np.cross(along, aside)
    aside *= 0.02 / np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
    leaves = np.stack([center - along, center + aside, center + along, center - aside], axis=1)
    ground = np.array([[[-20, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]]])
    return Scene(_quads(np.concatenate([ground, leaves]), "foliage"), View((-17, -16, 1.7), (0, 0, 4.0)))


def terrain(triangles: int = 260_000, seed: int = 0) -> Scene:
    """A height field of hills in waves of many lengths."""
    rng = np.random.default_rng(seed)
    side = max(3, round((triangles / 2) ** 0.5) + 1)
    x, y = np.meshgrid(np.linspace(-500, 500, side), np.linspace(-500, 500, side), indexing="ij")
    height = np.zeros_like(x)
    for octave in range(7):
        for _ in range(3):
            angle, phase = rng.uniform(0, 2 * np.pi, 2)
            wave = 2**octave * 2 * np.pi / 900
            height += 45 * 0.5**octave * np.sin(wave * (x * np.cos(angle) + y * np.sin(angle)) + phase)
    points = np.stack([x, y, height], axis=-1).reshape(-1, 3)
    mesh = _mesh(points, _grid_faces(side, side, closed=False), "terrain")
    return Scene(mesh, View((-480, -460, 180), (0, 0, 0)))


def part(triangles: int = 260_000, seed: int = 0) -> Scene:
    """A plate with drilled pins, as CAD programs write them: large flat faces beside fine fans and thin strips."""
    rng = np.random.default_rng(seed)
    around = 64
    pins = max(1, triangles // (4 * around))
    side = int(np.ceil(pins**0.5))
    place = np.stack(np.divmod(np.arange(pins), side), axis=1) - (side - 1) / 2
    radius, height = rng.uniform(0.1, 0.4, pins), rng.uniform(0.2, 3.0, pins)
    cylinders = [
        _cylinder(np.append(place[i], 0.0), np.append(place[i], height[i]), radius[i], around) for i in range(pins)
    ]
    plate = _boxes(np.array([[0, 0, -0.5]]), np.array([[side + 2.0, side + 2.0, 1.0]]), np.zeros(1))
    mesh = _joined([(plate.vertices, plate.faces), *cylinders], "part")
    return Scene(mesh, View((-0.6 * side, -0.7 * side, 0.5 * side), (0, 0, 0)))


def pipes(triangles: int = 260_000, seed: int = 0) -> Scene:
    """Straight pipes along the axes of a plant: each side is one pair of slivers of up to 30 m."""
    rng = np.random.default_rng(seed)
    around = 24
    count = max(1, triangles // (4 * around))
    axis = np.eye(3)[rng.integers(3, size=count)]
    center, length = rng.uniform(-15, 15, (count, 3)), rng.uniform(2, 30, (count, 1))
    radius = rng.uniform(0.02, 0.15, count)
    ends = center - axis * length / 2, center + axis * length / 2
    made = [_cylinder(ends[0][i], ends[1][i], radius[i], around) for i in range(count)]
    return Scene(_joined(made, "pipes"), View((-28, -25, 12), (0, 0, 0)))


def soup(triangles: int = 260_000, seed: int = 0) -> Scene:
    """Triangles anywhere, of sizes over two decades."""
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-2.5, -0.5, (triangles, 1, 1))
    corners = rng.uniform(-5, 5, (triangles, 1, 3)) + size * rng.normal(size=(triangles, 3, 3))
    mesh = _mesh(corners.reshape(-1, 3), np.arange(3 * triangles).reshape(-1, 3), "soup")
    return Scene(mesh, View((-9, -8, 3), (0, 0, 0)))


SCENES: dict[str, Callable[..., Scene]] = {
    made.__name__: made for made in (hall, lobes, foliage, terrain, part, pipes, soup)
}


# Rays


def camera_rays(scene: Scene, count: int) -> Rays:
    """Rays of the scene's camera row by row, in a picture of 4:3."""
    eye, target, half = (np.asarray(value, np.float64) for value in scene.view)
    height = max(1, round((count * 3 / 4) ** 0.5))
    width = max(1, count // height)
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    x, y = np.meshgrid((np.arange(width) + 0.5) * 2 / width - 1, 1 - (np.arange(height) + 0.5) * 2 / height)
    aside = x[..., None] * right * (width / height) + y[..., None] * up
    directions = (ahead + half * aside).reshape(-1, 3)
    return inputs.in_float32(np.tile(eye, (len(directions), 1))), inputs.in_float32(directions)


def bounce_rays(scene: Scene, surface: Surface, count: int, seed: int = 0) -> Rays:
    """Rays from where camera rays hit the surface, picture order, anywhere into the half space that they came from."""
    origins, directions = camera_rays(scene, count)
    found = surface.raycast(origins, directions)
    hit = found.triangle_id >= 0
    if not hit.any():
        raise ValueError(f"the camera of {scene.mesh.name} sees nothing")
    corners = scene.mesh.vertices[scene.mesh.faces[found.triangle_id[hit]]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= -np.sign(np.einsum("nd,nd->n", normals, directions[hit]))[:, None]
    way = np.random.default_rng(seed).normal(size=normals.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    offset = OFFSET * (scene.mesh.bounds[1] - scene.mesh.bounds[0]).max()
    starts = origins[hit] + found.t[hit, None] * directions[hit] + offset * normals
    return inputs.in_float32(starts), inputs.in_float32(normals + 0.999 * way)


def ray_sets(scene: Scene, surface: Surface, count: int) -> dict[str, Rays]:
    """Camera rays, bounces from what they see, and random rays."""
    random = inputs.random_rays(scene.mesh, count)
    return {
        "camera": camera_rays(scene, count),
        "bounces": bounce_rays(scene, surface, count),
        "random": (inputs.in_float32(random[0]), inputs.in_float32(random[1])),
    }


# Parts of scenes


def _mesh(vertices: np.ndarray, faces: np.ndarray, name: str) -> TriangleMesh:
    return TriangleMesh(inputs.in_float32(np.asarray(vertices, np.float64)), faces, name=name)


def _boxes(center: np.ndarray, size: np.ndarray, turn: np.ndarray) -> TriangleMesh:
    """Boxes turned about z."""
    corners = BOX * size[:, None]
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    x, y = corners[..., 0] * cos - corners[..., 1] * sin, corners[..., 0] * sin + corners[..., 1] * cos
    vertices = np.stack([x, y, corners[..., 2]], axis=-1) + center[:, None]
    faces = BOX_FACES + 8 * np.arange(len(center))[:, None, None]
    return _mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), "hall")


def _quads(corners: np.ndarray, name: str) -> TriangleMesh:
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(corners))[:, None, None]
    return _mesh(corners.reshape(-1, 3), faces.reshape(-1, 3), name)


def _grid_faces(rows: int, columns: int, closed: bool) -> np.ndarray:
    """Two triangles for each cell of a grid of points, whose rows may close to a ring."""
    i, j = (x.ravel() for x in np.meshgrid(np.arange(rows if closed else rows - 1), np.arange(columns - 1)))
    a, b = i * columns + j, (i + 1) % rows * columns + j
    return np.concatenate([np.stack([a, a + 1, b], axis=1), np.stack([b, a + 1, b + 1], axis=1)])


def _cylinder(start: np.ndarray, end: np.ndarray, radius: float, around: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed cylinder of 4 ``around`` triangles; its caps are fans."""
    axis = (end - start) / np.linalg.norm(end - start)
    aside = np.cross(axis, np.roll(axis, 1) + np.array([0.3, 0.2, 0.1]))
    aside /= np.linalg.norm(aside)
    angle = np.arange(around) * 2 * np.pi / around
    ring = radius * (np.cos(angle)[:, None] * aside + np.sin(angle)[:, None] * np.cross(axis, aside))
    vertices = np.concatenate([start + ring, end + ring, [start, end]])
    i = np.arange(around)
    j = (i + 1) % around
    low, high = np.full(around, 2 * around), np.full(around, 2 * around + 1)
    faces = [(i, j, j + around), (i, j + around, i + around), (low, j, i), (high, i + around, j + around)]
    return vertices, np.concatenate([np.stack(face, axis=1) for face in faces])


def _joined(made: list[tuple[np.ndarray, np.ndarray]], name: str) -> TriangleMesh:
    before = np.cumsum([0] + [len(vertices) for vertices, _ in made])
    faces = [faces + first for (_, faces), first in zip(made, before, strict=False)]
    return _mesh(np.concatenate([vertices for vertices, _ in made]), np.concatenate(faces), name)
