"""An adaptive field keeps its tolerance at every order and codec, and while a detail shrinks, also with one level."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.mesh import TriangleMesh, sample_surface
from geokit.volume.adaptive.choice import levels_of
from geokit.volume.distance_fields.adaptive import AdaptiveSDF, _checked, adaptive_from_mesh
from geokit.volume.tolerance.from_mesh import tolerance_search
from tests.support import reference
from tests.support.effort import of_all

pytestmark = pytest.mark.slow

TOLERANCE = 0.004


def ball_and_cube(size: float) -> tuple[TriangleMesh, TriangleMesh]:
    """A ball of radius 1 with a turned cube beside it, and the cube alone."""
    turn = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0]
    cube = mesh_catalog.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    cube = TriangleMesh(size * cube.vertices @ (turn * np.sign(np.linalg.det(turn))).T + [1.2, 0.0, 0.0], cube.faces)
    return mesh_catalog.join(mesh_catalog.icosphere(3), cube), cube


def levels_only(
    mesh: TriangleMesh, tolerance: float, order: int | None, codec: str | None, max_levels: int = 12
) -> AdaptiveSDF:
    """The field of several voxel sizes, whether or not one takes fewer bytes."""
    search = tolerance_search(
        mesh,
        tolerance,
        within=None,
        order=order,
        half_width=None,
        sign="auto",
        thickness=None,
        interior="keep",
        codec=codec,
        device="cpu",
    )
    return _checked(levels_of(search, max_levels).tree, "levels", tolerance)[0]


def worst(field: AdaptiveSDF, mesh: TriangleMesh, parts: list[TriangleMesh], within: float) -> float:
    """Largest error against brute force at points on and beside faces, edges and corners of some parts of a mesh."""
    random = np.random.default_rng(31)
    found = []
    for part in parts:
        corners = part.vertices[part.faces]
        t = random.uniform(size=(4, len(corners), 1))
        edges = (corners[:, 0] * t + corners[:, 1] * (1.0 - t)).reshape(-1, 3)
        found += [sample_surface(part, 1000, seed=7).points, random.permutation(edges)[:800], part.vertices[:200]]
    points = np.concatenate(found)
    away = random.normal(size=points.shape)
    away *= within * random.uniform(size=(len(points), 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    points += away * (random.uniform(size=(len(points), 1)) < 0.7)
    exact = reference.signed_distance(mesh.vertices, mesh.faces, points)
    zone = np.abs(exact) <= within
    assert zone.sum() > 1000
    return float(np.abs(field.sample(points, device="cpu") - exact)[zone].max())


@pytest.mark.parametrize(
    ("order", "codec"),
    of_all(
        [(1, "fp8"), (2, "fpn"), (3, None)],
        [(1, "float"), (1, "fp4"), (1, None), (2, "fp8"), (2, "fpn"), (3, "fp16"), (3, "fpn"), (3, None)],
    ),
)
def test_the_tolerance_holds_at_every_order_and_codec(order, codec):
    mesh, cube = ball_and_cube(0.1)
    field = levels_only(mesh, TOLERANCE, order, codec)
    assert field.order == order
    assert field.level_count > 1
    if codec is not None:
        assert set(field.codecs) == {codec}
    error = worst(field, mesh, [mesh, cube], TOLERANCE)
    assert 0.2 * TOLERANCE < error <= TOLERANCE


@pytest.mark.parametrize("size", of_all([0.003], [0.3, 0.1, 0.03, 0.01, 0.003]))
def test_the_tolerance_holds_while_a_detail_shrinks(size):
    mesh, cube = ball_and_cube(size)
    field = adaptive_from_mesh(mesh, TOLERANCE, interior="keep", device="cpu")
    assert field.achieved_error <= TOLERANCE
    assert worst(field, mesh, [mesh, cube], TOLERANCE) <= TOLERANCE


@pytest.mark.parametrize("share", of_all([3e-2, 1e-3], [3e-2, 1e-2, 3e-3, 1e-3]))
def test_the_tolerance_holds_while_it_shrinks(share):
    mesh = mesh_catalog.l_profile()
    tolerance = share * float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    assert worst(adaptive_from_mesh(mesh, tolerance, device="cpu"), mesh, [mesh], tolerance) <= tolerance
