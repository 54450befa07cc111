"""Level sets of functions: what dense evaluation gives, found by looking near the zero set only."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, InputError
from geokit.volume._dense import to_dense
from geokit.volume._from_function import from_function
from geokit.volume.nanovdb.checks import check_grid
from tests.support.effort import of_all

CUBE = [[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]]


def torus(points: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(points[:, 0], points[:, 1]) - 1.0, points[:, 2]) - 0.4


def expected_voxels(function, bounds, voxel_size, half_width, lower, shape) -> tuple[np.ndarray, np.ndarray]:
    """Values and active states of a box of voxels by evaluating every one of them."""
    voxels = lower + np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    points = voxels * voxel_size
    exact = function(points.reshape(-1, 3)).reshape(shape)
    band = half_width * voxel_size
    within = ((points >= bounds[0]) & (points <= bounds[1])).all(axis=-1)
    active = within & (np.abs(exact) < band)
    values = np.where(within, np.where(active, exact, np.copysign(band, exact)), band)
    return values.astype(np.float32), active


def assert_as_dense(function, bounds, voxel_size, half_width=3.0, **options):
    volume = from_function(function, bounds, voxel_size, half_width=half_width, **options)
    check_grid(volume.nanovdb, "function")
    box = np.array(bounds)
    lower = np.ceil(box[0] / voxel_size).astype(int) - 12
    upper = np.floor(box[1] / voxel_size).astype(int) + 12
    dense = to_dense(volume, bounds=[lower, upper], device="cpu").values
    values, active = expected_voxels(function, box, voxel_size, half_width, lower, dense.shape)
    assert np.array_equal(dense, values)
    assert volume.info.active_voxel_count == active.sum()
    return volume


@pytest.mark.slow
@pytest.mark.parametrize("half_width", [1.0, 3.0, 7.5])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_band_inside_and_outside_are_those_of_dense_evaluation(half_width, sign):
    volume = assert_as_dense(lambda p: sign * torus(p), [[-2, -2, -1], [2, 2, 1]], 0.05, half_width)
    assert volume.info.grid_class == "level set"
    assert volume.info.background == np.float32(half_width * 0.05)


STEP = of_all(0.057, 0.037)


@pytest.mark.slow
@pytest.mark.parametrize("cut", [-1.3, -0.1, 0.0, 0.123, 0.7])
@pytest.mark.parametrize("axis", [0, 2])
def test_what_the_bounds_cut_ends_there(cut, axis):
    bounds = np.array([[-2.0, -2.0, -1.0], [2.0, 2.0, 1.0]])
    bounds[0, axis] = cut if cut > bounds[0, axis] else bounds[0, axis]
    assert_as_dense(torus, bounds, STEP)
    bounds[:, axis] = [-2.0, cut if axis == 0 else 0.3 + cut]
    assert_as_dense(torus, bounds, STEP)


def test_inside_all_over_the_bounds():
    volume = assert_as_dense(lambda p: np.full(len(p), -9.0), [[-1.0, -0.4, 0.1], [1.0, 0.9, 1.7]], 0.02)
    assert volume.info.active_voxel_count == 0


def test_outside_all_over_the_bounds():
    assert from_function(lambda p: np.full(len(p), 9.0), CUBE, 0.1).info.active_voxel_count == 0


def test_bounds_between_two_voxels_hold_nothing():
    volume = from_function(torus, [[0.01, 0.01, 0.01], [0.02, 0.02, 0.02]], 1.0)
    assert volume.info.active_voxel_count == 0


def test_steeper_functions_need_their_slope():
    plane = assert_as_dense(lambda p: p[:, 2] + 0.3 * p[:, 0], CUBE, 0.06, lipschitz=1.05)
    assert plane.info.active_voxel_count > 0
    assert_as_dense(lambda p: 2.5 * torus(p), CUBE, 0.06, lipschitz=2.5)


@pytest.mark.parametrize("factor", [1.01, 1.5, 10.0, 1e6])
def test_a_wrong_slope_is_found_and_named(factor):
    with pytest.raises(InputError, match="lipschitz: the function has a slope of") as caught:
        from_function(lambda p: factor * p[:, 0], CUBE, 0.05)
    named = float(str(caught.value).split("slope of ")[1].split(" ")[0])
    assert named == pytest.approx(factor, rel=1e-5)


def test_a_jump_is_found():
    with pytest.raises(InputError, match="lipschitz"):
        from_function(lambda p: np.where(p[:, 0] < 0.3, -1.0, 1.0), CUBE, 0.05)


def test_only_few_points_are_evaluated():
    asked = []

    def counted(points):
        asked.append(len(points))
        return torus(points)

    volume = from_function(counted, [[-4, -4, -4], [4, 4, 4]], 0.02)
    # 401^3 voxels; the leaves of the band hold 4 times its voxels, those that are tried another 2.
    assert sum(asked) < 8 * volume.info.active_voxel_count < 401**3 / 30


def test_blocks_do_not_matter():
    whole = from_function(torus, CUBE, 0.05)
    largest = []

    def watched(points):
        largest.append(len(points))
        return torus(points)

    parts = from_function(watched, CUBE, 0.05, block=700)
    assert np.array_equal(parts.nanovdb, whole.nanovdb)
    assert max(largest) <= 700


def test_points_reach_the_function_as_float64_rows_in_the_bounds_and_a_leaf_around():
    def checked(points):
        assert points.dtype == np.float64
        assert points.ndim == 2
        assert (np.abs(points) < 2.0 + 0.05 * 256).all()
        return torus(points)

    from_function(checked, CUBE, 0.05)


def test_far_from_the_origin_the_transform_moves():
    center = np.array([3.0e6, -1.0e6, 5.0])
    volume = from_function(lambda p: np.linalg.norm(p - center, axis=1) - 1.0, center + CUBE, 0.1)
    assert np.abs(volume.info.index_bounds).max() < 64
    points = center + np.array([[1.1, 0.0, 0.0], [0.0, 0.9, 0.0]])
    # Coordinates of 3e6 have steps of 5e-10; the band's interpolant is off by h^2 / 8 of curvature 2.
    np.testing.assert_allclose(volume.sample(points, device="cpu"), [0.1, -0.1], atol=0.003)


def test_what_it_came_from_is_known():
    info = from_function(torus, CUBE, 0.1, name="ring").info
    assert info.name == "ring"
    assert info.metadata["geokit:source"] == "torus"
    assert info.metadata["geokit:voxel_size"] == 0.1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"function": 3}, "function"),
        ({"function": lambda p: p}, "function: it gives shape"),
        ({"function": lambda p: 1.0}, "function: it gives shape"),
        ({"function": lambda p: ["a"] * len(p)}, "function: it cannot be evaluated"),
        ({"function": lambda p: np.full(len(p), np.nan)}, "function: it is not finite at"),
        ({"function": lambda p: np.full(len(p), np.inf)}, "function: it is not finite at"),
        ({"bounds": [[0, 0, 0]]}, "bounds"),
        ({"bounds": [[0, 0, 0], [1, 1, 0]]}, "bounds"),
        ({"bounds": [[0, 0, 0], [1, 1, np.inf]]}, "bounds"),
        ({"bounds": "x"}, "bounds"),
        ({"voxel_size": 0.0}, "voxel_size"),
        ({"voxel_size": 1e-12}, "voxel_size"),
        ({"voxel_size": 1e-40}, "float32"),
        ({"lipschitz": 0.0}, "lipschitz"),
        ({"lipschitz": np.inf}, "lipschitz"),
        ({"half_width": 0.5}, "half_width"),
        ({"lipschitz": 4.0}, "half_width"),
        ({"block": 100}, "block"),
        ({"block": 1e6}, "block"),
        ({"block": True}, "block"),
        ({"name": "x" * 300}, "name"),
        ({"grid_class": "no class"}, "grid_class"),
    ],
)
def test_refused(options, message):
    with pytest.raises(InputError, match=message):
        from_function(**{"function": torus, "bounds": CUBE, "voxel_size": 0.2, **options})


def test_errors_of_the_function_itself_are_not_hidden():
    def broken(points):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        from_function(broken, CUBE, 0.2)


def test_too_many_voxels_are_refused(monkeypatch):
    monkeypatch.setattr(available_memory, "available_host", lambda: 1 << 20)
    with pytest.raises(DeviceMemoryError, match="voxel_size"):
        from_function(torus, CUBE, 0.02)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (1.0, 1.0, 1.0), (3.0, 2.0, 1.0)])
def test_the_slope_that_an_error_names_is_enough(direction):
    """Two samples along a diagonal of a block tell less than the slope."""
    along = 1.6 * np.array(direction) / np.linalg.norm(direction)
    with pytest.raises(InputError, match=r"slope of 1\.6 near .*use 1\.60[01]? or more"):
        from_function(lambda p: p @ along, CUBE, 0.06)
    from_function(lambda p: p @ along, CUBE, 0.06, lipschitz=1.601)
