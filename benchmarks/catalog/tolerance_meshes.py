"""Meshes of many kinds for fields within a tolerance, and points around them."""

from __future__ import annotations

import numpy as np

from benchmarks.catalog import mesh_catalog
from geokit.mesh import TriangleMesh, sample_surface


def bumpy_sphere() -> TriangleMesh:
    sphere = mesh_catalog.icosphere(4)
    x, y, z = sphere.vertices.T
    radius = 1.0 + 0.05 * np.sin(9 * x) * np.sin(8 * y + 1) * np.sin(7 * z + 2)
    return TriangleMesh(sphere.vertices * radius[:, None], sphere.faces, name="bumpy")


MESHES = {
    "smooth": mesh_catalog.icosphere(4),
    "torus": mesh_catalog.torus(),
    "box": mesh_catalog.box(),
    "sharp": mesh_catalog.l_profile(),
    "needles": mesh_catalog.cone(24, 2.0),
    "thin": mesh_catalog.box((0, 0, 0), (1, 1, 0.02)),
    "bumpy": bumpy_sphere(),
    "open": mesh_catalog.open_shell(),
    "holed": mesh_catalog.holed_sphere(),
    "two bodies": mesh_catalog.join(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.icosphere(2), (4, 0, 0))),
    "nested": mesh_catalog.nested_boxes(),
    "tiny": mesh_catalog.scaled(mesh_catalog.torus(), 1e-6),
    "huge": mesh_catalog.scaled(mesh_catalog.tetrahedron(), 1e7),
    "far": mesh_catalog.far_away(mesh_catalog.torus(24, 12), 1e6),
}


def points_near(mesh: TriangleMesh, within: float, count: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    away = within * random.uniform(size=(count, 1)) * 0.999
    return sample_surface(mesh, count, seed=seed).points + away * directions
