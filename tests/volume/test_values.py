"""Active values as one flat array."""

from __future__ import annotations

import numpy as np
import pytest

from geokit import InputError, UnsupportedGridError, volume


@pytest.fixture
def torus():
    return volume.load("data/samples/torus.vdb")


def test_values_are_those_at_their_voxels(torus):
    found = volume.active_voxels(torus)
    assert len(found.values) == torus.info.active_voxel_count
    assert len(np.unique(found.coordinates, axis=0)) == len(found.values)
    assert torus.active_at(found.coordinates.astype(float), space="index", device="cpu").all()
    samples = torus.sample(found.coordinates.astype(float), order=0, space="index", device="cpu")
    assert np.array_equal(samples, found.values)


def test_other_values(torus):
    found = volume.active_voxels(torus)
    other = np.random.default_rng(0).standard_normal(len(found.values)).astype(np.float32)
    made = volume.with_values(torus, other)
    assert np.array_equal(volume.active_voxels(made).values, other)
    assert np.array_equal(volume.active_voxels(torus).values, found.values)
    outside = np.array([[0.0, 0.0, 0.0], [9.0, 9.0, 9.0]])
    assert np.array_equal(made.sample(outside, device="cpu"), torus.sample(outside, device="cpu"))
    assert made.info == torus.info or made.info.active_voxel_count == torus.info.active_voxel_count


def test_files_again(torus, tmp_path):
    made = volume.with_values(torus, volume.active_voxels(torus).values * 2.0)
    volume.save(tmp_path / "twice.nvdb", made)
    again = volume.load(tmp_path / "twice.nvdb")
    assert np.array_equal(volume.active_voxels(again).values, volume.active_voxels(made).values)


def test_bad_values(torus):
    count = torus.info.active_voxel_count
    with pytest.raises(InputError, match=rf"values: shape \(3,\) is not \({count},\)"):
        volume.with_values(torus, np.zeros(3))
    bad = np.zeros(count)
    bad[5] = np.nan
    with pytest.raises(InputError, match="values: row 5 is nan"):
        volume.with_values(torus, bad)
    with pytest.raises(InputError, match="quantized"):
        volume.active_voxels(torus.quantize("fp8"))
    with pytest.raises(UnsupportedGridError, match="of type bool"):
        volume.active_voxels(volume.from_dense(np.ones((4, 4, 4), bool), voxel_size=1.0))
