"""Where distances at sharp edges are less exact: tips, ends of concave edges, and what is thinner than a voxel."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.spatial import ConvexHull, HalfspaceIntersection

from geokit import native
from geokit.mesh import Surface, TriangleMesh
from geokit.volume._morphology import closing, dilate, erode, opening
from tests.support.analytic_volumes import active_voxels, level_set
from tests.support.edged_bodies import cuboid, extruded, outline, polygon, revolved, turned
from tests.support.effort import of_all

pytestmark = [pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB"), pytest.mark.slow]

ODD = ((0.31, 0.47, 0.73), (0.3, 0.2, -0.1))


def found(volume, true):
    points, values = active_voxels(volume)
    return np.abs(values - np.clip(true(points), -3.0, 3.0))


def cone(distance, radius, height):
    slant = np.hypot(radius, height)
    top, bottom = height / 2 - distance * slant / radius, -height / 2 + distance
    end = radius * (top - bottom) / height
    return turned(revolved(polygon([(-end, bottom), (end, bottom), (0.0, top)])), *ODD)


def angle_section(distance):
    """An L without the quadrant from (1, 1) on, whose concave edge becomes an arc as it erodes."""
    a, n = 13.0 - distance, 1.0 - distance
    start = np.array([(-a, -a), (a, -a), (a, n), (n, a), (-a, a)])
    end = np.array([(a, -a), (a, n), (1.0, n), (-a, a), (-a, -a)])
    start = np.concatenate([start, [(n, 1.0)]])
    end = np.concatenate([end, [(n, a)]])
    arcs = np.array([[1.0, 1.0, distance, np.pi, 1.5 * np.pi]])

    def inside(p):
        beyond = np.linalg.norm(np.maximum(1.0 - p, 0.0), axis=1)
        return (np.abs(p).max(axis=1) < a) & (beyond > distance)

    return turned(extruded(outline(start, end, arcs, inside), 11.0 - distance), *ODD)


@pytest.mark.parametrize(
    ("size", "distance"),
    of_all([((13.0, 22.0), 4.0), ((12.5, 15.0), 1.0)], [*product([(13.0, 22.0), (12.5, 15.0)], [1.0, 2.6, 4.0])]),
)
def test_cones(size, distance):
    body = level_set(cone(0.0, *size))
    true = cone(distance, *size)
    assert found(erode(body, distance), true).max() < 0.4
    assert found(opening(body, distance), lambda p: true(p) - distance).max() < 0.5


@pytest.mark.parametrize("distance", [1.0, 2.6, 5.0])
def test_ends_of_concave_edges(distance):
    errors = found(erode(level_set(angle_section(1e-9)), distance), angle_section(distance))
    assert errors.max() < 0.7
    assert np.mean(errors > 0.3) < 0.01


def test_less_than_a_voxel_is_left():
    half = np.array([12.0, 11.0, 2.9])
    body, core = level_set(turned(cuboid(half), *ODD)), turned(cuboid(half - 2.6), *ODD)
    assert found(erode(body, 2.6), core).max() < 0.4
    assert found(opening(body, 2.6), lambda p: core(p) - 2.6).max() < 1.0


@pytest.mark.parametrize("distance", of_all([6.0], [1.0, 4.0, 6.0]))
@pytest.mark.parametrize("pose", [ODD, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))])
def test_closing_of_boxes(distance, pose):
    box = turned(cuboid(np.array([12.0, 10.5, 9.3])), *pose)
    assert found(closing(level_set(box), distance), box).max() < 0.6


def test_the_worst_closing_that_was_found():
    box, distance = random_box(234, (7.0, 12.0), (0.5, 6.0))
    errors = found(closing(level_set(box), distance), box)
    assert errors.max() < 1.5
    assert np.mean(errors > 0.7) < 2e-4


def test_dilation_within_the_band():
    box = turned(cuboid(np.array([12.0, 10.5, 9.3])), *ODD)
    assert found(dilate(level_set(box), 1.0), lambda p: box(p) - 1.0).max() < 0.3


def random_box(seed, sizes, distances):
    rng = np.random.default_rng(seed)
    pose = rng.uniform(-3.0, 3.0, 3), rng.uniform(-0.5, 0.5, 3)
    distance = rng.uniform(*distances)
    return turned(cuboid(rng.uniform(*sizes, 3)), *pose), distance


@pytest.mark.parametrize(("seed", "share"), [(28, 3e-4), (45, 0.0)])
def test_the_worst_dilations_within_the_band_that_were_found(seed, share):
    box, distance = random_box(seed, (4.0, 10.0), (0.3, 2.9))
    errors = found(dilate(level_set(box), distance), lambda p: box(p) - distance)
    assert errors.max() < 0.6
    assert np.mean(errors > 0.3) <= share


@pytest.mark.parametrize("seed", [232, 257])
def test_the_worst_dilations_beyond_the_band_that_were_found(seed):
    box, distance = random_box(seed, (7.0, 12.0), (0.5, 6.0))
    errors = found(dilate(level_set(box), distance), lambda p: box(p) - distance)
    assert errors.max() < 1.5
    assert np.mean(errors > 0.3) < 0.001


@pytest.mark.parametrize(("distance", "most"), of_all([(4.5, 0.7)], [(0.8, 0.3), (2.0, 0.3), (4.5, 0.7)]))
def test_a_room_that_becomes_smaller(distance, most):
    """Concave edges and corners, which stay sharp where the body grows."""
    room = np.array([9.0, 8.0, 10.5])
    walls, space = turned(cuboid(np.full(3, 18.0)), *ODD), turned(cuboid(room), *ODD)
    smaller = turned(cuboid(room - distance), *ODD)

    def grown(p):
        return np.maximum(walls(p) - distance, -smaller(p))

    body = level_set(lambda p: np.maximum(walls(p), -space(p)), leaves=5)
    assert found(dilate(body, distance), grown).max() < most


@pytest.mark.parametrize("distance", of_all([4.2], [1.3, 4.2]))
def test_dilated_tori(distance):
    def torus(tube):
        return turned(lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - 32.0, p[:, 2]) - tube, *ODD)

    errors = found(dilate(level_set(torus(12.0), leaves=7), distance), torus(12.0 + distance))
    assert 0.05 < errors.max() < 0.15
    assert np.mean(errors > 0.05) < 0.002


def polyhedron(seed):
    """Fourteen random planes and six of a turned cube; erosion moves them all."""
    rng = np.random.default_rng(seed)
    turn, normal = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=(14, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normals, center = np.concatenate([normal, turn, -turn]), rng.uniform(-0.5, 0.5, 3)
    away = np.concatenate([np.full(14, 10.0), np.full(6, 11.0)]) + normals @ center

    def eroded(distance):
        corners = HalfspaceIntersection(np.c_[normals, distance - away], center).intersections
        surface = Surface(TriangleMesh(corners, ConvexHull(corners).simplices), device="cpu")
        return lambda points: surface.signed_distance(points).distance

    return eroded, rng.uniform(0.5, 4.5)


@pytest.mark.parametrize("seed", of_all([5], range(6)))
def test_polyhedra_of_many_faces(seed):
    eroded, distance = polyhedron(seed)
    body, core = level_set(eroded(0.0)), eroded(distance)
    errors = [
        found(erode(body, distance), core),
        found(opening(body, distance), lambda p: core(p) - distance),
        found(closing(body, distance), eroded(0.0)),
    ]
    assert max(e.max() for e in errors) < 3.0
    assert max(np.mean(e > 0.3) for e in errors) < 0.001
