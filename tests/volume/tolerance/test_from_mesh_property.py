"""Distance fields that keep a tolerance: on meshes of many kinds, judged by brute force at points of other seeds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.catalog.tolerance_meshes import MESHES, points_near
from geokit.mesh import Surface, TriangleMesh
from geokit.volume import from_mesh
from geokit.volume.tolerance.from_mesh import make_setting, tolerance_search
from geokit.volume.tolerance.search import Option, Setting
from tests.support import reference
from tests.support.effort import of_all, spread

pytestmark = pytest.mark.slow

DEVICE = "cpu"
# Of the diagonal: coarse enough for a mesh to take a second, fine enough for edges and curvature to matter.
SHARE = of_all(8e-3, 4e-3)
JUDGED = of_all(600, 1500)


def diagonal(mesh: TriangleMesh) -> float:
    return float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))


@pytest.mark.parametrize("name", spread(MESHES, 6))
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


@pytest.mark.parametrize("name", of_all(["sharp"], ["torus", "sharp", "thin"]))
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
