"""Statistics against NumPy, and area and volume against analytic ones."""

from __future__ import annotations

import math

import numpy as np
import pytest

from geokit import native
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._dense import from_dense
from geokit.volume._morphology import erode
from geokit.volume._statistics import Statistics, statistics
from geokit.volume._topology import prune
from tests.support.analytic_volumes import SHEARED, active_voxels, ball, cubes, field, level_set

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_like_numpy(dtype):
    source = field(lambda p: 1e6 + np.sin(p[:, 0]) + p[:, 1] * p[:, 2], dtype=dtype)
    _, values = active_voxels(source)
    found = statistics(source)
    assert found[:3] == (len(values), values.min(), values.max())
    assert found.mean == pytest.approx(values.mean(), rel=1e-14)
    assert found.standard_deviation == pytest.approx(values.std(), rel=1e-10)
    assert (found.area, found.volume) == (None, None)


def test_lengths_of_vectors():
    source = field(lambda p: p * np.array([1.0, 2.0, -3.0]), background=np.zeros(3))
    _, values = active_voxels(source)
    lengths = np.linalg.norm(values, axis=1)
    assert statistics(source)[1:5] == pytest.approx((lengths.min(), lengths.max(), lengths.mean(), lengths.std()))


def test_tiles_count_as_voxels():
    source = field(lambda p: np.where(p[:, 0] < 0, 2.0, p[:, 1]))
    assert statistics(prune(source)) == statistics(source)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e5])
@pytest.mark.parametrize(("radius", "area_error", "volume_error"), [(10.3, 0.001, 0.007), (18.3, 0.0004, 0.0025)])
def test_area_and_volume_of_a_ball(radius, area_error, volume_error, size):
    found = statistics(level_set(ball(radius * size), transform=cubes(size)))
    assert found.area == pytest.approx(4.0 * math.pi * (radius * size) ** 2, rel=area_error)
    assert found.volume == pytest.approx(4.0 / 3.0 * math.pi * (radius * size) ** 3, rel=volume_error)


@pytest.mark.filterwarnings("ignore:.*nothing of grid:UserWarning")
def test_no_active_voxel():
    found = statistics(erode(level_set(ball(5.3)), 8.0))
    assert (found.count, found.area, found.volume) == (0, 0.0, 0.0)
    assert np.isnan(found[1:5]).all()


def test_level_set_of_other_voxels_has_no_measures():
    found = statistics(level_set(ball(1.0), transform=SHEARED))
    assert isinstance(found, Statistics)
    assert found.count > 100
    assert (found.area, found.volume) == (None, None)


def test_refusals():
    with pytest.raises(InputError, match="not a SparseVolume"):
        statistics(None)
    import dataclasses

    from geokit.volume.model.sparse_volume import SparseVolume

    source = field(ball(3.0))
    with pytest.raises(UnsupportedGridError, match="type rgba8"):
        statistics(SparseVolume(source.nanovdb, dataclasses.replace(source.info, grid_type="rgba8")))
    with pytest.raises(InputError, match="background"):
        statistics(field(ball(3.0), grid_class="level set"))


def test_numbers_whose_squares_overflow_are_no_warning(capfd):
    values = np.zeros((8, 8, 8))
    values[2, 3, 4], values[5, 5, 5] = 1e200, -1e200
    found = statistics(from_dense(values, voxel_size=1.0, grid_type="double"))
    assert (found.minimum, found.maximum, found.standard_deviation) == (-1e200, 1e200, np.inf)
    assert capfd.readouterr() == ("", "")
