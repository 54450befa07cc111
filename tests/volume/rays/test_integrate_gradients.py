"""Gradients of transmittances and emissions by rays and voxel values, against finite differences in float64."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from geokit import InputError, volume  # noqa: E402
from geokit.volume.nanovdb.header import aligned_buffer  # noqa: E402
from geokit.volume.nanovdb.nodes import bits_of, grid_nodes  # noqa: E402
from geokit.volume.tree.leaves import assemble, leaves_of  # noqa: E402
from tests.support.effort import of_all  # noqa: E402


def _rough(field, seed, low, high):
    """Random values in float64 under a sheared transform."""
    shape = grid_nodes(field.nanovdb).leaf.values.shape
    values = np.random.default_rng(seed).uniform(low, high, shape)
    turn = np.eye(4)
    turn[:3, :3] = 0.5 * np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.1], [0.0, 0.0, 1.2]])
    made = assemble(leaves_of(field), values, field, background=0.0, grid_class="fog volume", transform=turn)
    return _with_tiles(made, 0.4 * high)


def _with_tiles(grid, value):
    """Tiles beside the leaves, along x: 8 voxels wide."""
    buffer = aligned_buffer(len(grid.nanovdb))
    buffer[:] = grid.nanovdb
    for _, part in grid_nodes(buffer).lower.parts():
        child = bits_of(part.child_mask)
        for slot in np.ravel_multi_index(np.meshgrid([1, 14], [0, 15], [0, 15]), (16, 16, 16)).ravel():
            part.values[~child[:, slot], slot] = value
    return dataclasses.replace(grid, nanovdb=buffer, _uploads={})


def _as_float(grid):
    values = grid_nodes(grid.nanovdb).leaf.values.astype(np.float32)
    like = {"background": 0.0, "grid_class": "fog volume", "transform": grid.info.transform}
    return _with_tiles(assemble(leaves_of(grid), values, grid, **like), 0.4)


@pytest.fixture(scope="module")
def fog():
    """A rough density around a sphere; the leaves of its inside are left out."""
    field = volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.5)
    return _rough(field, 1, 0.0, 1.0)


@pytest.fixture(scope="module")
def light():
    """Emission of both signs in other leaves than the density's."""
    field = volume.from_function(lambda p: np.linalg.norm(p - 0.7, axis=1) - 1.0, [[-2, -2, -2], [3, 3, 3]], 0.5)
    return _rough(field, 2, -0.3, 1.0)


@pytest.fixture
def rays():
    random = np.random.default_rng(2)
    origins = 2.0 * random.standard_normal((12, 3))
    origins[:4] *= 0.1  # starts within
    directions = random.uniform(0.1, 2.0, (12, 1)) * (0.5 * random.standard_normal((12, 3)) - origins)
    return tuple(torch.tensor(rows, requires_grad=True) for rows in (origins, directions))


@pytest.mark.parametrize("limits", [{}, {"t_min": 0.2}, {"max_distance": 1.5}, {"t_min": 0.1, "max_distance": 2.5}])
def test_transmittances(fog, rays, limits):
    def answer(origins, directions):
        return volume.integrate(fog, origins, directions, extinction=0.7, device="cpu", **limits).transmittance

    assert (answer(*rays) < 0.99).sum() > 6
    assert torch.autograd.gradcheck(answer, rays, eps=1e-7, atol=1e-6, nondet_tol=0.0)
    single = [part.detach().float().requires_grad_() for part in rays]
    answer(*single).sum().backward()
    answer(*rays).sum().backward()
    for one, other in zip(single, rays, strict=True):
        np.testing.assert_allclose(one.grad, other.grad, rtol=1e-3, atol=1e-4)


def test_a_ray_that_misses_has_the_gradient_zero(fog):
    origins = torch.tensor([[50.0, 0, 0]], dtype=torch.float64, requires_grad=True)
    volume.integrate(fog, origins, [[1.0, 0, 0]], device="cpu").transmittance.sum().backward()
    assert (origins.grad == 0.0).all()


def test_rays_cross_tiles(fog):
    """What the other tests hold is not of leaves alone."""
    beside = fog.info.transform @ [10.0, 2.0, 2.0, 1.0]
    assert fog.sample(beside[None, :3], device="cpu")[0] == pytest.approx(0.4)


def test_a_second_derivative_is_refused(fog, rays):
    (slope,) = torch.autograd.grad(
        volume.integrate(fog, *rays, device="cpu").transmittance.sum(), rays[0], create_graph=True
    )
    with pytest.raises(InputError, match="second derivatives of integrals along rays are not known"):
        slope.sum().backward()


LIMITS = [{}, {"t_min": 0.1, "max_distance": 2.5}]


@pytest.mark.parametrize("limits", LIMITS)
def test_both_by_rays(fog, light, rays, limits):
    def answer(origins, directions):
        return volume.integrate(fog, origins, directions, emission=light, extinction=0.7, device="cpu", **limits)

    assert (answer(*rays).emission != 0.0).sum() > 6
    assert torch.autograd.gradcheck(answer, rays, eps=1e-7, atol=1e-6, nondet_tol=0.0)


@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("kind", ["double", "float"])
def test_both_by_voxel_values(fog, light, rays, limits, kind):
    """A scalar of all rays by single values: within leaves, at borders of the active region and of tiles."""
    origins, directions = (part.detach() for part in rays)
    grids = [grid if kind == "double" else _as_float(grid) for grid in (fog, light)]
    values = [torch.tensor(volume.active_voxels(grid).values.astype(np.float64)) for grid in grids]
    weights = torch.linspace(0.5, 2.0, len(origins), dtype=torch.float64)

    def loss(density, glow):
        first, second = (volume.with_values(grid, part) for grid, part in zip(grids, (density, glow), strict=True))
        options = {"extinction": 0.7, "device": "cpu", **limits}
        found = volume.integrate(first, origins, directions, emission=second, **options)
        return (weights * (found.transmittance + found.emission)).sum()

    tracked = [part.clone().requires_grad_() for part in values]
    slopes = torch.autograd.grad(loss(*tracked), tracked)
    again = torch.autograd.grad(loss(*tracked), tracked)
    step, tolerance = (1e-5, 1e-8) if kind == "double" else (2.0**-9, 1e-4)
    for which in (0, 1):
        slope = slopes[which]
        assert torch.equal(slope, again[which])
        asked = torch.nonzero(slope).ravel()
        assert len(asked) > 100
        # The largest, some others, and values that no ray comes near.
        some = [int(slope.abs().argmax()), *asked[:: len(asked) // 8].tolist(), int((slope == 0.0).nonzero()[0])]
        for row in some:
            moved = [[part.clone() for part in values] for _ in range(2)]
            moved[0][which][row] += step
            moved[1][which][row] -= step
            difference = (loss(*moved[0]) - loss(*moved[1])) / (2.0 * step)
            np.testing.assert_allclose(slope[row], difference, rtol=tolerance, atol=tolerance)


def test_an_emission_that_is_zero_has_a_slope(fog, light, rays):
    """The emission is linear in its values: the slope times any values is their emission."""
    origins, directions = (part.detach() for part in rays)
    plain = _with_tiles(volume.with_values(light, volume.active_voxels(light).values), 0.0)
    values = torch.tensor(volume.active_voxels(plain).values)

    def total(given):
        held = volume.with_values(plain, given)
        return volume.integrate(fog, origins, directions, emission=held, extinction=0.7, device="cpu").emission.sum()

    (slope,) = torch.autograd.grad(total(nothing := torch.zeros_like(values).requires_grad_()), nothing)
    inactive = total(torch.zeros_like(values))
    np.testing.assert_allclose((slope * values).sum() + inactive, total(values), rtol=1e-12)


RAYS = of_all(2000, 5000)


@pytest.mark.slow
def test_sums_do_not_depend_on_the_order_of_rays(fog, light):
    """Whole numbers are added: also across threads, and where one ray outweighs the others by far."""
    random = np.random.default_rng(5)
    origins = torch.tensor(3.0 * random.standard_normal((RAYS, 3)))
    directions = torch.tensor(0.5 * random.standard_normal((RAYS, 3))) - origins
    weights = torch.tensor(10.0 ** random.uniform(-9, 9, RAYS))

    def slopes(order):
        held = [torch.tensor(volume.active_voxels(grid).values, requires_grad=True) for grid in (fog, light)]
        first, second = (volume.with_values(grid, part) for grid, part in zip((fog, light), held, strict=True))
        found = volume.integrate(first, origins[order], directions[order], emission=second, device="cpu")
        loss = (weights[order] * (found.transmittance + found.emission)).sum()
        return torch.autograd.grad(loss, held)

    ahead, back = slopes(torch.arange(RAYS)), slopes(torch.arange(RAYS).flip(0))
    for one, other in zip(ahead, back, strict=True):
        assert torch.equal(one, other)
    # The same in two parts: each share is rounded to 1e-12 of the largest of its value.
    parts = [slopes(torch.arange(begin, RAYS, 2)) for begin in (0, 1)]
    for one, first, second in zip(ahead, *parts, strict=True):
        np.testing.assert_allclose(one, first + second, rtol=1e-9)


def test_values_of_float32_rays(fog, light, rays):
    """As in float64: the emission is asked again, because its answer was rounded."""
    found = []
    for dtype in (torch.float32, torch.float64):
        origins, directions = (part.detach().float().to(dtype) for part in rays)
        values = torch.tensor(volume.active_voxels(fog).values, requires_grad=True)
        held = volume.with_values(fog, values)
        volume.integrate(held, origins, directions, emission=light, device="cpu").emission.sum().backward()
        found.append(values.grad)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12, atol=1e-13)


def test_an_infinite_share_is_no_number(fog):
    """An amplification beyond float64: the values that are met have no slope."""
    values = torch.tensor(-500.0 * volume.active_voxels(fog).values, requires_grad=True)
    held = volume.with_values(fog, values)
    found = volume.integrate(held, [[-9.0, 0.1, 0.2]], [[1.0, 0.0, 0.0]], extinction=10.0, device="cpu").transmittance
    found.sum().backward()
    assert torch.isinf(found).all()
    assert torch.isnan(values.grad).any()
    assert (values.grad == 0.0).any()


@pytest.mark.slow
def test_compiled_whole(fog, light, rays):
    held = [torch.tensor(volume.active_voxels(grid).values, requires_grad=True) for grid in (fog, light)]
    first, second = (volume.with_values(grid, part) for grid, part in zip((fog, light), held, strict=True))

    def loss(origins, directions):
        found = volume.integrate(first, origins, directions, emission=second, device="cpu")
        return (found.transmittance + found.emission).sum()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    plain, other = (torch.autograd.grad(run(*rays), (*rays, *held)) for run in (loss, compiled))
    assert all(map(torch.equal, plain, other))


def test_a_volume_given_by_keyword_has_gradients_too(fog, rays):
    values = torch.tensor(volume.active_voxels(fog).values, requires_grad=True)
    origins, directions = (part.detach() for part in rays)
    held = volume.with_values(fog, values)
    volume.integrate(volume=held, origins=origins, directions=directions, device="cpu").transmittance.sum().backward()
    assert (values.grad < 0.0).any()
