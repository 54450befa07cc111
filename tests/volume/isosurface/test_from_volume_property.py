"""Isosurfaces of any field: closed, manifold and oriented, on the interpolant, and the same wherever the grid lies."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.catalog.float_grids import build_float_grid
from geokit.mesh._audit import audit
from geokit.mesh.volumes.from_volume import from_volume
from geokit.volume.at_points.sample import sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from tests.support.effort import of_all

METHODS = ["surface_nets", "marching_cubes", "dual_contouring"]
VOXELS = np.array(list(np.ndindex(8, 8, 8)))
SHEARED = np.array([[0.5, 0.2, 0.0, 3.0], [-0.1, 0.25, 0.3, -7.0], [0.0, 0.1, 2.0, 11.0], [0.0, 0.0, 0.0, 1.0]])
# Crossings keep 1e-6 voxel from the ends of edges, and float32 rounds their place to 1e-7; the steepest edge of the
# fields below spans 12 units.
ON_SURFACE = 12 * 2e-6


def grid(blocks, values, *, background=1.0, transform=None, origin=(0, 0, 0), active=None):
    blocks = (8 * np.asarray(blocks) + np.asarray(origin)).astype(np.int32)
    buffer = build_float_grid(
        blocks,
        values.astype(np.float32),
        np.ones(values.shape, bool) if active is None else active,
        background=background,
        transform=np.eye(4) if transform is None else transform,
        name="field",
        grid_class="unknown",
        signed_fill=False,
    )
    return SparseVolume(buffer, info_of(buffer))


def some_blocks(rng, share):
    blocks = np.array(list(np.ndindex(3, 2, 2)))
    keep = rng.random(len(blocks)) < share
    keep[rng.integers(len(blocks))] = True
    return blocks[keep] - 1


def noise(rng, blocks, steps):
    """Values without any smoothness, so that all cases occur; with steps, voxels that have the isovalue itself."""
    values = np.clip(rng.normal(size=(len(blocks), 512)), -6, 6)
    return np.round(values * steps) / steps if steps else values


def waves(rng, blocks):
    """A band-limited field: waves of at least six voxels."""
    points = (8 * blocks[:, None] + VOXELS).reshape(-1, 3).astype(float)
    total = np.zeros(len(points))
    for _ in range(6):
        direction = rng.normal(size=3)
        direction *= 2 * np.pi / rng.uniform(6, 20) / np.linalg.norm(direction)
        total += rng.uniform(0.2, 1) * np.sin(points @ direction + rng.uniform(0, 7))
    return total.reshape(-1, 512)


def is_sound(mesh):
    report = audit(mesh)
    return report.watertight and report.manifold and report.oriented and report.unreferenced_count == 0


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=of_all(12, 25), deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    share=st.sampled_from([0.2, 0.6, 1.0]),
    steps=st.sampled_from([0, 0, 2]),
    background=st.sampled_from([-1.0, 1.0]),
    isovalue=st.sampled_from([-0.5, 0.0, 0.3]),
)
def test_noise_has_a_closed_manifold_surface(method, seed, share, steps, background, isovalue):
    rng = np.random.default_rng(seed)
    blocks = some_blocks(rng, share)
    volume = grid(blocks, noise(rng, blocks, steps), background=background)
    mesh = from_volume(volume, isovalue=isovalue, method=method, device="cpu")
    assert len(mesh.faces) > 100
    if method == "dual_contouring" and steps:
        # Planes of values on a raster meet at voxels, where sheets may touch; by their indices they still do not.
        forward = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        keys = forward[:, 0].astype(np.int64) << 32 | forward[:, 1]
        back = forward[:, 1].astype(np.int64) << 32 | forward[:, 0]
        assert len(np.unique(keys)) == len(keys)
        assert set(keys.tolist()) == set(back.tolist())
    else:
        assert is_sound(mesh)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_band_limited_fields_have_a_closed_manifold_surface(method, seed):
    rng = np.random.default_rng(seed)
    blocks = np.array(list(np.ndindex(3, 2, 2)))
    mesh = from_volume(grid(blocks, waves(rng, blocks), background=3.0), method=method, device="cpu")
    assert is_sound(mesh)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), isovalue=st.sampled_from([-0.5, 0.0, 0.3]), sheared=st.booleans())
def test_marching_cubes_lie_on_the_interpolant(seed, isovalue, sheared):
    rng = np.random.default_rng(seed)
    blocks = some_blocks(rng, 0.6)
    volume = grid(blocks, noise(rng, blocks, 0), transform=SHEARED if sheared else None)
    mesh = from_volume(volume, isovalue=isovalue, method="marching_cubes", device="cpu")
    assert np.abs(sample(volume, mesh.vertices, device="cpu") - isovalue).max() < ON_SURFACE


@pytest.mark.slow
@settings(max_examples=of_all(6, 15), deadline=None)
@given(seed=st.integers(0, 2**32 - 1), dead=st.sampled_from([0.3, 0.7, 0.95]))
def test_faces_that_are_left_where_voxels_are_not_active_are_those_of_the_whole(seed, dead):
    rng = np.random.default_rng(seed)
    blocks = some_blocks(rng, 0.6)
    values = noise(rng, blocks, 0)
    active = rng.random(values.shape) >= dead
    for method in METHODS:
        whole = from_volume(grid(blocks, values), method=method, device="cpu")
        part = from_volume(grid(blocks, values, active=active), method=method, device="cpu")
        assert 0 < len(part.faces) < len(whole.faces)
        corners = {row.tobytes() for row in whole.vertices[whole.faces].reshape(-1, 9)}
        assert corners >= {row.tobytes() for row in part.vertices[part.faces].reshape(-1, 9)}
        assert audit(part).unreferenced_count == 0
        assert audit(part).non_manifold_edge_count == 0


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    step=st.tuples(*3 * [st.sampled_from([-(2**30), -4096, -128, -8, 0, 8, 128, 4096, 2**30])]),
)
def test_a_surface_moves_with_its_grid(method, seed, step):
    rng = np.random.default_rng(seed)
    blocks = some_blocks(rng, 0.6)
    values = noise(rng, blocks, 0)
    here = from_volume(grid(blocks, values), method=method, device="cpu")
    there = from_volume(grid(blocks, values, origin=step), method=method, device="cpu")
    assert len(here.vertices) == len(there.vertices)
    assert len(here.faces) == len(there.faces)
    # Leaves may come in another order. Coordinates of 2^30 have a raster of 2^-22.
    rounding = 2.0**-21 if max(map(abs, step)) > 2**20 else 1e-9
    moved = there.vertices - np.array(step, float)
    assert np.abs(np.sort(here.vertices, axis=0) - np.sort(moved, axis=0)).max() <= rounding


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_all_methods_enclose_about_the_same(seed):
    rng = np.random.default_rng(seed)
    blocks = np.array(list(np.ndindex(3, 2, 2)))
    volume = grid(blocks, waves(rng, blocks), background=3.0)
    nets, cubes, sharp = (from_volume(volume, method=method, device="cpu") for method in METHODS)
    # The shortest waves have a radius of curvature of about a voxel where two meet.
    size = audit(nets).signed_volume
    assert abs(audit(cubes).signed_volume - size) < 0.1 * size
    assert abs(audit(sharp).signed_volume - size) < 0.1 * size
