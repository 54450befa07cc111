"""Union, intersection and difference of masks against dense arrays of their voxels."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog.typed_grids import TypedGrid
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._csg import difference, intersection, union
from geokit.volume.nanovdb.checks import check_grid
from tests.support.analytic_volumes import ball, level_set
from tests.support.random_grids import dense_of, random_grid

DENSE = {
    union: lambda a, b, c: a | b | c,
    intersection: lambda a, b, c: a & b & c,
    difference: lambda a, b, c: a & ~b & ~c,
}


@pytest.mark.slow
@pytest.mark.parametrize("operation", DENSE)
def test_same_voxels_as_of_dense_arrays(operation):
    grids = [random_grid("mask", seed) for seed in (0, 1, 2)]
    result = operation(*(grid.volume for grid in grids))
    expected = DENSE[operation](*(grid.active for grid in grids))
    values, active = dense_of(result)
    np.testing.assert_array_equal(active, expected)
    np.testing.assert_array_equal(values, expected)
    assert 0 < result.info.active_voxel_count == expected.sum()
    info, was = result.info, grids[0].volume.info
    assert (info.grid_type, info.grid_class, info.name) == ("mask", was.grid_class, was.name)
    assert info.metadata == was.metadata
    check_grid(result.nanovdb, "result")


def test_nothing_is_left():
    mask = random_grid("mask", 3).volume
    nothing = difference(mask, mask)
    assert nothing.info.active_voxel_count == 0
    assert union(nothing, mask).info.active_voxel_count == mask.info.active_voxel_count


def test_refusals():
    mask = random_grid("mask", 4).volume
    with pytest.raises(InputError, match=r"b: the voxels of mask 'test' are not those of 'some voxels'"):
        union(mask, TypedGrid("mask").volume)
    with pytest.raises(InputError, match=r"smooth: 0\.5 is for level sets"):
        union(mask, mask, smooth=0.5)
    with pytest.raises(InputError, match="smooth"):
        union(mask, mask, smooth=np.nan)
    with pytest.raises(UnsupportedGridError, match=r"b: .* is of type bool"):
        union(mask, random_grid("bool", 4).volume)
    with pytest.raises(InputError, match="b: str is not a SparseVolume"):
        union(mask, "b.vdb")


def test_a_mask_beside_a_level_set():
    mask = random_grid("mask", 5).volume
    from geokit import native

    if not native.available():
        pytest.skip("geokit was built without OpenVDB")
    body = level_set(ball(5.0))
    with pytest.raises(UnsupportedGridError, match=r"b: .* is of type mask"):
        union(body, mask)
    with pytest.raises(UnsupportedGridError, match=r"b: .* is of type float"):
        union(mask, body)
