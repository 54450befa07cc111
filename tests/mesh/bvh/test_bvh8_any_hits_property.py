"""On a CPU any hits test the widest triangles before the tree: this must not change an answer."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import warp as wp

from benchmarks import scenes
from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, TriangleMesh
from geokit.mesh.bvh.tree_kernels import SurfaceTree

RAYS = 1_000_000


def surface_of(mesh: TriangleMesh, **fields: wp.array) -> Surface:
    """A surface whose any hits have other arrays in their tree."""
    surface = Surface(mesh, device="cpu")
    tree = SurfaceTree()
    tree.assign(surface._any_hit_tree)
    for name, array in fields.items():
        setattr(tree, name, array)
    surface.__dict__["_any_hit_tree"] = tree
    return surface


def slots(*numbers: int) -> wp.array:
    return wp.array(numbers, dtype=wp.int32, device="cpu")


@cache
def hall() -> tuple[Surface, Surface]:
    """A hall, and the same without walls before the tree."""
    mesh = scenes.hall(20_000).mesh
    return Surface(mesh, device="cpu"), surface_of(mesh, wide=slots())


def require_same(surface: Surface, plain: Surface, rays: tuple[np.ndarray, np.ndarray], **limits: float) -> np.ndarray:
    found = surface.occluded(*rays, **limits)
    np.testing.assert_array_equal(found, plain.occluded(*rays, **limits))
    np.testing.assert_array_equal(found, surface.raycast(*rays, **limits).triangle_id >= 0)
    return found


@pytest.mark.parametrize("name", ["hall", "foliage", "lobes", "part"])
def test_a_million_random_rays(name):
    scene = scenes.SCENES[name](20_000)
    surface, plain = Surface(scene.mesh, device="cpu"), surface_of(scene.mesh, wide=slots())
    assert len(surface._any_hit_tree.wide) == {"hall": 12, "foliage": 2, "lobes": 0, "part": 12}[name]
    rng = np.random.default_rng(71)
    lower, upper = scene.mesh.bounds
    origins = rng.uniform(lower - 0.1, upper + 0.1, (RAYS, 3))
    directions = rng.normal(size=(RAYS, 3)) * 10.0 ** rng.uniform(-3, 3, (RAYS, 1))
    found = require_same(surface, plain, (origins, directions))
    assert 0.01 < found.mean() < 1.0
    require_same(surface, plain, (origins, directions), t_min=0.5, max_distance=0.2 * scene.mesh.diagonal)
    # The answers for rays in float32 are those for the same numbers.
    single = origins.astype(np.float32), directions.astype(np.float32)
    wide = tuple(rows.astype(np.float64) for rows in single)
    np.testing.assert_array_equal(surface.occluded(*single), require_same(surface, plain, wide))


def test_walls_stop_the_rays_of_a_hall_before_the_tree():
    scene = scenes.hall(20_000)
    surface, _ = hall()
    # Leaves without triangles: the walk finds nothing.
    leaves = wp.zeros_like(surface._ray_tree.ray_leaves)
    walls, none = surface_of(scene.mesh, ray_leaves=leaves), surface_of(scene.mesh, ray_leaves=leaves, wide=slots())
    for kind, rays in scenes.ray_sets(scene, surface, 20_000).items():
        assert not none.occluded(*rays).any()
        hit, sure = surface.occluded(*rays), walls.occluded(*rays)
        assert not (sure & ~hit).any()
        assert kind == "random" or sure.mean() > 0.98


@pytest.mark.parametrize("beside", [0.0, 1e-16, 1e-12, 1e-8, 1e-6, 1e-5, 3e-5, 1e-4, 1e-3])
def test_limits_beside_a_wall(beside):
    """Rays that end, or begin, at walls or a little before or behind them."""
    surface, plain = hall()
    rng = np.random.default_rng(72)
    corners = surface.mesh.vertices[surface.mesh.faces[rng.integers(12, size=20_000)]]
    targets = np.einsum("nk,nkd->nd", rng.dirichlet([1, 1, 1], len(corners)), corners)
    way = rng.normal(size=targets.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    for length in (1.0, 30.0):
        rays = targets - length * way, way
        for limit in (length * (1.0 - beside), length * (1.0 + beside)):
            require_same(surface, plain, rays, max_distance=limit)
            require_same(surface, plain, rays, t_min=limit)
    # From the wall itself, and from a little before and behind it.
    for offset in (0.0, -beside, beside):
        require_same(surface, plain, (targets + offset * way, way))
        require_same(surface, plain, (targets + offset * way, way), t_min=beside)


@pytest.mark.parametrize("make", [*mesh_catalog.CLOSED, *mesh_catalog.OPEN, *mesh_catalog.DEFECTIVE])
def test_any_slots_before_the_tree(make):
    """Whatever is tested first, slivers and faces without area too, at vertices and edges and beside."""
    mesh = make()
    plain = surface_of(mesh, wide=slots())
    filled = np.flatnonzero(plain._tree.slot_triangle.numpy() >= 0)
    surface = surface_of(mesh, wide=slots(*filled[:40]))
    rng = np.random.default_rng(73)
    middle, size = mesh.bounds.mean(axis=0), mesh.diagonal
    face = mesh.faces[rng.integers(len(mesh.faces), size=4000)]
    share = rng.choice([0.0, 0.3, 1.0], (4000, 1))
    targets = mesh.vertices[face[:, 0]] * share + mesh.vertices[face[:, 1]] * (1.0 - share)
    targets[::2] += rng.normal(size=(2000, 3)) * size * 10.0 ** rng.uniform(-16, 0, (2000, 1))
    for away in (0.3, 3.0, 1e3, 1e6, 1e9, 1e12):
        origins = middle + away * size * rng.normal(size=(4000, 3))
        directions = (targets - origins) * 10.0 ** rng.uniform(-3, 3, (4000, 1))
        require_same(surface, plain, (origins, directions))
        require_same(surface, plain, (origins, targets - origins), t_min=1.0)
        require_same(surface, plain, (origins, targets - origins), t_min=0.9, max_distance=away * size)


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e9])
def test_few_rays_and_few_triangles(offset):
    mesh = mesh_catalog.moved(mesh_catalog.box(), (offset, -offset, offset))
    surface, plain = Surface(mesh, device="cpu"), surface_of(mesh, wide=slots())
    assert len(surface._any_hit_tree.wide) == 12
    rng = np.random.default_rng(74)
    for count in (*range(1, 20), 31, 33, 255, 257, 1023, 1025):
        origins = mesh.bounds.mean(axis=0) + rng.uniform(-1, 1, (count, 3))
        directions = rng.choice([-1.0, -0.3, -0.0, 0.0, 1e-30, 1.0], (count, 3))
        directions[:, 0] += 1e-3
        rays = origins, directions
        assert len(require_same(surface, plain, rays)) == count


def test_the_tree_of_moved_vertices_has_other_wide_triangles():
    surface = Surface(mesh_catalog.icosphere(3), device="cpu")
    assert len(surface._any_hit_tree.wide) == 0
    moved = surface.mesh.vertices.copy()
    moved[surface.mesh.faces[7]] *= 50.0
    surface.update(moved)
    corners = surface.mesh.vertices[surface.mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    triangles = surface._tree.slot_triangle.numpy()[surface._any_hit_tree.wide.numpy()]
    np.testing.assert_allclose(areas[triangles], np.sort(areas)[::-1][: len(triangles)], rtol=1e-12)
    assert len(triangles) > 2
    rng = np.random.default_rng(75)
    rays = rng.normal(size=(5000, 3)) * 20.0, rng.normal(size=(5000, 3))
    require_same(surface, surface_of(surface.mesh, wide=slots()), rays)


def test_bad_rays_beside_good_ones_are_named():
    surface, _ = hall()
    for row in (0, 5, 12):
        for bad in ([0.0, 0.0, 0.0], [np.nan, 1.0, 0.0], [np.inf, 0.0, 1.0]):
            directions = np.ones((13, 3))
            directions[row] = bad
            with pytest.raises(ValueError, match=f"directions: row {row}"):
                surface.occluded(np.ones((13, 3)), directions)
