"""Connected components of random grids of every type, against scipy's labels of the same voxels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from geokit.volume._components import connected_components
from geokit.volume._dense import from_dense
from geokit.volume.tree.typed_tree import VALUE_TYPES
from tests.support.random_grids import dense_of, random_grid


def assert_same_components(labels, expected):
    """The same voxels are labeled, and the two labels of a voxel determine each other."""
    np.testing.assert_array_equal(labels > 0, expected > 0)
    some = expected > 0
    pairs = np.unique(np.stack([labels[some], expected[some]]), axis=1)
    assert pairs.shape[1] == len(np.unique(pairs[0])) == len(np.unique(pairs[1])) == expected.max(initial=0)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.0, 1.0))
def test_dense_random_masks(seed, share):
    states = np.random.default_rng(seed).random((29, 31, 40)) < share
    volume = from_dense(states, voxel_size=1.0, grid_type="mask")
    found = connected_components(volume, device="cpu")
    expected, count = ndimage.label(states)
    assert found.count == count
    labels = found.labels.to_dense(bounds=[[0, 0, 0], np.array(states.shape) - 1], device="cpu").values
    assert_same_components(labels, expected)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    np.testing.assert_array_equal(found.voxel_counts, sizes)
    assert (np.diff(sizes) <= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", VALUE_TYPES)
def test_every_type_with_tiles_on_both_sides_of_the_origin(grid_type):
    grid = random_grid(grid_type, 11)
    found = connected_components(grid.volume, device="cpu")
    labels, active = dense_of(found.labels)
    np.testing.assert_array_equal(active, grid.active)
    assert_same_components(labels, ndimage.label(grid.active)[0])
    again = connected_components(grid.volume, device="cpu")
    np.testing.assert_array_equal(again.labels.nanovdb, found.labels.nanovdb)
