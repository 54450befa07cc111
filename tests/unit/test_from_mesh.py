"""Narrow bands: every active voxel against brute force, the fill around it, and every error it promises."""

from __future__ import annotations

import numpy as np
import pytest

from geokit import DeviceMemoryError, InputError, volume
from geokit.mesh import Surface, TriangleMesh
from tests import catalogue, reference


def dense(grid, lower, upper):
    """Values at all voxels of the index box, by nearest-voxel sampling at their centres."""
    axes = [np.arange(a, b + 1) for a, b in zip(lower, upper, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    world = index @ grid.info.transform[:3, :3].T + grid.info.transform[:3, 3]
    return world, volume.sample(grid, world, order=0, device="cpu")


@pytest.mark.parametrize("half_width", [1.0, 3.0, 4.5])
@pytest.mark.parametrize(
    "mesh",
    [
        catalogue.tetrahedron(),
        catalogue.icosphere(1),
        catalogue.torus(16, 8),
        catalogue.l_profile(),
        catalogue.nested_boxes(),
        catalogue.inside_out_box(),
    ],
    ids=lambda mesh: mesh.name,
)
def test_every_voxel_is_exact(mesh, half_width):
    size = float((mesh.bounds[1] - mesh.bounds[0]).max()) / 17.3
    grid = volume.from_mesh(mesh, size, half_width=half_width, device="cpu")
    lower = np.floor(mesh.bounds[0] / size).astype(int) - 6
    upper = np.ceil(mesh.bounds[1] / size).astype(int) + 6
    world, found = dense(grid, lower, upper)
    rng = np.random.default_rng(51)
    some = rng.choice(len(world), min(len(world), 4000), replace=False)
    expected = reference.signed_distance(mesh.vertices, mesh.faces, world[some])
    if mesh.name == "inside_out_box":
        inside = reference.winding_number(mesh.vertices, mesh.faces, world[some]) < -0.5
        expected = np.where(inside, -1, 1) * np.abs(expected)
    band = float(np.float32(half_width * size))
    np.testing.assert_allclose(found[some], np.clip(expected, -band, band), rtol=0, atol=2e-7 * band)
    distance = np.abs(reference.closest_point(mesh.vertices, mesh.faces, world[some]).distance)
    assert grid.info.background == pytest.approx(band)
    assert grid.info.grid_class == "level set"
    assert grid.info.grid_type == "float"
    # Counted over all voxels, not only over some: what is inside the band is active, and nothing else.
    assert grid.info.active_voxel_count == int((np.abs(found) < np.float32(band)).sum())
    assert (distance < 0.999 * band).any()


def test_a_large_inside_is_negative_at_every_level_of_the_tree():
    # 500 voxels across: whole tables of lower nodes lie inside.
    mesh = catalogue.icosphere(2)
    grid = volume.from_mesh(mesh, 2.0 / 500, half_width=2.0, device="cpu")
    rng = np.random.default_rng(52)
    points = rng.uniform(-1.2, 1.2, (20000, 3))
    found = volume.sample(grid, points, order=0, device="cpu")
    radius = np.linalg.norm(points, axis=1)
    assert (found[radius < 0.94] == -grid.info.background).all()
    assert (found[radius > 1.02] == grid.info.background).all()


def test_only_tiles_near_the_surface_are_touched():
    # Halving the voxel size makes four times the surface, not eight times the space.
    mesh = catalogue.icosphere(3)
    small, large = (volume.from_mesh(mesh, 2.0 / n, device="cpu").info.byte_count for n in (100, 200))
    assert large < 5.0 * small


def test_far_from_the_origin_the_band_is_the_same():
    mesh = catalogue.icosphere(2)
    size = 2.0**-5
    near = volume.from_mesh(mesh, size, device="cpu")
    offset = np.array([2.0**20, -(2.0**20), 2.0**19])
    far = volume.from_mesh(TriangleMesh(mesh.vertices + offset, mesh.faces), size, device="cpu")
    points = np.random.default_rng(53).uniform(-1.2, 1.2, (3000, 3))
    # Coordinates at 2^20 keep 2^-33: the mesh itself moved by that much.
    np.testing.assert_allclose(far.sample(points + offset), near.sample(points), rtol=0, atol=1e-8)
    assert np.abs(far.info.index_bounds).max() < 1 << 12
    np.testing.assert_array_equal(far.info.transform[:3, 3] % (8 * size), 0.0)


def test_a_surface_is_taken_as_it_is():
    surface = Surface(catalogue.box(), device="cpu")
    grid = volume.from_mesh(surface, 0.1, name="cube")
    np.testing.assert_array_equal(
        grid.nanovdb[700:], volume.from_mesh(catalogue.box(), 0.1, device="cpu").nanovdb[700:]
    )
    assert grid.info.name == "cube"


def test_open_meshes_have_exact_magnitudes_and_winding_signs():
    mesh = catalogue.holed_sphere()
    surface = Surface(mesh, device="cpu")
    grid = volume.from_mesh(surface, 0.06)
    rng = np.random.default_rng(54)
    index = rng.integers(-18, 19, (3000, 3))
    found = grid.sample(index * 0.06, order=0)
    expected = surface.signed_distance(index * 0.06).distance
    band = np.abs(expected) < 0.999 * grid.info.background
    assert band.sum() > 300
    np.testing.assert_allclose(found[band], expected[band], rtol=0, atol=1e-7)


def test_threads_do_not_change_a_byte(monkeypatch):
    mesh = catalogue.torus(32, 16)
    monkeypatch.setenv("GEOKIT_THREADS", "1")
    one = volume.from_mesh(mesh, 0.04, device="cpu").nanovdb
    monkeypatch.setenv("GEOKIT_THREADS", "3")
    np.testing.assert_array_equal(volume.from_mesh(mesh, 0.04, device="cpu").nanovdb, one)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"voxel_size": 0.0}, "voxel_size"),
        ({"voxel_size": -1.0}, "voxel_size"),
        ({"voxel_size": np.nan}, "voxel_size"),
        ({"voxel_size": np.inf}, "voxel_size"),
        ({"voxel_size": "fine"}, "voxel_size"),
        ({"voxel_size": 0.1, "half_width": 0.5}, "half_width"),
        ({"voxel_size": 0.1, "half_width": np.inf}, "half_width"),
    ],
)
def test_bad_options_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        volume.from_mesh(catalogue.box(), device="cpu", **arguments)


def test_an_empty_mesh_is_refused():
    with pytest.raises(InputError, match="no faces"):
        volume.from_mesh(TriangleMesh([], []), 0.1, device="cpu")


@pytest.mark.parametrize("voxel_size", [1e-5, 1e-7, 1e-12, 1e-300])
def test_voxels_too_small_for_the_memory_name_a_size_that_fits(voxel_size):
    with pytest.raises(DeviceMemoryError, match=r"use (at least )?[0-9.e+-]+"):
        volume.from_mesh(catalogue.icosphere(1), voxel_size, device="cpu")
