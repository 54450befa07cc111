"""hausdorff: known shapes, dense samples by the plain reference, bounds, blocks and every error."""

from __future__ import annotations

import importlib
import math
import os
from unittest import mock

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.errors import InputError
from geokit.mesh import Surface, TriangleMesh
from geokit.mesh._hausdorff import DirectedDistance, HausdorffDistance, hausdorff
from tests.support import reference

EMPTY = TriangleMesh(np.empty((0, 3)), np.empty((0, 3), int))
# closest_point is good to 1e-12 of a diagonal.
ROUNDING = 4e-12


def plate(lower, upper, height, steps=1):
    """A rectangle in the plane z = height, of 2 steps^2 triangles."""
    x, y = (np.linspace(lower[k], upper[k], steps + 1) for k in range(2))
    vertices = [[u, v, height] for v in y for u in x]
    width = steps + 1
    corners = [j * width + i for j in range(steps) for i in range(steps)]
    faces = [t for k in corners for t in ([k, k + 1, k + width + 1], [k, k + width + 1, k + width])]
    return TriangleMesh(vertices, faces, name="plate")


def points_as_mesh(points):
    """Each point as a triangle without area."""
    return TriangleMesh(points, [[i, i, i] for i in range(len(points))], name="points")


def turned(mesh, seed):
    """The mesh in a random rotation."""
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return TriangleMesh(mesh.vertices @ rotation, mesh.faces, name=mesh.name)


def spun(mesh, angle):
    """The mesh rotated around the z axis."""
    cosine, sine = math.cos(angle), math.sin(angle)
    rotation = [[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]
    return TriangleMesh(mesh.vertices @ rotation, mesh.faces, name=mesh.name)


def joint_diagonal(a, b):
    used = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh in (a, b)])
    return float(np.linalg.norm(np.ptp(used, axis=0)))


def dense_bounds(source, target):
    """The largest distance of lattice points of each triangle, and that plus the largest distance to a lattice
    point."""
    # The reference takes a microsecond for each pair of a point and a triangle.
    steps = max(2, int(math.sqrt(3e5 / len(source.faces) / len(target.faces))))
    weights = np.array([[i, j, steps - i - j] for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
    corners = source.vertices[source.faces]
    points = np.einsum("wc,fck->fwk", weights, corners).reshape(-1, 3)
    distance = reference.closest_point(target.vertices, target.faces, points).distance
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    return distance.max(), distance.max() + longest / steps


def assert_certified(found, source, target, tolerance, dense):
    """The bracket is as narrow as promised, and contains the largest distance by the reference within its accuracy."""
    diagonal = joint_diagonal(source, target)
    low, high = dense
    assert found.max <= found.upper <= found.max + (tolerance + ROUNDING) * diagonal
    assert found.upper >= low - ROUNDING * diagonal
    assert found.max <= high + ROUNDING * diagonal
    # The witness points are valid: one lies on its surface, the other is its closest point on the other surface.
    assert reference.closest_point(source.vertices, source.faces, found.point[None]).distance < ROUNDING * diagonal
    closest = reference.closest_point(target.vertices, target.faces, found.point[None])
    assert closest.distance == pytest.approx(found.max, abs=ROUNDING * diagonal)
    assert np.linalg.norm(found.point - found.closest_point) == pytest.approx(found.max, abs=ROUNDING * diagonal)


def test_parallel_triangles():
    low = mesh_catalog.single_triangle()
    found = hausdorff(low, mesh_catalog.moved(low, (0, 0, 2)), device="cpu")
    assert isinstance(found, HausdorffDistance)
    assert isinstance(found.a_to_b, DirectedDistance)
    assert (found.max, found.upper, found.mean, found.rms) == (2.0, 2.0, 2.0, 2.0)
    for one, z in ((found.a_to_b, 0.0), (found.b_to_a, 2.0)):
        assert (one.max, one.upper, one.mean, one.rms) == (2.0, 2.0, 2.0, 2.0)
        assert (one.mean_error, one.rms_error) == (0.0, 0.0)
        assert one.point[2] == z
        assert one.closest_point.tolist() == [*one.point[:2], 2.0 - z]
    assert (found.point_a[2], found.point_b[2]) == (0.0, 2.0)


@pytest.mark.parametrize(
    "make", [*mesh_catalog.CLOSED, *mesh_catalog.OPEN, *mesh_catalog.DEFECTIVE], ids=lambda m: m.__name__
)
def test_a_mesh_is_zero_away_from_itself(make):
    mesh = make()
    found = hausdorff(mesh, TriangleMesh(mesh.vertices, mesh.faces), samples=500, device="cpu")
    assert found.max == 0.0
    assert found.upper <= 1e-15 * mesh.diagonal
    assert found.mean <= 1e-15 * mesh.diagonal


def test_other_triangles_of_the_same_plane_are_zero_away():
    fine, coarse = plate((0, 0), (3, 2), 0.0, steps=7), plate((0, 0), (3, 2), 0.0, steps=3)
    for tolerance in (1e-4, 1e-10):
        found = hausdorff(fine, coarse, tolerance=tolerance, samples=100, device="cpu")
        assert found.max <= 1e-14
        assert found.upper <= tolerance * math.hypot(3, 2)


def test_a_part_of_a_plane():
    whole, part = plate((0, 0), (4, 4), 1.0, steps=5), plate((1, 1), (3, 2), 1.0)
    found = hausdorff(part, whole, device="cpu")
    assert found.a_to_b.max <= 1e-15
    assert found.a_to_b.upper <= 1e-4 * whole.diagonal
    # From the upper corners of the whole, at (0, 4) and (4, 4), to those of the part.
    assert found.b_to_a.max == pytest.approx(math.hypot(1, 2), abs=1e-14)
    assert found.max == found.b_to_a.max
    assert found.point_b[1] == 4.0
    assert found.point_a.tolist() == [1.0 if found.point_b[0] == 0 else 3.0, 2.0, 1.0]


def test_a_shifted_box():
    found = hausdorff(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.box(), (0.3, 0, 0)), device="cpu")
    assert found.max == pytest.approx(0.3, abs=1e-15)
    assert found.upper == pytest.approx(0.3, abs=1e-4 * math.hypot(1.3, 1, 1))
    # Of six unit faces: the one that moved is 0.3 away; the opposite one is inside the other box, where the distance is
    # the smaller of 0.3 and that to the border; of the others a strip 0.3 wide extends beyond.
    inside = (1 - 0.4**3) / 6
    mean = (0.3 + inside + 4 * 0.3**2 / 2) / 6
    squares = (0.3**2 + 8 * (0.3**3 / 6 - 0.3**4 / 4) + 0.4**2 * 0.3**2 + 4 * 0.3**3 / 3) / 6
    for one in (found.a_to_b, found.b_to_a):
        assert abs(one.mean - mean) < 5 * one.mean_error
        assert abs(one.rms - math.sqrt(squares)) < 5 * one.rms_error
        assert 0 < one.mean_error < 0.01 * one.mean
        assert 0 < one.rms_error < 0.01 * one.rms


def test_concentric_spheres():
    inner, outer = mesh_catalog.icosphere(4), mesh_catalog.icosphere(4, 1.25)
    found = hausdorff(inner, outer, samples=10_000, device="cpu")
    # Vertex above vertex, and distances between 0.2495 and 0.25 everywhere: little can be ruled out early.
    assert found.max == pytest.approx(0.25, abs=1e-14)
    assert found.upper == pytest.approx(0.25, abs=1e-4 * outer.diagonal)
    assert found.a_to_b.mean == pytest.approx(0.25, abs=1e-3)
    coarse = mesh_catalog.icosphere(2, 1.25)
    found = hausdorff(inner, coarse, tolerance=1e-6, samples=10, device="cpu")
    # The sphere's vertices are closest to the middles of the coarse faces, or not far from there.
    middles = np.linalg.norm(coarse.vertices[coarse.faces].mean(axis=1), axis=1)
    assert middles.min() - 1 - 1e-3 < found.a_to_b.max < 0.25
    assert found.b_to_a.max == pytest.approx(0.25, abs=1e-3)


def test_the_largest_distance_may_be_within_a_triangle():
    # From the corners alone: at the circumcenter the covering bound has no slack at all.
    corners = np.array([[0, 0, 0], [1, 0, 0], [0.5, math.sqrt(0.75), 0]])
    triangle = TriangleMesh(corners, [[0, 1, 2]])
    for tolerance in (1e-3, 1e-9):
        found = hausdorff(triangle, points_as_mesh(corners), tolerance=tolerance, samples=10, device="cpu")
        assert found.a_to_b.max == pytest.approx(1 / math.sqrt(3), abs=1.5 * tolerance)
        assert found.a_to_b.upper >= 1 / math.sqrt(3) - 1e-15
        np.testing.assert_allclose(found.a_to_b.point, corners.mean(axis=0), atol=2 * tolerance)
        assert found.b_to_a.max == 0.0
    right = hausdorff(
        mesh_catalog.single_triangle(), points_as_mesh(mesh_catalog.single_triangle().vertices), device="cpu"
    )
    assert right.a_to_b.max == pytest.approx(math.sqrt(0.5), abs=2e-4)
    assert right.a_to_b.upper >= math.sqrt(0.5)


def test_a_ridge_between_two_sheets():
    sheets = mesh_catalog.join(plate((-9, -9), (9, 9), 0.0, steps=3), plate((-9, -9), (9, 9), 1.0, steps=4))
    ramp = TriangleMesh([[0, 0, 0], [1, 0, 0], [1, 1, 1], [0, 1, 1]], [[0, 1, 2], [0, 2, 3]])
    found = hausdorff(ramp, sheets, tolerance=1e-9, samples=0, device="cpu").a_to_b
    assert found.max == pytest.approx(0.5, abs=1e-7)
    assert found.upper >= 0.5 - 1e-15
    assert found.point[2] == pytest.approx(0.5, abs=1e-7)


PAIRS = {
    "torus, sphere": (mesh_catalog.torus(10, 6), mesh_catalog.icosphere(1)),
    "sphere, box": (mesh_catalog.icosphere(1), mesh_catalog.box((-1, -1, -1), (0.5, 0.5, 0.5))),
    "holes": (mesh_catalog.icosphere(1), mesh_catalog.with_holes(mesh_catalog.icosphere(1), 0.1)),
    "fins": (mesh_catalog.icosphere(1), mesh_catalog.with_fins(mesh_catalog.icosphere(1))),
    "slivers": (mesh_catalog.sliver_fan(16), mesh_catalog.single_triangle()),
    "turned": (mesh_catalog.icosphere(1), turned(mesh_catalog.icosphere(1), 3)),
    "nearly equal": (mesh_catalog.torus(10, 6), spun(mesh_catalog.torus(10, 6, minor=0.351), 0.2)),
    "soup": (mesh_catalog.soup(mesh_catalog.icosphere(1)), mesh_catalog.tetrahedron()),
    "large triangles": (mesh_catalog.box((-1, -1, -1), (1, 1, 1)), mesh_catalog.torus(10, 6)),
}


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_like_dense_samples(pair):
    a, b = PAIRS[pair]
    there, back = dense_bounds(a, b), dense_bounds(b, a)
    for tolerance in (0.1, 1e-2, 1e-4, 1e-8, 1e-13):
        found = hausdorff(a, b, tolerance=tolerance, samples=0 if tolerance == 1e-2 else 100, device="cpu")
        assert_certified(found.a_to_b, a, b, tolerance, there)
        assert_certified(found.b_to_a, b, a, tolerance, back)
        assert found.max == max(found.a_to_b.max, found.b_to_a.max)
        assert found.upper == max(found.a_to_b.upper, found.b_to_a.upper)
        assert np.linalg.norm(found.point_a - found.point_b) == pytest.approx(found.max, abs=1e-12)


def test_means_like_the_reference():
    a, b = PAIRS["torus, sphere"]
    found = hausdorff(a, b, samples=10_000, device="cpu")
    for one, source, target in ((found.a_to_b, a, b), (found.b_to_a, b, a)):
        # The middles of 36 equal parts of each triangle, weighted by area.
        n = 6
        up = [(3 * i + 1, 3 * j + 1) for i in range(n) for j in range(n - i)]
        down = [(3 * i + 2, 3 * j + 2) for i in range(n) for j in range(n - i - 1)]
        weights = np.array([[u, v, 3 * n - u - v] for u, v in up + down]) / (3 * n)
        corners = source.vertices[source.faces]
        points = np.einsum("wc,fck->fwk", weights, corners).reshape(-1, 3)
        distance = reference.closest_point(target.vertices, target.faces, points).distance.reshape(len(corners), -1)
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = np.linalg.norm(np.cross(u, v), axis=1)
        mean = (distance.mean(axis=1) * area).sum() / area.sum()
        rms = math.sqrt(((distance**2).mean(axis=1) * area).sum() / area.sum())
        assert abs(one.mean - mean) < 5 * one.mean_error
        assert abs(one.rms - rms) < 5 * one.rms_error
    assert found.mean == max(found.a_to_b.mean, found.b_to_a.mean)
    assert found.rms == max(found.a_to_b.rms, found.b_to_a.rms)


def test_standard_errors_are_the_scatter_over_seeds():
    a, b = Surface(mesh_catalog.box(), device="cpu"), Surface(mesh_catalog.icosphere(1), device="cpu")
    drawn = [hausdorff(a, b, tolerance=0.1, samples=400, seed=seed).a_to_b for seed in range(60)]
    for value, error in (("mean", "mean_error"), ("rms", "rms_error")):
        scatter = np.std([getattr(one, value) for one in drawn])
        said = np.mean([getattr(one, error) for one in drawn])
        # The scatter of 60 runs is itself known only to 9%.
        assert 0.65 < scatter / said < 1.45


def test_directions_swap_with_the_arguments():
    a, b = PAIRS["sphere, box"]
    one, other = hausdorff(a, b, device="cpu"), hausdorff(b, a, device="cpu")
    for left, right in ((one.a_to_b, other.b_to_a), (one.b_to_a, other.a_to_b)):
        for x, y in zip(left, right, strict=True):
            np.testing.assert_array_equal(x, y)
    np.testing.assert_array_equal(one.point_a, other.point_b)
    np.testing.assert_array_equal(one.point_b, other.point_a)


def test_prepared_surfaces_are_used_as_they_are(monkeypatch):
    a, b = PAIRS["sphere, box"]
    plain = hausdorff(a, b, samples=100, device="cpu")
    ready = Surface(a, device="cpu"), Surface(b, device="cpu")
    module = importlib.import_module("geokit.mesh._hausdorff")
    monkeypatch.setattr(module, "_surface_of", mock.Mock(side_effect=lambda given, device: given))
    found = hausdorff(*ready, samples=100)
    assert (found.max, found.upper, found.mean) == (plain.max, plain.upper, plain.mean)


def test_after_an_update():
    surface = Surface(mesh_catalog.box(), device="cpu")
    surface.update(mesh_catalog.moved(mesh_catalog.box(), (0, 0, 5)).vertices)
    assert hausdorff(mesh_catalog.box(), surface, samples=10, device="cpu").max == pytest.approx(5.0, abs=1e-14)


def test_results_do_not_depend_on_threads():
    a, b = PAIRS["nearly equal"]
    with mock.patch.dict(os.environ, GEOKIT_THREADS="1"):
        one = hausdorff(a, b, samples=5000, device="cpu")
    with mock.patch.dict(os.environ, GEOKIT_THREADS="3"):
        other = hausdorff(a, b, samples=5000, device="cpu")
    for x, y in zip(one.a_to_b, other.a_to_b, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.slow
@pytest.mark.parametrize(("block", "most"), [(64, 1 << 20), (64, 200), (1, 1)])
def test_small_blocks_bound_what_waits(block, most, monkeypatch):
    module = importlib.import_module("geokit.mesh.queries.hausdorff")
    monkeypatch.setattr(module, "BLOCK", block)
    monkeypatch.setattr(module, "MOST_WAITING", most)
    waiting = []
    undecided = module.DistanceSearch._undecided

    def counted(self, pieces):
        waiting.append(len(pieces.upper))
        return undecided(self, pieces)

    monkeypatch.setattr(module.DistanceSearch, "_undecided", counted)
    a, b = mesh_catalog.icosphere(1), turned(mesh_catalog.icosphere(1), 5)
    found = hausdorff(a, b, tolerance=1e-3, samples=10, device="cpu")
    assert_certified(found.a_to_b, a, b, 1e-3, dense_bounds(a, b))
    assert_certified(found.b_to_a, b, a, 1e-3, dense_bounds(b, a))
    # The initial triangles, the waiting pieces, and a block for each halving of an edge (60 are many).
    assert max(waiting) <= len(a.faces) + min(most, 4000) + 60 * block


def test_far_away_and_finer_than_its_coordinates():
    a = mesh_catalog.moved(mesh_catalog.icosphere(1), (1e9, 0, 0))
    b = mesh_catalog.moved(turned(mesh_catalog.icosphere(1), 6), (1e9, 0, 0))
    near = hausdorff(mesh_catalog.icosphere(1), turned(mesh_catalog.icosphere(1), 6), samples=0, device="cpu")
    found = hausdorff(a, b, tolerance=1e-15, samples=0, device="cpu")
    # Coordinates are 1.2e-7 apart there; a tolerance below 32 roundings of them counts as that.
    assert found.upper - found.max <= 32 * np.finfo(float).eps * 1.01e9
    assert abs(found.max - near.max) < 1e-3


@pytest.mark.parametrize("factor", [1e-9, 1e9])
def test_scales(factor):
    a, b = PAIRS["sphere, box"]
    plain = hausdorff(a, b, samples=1000, device="cpu")
    found = hausdorff(mesh_catalog.scaled(a, factor), mesh_catalog.scaled(b, factor), samples=1000, device="cpu")
    for name in ("max", "upper", "mean", "rms"):
        assert getattr(found, name) == pytest.approx(factor * getattr(plain, name), rel=2e-4)


def test_vertices_that_no_face_uses_do_not_count():
    mesh = mesh_catalog.unreferenced_vertices()
    rows, faces = np.unique(mesh.faces, return_inverse=True)
    used = TriangleMesh(mesh.vertices[rows], faces.reshape(-1, 3))  # NumPy 1 returns them flat
    found = hausdorff(mesh, mesh_catalog.moved(used, (0, 0, 0.25)), samples=100, device="cpu")
    expected = hausdorff(used, mesh_catalog.moved(used, (0, 0, 0.25)), samples=100, device="cpu")
    assert (found.max, found.upper) == (expected.max, expected.upper)


def test_without_area_there_is_no_mean():
    points = points_as_mesh([[0, 0, 3.0], [0.25, 0.25, 1.0]])
    found = hausdorff(points, mesh_catalog.single_triangle(), device="cpu")
    assert found.a_to_b.max == 3.0
    assert math.isnan(found.a_to_b.mean)
    assert math.isnan(found.a_to_b.rms_error)
    assert not math.isnan(found.b_to_a.mean)
    assert math.isnan(found.mean)
    single = hausdorff(points_as_mesh([[0, 0, 0]]), points_as_mesh([[0, 0, 0]]), device="cpu")
    assert (single.max, single.upper) == (0.0, 0.0)


def test_without_samples_there_is_no_mean():
    found = hausdorff(*PAIRS["sphere, box"], samples=0, device="cpu")
    assert found.max > 0
    assert math.isnan(found.mean)
    assert math.isnan(found.rms)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tolerance": 0.0}, "tolerance: 0.0"),
        ({"tolerance": -1e-4}, "tolerance: -0.0001"),
        ({"tolerance": math.nan}, "tolerance: nan"),
        ({"tolerance": math.inf}, "tolerance: inf"),
        ({"tolerance": "fine"}, "tolerance: 'fine'"),
        ({"samples": -1}, "samples: -1"),
        ({"samples": 1.5}, "samples: 1.5"),
        ({"samples": None}, "samples: None"),
        ({"seed": -1}, "seed: -1"),
        ({"seed": "x", "samples": 0}, "seed: 'x'"),
        ({"device": "cuda:99"}, "device: 'cuda:99'"),
    ],
)
def test_what_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        hausdorff(mesh_catalog.box(), mesh_catalog.tetrahedron(), **{"device": "cpu", **arguments})


def test_only_meshes_and_surfaces_with_faces():
    with pytest.raises(InputError, match="a: ndarray is not a TriangleMesh"):
        hausdorff(np.zeros((3, 3)), mesh_catalog.box(), device="cpu")
    with pytest.raises(InputError, match="b: str is not a TriangleMesh"):
        hausdorff(mesh_catalog.box(), "box.obj", device="cpu")
    with pytest.raises(InputError, match="a: the mesh has no faces"):
        hausdorff(EMPTY, mesh_catalog.box(), device="cpu")
    with pytest.raises(InputError, match="b: the mesh has no faces"):
        hausdorff(mesh_catalog.box(), EMPTY, device="cpu")
