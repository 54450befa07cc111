"""Distance fields that keep a tolerance: on meshes of many kinds, judged by brute force at points of other seeds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from geokit.mesh import Surface, TriangleMesh, sample_surface
from geokit.volume import from_mesh
from geokit.volume.tolerance.from_mesh import make_setting, tolerance_search
from geokit.volume.tolerance.search import Option, Setting
from tests.support import mesh_catalog, reference

pytestmark = pytest.mark.slow

DEVICE = "cpu"
# Of the diagonal: coarse enough for a mesh to take a second, fine enough for edges and curvature to matter.
SHARE = 4e-3
JUDGED = 1500


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


def diagonal(mesh: TriangleMesh) -> float:
    return float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))


def points_near(mesh: TriangleMesh, within: float, count: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    away = within * random.uniform(size=(count, 1)) * 0.999
    return sample_surface(mesh, count, seed=seed).points + away * directions


@pytest.mark.parametrize("name", MESHES)
def test_the_tolerance_is_kept_at_points_that_nobody_has_seen(name):
    mesh = MESHES[name]
    tolerance = SHARE * diagonal(mesh)
    field = from_mesh(mesh, tolerance=tolerance, device=DEVICE)
    info = field.info
    assert info.tolerance == tolerance
    assert 0.0 < info.achieved_error_999 <= info.achieved_error <= tolerance
    within = info.metadata["geokit:checked_within"]
    assert within == (tolerance if Surface(mesh, device=DEVICE).is_closed else 0.25 * tolerance)
    points = points_near(mesh, within, JUDGED, seed=2_000_003)
    # Far from the origin brute force would lose digits that the mesh does not have: both are moved back, exactly.
    origin = np.round(mesh.vertices.mean(axis=0))
    exact = reference.signed_distance(mesh.vertices - origin, mesh.faces, points - origin)
    error = np.abs(field.sample(points, device=DEVICE) - exact)
    assert error.max() <= tolerance
    assert error.max() > 0.1 * info.achieved_error


def least_bytes(search, within_points, exact) -> float:
    """Of all settings on a ladder of voxel sizes, made and measured, the least that keeps the tolerance."""
    best = math.inf
    for size in search.zone.longest / 4.0 * 2.0 ** (-np.arange(0, 24) / 4.0):
        for option in search.options:
            width = search.width_of(option, size)
            setting = Setting(option, size, width, 0.0, search.memory.counts(size, width * size), 0.0)
            field = make_setting(search, setting)
            error = np.abs(field.sample(within_points, order=option.order, device=DEVICE) - exact).max()
            if error <= search.tolerance:
                best = min(best, field.info.byte_count)
        if best < search.memory.counts(size, 2.0 * size).bytes_of("fp4"):
            return best
    return best


@pytest.mark.parametrize("name", ["torus", "sharp", "thin"])
def test_memory_is_near_the_least_that_an_exhaustive_search_finds(name):
    mesh = MESHES[name]
    tolerance = SHARE * diagonal(mesh)
    found = from_mesh(mesh, tolerance=tolerance, device=DEVICE)
    asked = {"within": None, "order": None, "half_width": None, "sign": "auto", "thickness": None, "codec": None}
    search = tolerance_search(mesh, tolerance, **asked, device=DEVICE)
    search.options = [Option(order, codec) for order in (1, 2, 3) for codec in ("float", "fp8", "fp4")]
    points = points_near(mesh, tolerance, 20_000, seed=11)
    exact = Surface(mesh, device=DEVICE).signed_distance(points).distance
    assert found.info.byte_count <= 1.5 * least_bytes(search, points, exact)
