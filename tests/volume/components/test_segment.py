"""Components of level sets as volumes: each is the distance field of its body alone."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.volume._components import segment
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.retyped.quantize import quantize
from tests.support.analytic_volumes import TURNED, ball, dense, level_set
from tests.support.two_bodies import errors


def pair(gap, radius=6.0, dtype=np.float32, half_width=3.0, transform=None):
    x = radius + gap / 2.0
    size = 1.0 if transform is None else 0.1
    middle = np.zeros(3) if transform is None else transform[:3, 3]
    ends = [tuple(middle + np.array([sign * x * size, 0.0, 0.0])) for sign in (-1, 1)]
    bodies = [ball(radius * size, end) for end in ends]
    whole = level_set(
        lambda p: np.minimum(bodies[0](p), bodies[1](p)), dtype=dtype, half_width=half_width, transform=transform
    )
    return whole, bodies


def test_a_component_does_not_see_the_other_surface():
    # The ends of the gap are on the surfaces: the values there were 0 in both components once.
    whole, _ = pair(4.0)
    ends = np.array([[-2.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    for component in segment(whole, device="cpu"):
        found = component.sample(ends, device="cpu")
        assert sorted(np.round(found, 6).tolist()) == [0.0, 3.0]


@pytest.mark.slow
@pytest.mark.parametrize("gap", [6.0, 8.3])
def test_bodies_whose_bands_do_not_meet_keep_every_value(gap):
    whole, bodies = pair(gap)
    # Equally large: the order is that of the leaves.
    components = sorted(segment(whole, device="cpu"), key=lambda component: component.info.index_bounds[0, 0])
    for component, body in zip(components, bodies, strict=True):
        alone = level_set(body)
        np.testing.assert_array_equal(dense(component, -24, 24), dense(alone, -24, 24))
        assert component.info.active_voxel_count == alone.info.active_voxel_count
        check_grid(component.nanovdb, "component")


def test_order_name_and_metadata():
    large, small = ball(7.3, (-9.0, 0.0, 0.0)), ball(4.3, (6.0, 0.0, 0.0))
    whole = level_set(lambda p: np.minimum(large(p), small(p)))
    components = segment(whole, device="cpu")
    counts = [component.info.active_voxel_count for component in components]
    assert counts == sorted(counts, reverse=True)
    assert components[0].info.index_bounds[0, 0] < components[1].info.index_bounds[0, 0]
    for component in components:
        assert (component.info.name, component.info.grid_class) == ("body", "level set")
        assert component.info.metadata == {"author": "tests"}


def test_one_body_is_returned_as_it_is():
    whole = level_set(ball(8.3))
    (component,) = segment(whole, device="cpu")
    np.testing.assert_array_equal(component.nanovdb, whole.nanovdb)


@pytest.mark.parametrize("codec", ["fp16", "fp8"])
def test_quantized_level_sets_become_floats(codec):
    components = segment(quantize(pair(4.0)[0], codec), device="cpu")
    assert [component.info.grid_type for component in components] == ["float", "float"]
    assert [component.info.grid_class for component in components] == ["level set", "level set"]


@pytest.mark.slow
def test_doubles_and_wide_bands():
    assert max(errors([ball(6.0, (-8.0, 0.1, 0.2)), ball(6.0, (8.0, 0.3, 0.0))], dtype=np.float64)) < 0.01
    assert max(errors([ball(5.0, (-7.0, 0.1, 0.2)), ball(5.0, (6.0, 0.3, 0.0))], half_width=8.0, leaves=4)) < 0.1


@pytest.mark.slow
def test_turned_voxels():
    whole, bodies = pair(2.0, transform=TURNED)
    components = segment(whole, device="cpu")
    own = [level_set(body, transform=TURNED) for body in bodies]
    found = [dense(component, -20, 20) for component in components]
    for alone in own:
        assert min(np.abs(values - dense(alone, -20, 20)).max() for values in found) < 0.1 * 0.1


def test_a_body_in_the_cavity_of_another():
    distance = lambda p: np.abs(ball(13.0)(p)) - 2.5  # noqa: E731
    shell, core = distance, ball(6.0, (1.0, 0.0, 0.5))
    assert max(errors([shell, core])) < 0.1
