"""An adaptive field keeps its tolerance on points that nobody looked at, on meshes of all kinds, wherever they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.catalog import mesh_catalog
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.volume.distance_fields.adaptive import adaptive_from_mesh
from tests.support import reference
from tests.support.effort import of_all, spread

pytestmark = pytest.mark.slow

EXAMPLES = settings(max_examples=of_all(2, 20), deadline=None)
# Of the longest edge of the mesh's box.
SHARE = 0.01
# All orders and codecs are searched by the first of these tests.
FEW = of_all({"order": 2, "codec": "fp8"}, {})
# Others search all of them.
SEARCHED = of_all({"overlapping": {"order": 1}, "torn": {"order": 2}, "smooth": {"order": 3, "codec": "fpn"}}, {})
MESHES = {
    "sharp": mesh_catalog.l_profile,
    "acute": mesh_catalog.tetrahedron,
    "thin": lambda: mesh_catalog.box((0, 0, 0), (1, 0.7, 0.004)),
    "needle": lambda: mesh_catalog.cone(9, 8.0),
    "smooth": lambda: mesh_catalog.icosphere(3),
    "nested": mesh_catalog.nested_boxes,
    "touching": mesh_catalog.two_boxes_touching_at_a_vertex,
    "overlapping": mesh_catalog.overlapping_spheres,
    "open": lambda: mesh_catalog.half_shell(mesh_catalog.icosphere()),
    "torn": lambda: mesh_catalog.holed_sphere(3),
    "with collapsed faces": mesh_catalog.collapsed_faces,
    "tiny": lambda: mesh_catalog.scaled(mesh_catalog.l_profile(), 1e-6),
    "huge and far": lambda: mesh_catalog.far_away(mesh_catalog.scaled(mesh_catalog.l_profile(), 1e4), 1e8),
}


def _worst(mesh, field, within, seed):
    """Largest error against brute force, on points of faces, edges and corners and up to ``within`` from them."""
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    corners = corners[rng.choice(len(corners), 150)]
    inner = np.einsum("nfk,fkd->nfd", rng.dirichlet([1, 1, 1], (6, len(corners))), corners).reshape(-1, 3)
    t = rng.uniform(size=(6, len(corners), 1))
    edges = (corners[:, 0] * t + corners[:, 1] * (1 - t)).reshape(-1, 3)
    points = np.concatenate([inner, edges, corners[:, 0]])
    direction = rng.normal(size=points.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points += direction * (rng.uniform(0.0, within, len(points)) * (rng.uniform(size=len(points)) < 0.6))[:, None]
    if field.levels[0].info.metadata["geokit:sign_method"] == "pseudonormal":
        exact = reference.signed_distance(mesh.vertices, mesh.faces, points)
    else:
        winding = reference.winding_number(mesh.vertices, mesh.faces, points)
        distance = reference.closest_point(mesh.vertices, mesh.faces, points).distance
        # Where the winding number passes a half away from the surface, rounding decides.
        exact = np.where(winding >= 0.5, -distance, distance)
        keep = np.abs(winding - 0.5) > 1e-2
        points, exact = points[keep | (distance < 1e-9)], exact[keep | (distance < 1e-9)]
    zone = np.abs(exact) <= within
    assert zone.sum() > 800
    return np.abs(field.sample(points, device="cpu") - exact)[zone].max()


# The profile of "sharp" is also far away and tiny.
@pytest.mark.parametrize("kind", spread((kind for kind in MESHES if kind != "sharp"), 5) + of_all([], ["sharp"]))
def test_the_tolerance_holds_on_other_points(kind):
    mesh = MESHES[kind]()
    tolerance = SHARE * float((mesh.bounds[1] - mesh.bounds[0]).max())
    with np.errstate(invalid="raise"):
        field = adaptive_from_mesh(mesh, tolerance, interior="keep", **SEARCHED.get(kind, {}), device="cpu")
    assert field.achieved_error <= tolerance
    within = field.levels[0].info.metadata["geokit:checked_within"]
    assert _worst(mesh, field, within, 31) <= tolerance


@EXAMPLES
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(of_all(0.01, 0.004), 0.1), wider=st.floats(0.0, 4.0))
def test_the_tolerance_holds_in_any_position_and_zone(seed, share, wider):
    mesh = mesh_catalog.turned(mesh_catalog.l_profile(), seed)
    tolerance = share * float((mesh.bounds[1] - mesh.bounds[0]).max())
    field = adaptive_from_mesh(mesh, tolerance, within=wider * tolerance, device="cpu")
    assert _worst(mesh, field, max(wider * tolerance, 1e-12), seed) <= tolerance


@EXAMPLES
@given(seed=st.integers(0, 2**32 - 1), exponent=st.integers(-20, 20))
def test_scaling_by_a_power_of_two_scales_everything(seed, exponent):
    mesh, factor = mesh_catalog.turned(mesh_catalog.l_profile(), seed), 2.0**exponent
    larger = TriangleMesh(mesh.vertices * factor, mesh.faces)
    fields = [adaptive_from_mesh(m, 0.1 * f, **FEW, device="cpu") for m, f in ((mesh, 1.0), (larger, factor))]
    assert fields[0].byte_count == fields[1].byte_count
    assert fields[1].voxel_sizes == tuple(factor * size for size in fields[0].voxel_sizes)
    points = np.random.default_rng(seed).uniform(mesh.bounds[0] - 0.2, mesh.bounds[1] + 0.2, (2000, 3))
    a, b = (f.sample(points * scale, device="cpu") for f, scale in zip(fields, (1.0, factor), strict=True))
    np.testing.assert_allclose(b, a * factor, rtol=0, atol=1e-6 * factor)
