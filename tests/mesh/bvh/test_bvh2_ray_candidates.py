"""The two passes of rays on a GPU, run on the CPU with the tree of a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.mesh.bvh import ray_walk_kernels as kernels
from geokit.mesh.bvh.tree_kernels import LEFT_OVER, SurfaceTree
from geokit.mesh.queries.raycast_kernels import occluded_left_over_kernel
from geokit.mesh.queries.rays import wide_slots
from tests.mesh.bvh.test_bvh2 import binary


def in_passes(surface, origins, directions, t_min=0.0, max_distance=np.inf):
    """t, triangle_id, barycentric, and which rays were left undecided."""
    count, device = len(origins), surface._device
    bad = wp.zeros(2, dtype=wp.int32, device=device)
    rays = [wp.array(a, dtype=wp.vec3d, device=device) for a in (origins, directions)]
    shared = [*rays, surface._tree, wp.float64(t_min), wp.float64(max_distance)]
    out = [
        wp.zeros(count, dtype=wp.float64, device=device),
        wp.zeros(count, dtype=wp.int32, device=device),
        wp.zeros(count, dtype=wp.vec3d, device=device),
    ]
    launcher.launch(kernels.first_hit_kernel, count, shared, [*out, bad], device)
    assert not bad.numpy()[0]
    undecided = out[1].numpy() == kernels.UNDECIDED
    assert bool(bad.numpy()[1]) == undecided.any()
    return [a.numpy() for a in out], undecided


@pytest.mark.slow
@pytest.mark.parametrize("make", [*mesh_catalog.CLOSED, *mesh_catalog.OPEN, *mesh_catalog.DEFECTIVE])
@pytest.mark.parametrize("distance", [0.5, 3.0, 1000.0])
def test_passes_answer_as_the_walk_in_float64(make, distance):
    mesh = make()
    rng = np.random.default_rng(0)
    middle, size = mesh.bounds.mean(axis=0), mesh.diagonal
    origins = middle + distance * size * rng.normal(size=(3000, 3)) / 2.0
    # Half of them at vertices and edges.
    face = mesh.faces[rng.integers(len(mesh.faces), size=3000)]
    share = rng.choice([0.0, 0.3, 1.0], (3000, 1))
    targets = mesh.vertices[face[:, 0]] * share + mesh.vertices[face[:, 1]] * (1.0 - share)
    targets[::2] = middle + rng.normal(size=(1500, 3)) * size / 3.0
    directions = (targets - origins) * 10.0 ** rng.uniform(-3, 3, (3000, 1))
    expected = gk.mesh.Surface(mesh, device="cpu").raycast(origins, directions)
    found, undecided = in_passes(binary(mesh), origins, directions)
    # Candidates overflow only where many triangles meet.
    assert undecided.mean() < (0.7 if make in mesh_catalog.OPEN else 0.1)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one[~undecided], other[~undecided])


def test_starts_and_lengths_are_kept():
    mesh = mesh_catalog.torus()
    rng = np.random.default_rng(1)
    origins, directions = rng.uniform(-1.5, 1.5, (3000, 3)), rng.normal(size=(3000, 3))
    for options in ({"t_min": 0.3}, {"max_distance": 0.8}, {"t_min": 0.2, "max_distance": 0.9}):
        expected = gk.mesh.Surface(mesh, device="cpu").raycast(origins, directions, **options)
        found, undecided = in_passes(binary(mesh), origins, directions, **options)
        assert not undecided.any()
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other)


def test_far_away_rays_are_left_to_float64():
    mesh = mesh_catalog.icosphere()
    origins = np.array([[1e7, 0.0, 0.0], [1e7, 0.0, 0.0]])
    _, undecided = in_passes(binary(mesh), origins, np.array([[-1.0, 0.0, 0.0], [-1.0, 1e-7, 0.0]]))
    assert undecided.all()


def any_hits(surface, origins, directions, t_min=0.0, max_distance=np.inf, wide=None):
    """The answers after both passes, and which rays the first one left."""
    count, device = len(origins), surface._device
    bad, found = (wp.zeros(n, dtype=kind, device=device) for n, kind in ((2, wp.int32), (count, wp.bool)))
    rays = [wp.array(a, dtype=wp.vec3d, device=device) for a in (origins, directions)]
    tree = SurfaceTree()
    tree.assign(surface._tree)
    tree.wide = wide_slots(tree.corners) if wide is None else wp.array(wide, dtype=wp.int32, device=device)
    shared = [*rays, tree, wp.float64(t_min), wp.float64(max_distance)]
    launcher.launch(kernels.any_hit_kernel, count, shared, [found, bad], device)
    assert not bad.numpy()[0]
    left = found.numpy().view(np.uint8) == LEFT_OVER
    assert bool(bad.numpy()[1]) == left.any()
    # On a CPU the second pass has a tree of its own.
    shared[2] = gk.mesh.Surface(surface.mesh, device="cpu")._ray_tree
    launcher.launch(occluded_left_over_kernel, count, shared, [found, bad], device)
    return found.numpy(), left


@pytest.mark.slow
@pytest.mark.parametrize("make", [*mesh_catalog.CLOSED, *mesh_catalog.OPEN, *mesh_catalog.DEFECTIVE])
@pytest.mark.parametrize("limits", [{}, {"t_min": 0.4}, {"max_distance": 0.7}])
def test_any_hits_are_those_of_the_walk_in_float64(make, limits):
    mesh = make()
    rng = np.random.default_rng(2)
    middle, size = mesh.bounds.mean(axis=0), mesh.diagonal
    origins = middle + size * rng.normal(size=(3000, 3)) / 2.0
    face = mesh.faces[rng.integers(len(mesh.faces), size=3000)]
    share = rng.choice([0.0, 0.3, 1.0], (3000, 1))
    targets = mesh.vertices[face[:, 0]] * share + mesh.vertices[face[:, 1]] * (1.0 - share)
    targets[::2] = middle + rng.normal(size=(1500, 3)) * size / 3.0
    directions = targets - origins
    limits = {name: value * size if name == "max_distance" else value for name, value in limits.items()}
    # Rays that end at a vertex to the last bit are in doubt: float64 decides.
    directions[::3] *= rng.choice([0.4, 1.0, 2.5], (1000, 1))
    expected = gk.mesh.Surface(mesh, device="cpu").occluded(origins, directions, **limits)
    surface = binary(mesh)
    for wide in (None, np.arange(min(40, mesh.face_count))):
        found, left = any_hits(surface, origins, directions, **limits, wide=wide)
        np.testing.assert_array_equal(found, expected)
        # Candidates overflow only where many triangles meet.
        assert left.mean() < (0.7 if make in mesh_catalog.OPEN else 0.1)


@pytest.mark.slow
def test_limits_at_the_hit_itself():
    """Hits at t_min or at the end, and a rounding beside them, are told as by first hits."""
    mesh = mesh_catalog.torus()
    rng = np.random.default_rng(3)
    origins, directions = rng.uniform(-1.5, 1.5, (3000, 3)), rng.normal(size=(3000, 3))
    plain, surface = gk.mesh.Surface(mesh, device="cpu"), binary(mesh)
    t = plain.raycast(origins, directions).t
    row = np.flatnonzero(np.isfinite(t))[:300]
    for limit in (t[row], np.nextafter(t[row], 0.0), np.nextafter(t[row], np.inf)):
        for i, value in zip(row[:40], limit, strict=False):
            ray = origins[i : i + 1], directions[i : i + 1]
            for options in ({"t_min": value}, {"max_distance": value * np.linalg.norm(directions[i])}):
                assert any_hits(surface, *ray, **options)[0][0] == plain.occluded(*ray, **options)[0]


def test_far_away_rays_ask_for_float64():
    surface = binary(mesh_catalog.icosphere())
    assert any_hits(surface, np.array([[1e7, 0.0, 0.0]]), np.array([[-1.0, 1e-7, 0.0]]))[1].all()


def test_the_widest_triangles_of_a_hall_and_of_a_scan():
    hall = gk.mesh.box((40.0, 30.0, 10.0))
    crates = [gk.mesh.box((0.1, 0.1, 0.1), center=c) for c in np.random.default_rng(4).uniform(-4.0, 4.0, (50, 3))]
    mesh = gk.mesh.TriangleMesh(
        np.concatenate([each.vertices for each in (hall, *crates)]),
        np.concatenate([each.faces + 8 * k for k, each in enumerate((hall, *crates))]),
    )
    surface = binary(mesh)
    slots = wide_slots(surface._tree.corners).numpy()
    triangles = surface._tree.slot_triangle.numpy()[slots]
    assert sorted(triangles) == list(range(12))
    corners = mesh.vertices[mesh.faces[triangles]]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (np.diff(areas) <= 0.0).all()
    assert len(wide_slots(binary(mesh_catalog.torus())._tree.corners)) == 0
    flat = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]])
    assert len(wide_slots(binary(flat)._tree.corners)) == 0
