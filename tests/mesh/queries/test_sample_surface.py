"""sample_surface: distributions, minimum distances, determinism, and every error."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import chisquare, kstest

from benchmarks.catalog import mesh_catalog
from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, InputError
from geokit.mesh import TriangleMesh
from geokit.mesh._sample_surface import sample_surface
from tests.support import reference

SHAPES = {
    "triangle": mesh_catalog.single_triangle(),
    "box": mesh_catalog.box((0, 0, 0), (3, 1, 0.2)),
    "torus": mesh_catalog.torus(),
    "slivers": mesh_catalog.sliver_fan(),
    "far": mesh_catalog.moved(mesh_catalog.icosphere(2), (1e6, -2e6, 3e6)),
    "tiny": mesh_catalog.scaled(mesh_catalog.torus(), 1e-200),
    "huge": mesh_catalog.scaled(mesh_catalog.torus(), 1e200),
}
# A correct sampler fails with a chance of one in ten thousand; the seeds are fixed.
LEAST_CHANCE = 1e-4


def areas(mesh):
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def plate(length, width):
    corners = [[0, 0, 0], [length, 0, 0], [length, width, 0], [0, width, 0]]
    return TriangleMesh(corners, [[0, 1, 2], [0, 2, 3]], name="plate")


def unit_scale(mesh):
    """A power of two that brings the mesh to unit size, so that scaling does not round."""
    return 2.0 ** -np.round(np.log2(np.ptp(mesh.vertices, axis=0).max()))


def least_distance(points):
    # By the documented formula, not with the rounding of the k-d tree.
    pairs = cKDTree(points).query(points, k=2)[1]
    d = points[pairs[:, 0]] - points[pairs[:, 1]]
    return np.sqrt((d[:, 0] ** 2 + d[:, 1] ** 2) + d[:, 2] ** 2).min()


@pytest.mark.parametrize("method", ["uniform", "poisson_disk"])
@pytest.mark.parametrize("shape", SHAPES)
def test_points_lie_on_their_triangles(shape, method):
    mesh = SHAPES[shape]
    found = sample_surface(mesh, 500, method=method)
    assert found._fields == ("points", "triangle_id", "barycentric", "radius")
    assert (found.points.dtype, found.triangle_id.dtype, found.barycentric.dtype) == (np.float64, np.int32, np.float64)
    assert found.points.shape == found.barycentric.shape == (500, 3)
    assert (found.barycentric >= 0).all()
    np.testing.assert_allclose(found.barycentric.sum(axis=1), 1.0, rtol=0, atol=2**-52)
    corners = mesh.vertices[mesh.faces[found.triangle_id]]
    expected = np.einsum("nc,nck->nk", found.barycentric, corners)
    allowed = 4 * np.finfo(float).eps * np.abs(mesh.vertices).max()
    np.testing.assert_allclose(found.points, expected, rtol=0, atol=allowed)


def test_a_plane_s_own_coordinate_is_kept():
    mesh = mesh_catalog.moved(plate(1.0, 1.0), (0.0, 0.0, 0.1))
    assert (sample_surface(mesh, 1000).points[:, 2] == 0.1).all()


def test_triangles_are_chosen_by_their_area():
    mesh = mesh_catalog.box((0, 0, 0), (3, 1, 0.2))
    found = sample_surface(mesh, 50_000, seed=3)
    counts = np.bincount(found.triangle_id, minlength=len(mesh.faces))
    share = areas(mesh) / areas(mesh).sum()
    assert chisquare(counts, share * counts.sum()).pvalue > LEAST_CHANCE


def test_a_triangle_is_covered_uniformly():
    found = sample_surface(mesh_catalog.single_triangle(), 50_000, seed=4)
    for weight in found.barycentric.T:
        # The share of a triangle that is farther from an edge than x of the height is (1 - x)^2.
        assert kstest(weight, lambda x: 1 - (1 - x) ** 2).pvalue > LEAST_CHANCE
    # Sixteen congruent parts, the turned ones among them, are hit alike.
    v, w = 4 * found.points[:, 0], 4 * found.points[:, 1]
    part = (np.floor(v) * 4 + np.floor(w)) * 2 + (v % 1 + w % 1 > 1)
    assert chisquare(np.unique(part, return_counts=True)[1]).pvalue > LEAST_CHANCE
    assert len(np.unique(part)) == 16


def test_samples_are_independent_of_their_order():
    found = sample_surface(mesh_catalog.torus(), 20_000, seed=5)
    first, second = found.triangle_id[:-1], found.triangle_id[1:]
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.03


def test_triangles_without_area_are_never_chosen():
    mesh = mesh_catalog.collapsed_faces()
    flat = areas(mesh) == 0
    assert flat.any()
    found = sample_surface(mesh, 20_000)
    assert not flat[found.triangle_id].any()
    assert set(found.triangle_id) == set(np.flatnonzero(~flat))


@pytest.mark.parametrize("arguments", [{"count": 300}, {"count": 300, "method": "poisson_disk"}, {"radius": 0.2}])
def test_the_seed_decides(arguments):
    arguments = {"method": "poisson_disk", **arguments} if "radius" in arguments else arguments
    mesh = mesh_catalog.torus()
    one, again = sample_surface(mesh, seed=7, **arguments), sample_surface(mesh, seed=7, **arguments)
    for a, b in zip(one, again, strict=True):
        np.testing.assert_array_equal(a, b)
    other = sample_surface(mesh, seed=8, **arguments).points
    assert other.shape != one.points.shape or (other != one.points).any()


def test_uniform_has_no_radius():
    assert sample_surface(mesh_catalog.box(), 10).radius == 0.0


@pytest.mark.parametrize("count", [1, 2, 10, 700, 5000])
@pytest.mark.parametrize("shape", SHAPES)
def test_no_two_are_nearer_than_the_radius_given_back(shape, count):
    mesh = SHAPES[shape]
    found = sample_surface(mesh, count, method="poisson_disk")
    assert len(found.points) == count
    assert found.radius > 0
    if count > 1:
        scale = unit_scale(mesh)
        assert least_distance(found.points * scale) >= found.radius * scale * (1 - 1e-15)


@pytest.mark.parametrize("shape", ["triangle", "box", "torus", "far", "tiny", "huge"])
def test_a_count_is_spread_evenly(shape):
    mesh = SHAPES[shape]
    found = sample_surface(mesh, 1000, method="poisson_disk")
    scale = unit_scale(mesh)
    area = areas(TriangleMesh(mesh.vertices * scale, mesh.faces)).sum()
    # About 0.8, as documented; the densest packing of a plane has 1.07.
    assert 0.7 < found.radius * scale / np.sqrt(area / 1000) < 1.0
    # Evenly also means that no place is far from all of them.
    probes = sample_surface(mesh, 20_000, seed=1).points * scale
    assert cKDTree(found.points * scale).query(probes)[0].max() < 1.6 * found.radius * scale


@pytest.mark.parametrize("radius", [0.03, 0.1, 0.5])
@pytest.mark.parametrize("shape", ["triangle", "box", "torus", "slivers"])
def test_a_radius_is_kept_and_filled(shape, radius):
    mesh = SHAPES[shape]
    found = sample_surface(mesh, radius=radius, method="poisson_disk")
    assert found.radius == radius
    if len(found.points) > 1:
        assert least_distance(found.points) >= radius * (1 - 1e-15)
    probes = sample_surface(mesh, 20_000, seed=1).points
    room = cKDTree(found.points).query(probes)[0] >= radius
    assert room.mean() < 0.005


def test_both_sides_of_a_thin_plate_keep_their_distance():
    mesh = mesh_catalog.box((0, 0, 0), (1, 1, 1e-3))
    for arguments in ({"count": 400}, {"radius": 0.05}):
        found = sample_surface(mesh, method="poisson_disk", **arguments)
        assert least_distance(found.points) >= found.radius * (1 - 1e-15)


def test_a_strip_with_hardly_any_area_is_filled_along_its_length():
    found = sample_surface(plate(1000.0, 1e-9), radius=1.0, method="poisson_disk")
    x = np.sort(found.points[:, 0])
    assert np.diff(x).min() >= 1.0 * (1 - 1e-12)
    # Saturated random parking of cars on a street takes 0.7476 of it.
    assert len(x) > 700


def test_a_radius_beyond_the_mesh_leaves_one_point():
    for radius in (10.0, 1e300):
        assert len(sample_surface(mesh_catalog.box(), radius=radius, method="poisson_disk").points) == 1


def test_many_points_outgrow_their_first_table():
    # By its area the strip has room for a few points only.
    found = sample_surface(plate(6000.0, 1e-6), radius=1.0, method="poisson_disk")
    assert len(found.points) > 4000
    assert np.diff(np.sort(found.points[:, 0])).min() >= 1.0 * (1 - 1e-12)


@pytest.mark.parametrize("method", ["uniform", "poisson_disk"])
def test_no_points_are_asked_for(method):
    for mesh in (mesh_catalog.box(), TriangleMesh(np.empty((0, 3)), np.empty((0, 3), int))):
        found = sample_surface(mesh, 0, method=method)
        assert (found.points.shape, found.triangle_id.shape, found.barycentric.shape) == ((0, 3), (0,), (0, 3))
        assert found.triangle_id.dtype == np.int32


def test_the_mesh_is_not_changed():
    mesh = mesh_catalog.torus()
    vertices, faces = mesh.vertices.copy(), mesh.faces.copy()
    sample_surface(mesh, 100, method="poisson_disk")
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)


def test_points_are_on_the_surface_by_the_reference():
    mesh = mesh_catalog.l_profile()
    found = sample_surface(mesh, 200, method="poisson_disk")
    assert reference.closest_point(mesh.vertices, mesh.faces, found.points).distance.max() < 1e-15


def test_meshes_without_area():
    message = "has no area"
    empty = TriangleMesh(np.empty((0, 3)), np.empty((0, 3), int))
    segment = TriangleMesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], name="segment")
    for mesh in (empty, segment, TriangleMesh([[1, 2, 3]], [[0, 0, 0]])):
        for arguments in ({"count": 1}, {"count": 1, "method": "poisson_disk"}):
            with pytest.raises(InputError, match=message):
                sample_surface(mesh, **arguments)
        with pytest.raises(InputError, match=message):
            sample_surface(mesh, radius=0.1, method="poisson_disk")
    with pytest.raises(InputError, match="mesh: segment"):
        sample_surface(segment, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "count: method 'uniform' needs"),
        ({"count": -1}, "count: -1"),
        ({"count": 2.5}, "count: 2.5"),
        ({"count": True}, "count: True"),
        ({"count": "ten"}, "count: 'ten'"),
        ({"count": 5, "radius": 0.1}, "radius: method 'uniform'"),
        ({"count": 5, "method": "even"}, "method: 'even'"),
        ({"method": "poisson_disk"}, "either count or radius"),
        ({"method": "poisson_disk", "count": 5, "radius": 0.1}, "either count or radius"),
        ({"method": "poisson_disk", "radius": 0.0}, "radius: 0.0"),
        ({"method": "poisson_disk", "radius": -1}, "radius: -1"),
        ({"method": "poisson_disk", "radius": np.nan}, "radius: nan"),
        ({"method": "poisson_disk", "radius": np.inf}, "radius: inf"),
        ({"method": "poisson_disk", "radius": "wide"}, "radius: 'wide'"),
        ({"count": 5, "seed": -1}, "seed: -1"),
        ({"count": 5, "seed": 0.5}, "seed: 0.5"),
        ({"count": 0, "seed": None}, "seed: None"),
    ],
)
def test_what_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        sample_surface(mesh_catalog.box(), **arguments)


def test_only_meshes():
    with pytest.raises(InputError, match="mesh: ndarray"):
        sample_surface(np.zeros((3, 3)), 1)


def test_more_points_than_float64_has_there():
    # At 1e16 neighboring float64 are 2 apart: the plate has six by six of them at most.
    mesh = mesh_catalog.moved(plate(10.0, 10.0), (1e16, 1e16, 0.0))
    with pytest.raises(InputError, match="count: float64 has only"):
        sample_surface(mesh, 1000, method="poisson_disk")
    assert len(sample_surface(mesh, radius=0.5, method="poisson_disk").points) <= 36


def test_a_radius_that_no_memory_holds():
    with pytest.raises(DeviceMemoryError, match=r"radius: box has room for .* use a radius of"):
        sample_surface(mesh_catalog.box(), radius=1e-9, method="poisson_disk")
    # Its square is below all float64; the radius that is proposed is one all the same.
    with pytest.raises(DeviceMemoryError, match=r"more than 1e\+300 points .* use a radius of [\d.]+(e-\d+)? or more"):
        sample_surface(mesh_catalog.box(), radius=1e-300, method="poisson_disk")


def test_a_radius_where_no_memory_is_left(monkeypatch):
    monkeypatch.setattr(available_memory, "available_host", lambda: 0)
    with pytest.raises(DeviceMemoryError, match="use a radius of"):
        sample_surface(mesh_catalog.box(), radius=0.5, method="poisson_disk")


def test_points_that_outgrow_memory_on_the_way(monkeypatch):
    monkeypatch.setattr(available_memory, "available_host", lambda: 400 * 500)
    # By its area there is room for one.
    with pytest.raises(DeviceMemoryError, match="use a larger radius"):
        sample_surface(plate(1000.0, 1e-9), radius=1.0, method="poisson_disk")


def test_candidates_that_no_memory_holds(monkeypatch):
    monkeypatch.setattr(available_memory, "available_host", lambda: 1 << 20)
    with pytest.raises(DeviceMemoryError, match="count: 1000 points"):
        sample_surface(mesh_catalog.box(), 1000, method="poisson_disk")
