"""Meshes, queries and rays shared by the benchmarks; all random choices are seeded."""

from __future__ import annotations

import numpy as np

from geokit.mesh import TriangleMesh


def bunny() -> TriangleMesh:
    """The Stanford bunny from warp's wheel, 12,200 triangles; a bumpy torus if it cannot be read."""
    import os

    import warp as wp

    from geokit import GeokitError, mesh

    try:
        return mesh.load(os.path.join(os.path.dirname(wp.__file__), "examples", "assets", "bunny.usd"))
    except GeokitError:
        return bumpy_torus(110, 55)


def bunny_of(triangles: int) -> TriangleMesh:
    """The bunny with every triangle split into four until the number is reached: 195,200 and 3,123,200 among others.

    Vertices are rounded to float32, so that peers of either precision have the same mesh.
    """
    mesh = bunny()
    while len(mesh.faces) < triangles:
        mesh = subdivided(mesh, 1)
    return TriangleMesh(in_float32(mesh.vertices), mesh.faces, name=mesh.name)


def bumpy_torus(around: int, across: int) -> TriangleMesh:
    """A closed surface with waves on it, ``2 * around * across`` triangles."""
    u, v = np.meshgrid(np.arange(around) / around, np.arange(across) / across, indexing="ij")
    a, b = 2 * np.pi * u.ravel(), 2 * np.pi * v.ravel()
    tube = 0.4 + 0.05 * np.sin(9 * a) * np.cos(5 * b)
    ring = 1.0 + tube * np.cos(b)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    at = lambda i, j: (i % around) * across + j % across  # noqa: E731
    faces = np.concatenate(
        [
            np.stack([at(i, j), at(i + 1, j), at(i + 1, j + 1)], axis=1),
            np.stack([at(i, j), at(i + 1, j + 1), at(i, j + 1)], axis=1),
        ]
    )
    return TriangleMesh(np.stack([ring * np.cos(a), ring * np.sin(a), tube * np.sin(b)], axis=1), faces, name="torus")


def subdivided(mesh: TriangleMesh, times: int) -> TriangleMesh:
    """Each triangle split into four at the midpoints of its edges, ``times`` times."""
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)
    for _ in range(times):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        keys, inverse = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True)
        first, second = np.divmod(keys, len(vertices))
        ab, bc, ca = (len(vertices) + part for part in np.split(inverse, 3))
        vertices = np.concatenate([vertices, (vertices[first] + vertices[second]) / 2])
        a, b, c = faces.T
        faces = np.concatenate(
            [np.stack(corners, axis=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    return TriangleMesh(vertices, faces, name=mesh.name)


def without_faces(mesh: TriangleMesh, share: float, seed: int = 0) -> TriangleMesh:
    """The mesh without a random ``share`` of its faces: one hole each."""
    kept = np.random.default_rng(seed).random(len(mesh.faces)) >= share
    return TriangleMesh(mesh.vertices, mesh.faces[kept], name=mesh.name)


def in_float32(values: np.ndarray) -> np.ndarray:
    """Values rounded to float32, in float64, so that peers of either precision get the same input."""
    return values.astype(np.float32).astype(np.float64)


def in_morton_order(points: np.ndarray) -> np.ndarray:
    """The points along a Morton curve of 1024 cells a side."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    cells = np.minimum((points - lower) / (upper - lower).max() * 1024, 1023).astype(np.int64)
    keys = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return points[np.argsort(keys, kind="stable")]


def uniform(mesh: TriangleMesh, count: int, seed: int = 0) -> np.ndarray:
    """Points in 1.5 times the bounding box."""
    lower, upper = mesh.bounds
    return (lower + upper) / 2 + (np.random.default_rng(seed).random((count, 3)) - 0.5) * (upper - lower) * 1.5


def near(mesh: TriangleMesh, count: int, seed: int = 0, sigma: float = 0.01) -> np.ndarray:
    """Points around the surface, normally distributed with ``sigma`` as a share of the longest side."""
    rng = np.random.default_rng(seed)
    center = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=count)]].mean(axis=1)
    return center + rng.normal(0, sigma * (mesh.bounds[1] - mesh.bounds[0]).max(), (count, 3))


def random_rays(mesh: TriangleMesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from anywhere in 1.5 times the box in any direction."""
    directions = np.random.default_rng(seed + 1).normal(size=(count, 3))
    return uniform(mesh, count, seed), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def camera_rays(mesh: TriangleMesh, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays of a pinhole camera in front of the mesh, row by row."""
    lower, upper = mesh.bounds
    size = (upper - lower).max()
    x, y = np.meshgrid((np.arange(width) + 0.5) / width - 0.5, 0.5 - (np.arange(height) + 0.5) / height)
    directions = np.stack([x * width / height, y, np.full_like(x, -1.2)], axis=-1).reshape(-1, 3)
    origin = (lower + upper) / 2 + [0, 0, 1.8 * size]
    return np.broadcast_to(origin, directions.shape).copy(), directions


def surface_points(mesh: TriangleMesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points in triangles drawn with equal probability, and the normals there."""
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=count)]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return np.einsum("nc,ncd->nd", rng.dirichlet(np.ones(3), size=count), corners), normals


def surface_rays(
    mesh: TriangleMesh, count: int, seed: int = 0, start: float = 0.01, least: float = 0.1
) -> tuple[np.ndarray, np.ndarray]:
    """Rays from points of the surface to others, starting at ``start`` of the way.

    At the surface itself, rounding would decide whether a ray hits the triangle that it leaves. Both ends are therefore
    at least ``least`` diagonals apart, and the sine between a ray and the triangle that it leaves is at least
    ``least``.
    """
    origins, directions = np.zeros((0, 3)), np.zeros((0, 3))
    while len(origins) < count:
        a, normals = surface_points(mesh, 2 * count, seed)
        way = surface_points(mesh, 2 * count, seed + 1)[0] - a
        length = np.linalg.norm(way, axis=1)
        steep = np.abs(np.einsum("nd,nd->n", normals, way)) > least * length
        kept = steep & (length > least * mesh.diagonal)
        origins = np.concatenate([origins, (a + start * way)[kept]])
        directions = np.concatenate([directions, way[kept]])
        seed += 2
    return origins[:count], directions[:count]


def aimed_rays(mesh: TriangleMesh, start: np.ndarray, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from one point at vertices (first half) and edges (second half) of the mesh."""
    rng = np.random.default_rng(seed)
    face = mesh.faces[rng.integers(len(mesh.faces), size=count)]
    share = rng.random((count, 1))
    share[: count // 2] = 1.0
    targets = mesh.vertices[face[:, 0]] * share + mesh.vertices[face[:, 1]] * (1.0 - share)
    return np.broadcast_to(start, targets.shape).copy(), targets - start
