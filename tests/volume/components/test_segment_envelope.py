"""Components towards the limits: bodies that nearly touch, thin and tiny ones, many at once, distant ones."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.volume._components import connected_components, segment
from geokit.volume._from_function import from_function
from tests.support.analytic_volumes import ball, cubes, dense, level_set
from tests.support.effort import of_all
from tests.support.two_bodies import cuboid, errors


@pytest.mark.slow
@pytest.mark.parametrize("gap", of_all([0.1, 0.8], [0.1, 0.3, 0.5, 0.8]))
def test_gaps_below_a_voxel(gap):
    """Bodies are apart if a layer of voxels lies between them, and one component if not."""
    x = 6.0 + gap / 2.0
    apart = [ball(6.0, (-x, 0.0, 0.0)), ball(6.0, (x, 0.0, 0.0))]
    assert max(errors(apart)) < 0.1
    shifted = [ball(6.0, (0.5 - x, 0.0, 0.0)), ball(6.0, (0.5 + x, 0.0, 0.0))]
    whole = level_set(lambda p: np.minimum(shifted[0](p), shifted[1](p)))
    # The voxels at 0 and 1 face each other in different bodies.
    assert len(segment(whole, device="cpu")) == 1


@pytest.mark.parametrize("thickness", [1.2, 2.0, 3.0])
@pytest.mark.parametrize("gap", [4.0, 6.0])
def test_plates(thickness, gap):
    plate = cuboid((8.0, 8.0, thickness / 2.0), (0.2, 0.1, -0.3))
    body = ball(6.0, (0.2, 0.1, thickness / 2.0 - 0.3 + gap + 6.0))
    assert max(errors([plate, body])) < 0.4


@pytest.mark.parametrize("radius", [0.8, 1.3, 2.1])
def test_specks_beside_a_body(radius):
    body, speck = ball(8.0, (-5.0, 0.0, 0.0)), ball(radius, (3.0 + radius + 3.5, 0.2, 0.1))
    large, small = errors([body, speck])
    assert large < 0.1
    # A speck below two voxels has no voxels from which its curvature shows.
    assert small < (0.1 if radius > 2.0 else 0.5)


@pytest.mark.slow
def test_many_bodies_at_once():
    spacing = 14.0

    def distance(points):
        return np.linalg.norm(points - spacing * np.clip(np.round(points / spacing), -1, 1), axis=1) - 5.0

    reach = spacing + 10.0
    whole = from_function(distance, [[-reach] * 3, [reach] * 3], 1.0)
    components = segment(whole, device="cpu")
    assert len(components) == 27 == connected_components(whole, device="cpu").count
    for component in components:
        lower = component.info.index_bounds[0] - 2
        upper = component.info.index_bounds[1] + 2
        box = component.to_dense(bounds=np.stack([lower, upper]), device="cpu").values
        steps = [np.arange(a, b + 1) for a, b in zip(lower, upper, strict=True)]
        points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1) * 1.0
        points = points @ component.info.transform[:3, :3].T + component.info.transform[:3, 3]
        center = spacing * np.round(points.mean(axis=(0, 1, 2)) / spacing)
        truth = np.clip(np.linalg.norm(points - center, axis=-1) - 5.0, -3.0, 3.0)
        assert np.abs(box - truth).max() < 0.1


@pytest.mark.parametrize("size", [1e-6, 1e3])
def test_voxel_sizes(size):
    bodies = [ball(6.0 * size, (-7.5 * size, 0.0, 0.0)), ball(6.0 * size, (7.5 * size, 0.0, 0.0))]
    whole = level_set(lambda p: np.minimum(bodies[0](p), bodies[1](p)), transform=cubes(size), dtype=np.float64)
    found = [dense(component, -20, 20) / size for component in segment(whole, device="cpu")]
    for body in bodies:
        alone = dense(level_set(body, transform=cubes(size), dtype=np.float64), -20, 20) / size
        assert min(np.abs(values - alone).max() for values in found) < 0.1


def test_values_that_are_not_finite():
    bodies = [ball(6.0, (-7.5, 0.0, 0.0)), ball(6.0, (7.5, 0.0, 0.0))]

    def broken(points):
        values = np.minimum(bodies[0](points), bodies[1](points))
        values[np.abs(points - [-14.0, 0.0, 0.0]).max(axis=1) < 0.5] = np.nan
        return values

    whole = level_set(lambda p: np.minimum(bodies[0](p), bodies[1](p)), values=broken)
    components = segment(whole, device="cpu")
    assert len(components) == 2
    far = dense(components[0], -24, 24), dense(components[1], -24, 24)
    alone = dense(level_set(bodies[1]), -24, 24)
    assert min(np.abs(values - alone).max() for values in far) < 0.1
