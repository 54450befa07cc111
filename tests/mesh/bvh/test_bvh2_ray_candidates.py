"""The two passes of rays on a GPU, run on the CPU with the same tree of a warp Mesh."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.mesh.bvh import bvh2_ray_candidates_cuda_kernels as kernels


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


def on_warp_tree(mesh):
    """A CPU surface over the tree that CUDA queries walk."""
    surface = gk.mesh.Surface(mesh, device="cpu")
    surface._take_warp_tree()
    return surface


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
    found, undecided = in_passes(on_warp_tree(mesh), origins, directions)
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
        found, undecided = in_passes(on_warp_tree(mesh), origins, directions, **options)
        assert not undecided.any()
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other)


def test_far_away_rays_are_left_to_float64():
    mesh = mesh_catalog.icosphere()
    origins = np.array([[1e7, 0.0, 0.0], [1e7, 0.0, 0.0]])
    _, undecided = in_passes(on_warp_tree(mesh), origins, np.array([[-1.0, 0.0, 0.0], [-1.0, 1e-7, 0.0]]))
    assert undecided.all()
