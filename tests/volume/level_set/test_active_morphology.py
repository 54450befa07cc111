"""Growing and shrinking of active voxels against scipy's morphology of dense masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from geokit import native
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._morphology import dilate, erode
from geokit.volume._topology import clip
from geokit.volume.model.sparse_volume import SparseVolume
from tests.support.analytic_volumes import ball, dense, field, level_set
from tests.support.scipy_morphology import CONNECTIVITY, GEOKIT, SCIPY

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

LOW, HIGH = -40, 40


def speckled(dtype=np.float32, components=0):
    """Blocks of a field, clipped to boxes that cut through leaves."""
    shape = (components,) if components else ()
    values = lambda p: np.full((len(p), *shape), 2.0) + (p[:, :1] if components else p[:, 0]) * 1e-3  # noqa: E731
    background = np.zeros(3) if components else 0.0
    return clip(field(values, dtype=dtype, background=background), [[-9.0, -3.0, -13.0], [6.0, 4.0, 11.0]])


def active(volume):
    steps = np.arange(LOW, HIGH)
    voxels = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    return np.asarray(volume.active_at(voxels, device="cpu")).reshape(*3 * [len(steps)])


@pytest.mark.slow
@pytest.mark.parametrize("neighbors", CONNECTIVITY)
@pytest.mark.parametrize("voxels", [1, 3, 11])
@pytest.mark.parametrize("name", GEOKIT)
def test_same_voxels_as_scipy(name, voxels, neighbors):
    source = speckled()
    before = source.nanovdb.copy()
    result = GEOKIT[name](source, voxels=voxels, neighbors=neighbors, device="cpu")
    structure = ndimage.generate_binary_structure(3, CONNECTIVITY[neighbors])
    expected = SCIPY[name](active(source), structure, iterations=voxels)
    np.testing.assert_array_equal(active(result), expected)
    assert result.info.active_voxel_count == expected.sum()
    np.testing.assert_array_equal(source.nanovdb, before)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "components"), [(np.float32, 0), (np.float64, 0), (np.float32, 3), (np.float64, 3)])
def test_values_stay_and_new_voxels_have_the_background(dtype, components):
    source = speckled(dtype, components)
    was = active(source)
    grown = dilate(source, voxels=2, device="cpu")
    assert grown.info.grid_type == source.info.grid_type
    np.testing.assert_array_equal(dense(grown, LOW, HIGH), dense(source, LOW, HIGH))
    shrunk = erode(source, voxels=1, device="cpu")
    still = active(shrunk)
    assert still.sum() > 0
    np.testing.assert_array_equal(dense(shrunk, LOW, HIGH)[still], dense(source, LOW, HIGH)[still])
    assert (dense(shrunk, LOW, HIGH)[was & ~still] == 0.0).all()


def test_class_name_and_metadata_stay():
    fog = field(ball(5.0), background=0.25, grid_class="fog volume", name="smoke")
    result = dilate(fog, voxels=1, device="cpu")
    assert (result.info.grid_class, result.info.name, result.info.background) == ("fog volume", "smoke", 0.25)
    assert result.info.metadata == fog.info.metadata


def test_no_steps_change_nothing():
    source = speckled()
    np.testing.assert_array_equal(active(dilate(source, voxels=0, device="cpu")), active(source))


def test_everything_can_be_eroded():
    result = erode(speckled(), voxels=9, device="cpu")
    assert result.info.active_voxel_count == 0
    assert dilate(result, voxels=3, device="cpu").info.active_voxel_count == 0


@pytest.mark.parametrize("operation", GEOKIT.values())
def test_refusals(operation):
    source = speckled()
    for options in ({}, {"distance": 1.0, "voxels": 1}):
        with pytest.raises(InputError, match="distance, voxels: give one of the two"):
            operation(source, **options)
    for voxels in (-1, 1.5, True, 1025, "two"):
        with pytest.raises(InputError, match=r"voxels: .* is not a whole number from 0 to 1024"):
            operation(source, voxels=voxels)
    with pytest.raises(InputError, match="neighbors: 'corners' is not known; use one of 'faces', 'edges', 'vertices'"):
        operation(source, voxels=1, neighbors="corners")
    with pytest.raises(InputError, match="whose surface moves by a distance"):
        operation(level_set(ball(5.0)), voxels=1)
    with pytest.raises(InputError, match="of class unknown"):
        operation(source, 1.0)
    with pytest.raises(InputError, match="not a SparseVolume"):
        operation("smoke.vdb", voxels=1)


@pytest.mark.parametrize("grid_type", ["onindex", "pointindex"])
def test_grids_without_values_are_refused_by_name(grid_type):
    source = speckled()
    other = SparseVolume(source.nanovdb, replace(source.info, grid_type=grid_type))
    with pytest.raises(UnsupportedGridError, match=f"type {grid_type}"):
        dilate(other, voxels=1)
