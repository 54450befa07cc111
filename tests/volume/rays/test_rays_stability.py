"""Rays through volumes towards failure: far away, tiny, huge, grazing, through thin walls and dents."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.volume._integrate import integrate
from geokit.volume._raycast import raycast
from tests.support.volume_rays import Field, both_ways, rays_through

EPSILON = 2.0**-53


def _field(lower=(0, 0, 0), transform=None):
    """The same random voxels anywhere."""
    return Field(np.random.default_rng(0).normal(size=(16, 16, 16)), lower, 0.6, transform)


def _scaled(voxel_size, translation=0.0):
    transform = np.diag([voxel_size] * 3 + [1.0])
    transform[:3, 3] = translation
    return transform


@pytest.fixture(scope="module")
def rays():
    start, toward = rays_through(np.full(3, -1.0), np.full(3, 16.0), 400, 1)
    # Numbers with few bits stay exact where they are moved.
    return np.round(start * 2**10) / 2**10, np.round(toward * 2**10) / 2**10


@pytest.fixture(scope="module")
def near(rays):
    return raycast(_field().volume, *rays, device="cpu")


@pytest.mark.parametrize("lower", [-1_000_000, 2**30, -(2**30), 2**31 - 4096, -(2**31) + 4096])
def test_any_place_in_index_space_gives_the_same_bits(lower, rays, near):
    start, toward = rays
    hits = raycast(_field((lower,) * 3).volume, start + lower, toward, device="cpu")
    np.testing.assert_array_equal(hits.t, near.t)
    np.testing.assert_array_equal(hits.normals, near.normals)


@pytest.mark.parametrize("voxels", [2.0**20, -(2.0**30), 2.0**40])
def test_any_translation_gives_the_same_bits(voxels, rays, near):
    start, toward = rays
    hits = raycast(_field(transform=_scaled(1.0, voxels)).volume, start + voxels, toward, device="cpu")
    np.testing.assert_array_equal(hits.t, near.t)


def test_translation_that_cancels_the_place_in_index_space(rays, near):
    # Voxels at 2^30 that stand at the world's origin: computed as inverse(linear) @ point - translation, the digits of
    # 2^30 voxels would be lost.
    lower, size = 2**30, 0.1
    field = _field((lower,) * 3, _scaled(size, -lower * size))
    start, toward = rays
    hits = raycast(field.volume, start * size, toward * size, device="cpu")
    # The translation itself is rounded: by 2^-27, of voxels of 0.1.
    same = np.isclose(hits.t, near.t, rtol=0, atol=1e-5) | (np.isinf(hits.t) & np.isinf(near.t))
    assert same.mean() > 0.98


@pytest.mark.parametrize("voxel_size", [1e-12, 1e-6, 1e6, 1e12])
def test_any_voxel_size(voxel_size, rays, near):
    start, toward = rays
    transform = _scaled(voxel_size)
    hits = raycast(_field(transform=transform).volume, start * voxel_size, toward, device="cpu")
    same = np.isclose(hits.t, near.t * voxel_size, rtol=1e-9) | (np.isinf(hits.t) & np.isinf(near.t))
    assert same.mean() > 0.99
    np.testing.assert_allclose(np.linalg.norm(hits.normals[np.isfinite(hits.t)], axis=1), 1.0, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("distance", 10.0 ** np.arange(2, 17, 2))
def test_origins_far_away(distance, rays, near):
    start, toward = rays
    back = distance / np.linalg.norm(toward, axis=1, keepdims=True)
    origins = start - back * toward
    hits = _t_beyond(origins, start, toward)
    found = np.isfinite(hits) & np.isfinite(near.t)
    error = np.abs(hits[found] - near.t[found])
    # The ray passes beside the near one by the rounding of its origin, and t is rounded too: the crossing moves by some
    # hundred times that at most, but for rays that graze a level, or hit another.
    bound = 1e3 * EPSILON * distance + 1e-9
    assert np.quantile(error, 0.9) <= bound
    assert (np.isfinite(hits) == np.isfinite(near.t)).mean() > (0.9 if distance < 1e14 else 0.2)


def _t_beyond(origins, start, toward):
    """t of hits beyond ``start``, counted from there."""
    past = ((start - origins) * toward).sum(axis=1) / (toward**2).sum(axis=1)
    volume = _field().volume
    found = np.array(
        [
            raycast(volume, o[None], d[None], t_min=max(float(p), 0.0), device="cpu").t[0]
            for o, d, p in zip(origins, toward, past, strict=True)
        ]
    )
    return found - past


def test_numbers_beyond_all_measure_are_misses_and_not_crashes():
    start = np.array([[1e308, 0, 0], [-1e308, 8, 8], [8, 8, -1e300], [1e300, 1e300, 1e300]])
    toward = np.array([[-1.0, 0, 0], [1.0, 0, 0], [0, 1e-300, 1.0], [-1.0, -1.0, -1.0]])
    for size in (1e-10, 1.0, 1e10):
        volume = _field(transform=_scaled(size)).volume
        hits = raycast(volume, start, toward, device="cpu")
        assert not np.isnan(hits.t).any()
        assert (integrate(Field(np.ones((8, 8, 8)), background=0.0).volume, start, toward, device="cpu")[0] <= 1).all()


@pytest.mark.parametrize("tilt", [0.0, 1e-16, 1e-12, 1e-8, 1e-4])
def test_rays_that_graze_borders(tilt, monkeypatch):
    # A plane of the level at x = 5.5, rays along borders of cells and leaves tilted by less and less: none slips
    # between cells.
    field = Field(np.broadcast_to(np.arange(16.0)[:, None, None] - 5.5, (16, 16, 16)), background=20.0)
    offset = np.array([0.0, 1e-17, 1e-12, -1e-12, 0.5])
    y, z = (o.ravel() for o in np.meshgrid(8.0 + offset, 8.0 + offset))
    for sign in (1.0, -1.0):
        start = np.stack([np.zeros(len(y)), y, z], axis=1)
        toward = np.tile([1.0, sign * tilt, -sign * tilt], (len(y), 1))
        hits = both_ways(monkeypatch, field.volume, start, toward)
        np.testing.assert_allclose(hits.t, 5.5, rtol=1e-15)


@pytest.mark.parametrize("depth", [1e-1, 1e-4, 1e-8, 1e-12])
def test_dents_that_hardly_reach_through_the_level(depth, monkeypatch):
    # One voxel just beyond the level, all around it 1: the region beyond it is as small as `depth` voxels.
    dense = np.ones((16, 16, 16))
    dense[8, 8, 8] = -np.float32(depth)
    field = Field(dense, background=1.0)
    toward = np.random.default_rng(0).normal(size=(200, 3))
    hits = both_ways(monkeypatch, field.volume, 8.0 - 5.0 * toward, toward)
    # The interpolant there is 1 - (1 + depth) (1 - |x|) (1 - |y|) (1 - |z|): |x| + |y| + |z| - depth to first order.
    beside = (5.0 - hits.t) * np.abs(toward).sum(axis=1)
    np.testing.assert_allclose(beside, depth, rtol=1.5 * depth + 1e-6, atol=1e-13)


def test_thin_walls(monkeypatch):
    # A wall between two planes of voxels, thinner and thinner; the interpolant has both sides of it within a cell of
    # a linear field only where a voxel is beyond, so that the wall is one plane of voxels.
    for scale in (1.0, 1e-3, 1e-6):
        dense = np.broadcast_to(np.abs(np.arange(16.0) - 8.0)[:, None, None] - scale, (16, 16, 16))
        field = Field(dense, background=10.0)
        start, toward = np.array([[1.0, 5.3, 7.7]]), np.array([[1.0, 0.01, 0.02]])
        hits = both_ways(monkeypatch, field.volume, start, toward)
        inner = dense[8, 0, 0].astype(np.float32).astype(float)
        outer = dense[7, 0, 0].astype(np.float32).astype(float)
        wanted = 6.0 + outer / (outer - inner)
        np.testing.assert_allclose(hits.t, wanted, rtol=1e-12)


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1e6, 1e30])
def test_scaled_fields_have_the_same_hits(scale, rays, near):
    dense = np.random.default_rng(0).normal(size=(16, 16, 16)).astype(np.float32)
    # A power of two scales without rounding.
    factor = 2.0 ** np.round(np.log2(scale))
    field = Field(dense * factor, (0, 0, 0), float(np.float32(0.6) * factor))
    hits = raycast(field.volume, *rays, device="cpu")
    np.testing.assert_array_equal(hits.t, near.t)
