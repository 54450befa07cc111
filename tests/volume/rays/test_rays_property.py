"""What holds for rays through any field under any affine transform."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from geokit.volume._integrate import integrate
from geokit.volume._raycast import raycast
from geokit.volume.at_points.sample import sample
from tests.support.volume_rays import Field, assert_first_crossings, both_ways, rays_through

EXAMPLES = settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
seeds = st.integers(0, 2**32 - 1)
lowers = st.tuples(*[st.integers(-600, 600)] * 3).map(lambda o: tuple(8 * x for x in o))


def _transform(seed: int) -> np.ndarray:
    """A random rotation, reflection, shear and scale with a condition number below 30, and a translation."""
    rng = np.random.default_rng(seed)
    u, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    v, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    transform = np.eye(4)
    transform[:3, :3] = u @ np.diag(rng.uniform(0.1, 3.0, 3)) @ v
    transform[:3, 3] = rng.uniform(-100, 100, 3)
    return transform


def _field(seed, lower, transform=None, low=-1.0, background=0.7):
    rng = np.random.default_rng(seed)
    return Field(rng.uniform(low, 1.0, (16, 16, 16)), lower, background, transform, rng.random((2, 2, 2)) < 0.8)


def _rays(field, count, seed):
    return rays_through(field.lower - 1.0, field.lower + 16.0, count, seed)


@pytest.mark.slow
@EXAMPLES
@given(seeds, lowers, st.floats(-0.9, 0.9))
def test_first_crossings_of_any_field(monkeypatch, seed, lower, isovalue):
    field = _field(seed, lower)
    start, toward = _rays(field, 8, seed)
    hits = both_ways(monkeypatch, field.volume, start, toward, isovalue=isovalue)
    assert_first_crossings(field.at, start, toward, hits.t, isovalue=isovalue, last=45.0, atol=1e-8)


@pytest.mark.slow
@EXAMPLES
@given(seeds, lowers, seeds)
def test_any_transform_gives_the_same_hits(monkeypatch, seed, lower, shape):
    plain, turned = _field(seed, lower), _field(seed, lower, _transform(shape))
    start, toward = _rays(plain, 200, seed)
    one = raycast(plain.volume, start, toward, device="cpu")
    other = both_ways(monkeypatch, turned.volume, *turned.to_world(start, toward))
    # Roundings of index coordinates up to 5000 decide for a few rays whether they graze a level.
    both = np.isfinite(one.t) & np.isfinite(other.t)
    same = both & np.isclose(one.t, other.t, rtol=0, atol=1e-6)
    assert (same | (np.isinf(one.t) & np.isinf(other.t))).mean() > 0.98
    value = sample(turned.volume, other.points[same], device="cpu")
    np.testing.assert_allclose(value, 0.0, atol=1e-9)


@EXAMPLES
@given(seeds, st.permutations(range(40)))
def test_order_of_rays_does_not_matter(seed, order):
    field = _field(seed, (0, 0, 0))
    start, toward = _rays(field, 40, seed)
    whole = raycast(field.volume, start, toward, device="cpu")
    moved = raycast(field.volume, start[order], toward[order], device="cpu")
    for one, other in zip(whole, moved, strict=True):
        np.testing.assert_array_equal(one[order], other)


@EXAMPLES
@given(seeds, st.floats(0.0, 30.0))
def test_no_hit_is_passed_over_by_starting_earlier(seed, t_min):
    field = _field(seed, (0, 0, 0))
    start, toward = _rays(field, 40, seed)
    whole = raycast(field.volume, start, toward, device="cpu").t
    later = raycast(field.volume, start, toward, t_min=t_min, device="cpu").t
    assert (later >= whole - 1e-9).all()
    beyond = whole > t_min + 1e-9
    np.testing.assert_allclose(later[beyond], whole[beyond], atol=1e-9)


@EXAMPLES
@given(seeds, lowers, seeds, st.floats(1.0, 40.0))
def test_transmittance_is_a_product(seed, lower, shape, cut):
    field = _field(seed, lower, _transform(shape), low=0.0, background=0.0)
    origins, directions = field.to_world(*_rays(field, 30, seed))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    whole = integrate(field.volume, origins, directions, extinction=0.1, device="cpu").transmittance
    near = integrate(field.volume, origins, directions, extinction=0.1, max_distance=cut, device="cpu").transmittance
    far = integrate(field.volume, origins, directions, extinction=0.1, t_min=cut, device="cpu").transmittance
    np.testing.assert_allclose(near * far, whole, rtol=1e-9)
    # Backwards from beyond the far end.
    back = integrate(
        field.volume, origins + 500 * directions, -directions, extinction=0.1, max_distance=500.0, device="cpu"
    )
    np.testing.assert_allclose(back.transmittance, whole, rtol=1e-8)


@pytest.mark.parametrize("threads", ["1", "2"])
def test_threads_do_not_matter(threads, monkeypatch):
    field = _field(1, (0, 0, 0))
    start, toward = _rays(field, 3000, 1)
    monkeypatch.setenv("GEOKIT_THREADS", "3")
    wanted = raycast(field.volume, start, toward, device="cpu")
    monkeypatch.setenv("GEOKIT_THREADS", threads)
    for one, other in zip(wanted, raycast(field.volume, start, toward, device="cpu"), strict=True):
        np.testing.assert_array_equal(one, other)
