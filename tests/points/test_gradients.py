"""Gradients of distances between points, and of densities."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from geokit import InputError, points  # noqa: E402
from tests.support.gradient_checks import check, tensor  # noqa: E402


@pytest.fixture
def clouds():
    random = np.random.default_rng(6)
    return tensor(random.random((30, 3))), tensor(random.random((20, 3)))


@pytest.mark.slow
def test_nearest(clouds):
    check(lambda a, b: points.NeighborGrid(a, device="cpu").knn(b, k=3).distance, *clouds)
    check(lambda a: points.NeighborGrid(a, device="cpu").knn(k=3, exclude_self=True).distance, clouds[0])


def test_none_within_the_radius(clouds):
    def answer(a, b):
        found = points.NeighborGrid(a, device="cpu").hybrid(b, k=3, radius=0.2)
        return torch.where(found.indices < 0, 0.0, found.distance)

    check(answer, *clouds)


@pytest.mark.slow
@pytest.mark.parametrize("order", ["index", "distance", "any"])
def test_all_within_the_radius(clouds, order):
    grid = points.NeighborGrid
    check(lambda a, b: grid(a, device="cpu").radius_search(b, radius=0.4, order=order).distance, *clouds)
    check(lambda b: grid(clouds[0], device="cpu").radius_search(b, radius=0.4, order=order).distance, clouds[1])
    # A point finds itself, and that distance has no slope.
    a = clouds[0].clone().requires_grad_()
    found = grid(a, device="cpu").radius_search(radius=0.4, order=order)
    plain = grid(clouds[0], device="cpu").radius_search(radius=0.4, order=order)
    assert torch.equal(found.indices, plain.indices)
    assert torch.equal(found.distance.detach(), plain.distance)
    own = torch.zeros_like(found.distance)
    own[found.distance == 0.0] = 1.0
    (slope,) = torch.autograd.grad(found.distance, a, own)
    assert (slope == 0.0).all()


@pytest.mark.slow
def test_images_within_the_radius(clouds):
    cell = [[1.0, 0.0, 0.0], [0.2, 0.9, 0.0], [0.1, -0.2, 1.1]]

    def made(a):
        return points.NeighborGrid(a, 0.6, periodic=cell, device="cpu")

    check(lambda a, b: made(a).neighbor_list(b).distance, *clouds)
    check(lambda a: made(a).neighbor_list(exclude_self=True, order="distance").distance, clouds[0])
    # Points and queries outside of the cell, and points that have no gradients.
    far = made(3.0 * clouds[0] - 1.0)
    check(lambda b: far.neighbor_list(b).distance, 3.0 * clouds[1] - 1.0)
    with pytest.raises(InputError, match=r"radius_search: distances to images .* use neighbor_list\(\)"):
        made(clouds[0].requires_grad_()).radius_search().distance.sum().backward()


def test_no_point_within_the_radius(clouds):
    a = clouds[0].clone().requires_grad_()
    found = points.NeighborGrid(a, device="cpu").radius_search(a.detach() + 10.0, radius=0.1)
    found.distance.sum().backward()
    assert (a.grad == 0.0).all()


@pytest.mark.parametrize("part", ["distance", "squared"])
def test_chamfer(clouds, part):
    check(lambda a, b: getattr(points.chamfer(a, b, device="cpu"), part), *clouds)


def test_chamfer_is_that_without_gradients(clouds):
    a, b = clouds
    plain, found = points.chamfer(a, b, device="cpu"), points.chamfer(a.clone().requires_grad_(), b, device="cpu")
    for number, without in [(found.distance, plain.distance), (found.squared, plain.squared),
                            *zip(found.a_to_b, plain.a_to_b, strict=True)]:  # fmt: skip
        assert number.item() == pytest.approx(without, rel=1e-14)


GROUPS = [0, 10, 11, 30], [0, 5, 12, 20]


@pytest.mark.slow
@pytest.mark.parametrize("part", ["distance", "squared"])
def test_chamfer_of_groups(clouds, part):
    check(lambda a, b: getattr(points.chamfer(a, b, groups=GROUPS, device="cpu"), part), *clouds)
    check(lambda a, b: points.chamfer(a, b, groups=GROUPS, device="cpu").b_to_a.max, *clouds)


def test_chamfer_of_groups_is_that_without_gradients(clouds):
    a, b = clouds
    plain = points.chamfer(a, b, groups=GROUPS, device="cpu")
    found = points.chamfer(a.clone().requires_grad_(), b, groups=GROUPS, device="cpu")
    for with_slope, without in [(found.distance, plain.distance), (found.squared, plain.squared),
                                *zip(found.b_to_a, plain.b_to_a, strict=True)]:  # fmt: skip
        assert torch.allclose(with_slope.detach(), without, rtol=1e-14)


def test_nearest_in_groups(clouds):
    def answer(a, b):
        return points.NeighborGrid(a, groups=GROUPS[0], device="cpu").knn(b, 1, groups=GROUPS[1]).distance

    check(answer, *clouds)


def test_equal_clouds_have_no_slope(clouds):
    a = clouds[0].clone().requires_grad_()
    found = points.chamfer(a, a.detach(), device="cpu")
    (slope,) = torch.autograd.grad(found.distance + found.squared + found.a_to_b.rms, a)
    assert (slope == 0.0).all()


def test_hausdorff_by_its_witnesses(clouds):
    check(lambda a, b: points.hausdorff(a, b, device="cpu").max, *clouds)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["cubic_spline", "wendland_c2", "poly6"])
def test_density(clouds, kernel):
    check(lambda a, b: points.density(a, radius=0.4, kernel=kernel, queries=b, mass=2.0, device="cpu"), *clouds)
    check(lambda a: points.density(a, radius=0.4, kernel=kernel, device="cpu"), clouds[0], second=False)


def test_counts_are_steps(clouds):
    a = clouds[0].clone().requires_grad_()
    with pytest.raises(InputError, match="kernel: 'count' has no derivative"):
        points.density(a, radius=0.4, device="cpu").sum().backward()
