"""Narrow bands towards where they fail: thin and flat triangles, distance, scale, walls on voxels, broken meshes."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit import volume
from geokit.mesh import Surface
from tests.support import reference

# float32 keeps distances to half of 2^-23 of themselves.
ROUNDING = 2.0**-24
# Shares of the diagonal: nearer to the surface a sign is that of a rounding.
SIGNED = 1e-6

BROKEN = [
    pytest.param(break_it(mesh), id=f"{mesh.name}: {name}")
    for mesh in (mesh_catalog.icosphere(2), mesh_catalog.torus(16, 8))
    for name, break_it in mesh_catalog.BROKEN.items()
]


def some_voxels(mesh, grid, count, seed):
    size = float(grid.info.voxel_size[0])
    origin = grid.info.transform[:3, 3]
    bounds = (mesh.bounds - origin) / size
    index = np.random.default_rng(seed).integers(np.floor(bounds[0]) - 5, np.ceil(bounds[1]) + 6, (count, 3))
    return index * size + origin


def require_exact(mesh, grid, count=1200, seed=81):
    """Magnitudes by brute force at random voxels, to rounding; ``mesh`` decides how exactly coordinates are kept."""
    world = some_voxels(mesh, grid, count, seed)
    band = grid.info.background
    expected = np.minimum(reference.closest_point(mesh.vertices, mesh.faces, world).distance, band)
    found = np.abs(grid.sample(world, order=0, device="cpu"))
    # float64 coordinates keep 2^-52 of their size, and a distance is made of a few of them.
    coordinate = 16 * 2.0**-52 * np.abs(mesh.bounds).max()
    np.testing.assert_allclose(found, expected, rtol=2 * ROUNDING, atol=coordinate)
    assert (expected < band).any()


@pytest.mark.parametrize("height", [1e-1, 1e-5, 1e-9, 0.0])
def test_slivers_and_triangles_without_area(height):
    mesh = mesh_catalog.sliver_fan(32, height)
    require_exact(mesh, volume.from_mesh(mesh, 0.07, sign="none", device="cpu"))


@pytest.mark.parametrize("height", [1.0, 1e2, 1e4])
def test_needles(height):
    mesh = mesh_catalog.cone(24, height)
    grid = volume.from_mesh(mesh, max(0.1, height / 300), sign="none", device="cpu")
    require_exact(mesh, grid)


@pytest.mark.parametrize("across", [0.7, 3.0, 11.0, 70.0])
def test_coarse_and_fine_voxels(across):
    # In the coarsest thousands of triangles lie in one tile: more than its list holds.
    mesh = mesh_catalog.icosphere(4)
    grid = volume.from_mesh(mesh, 2.0 / across, device="cpu")
    world = some_voxels(mesh, grid, 80, 82)
    band = grid.info.background
    expected = np.clip(reference.signed_distance(mesh.vertices, mesh.faces, world), -band, band)
    np.testing.assert_allclose(grid.sample(world, order=0, device="cpu"), expected, rtol=2 * ROUNDING, atol=1e-14)


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1e6, 1e15])
def test_scales(scale):
    mesh = mesh_catalog.scaled(mesh_catalog.torus(16, 8), scale)
    grid = volume.from_mesh(mesh, 0.07 * scale, device="cpu")
    require_exact(mesh, grid)


@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6, 1e8])
def test_far_from_the_origin(distance):
    mesh = mesh_catalog.far_away(mesh_catalog.torus(16, 8), distance)
    require_exact(mesh, volume.from_mesh(mesh, 0.07, device="cpu"))


@pytest.mark.slow
@pytest.mark.parametrize("half_width", [1.0, 1.0005, 2.0, 3.0])
@pytest.mark.parametrize("voxels", [4, 8, 16, 24])
def test_walls_on_voxel_centers_hold_the_flood(voxels, half_width):
    # Faces through voxel centers and along the borders of tiles: distances are whole voxels, and sums are the spacing.
    mesh = mesh_catalog.box((0, 0, 0), (1, 1, 1))
    size = 1.0 / voxels
    grid = volume.from_mesh(mesh, size, half_width=half_width, device="cpu")
    axis = np.arange(-4, voxels + 5)
    index = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = ((index > 0) & (index < voxels)).all(axis=1)
    on = ((index >= 0) & (index <= voxels)).all(axis=1) & ~inside
    found = grid.sample(index * size, order=0, device="cpu")
    assert (found[inside] < 0.0).all()
    # A whole number of voxels is off by a rounding where the voxel is not a power of two.
    assert (np.abs(found[on]) <= 2.0**-52).all()
    assert (found[~inside & ~on] > 0.0).all()


@pytest.mark.parametrize("gap", [0.02, 0.2, 0.6, 0.95])
def test_walls_closer_than_a_voxel_keep_their_sides(gap):
    # Two boxes with a slit between them, and a hollow of that width: what lies between is outside.
    size = 0.1
    start = 0.5 * size - 0.5 * gap * size
    left = mesh_catalog.box((-1.0, -0.5, -0.5), (start, 0.5, 0.5))
    right = mesh_catalog.box((start + gap * size, -0.5, -0.5), (1.0, 0.5, 0.5))
    mesh = mesh_catalog.join(left, right)
    grid = volume.from_mesh(mesh, size, device="cpu")
    world = some_voxels(mesh, grid, 3000, 83)
    expected = Surface(mesh, device="cpu").signed_distance(world).distance
    off = np.abs(expected) > SIGNED * mesh.diagonal
    found = grid.sample(world, order=0, device="cpu")
    np.testing.assert_array_equal(found[off] < 0, expected[off] < 0)


@pytest.mark.slow
@pytest.mark.parametrize("mesh", BROKEN)
def test_broken_meshes_have_the_signs_of_their_surface(mesh):
    surface = Surface(mesh, device="cpu")
    size = float((mesh.bounds[1] - mesh.bounds[0]).max()) / 25.3
    grid = volume.from_mesh(surface, size, interior="keep")
    world = some_voxels(mesh, grid, 2500, 84)
    expected = surface.signed_distance(world).distance
    active = (np.abs(expected) < 0.999 * grid.info.background) & (np.abs(expected) > SIGNED * mesh.diagonal)
    found = grid.sample(world, order=0, device="cpu")
    np.testing.assert_allclose(found[active], expected[active], rtol=2 * ROUNDING, atol=1e-14)
    assert grid.info.metadata["geokit:sign_method"] == surface.sign_method
    assert grid.info.metadata["geokit:sign_reason"] == surface.sign_reason
