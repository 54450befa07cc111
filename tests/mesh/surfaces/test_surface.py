"""Surface on hand-sized inputs, and every error it promises."""

from __future__ import annotations

import inspect
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit import InputError
from geokit.mesh import Surface, TriangleMesh
from geokit.mesh.bvh.leaf_planes_kernels import SLOT_WORDS
from geokit.mesh.surfaces import surface as surface_module
from tests.support import reference


@pytest.fixture(scope="module")
def triangle() -> Surface:
    return Surface(mesh_catalog.single_triangle(), device="cpu")


@pytest.fixture(scope="module")
def box() -> Surface:
    return Surface(mesh_catalog.box(), device="cpu")


@pytest.mark.parametrize(
    ("query", "expected", "weights"),
    [
        ((0.25, 0.25, 2.0), (0.25, 0.25, 0.0), (0.5, 0.25, 0.25)),  # inside
        ((-1.0, -1.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),  # corner a
        ((2.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),  # corner b
        ((-1.0, 2.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),  # corner c
        ((0.5, -1.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.5, 0.0)),  # edge ab
        ((1.0, 1.0, 0.0), (0.5, 0.5, 0.0), (0.0, 0.5, 0.5)),  # edge bc
        ((-1.0, 0.5, 0.0), (0.0, 0.5, 0.0), (0.5, 0.0, 0.5)),  # edge ca
    ],
)
def test_closest_point_in_each_region(triangle, query, expected, weights):
    found = triangle.closest_point([query])
    np.testing.assert_allclose(found.points[0], expected, atol=1e-15)
    np.testing.assert_allclose(found.barycentric[0], weights, atol=1e-15)
    assert found.distance[0] == pytest.approx(np.linalg.norm(np.subtract(query, expected)), abs=1e-15)
    assert found.triangle_id[0] == 0


def test_ties_go_to_the_lowest_triangle():
    twice = mesh_catalog.box()
    mesh = TriangleMesh(twice.vertices, np.concatenate([twice.faces, twice.faces, twice.faces]))
    points = np.random.default_rng(1).uniform(-1, 2, (5000, 3))
    assert Surface(mesh, device="cpu").closest_point(points).triangle_id.max() < len(twice.faces)


def test_max_distance_includes_its_end(triangle):
    found = triangle.closest_point([[0, 0, 1.0], [0, 0, 1.0000001]], max_distance=1.0)
    assert found.triangle_id.tolist() == [0, -1]
    assert found.distance[1] == np.inf
    assert np.isnan(found.points[1]).all()
    assert np.isnan(found.barycentric[1]).all()


def test_max_distance_of_zero_finds_points_on_the_surface(triangle):
    assert triangle.closest_point([[0.25, 0.25, 0.0], [0, 0, 0.1]], max_distance=0.0).triangle_id.tolist() == [0, -1]


def test_triangles_without_area_answer_as_what_they_are():
    mesh = TriangleMesh([[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]], [[0, 1, 2], [3, 3, 3]])
    found = Surface(mesh, device="cpu").closest_point([[1.5, 1, 0], [5, 5, 7]])
    np.testing.assert_allclose(found.distance, [1.0, 2.0], atol=1e-15)
    assert found.triangle_id.tolist() == [0, 1]


def test_signed_distance_of_a_box(box):
    found = box.signed_distance([[0.5, 0.5, 0.25], [0.5, 0.5, 1.5], [0.9, 0.5, 0.5]])
    np.testing.assert_allclose(found.distance, [-0.25, 0.5, -0.1], atol=1e-15)


def test_contains(box):
    assert box.contains([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [1e9, 0, 0]]).tolist() == [True, False, False]


def test_winding_number_inside_and_outside(box):
    np.testing.assert_allclose(box.winding_number([[0.5, 0.4, 0.3], [2, 2, 2]]), [1.0, 0.0], atol=1e-5)


def test_an_inside_out_box_is_turned(box):
    surface = Surface(mesh_catalog.inside_out_box(), device="cpu")
    assert surface.orientation == -1
    assert box.orientation == 1
    points = np.random.default_rng(2).uniform(-0.5, 1.5, (1000, 3))
    np.testing.assert_array_equal(surface.contains(points), box.contains(points))
    assert (surface.signed_distance(points).distance < 0).any()


def test_a_cavity_is_outside():
    surface = Surface(mesh_catalog.nested_boxes(), device="cpu")
    points = np.random.default_rng(3).uniform(*surface.mesh.bounds, (500, 3))
    expected = reference.winding_number(surface.mesh.vertices, surface.mesh.faces, points) > 0.5
    assert expected.any()
    assert not expected.all()
    np.testing.assert_array_equal(surface.contains(points), expected)


def test_raycast(box):
    hits = box.raycast([[0.5, 0.25, 3.0], [0.5, 0.5, 3.0], [0.5, 0.25, 0.5]], [[0, 0, -2.0], [0, 0, 1.0], [0, 0, 0.1]])
    np.testing.assert_allclose(hits.t, [1.0, np.inf, 5.0])
    assert hits.triangle_id[1] == -1
    corners = box.mesh.vertices[box.mesh.faces[hits.triangle_id[0]]]
    np.testing.assert_allclose(hits.barycentric[0] @ corners, [0.5, 0.25, 1.0], atol=1e-15)


def test_ray_length_is_measured_in_world_units(box):
    start, along = [[0.5, 0.25, 3.0]], [[0, 0, -10.0]]
    assert box.raycast(start, along, max_distance=1.9).triangle_id[0] == -1
    assert box.raycast(start, along, max_distance=2.1).t[0] == pytest.approx(0.2)
    assert box.occluded(start, along, max_distance=2.1).tolist() == [True]
    assert box.occluded(start, along, max_distance=1.9).tolist() == [False]


def test_rays_along_an_axis_through_the_planes_of_boxes(box):
    # Components of zero meet box planes at zero distance: 0 * inf must not lose the hit.
    starts = [[0.0, 0.5, -1.0], [1.0, 0.5, -1.0], [0.5, 0.0, -1.0], [0.5, 1.0, -1.0], [0.0, 0.0, -1.0]]
    hits = box.raycast(starts, np.tile([0.0, 0.0, 1.0], (5, 1)))
    np.testing.assert_allclose(hits.t, 1.0)


def test_no_queries_give_no_results(box):
    assert box.closest_point(np.empty((0, 3))).distance.shape == (0,)
    assert box.closest_point(np.empty((0, 3))).points.shape == (0, 3)
    assert box.signed_distance([]).distance.shape == (0,)
    assert box.contains([]).shape == (0,)
    assert box.raycast([], []).t.shape == (0,)


def test_float32_in_gives_float32_out(box):
    found = box.signed_distance(np.zeros((2, 3), np.float32))
    assert {found.distance.dtype, found.points.dtype, found.barycentric.dtype} == {np.dtype(np.float32)}
    assert found.triangle_id.dtype == np.int32


def test_warp_arrays_come_back_as_warp_arrays(box):
    points = np.random.default_rng(4).uniform(-1, 2, (50, 3))
    expected = box.signed_distance(points)
    for given in (wp.array(points, dtype=wp.vec3d, device="cpu"), wp.array(points, dtype=wp.float64, device="cpu")):
        found = box.signed_distance(given)
        assert all(isinstance(array, wp.array) for array in found)
        np.testing.assert_array_equal(found.distance.numpy(), expected.distance)
        np.testing.assert_array_equal(found.points.numpy(), expected.points)


def test_inputs_are_not_changed(box):
    points = np.random.default_rng(5).uniform(-1, 2, (100, 3))
    before = points.copy()
    box.signed_distance(points)
    box.raycast(points, points + 1.0)
    np.testing.assert_array_equal(points, before)


def test_handle_works_in_the_user_s_own_kernel(box):
    found = wp.zeros(1, dtype=wp.bool, device="cpu")
    wp.launch(inside_kernel, 1, [wp.uint64(box.id)], [found], device="cpu")
    assert found.numpy()[0]


@wp.kernel
def inside_kernel(mesh: wp.uint64, out: wp.array(dtype=wp.bool)):
    # The local frame of a unit box is centered on it.
    query = wp.mesh_query_point_sign_winding_number(mesh, wp.vec3(0.1, 0.2, 0.3), 10.0)
    out[0] = query.result and query.sign < 0.0


def test_unused_vertices_do_not_matter():
    points = np.random.default_rng(6).uniform(-1, 2, (200, 3))
    plain = mesh_catalog.box()
    far = TriangleMesh(np.vstack([plain.vertices, [[1e300, -1e300, 0]]]), plain.faces)
    expected = Surface(plain, device="cpu").signed_distance(points).distance
    np.testing.assert_array_equal(Surface(far, device="cpu").signed_distance(points).distance, expected)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.closest_point([[0, 0]]), "points: shape"),
        (lambda s: s.closest_point([[0, 0, 0], [0, np.nan, 0]]), "points: row 1"),
        (lambda s: s.signed_distance([[np.inf, 0, 0]]), "points: row 0"),
        (lambda s: s.contains("abc"), "points"),
        (lambda s: s.winding_number([[0, 0, None]]), "points"),
        (lambda s: s.closest_point([[0, 0, 0]], max_distance=-1), "max_distance"),
        (lambda s: s.closest_point([[0, 0, 0]], max_distance=np.nan), "max_distance"),
        (lambda s: s.raycast([[0, 0, 0]], [[0, 0, 0]]), "directions: row 0"),
        (lambda s: s.raycast([[0, 0, 0]] * 2, [[0, 0, 1], [0, 0, 1e-200]]), "directions: row 1"),
        (lambda s: s.raycast([[0, 0, 0]], [[0, 0, 1], [0, 0, 1]]), "2 rows for 1 origins"),
        (lambda s: s.occluded([[0, 0, 0]], [[0, 0, np.inf]]), "directions: row 0"),
        (lambda s: s.raycast([[0, 0, 0]], [[0, 0, 1]], max_distance=-0.5), "max_distance"),
    ],
)
def test_bad_input_is_named(box, call, message):
    with pytest.raises(InputError, match=message):
        call(box)


def test_a_mesh_without_faces_is_refused():
    with pytest.raises(InputError, match="no faces"):
        Surface(TriangleMesh([[0, 0, 0]], []), device="cpu")
    with pytest.raises(InputError, match="not a TriangleMesh"):
        Surface("bunny", device="cpu")


def test_an_unknown_device_is_refused():
    with pytest.raises(InputError, match="'cuda:99' is not on this machine"):
        Surface(mesh_catalog.box(), device="cuda:99")


def test_repr_says_what_it_is(box):
    assert "12 faces" in repr(box)
    assert "'cpu'" in repr(box)


@pytest.mark.parametrize("face_count", [98_000_000, 107_374_182])
def test_a_gpu_numbers_so_many_faces(face_count: int) -> None:
    gpu = SimpleNamespace(is_cuda=True, alias="cuda:0")
    surface_module._require_numbered(face_count, gpu)
    assert face_count * SLOT_WORDS < 2**31
    with pytest.raises(InputError, match=r"mesh: 107374183 faces are more than the 107374182 .* on cuda:0; split the"):
        surface_module._require_numbered(107_374_183, gpu)
    surface_module._require_numbered(107_374_183, SimpleNamespace(is_cuda=False, alias="cpu"))


def test_help_shows_the_arguments() -> None:
    assert list(inspect.signature(Surface).parameters) == ["mesh", "device"]
    grid = list(inspect.signature(gk.points.NeighborGrid).parameters)
    assert grid == ["points", "radius", "groups", "periodic", "skin", "device"]
