"""Input of the demo: its mesh, and points and rays around it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._packages import remedy
from geokit.accuracy.stability.shapes import torus
from geokit.errors import MissingDependencyError
from geokit.mesh.model.triangle_mesh import TriangleMesh

# Segments around and across the torus that is generated if no mesh is found.
TORUS_SEGMENTS = (160, 80)
TORUS = f"a generated torus; for the Stanford bunny: {remedy('pxr')}, for a mesh of your own: --mesh FILE"

# Share of the half diagonal that has to fit into the picture; the full diagonal is rarely visible.
FRAMING = 0.85


def find_mesh() -> Path | None:
    """Path of the Stanford bunny in the installed warp package, else of a sample in the source tree, else None."""
    warp = importlib.util.find_spec("warp")
    candidates = (
        [Path(folder) / "examples/assets/bunny.usd" for folder in (warp.submodule_search_locations or ())]
        if warp
        else []
    )
    if importlib.util.find_spec("pxr") is None:
        candidates.clear()
    samples = Path(__file__).resolve().parents[3] / "data" / "samples"
    candidates += sorted(samples.glob("smooth*")) + sorted(samples.glob("*.obj")) + sorted(samples.glob("*.ply"))
    return next((path for path in candidates if path.is_file()), None)


def load_mesh(path: Path | None) -> tuple[TriangleMesh, str]:
    """Load a mesh, or generate a torus if there is no file; also return a text that says where it is from."""
    from geokit.mesh import load

    chosen = path or find_mesh()
    if chosen is None:
        return _torus(), TORUS
    try:
        return load(chosen), str(chosen)
    except MissingDependencyError:
        if path is not None:
            raise
        return _torus(), TORUS


def _torus() -> TriangleMesh:
    mesh = torus(*TORUS_SEGMENTS, minor=0.4)
    x, y, z = mesh.vertices.T
    return TriangleMesh(np.stack([x, z, -y], axis=1), mesh.faces, name="torus")


def points_on(
    mesh: TriangleMesh, count: int, random: np.random.Generator, *, by_area: bool = True
) -> NDArray[np.float64]:
    """Random points on the surface, shape (count, 3), uniform by area or with equal chances for each triangle."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = random.choice(len(area), size=count, p=area / area.sum() if by_area else None)
    # The square root makes the density uniform within a triangle.
    u, v = np.sqrt(random.random(count))[:, None], random.random(count)[:, None]
    return (1.0 - u) * a[face] + u * (1.0 - v) * b[face] + u * v * c[face]


class Camera(NamedTuple):
    """Rays of a pinhole camera, top row first: origins and unit directions, shape (height * width, 3)."""

    origins: NDArray[np.float64]
    directions: NDArray[np.float64]
    width: int
    height: int


def camera_rays(mesh: TriangleMesh, width: int, height: int) -> Camera:
    """A camera in front of the mesh, slightly to the right and above, that sees the whole mesh."""
    lower, upper = mesh.bounds
    center, radius = 0.5 * (lower + upper), 0.5 * mesh.diagonal * FRAMING
    towards = np.array([0.5, 0.32, 0.9])
    towards /= np.linalg.norm(towards)
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    up = np.cross(towards, right)
    tangent = 0.26
    eye = center + towards * radius / tangent
    x = ((np.arange(width) + 0.5) / width * 2.0 - 1.0) * tangent * width / height
    y = (1.0 - (np.arange(height) + 0.5) / height * 2.0) * tangent
    grid_x, grid_y = np.meshgrid(x, y)
    directions = (grid_x[..., None] * right + grid_y[..., None] * up - towards).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Camera(np.broadcast_to(eye, directions.shape).copy(), directions, width, height)
