"""Volumes on other voxels, against the functions that they hold."""

from __future__ import annotations

import numpy as np
import pytest

from geokit import native
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._resample import resample
from geokit.volume.model.sparse_volume import SparseVolume
from tests.support.analytic_volumes import SHEARED, TURNED, active_voxels, ball, cubes, dense, field, level_set

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

BALL = ball(10.3, (0.3, 0.2, -0.1))
# Float32 values below 64.
ROUNDING = 8e-6


def plane(points):
    return points @ np.array([0.7, -0.4, 0.3]) + 0.25


def inside(volume, points, margin):
    """Points at least ``margin`` voxels inside the cube of active voxels that ``field`` makes."""
    matrix = volume.info.transform
    index = (points - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T
    return (np.abs(index + 0.5) < 16.0 - margin).all(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("target", [cubes(0.7), cubes(1.9), TURNED * 4.0, SHEARED * 9.0])
def test_linear_fields_are_reproduced(target, dtype):
    target = np.array(target)
    target[3] = (0.0, 0.0, 0.0, 1.0)
    target[:3, 3] = 0.21
    source = field(plane, dtype=dtype)
    result = resample(source, transform=target, device="cpu")
    points, values = active_voxels(result)
    kept = inside(source, points, 1.0)
    assert kept.sum() > 500
    assert np.abs(values - plane(points))[kept].max() < (ROUNDING if dtype == np.float32 else 1e-13)
    np.testing.assert_array_equal(result.info.transform, target)
    assert result.info.grid_type == ("float" if dtype == np.float32 else "double")


def test_active_where_the_nearest_voxel_is():
    result = resample(field(plane), voxel_size=0.5, device="cpu")
    # Voxels -16 .. 15 of size 1 reach from -16.5 to 15.5, halves rounded up: -33 .. 30 of size 0.5.
    np.testing.assert_array_equal(result.info.index_bounds, [[-33] * 3, [30] * 3])
    assert result.info.active_voxel_count == 64**3
    assert dense(result, 31, 33).max() == 0.0


def test_vectors_go_component_by_component():
    source = field(lambda p: p @ np.array([[1.0, 0.2, 0.0], [0.0, 0.5, 0.1], [0.3, 0.0, 1.0]]), background=np.zeros(3))
    result = resample(source, transform=cubes(0.8), device="cpu")
    points, values = active_voxels(result)
    kept = inside(source, points, 1.0)
    true = points @ np.array([[1.0, 0.2, 0.0], [0.0, 0.5, 0.1], [0.3, 0.0, 1.0]])
    assert np.abs(values - true)[kept].max() < ROUNDING
    assert result.info.grid_type == "vec3f"


def test_order_zero_takes_the_nearest_voxel():
    result = resample(field(plane, leaves=1), transform=cubes(0.25), order=0, device="cpu")
    points, values = active_voxels(result)
    assert np.abs(values - plane(np.floor(points + 0.5))).max() < ROUNDING


class TestLevelSets:
    @pytest.mark.slow
    @pytest.mark.parametrize("voxel_size", [0.5, 0.8, 1.6, 2.9])
    def test_distances_and_a_band_of_as_many_voxels(self, voxel_size):
        source = level_set(BALL)
        result = resample(source, voxel_size=voxel_size, device="cpu")
        points, values = active_voxels(result)
        # 3/8 of the squared voxel size times the curvatures' sum, at the band's inner end; what is computed beyond the
        # source's band adds a little.
        worst = 0.375 * 2.0 / (10.3 - 3.0 * max(voxel_size, 1.0)) + 0.1
        assert np.abs(values - BALL(points)).max() < worst
        near = np.abs(BALL(points)) < 1.0
        assert np.abs(values - BALL(points))[near].max() < 0.375 * 2.0 / 9.3
        assert result.info.background == pytest.approx(3.0 * voxel_size)
        assert (result.info.grid_class, result.info.name) == ("level set", "body")

    def test_signs_everywhere(self):
        result = resample(level_set(BALL), voxel_size=0.6, device="cpu")
        steps = np.arange(-20, 20, dtype=float)
        true = BALL(0.6 * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3))
        clear = np.abs(true) > 0.1
        np.testing.assert_array_equal(dense(result, -20, 20).ravel()[clear] < 0, true[clear] < 0)

    def test_voxels_that_are_no_cubes_become_cubes(self):
        matrix = np.diag([1.0, 0.8, 0.9, 1.0])
        source = level_set(ball(7.3), transform=matrix)
        result = resample(source, voxel_size=0.9, device="cpu")
        np.testing.assert_allclose(result.info.voxel_size, 0.9)
        points, values = active_voxels(result)
        near = np.abs(values) < 1.5
        assert np.abs(values - ball(7.3)(points))[near].max() < 0.12

    def test_sheared_axes_become_the_world_s(self):
        result = resample(field(plane, transform=SHEARED), voxel_size=0.1, device="cpu")
        np.testing.assert_array_equal(result.info.transform[:3, :3], 0.1 * np.eye(3))
        np.testing.assert_array_equal(result.info.transform[:3, 3], SHEARED[:3, 3])


class TestRefusals:
    def test_neither_or_both(self):
        with pytest.raises(InputError, match="give one of the two"):
            resample(field(plane))
        with pytest.raises(InputError, match="give one of the two"):
            resample(field(plane), voxel_size=1.0, transform=np.eye(4))

    @pytest.mark.parametrize("voxel_size", [0.0, -1.0, np.nan, np.inf, "fine"])
    def test_voxel_size(self, voxel_size):
        with pytest.raises(InputError, match="voxel_size"):
            resample(field(plane), voxel_size=voxel_size)

    @pytest.mark.parametrize("transform", [np.zeros((4, 4)), np.eye(3), np.full((4, 4), np.nan)])
    def test_transform(self, transform):
        with pytest.raises(InputError, match="transform"):
            resample(field(plane), transform=transform)

    def test_order(self):
        with pytest.raises(InputError, match="order"):
            resample(field(plane), voxel_size=0.5, order=7)

    def test_indices_beyond_int32(self):
        far = cubes(1.0)
        far[:3, 3] = 1e10
        with pytest.raises(InputError, match="int32"):
            resample(field(plane), transform=far)

    @pytest.mark.parametrize("voxel_size", [1e-3, 1e-6, 1e-8])
    def test_too_many_voxels(self, voxel_size):
        from geokit.errors import DeviceMemoryError

        with pytest.raises(DeviceMemoryError, match="voxel_size: the result may need"):
            resample(field(plane), voxel_size=voxel_size)

    def test_band_too_wide_to_compute(self):
        with pytest.raises(InputError, match="resample at"):
            resample(level_set(BALL), voxel_size=500.0)

    def test_types(self):
        with pytest.raises(InputError, match="not a SparseVolume"):
            resample(np.zeros(3), voxel_size=1.0)
        import dataclasses

        source = field(plane)
        other = SparseVolume(source.nanovdb, dataclasses.replace(source.info, grid_type="int32"))
        with pytest.raises(UnsupportedGridError, match="type int32"):
            resample(other, voxel_size=1.0)


def test_a_band_of_flat_voxels_that_cubes_cannot_hold_is_refused():
    # The mean edge is 2e-16, so the band would be 1e15 cubes wide, and grow until the memory ended.
    flat = level_set(BALL, transform=np.diag([1.0, 1e-45, 1.0, 1.0]))
    with pytest.raises(InputError, match=r"its band is .* voxels wide.*same proportions"):
        resample(flat, voxel_size=0.7)
