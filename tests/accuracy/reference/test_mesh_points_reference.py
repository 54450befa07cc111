"""The float64 references against exact rational arithmetic, known shapes and themselves without culling."""

from __future__ import annotations

import ast
import inspect
import tracemalloc
from fractions import Fraction

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.reference import points as reference_points
from tests.support.reference import all_ray_hits

# A few roundings of the extent of the data, which is at most 4 here.
ROUNDING = 4e-15
EXTREMES = (2.0**-400, 2.0**-40, 1.0, 2.0**40, 2.0**400)


def exact(point):
    return [Fraction(float(x)) for x in point]


def minus(a, b):
    return [x - y for x, y in zip(a, b, strict=True)]


def dot(a, b):
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def exact_distance(corners, query):
    """To one triangle, rounded once or twice."""
    a, b, c = map(exact, corners)
    query = exact(query)
    squares = []
    for start, end in ((a, b), (b, c), (c, a)):
        along = minus(end, start)
        length = dot(along, along)
        t = min(max(dot(minus(query, start), along) / length, 0), 1) if length else Fraction(0)
        apart = minus([x + t * y for x, y in zip(start, along, strict=True)], query)
        squares.append(dot(apart, apart))
    normal = cross(minus(b, a), minus(c, a))
    sides = [dot(cross(minus(q, p), minus(query, p)), normal) for p, q in ((a, b), (b, c), (c, a))]
    if any(normal) and min(sides) >= 0:
        squares.append(dot(minus(query, a), normal) ** 2 / dot(normal, normal))
    return float(min(squares)) ** 0.5


def some_mesh(seed):
    """Triangles of all shapes: random ones, slivers, segments and points."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1.0, 1.0, (24, 3, 3))
    corners[6:12, 2] = corners[6:12, 0] + 1e-7 * rng.normal(size=(6, 3))
    corners[12:15, 2] = corners[12:15, 0]
    corners[15:18, 1:] = corners[15:18, :1]
    return corners.reshape(-1, 3), np.arange(72).reshape(-1, 3), rng


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_closest_point_of_exact_arithmetic(seed):
    vertices, faces, rng = some_mesh(seed)
    queries = rng.uniform(-1.5, 1.5, (20, 3))
    found = reference.closest_point(vertices, faces, queries)
    for query, distance in zip(queries, found.distance, strict=True):
        assert distance == pytest.approx(min(exact_distance(vertices[face], query) for face in faces), abs=ROUNDING)
    np.testing.assert_allclose(np.linalg.norm(found.points - queries, axis=1), found.distance, atol=ROUNDING)
    corners = vertices[faces[found.triangle_id]]
    np.testing.assert_allclose((found.barycentric[..., None] * corners).sum(axis=1), found.points, atol=1e-8)
    assert ((found.barycentric >= 0.0) & (found.barycentric <= 1.0)).all()


@pytest.mark.parametrize("query", [(0.25, 0.25, 3.0), (-1.0, -1.0, 0.0), (1e12, 0.0, 0.0), (0.25, 0.25, 0.0)])
def test_closest_point_of_one_triangle(query):
    found = reference.closest_point(np.eye(3), [[0, 1, 2]], [query])
    assert found.distance[0] == pytest.approx(exact_distance(np.eye(3), query), rel=1e-15, abs=1e-16)


def test_closest_point_ties_go_to_the_lowest_triangle():
    box = mesh_catalog.box()
    found = reference.closest_point(box.vertices, box.faces[::-1], [[0.5, 0.5, 0.5], [2.0, 2.0, 2.0]])
    assert found.triangle_id[0] == 0
    at_corner = np.flatnonzero((box.faces[::-1] == 7).any(axis=1))
    assert found.triangle_id[1] == at_corner.min()


@pytest.mark.parametrize("scale", EXTREMES)
def test_scaling_by_powers_of_two_scales_the_answers(scale):
    # Exactly: so that no product of four lengths runs out of range where lengths do not.
    torus, rng = mesh_catalog.torus(12, 8), np.random.default_rng(5)
    queries, directions = rng.uniform(-1.5, 1.5, (50, 3)), rng.normal(size=(50, 3))
    one = reference.closest_point(torus.vertices, torus.faces, queries)
    other = reference.closest_point(scale * torus.vertices, torus.faces, scale * queries)
    np.testing.assert_array_equal(other.distance, scale * one.distance)
    np.testing.assert_array_equal(other.triangle_id, one.triangle_id)
    if 1e-20 < scale < 1e20:  # volumes of rays are products of three lengths
        hits = reference.first_hit(torus.vertices, torus.faces, queries, directions)
        others = reference.first_hit(scale * torus.vertices, torus.faces, scale * queries, directions)
        np.testing.assert_array_equal(others.t, scale * hits.t)
    np.testing.assert_array_equal(
        reference.face_normals(scale * torus.vertices, torus.faces),
        reference.face_normals(torus.vertices, torus.faces),
    )


@pytest.mark.parametrize("block", [1, 777, 10**7])
def test_blocks_change_nothing(block, monkeypatch):
    torus, rng = mesh_catalog.torus(), np.random.default_rng(6)
    queries, directions = rng.uniform(-1.5, 1.5, (40, 3)), rng.normal(size=(40, 3))

    def answers():
        closest = reference.closest_point(torus.vertices, torus.faces, queries)
        hits = reference.first_hit(torus.vertices, torus.faces, queries, directions)
        return [*closest, *hits]

    expected = answers()
    winding = reference.winding_number(torus.vertices, torus.faces, queries)
    monkeypatch.setattr(reference, "BLOCK", block)
    for one, other in zip(expected, answers(), strict=True):
        np.testing.assert_array_equal(one, other)
    if block >= reference.QUERIES:
        turned = reference.winding_number(torus.vertices, torus.faces, queries)
        np.testing.assert_allclose(turned, winding, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(
    "mesh",
    [mesh_catalog.torus(), mesh_catalog.sliver_fan(), mesh_catalog.soup(mesh_catalog.box())],
    ids=lambda mesh: mesh.name,
)
def test_triangles_that_are_ruled_out_are_not_the_answer(mesh, monkeypatch):
    rng = np.random.default_rng(7)
    lower, upper = mesh.bounds
    spread = upper - lower
    queries = rng.uniform(lower - 0.2 * spread, upper + 0.2 * spread, (60, 3))
    directions = np.concatenate([rng.normal(size=(30, 3)), mesh.vertices[mesh.faces[:30].ravel()[:30]] - queries[30:]])
    closest = reference.closest_point(mesh.vertices, mesh.faces, queries)
    hits = reference.first_hit(mesh.vertices, mesh.faces, queries, directions)
    monkeypatch.setattr(reference, "SPHERE_MARGIN", 1e6)
    for one, other in zip(closest, reference.closest_point(mesh.vertices, mesh.faces, queries), strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(hits, reference.first_hit(mesh.vertices, mesh.faces, queries, directions), strict=True):
        np.testing.assert_array_equal(one, other)
    times, _ = all_ray_hits(mesh.vertices, mesh.faces, queries, directions)
    np.testing.assert_array_equal(hits.t, times.min(axis=1))
    assert np.isfinite(hits.t).any()


@pytest.mark.slow
def test_memory_is_bounded():
    sphere = mesh_catalog.icosphere(5)  # 20,480 faces
    # From so far away no triangle can be ruled out.
    far = np.random.default_rng(8).normal(size=(10, 3)) * 1e12
    rays = np.tile([0.0, 0.0, 1.0], (10, 1))
    for ask in (
        lambda: reference.closest_point(sphere.vertices, sphere.faces, far),
        lambda: reference.first_hit(sphere.vertices, sphere.faces, -1e12 * rays, rays),
        lambda: reference.winding_number(sphere.vertices, sphere.faces, far),
    ):
        tracemalloc.start()
        ask()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        # All pairs at once take 95 MB and more.
        assert peak < 40e6


def test_winding_numbers_of_boxes():
    box, nested = mesh_catalog.box(), mesh_catalog.nested_boxes()
    points = [[0.5, 0.5, 0.5], [2.0, 0.5, 0.5], [1e-9, 0.5, 0.5]]
    np.testing.assert_allclose(reference.winding_number(box.vertices, box.faces, points), [1, 0, 1], atol=1e-14)
    turned = reference.winding_number(box.vertices, box.faces[:, ::-1], points)
    np.testing.assert_allclose(turned, [-1, 0, -1], atol=1e-14)
    # One side of six, seen from the middle.
    side = box.faces[[0, 1]]
    np.testing.assert_allclose(reference.winding_number(box.vertices, side, points[:1]), [1 / 6], atol=1e-15)
    inside = reference.winding_number(nested.vertices, nested.faces, [[1.5, 1.5, 1.5], [0.5, 0.5, 0.5]])
    np.testing.assert_allclose(inside, [0, 1], atol=1e-14)


def test_signed_distance_of_a_box():
    box = mesh_catalog.box()
    found = reference.signed_distance(box.vertices, box.faces, [[0.5, 0.5, 0.25], [0.5, 0.5, 1.5]])
    np.testing.assert_allclose(found, [-0.25, 0.5], atol=1e-15)


@pytest.mark.parametrize("distance", [1.0, 1e3, 1e6])
def test_first_hit_of_exact_arithmetic(distance):
    vertices, faces, rng = some_mesh(11)
    targets = rng.uniform(-0.5, 0.5, (40, 3))
    directions = rng.normal(size=(40, 3))
    origins = targets - distance * directions
    found = reference.first_hit(vertices, faces, origins, directions)
    assert (found.triangle_id >= 0).sum() > 20
    for row in np.flatnonzero(found.triangle_id >= 0):
        a, b, c = map(exact, vertices[faces[found.triangle_id[row]]])
        start, way = exact(origins[row]), exact(directions[row])
        normal = cross(minus(b, a), minus(c, a))
        t = dot(normal, minus(a, start)) / dot(normal, way)
        slope = abs(float(dot(normal, way))) / np.sqrt(float(dot(normal, normal)) * float(dot(way, way)))
        assert abs(float(Fraction(float(found.t[row])) - t)) <= 8e-16 * distance / slope + 1e-15


@pytest.mark.parametrize("height", [1e-3, 1e-7, 1e-11])
def test_first_hit_of_slivers(height):
    rng = np.random.default_rng(14)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, height, 0]]) @ turn + rng.normal(size=3)
    directions = rng.normal(size=(50, 3))
    origins = rng.dirichlet([1, 1, 1], 50) @ corners - 2.0 * directions
    found = reference.first_hit(corners, [[0, 1, 2]], origins, directions)
    hits = np.flatnonzero(found.triangle_id == 0)
    assert len(hits) > 10
    a, b, c = map(exact, corners)
    normal = cross(minus(b, a), minus(c, a))
    for row in hits:
        t = dot(normal, minus(a, exact(origins[row]))) / dot(normal, exact(directions[row]))
        slope = abs(float(dot(normal, exact(directions[row])))) / float(dot(normal, normal)) ** 0.5
        assert abs(float(Fraction(float(found.t[row])) - t)) * slope < 4e-15


def test_triangles_without_area_are_never_hit():
    rng = np.random.default_rng(15)
    ends = rng.normal(size=(200, 2, 3))
    middle = 0.3 * ends[:, 0] + 0.7 * ends[:, 1]  # but for roundings, on the line
    corners = np.concatenate([ends, middle[:, None]], axis=1)
    origins = rng.normal(size=(200, 3)) * 3.0
    faces = np.arange(600).reshape(-1, 3)
    found = reference.first_hit(corners.reshape(-1, 3), faces, origins, middle - origins)
    assert (found.triangle_id == -1).all()


def test_first_hit_takes_the_nearest_and_knows_misses():
    nested = mesh_catalog.nested_boxes()
    origins, directions = [[1.5, 1.4, -1.0], [0.5, 0.6, 0.5], [9.0, 9.0, 9.0]], [[0, 0, 2.0], [0, 0, 1.0], [0, 0, 1.0]]
    found = reference.first_hit(nested.vertices, nested.faces, origins, directions)
    np.testing.assert_array_equal(found.t, [0.5, 2.5, np.inf])
    assert found.triangle_id[2] == -1
    assert not found.barycentric[2].any()
    np.testing.assert_allclose(found.barycentric[:2].sum(axis=1), 1.0)
    # The length of a ray is meant, not its parameter; its end belongs to it.
    within = reference.first_hit(nested.vertices, nested.faces, origins, directions, max_distance=1.0)
    np.testing.assert_array_equal(within.t, [0.5, np.inf, np.inf])
    short = reference.first_hit(nested.vertices, nested.faces, origins, directions, max_distance=0.999)
    np.testing.assert_array_equal(short.t, [np.inf] * 3)


def test_no_ray_leaks_through_an_edge():
    sphere, rng = mesh_catalog.icosphere(2), np.random.default_rng(12)
    edges = sphere.faces[rng.integers(len(sphere.faces), size=2000)][:, :2]
    share = rng.random((2000, 1))
    targets = share * sphere.vertices[edges[:, 0]] + (1 - share) * sphere.vertices[edges[:, 1]]
    starts = rng.uniform(-0.3, 0.3, (2000, 3))
    found = reference.first_hit(sphere.vertices, sphere.faces, starts, targets - starts)
    np.testing.assert_allclose(found.t, 1.0, atol=1e-13)


def test_face_normals():
    vertices = [[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 5]]
    found = reference.face_normals(vertices, [[0, 1, 2], [0, 2, 1], [0, 1, 1], [1, 2, 3]])
    np.testing.assert_array_equal(found[:3], [[0, 0, 1], [0, 0, -1], [0, 0, 0]])
    np.testing.assert_allclose(found[3], np.array([15, 10, 6]) / 19.0, atol=1e-16)


def test_neighbors_at_exactly_the_radius_count():
    lattice = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)
    found = reference.neighbors_within(lattice, lattice, 1.0)
    apart = np.abs(lattice[:, None] - lattice).sum(axis=2)
    for row, near in enumerate(found):
        np.testing.assert_array_equal(near, np.flatnonzero(apart[row] <= 1))
    assert [len(near) for near in reference.neighbors_within(lattice, [[1, 1, 1], [9, 9, 9]], 0.999)] == [1, 0]


@pytest.mark.parametrize("k", [1, 3, 7, 40, 64, 70])
@pytest.mark.parametrize("exclude_self", [False, True])
def test_k_nearest_of_a_full_sort(k, exclude_self):
    # A lattice: nearly all distances tie with others.
    lattice = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)
    distance, indices = reference.k_nearest(lattice, k, exclude_self=exclude_self)
    assert distance.shape == indices.shape == (64, k)
    for row, query in enumerate(lattice):
        squared = ((lattice - query) ** 2).sum(axis=1)
        order = sorted((s, j) for j, s in enumerate(squared) if not (exclude_self and j == row))[:k]
        assert indices[row].tolist() == [j for _, j in order] + [-1] * (k - len(order))
        np.testing.assert_array_equal(distance[row], [s**0.5 for s, _ in order] + [np.inf] * (k - len(order)))


def test_k_nearest_within_a_limit():
    line = np.arange(5.0)[:, None] * [1.0, 0.0, 0.0]
    distance, indices = reference.k_nearest(line, 3, line[:2], limit_squared=np.array([1.0, 0.5]))
    assert indices.tolist() == [[0, 1, -1], [1, -1, -1]]
    assert distance.tolist() == [[0.0, 1.0, np.inf], [0.0, np.inf, np.inf]]


def test_planes_through_neighbors():
    rng = np.random.default_rng(13)
    normal = np.array([1.0, 2.0, 2.0]) / 3.0
    flat = rng.normal(size=(50, 3))
    flat -= (flat @ normal)[:, None] * normal
    points = np.concatenate([flat + 1e3, np.zeros((4, 3)), np.eye(3), -np.eye(3)])
    found = reference.plane_normals(points, np.arange(50)[None])
    assert abs(found.normals[0] @ normal) == pytest.approx(1.0, abs=1e-15)
    assert 0.1 < found.gap[0] <= 1.0
    # All in one place, and the same in every direction: no plane is better than others.
    np.testing.assert_allclose(reference.plane_normals(points, [[50, 51, 52, 53]]).gap, 0.0)
    np.testing.assert_allclose(reference.plane_normals(points, [[54, 55, 56, 57, 58, 59]]).gap, 0.0, atol=1e-15)


@pytest.mark.parametrize("module", [reference, reference_points], ids=lambda module: module.__name__)
def test_shares_no_code_with_geokit(module):
    tree = ast.parse(inspect.getsource(module))
    names = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    names |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert {name for name in names if name.startswith("geokit")} <= {"geokit.accuracy.reference.points"}
    assert not any(name.startswith(("warp", "scipy")) for name in names)
