"""Boxes around points, by the CPU's kernel and by the GPU's, which runs on a CPU too."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from geokit.core import launcher
from geokit.points.search import cells_kernels as kernels
from geokit.points.search.cells_cpu_kernels import SHARE, SURVEY_HOST

CPU = wp.get_device("cpu")


def boxes(rows, dtype=wp.vec3d, runs=None):
    """Lower and upper corners (runs, 3) of the shares; ``runs`` for the kernel that a GPU takes."""
    points = wp.array(rows, dtype=dtype, device=CPU)
    count = runs or -(-len(rows) // int(SHARE))
    out = [wp.empty(count, dtype=wp.vec3d, device=CPU) for _ in range(2)]
    if runs is None:
        launcher.launch(SURVEY_HOST[dtype], count, [points], out, CPU)
    else:
        launcher.launch(kernels.SURVEY[dtype], count, [points, count], out, CPU)
    return [array.numpy() for array in out]


@pytest.mark.parametrize("dtype", [wp.vec3d, wp.vec3f])
@pytest.mark.parametrize("count", [*range(1, 27), 1000, 1023, 1024, 1025, 3000])
def test_boxes_of_shares_in_a_row(count, dtype):
    rows = np.random.default_rng(count).normal(0.0, 1e3, (count, 3)).astype(wp.dtype_to_numpy(dtype._wp_scalar_type_))
    lower, upper = boxes(rows, dtype)
    for share in range(len(lower)):
        part = rows[share * int(SHARE) : (share + 1) * int(SHARE)]
        np.testing.assert_array_equal(lower[share], part.min(axis=0))
        np.testing.assert_array_equal(upper[share], part.max(axis=0))


@pytest.mark.parametrize("dtype", [wp.vec3d, wp.vec3f])
@pytest.mark.parametrize(("count", "runs"), [(1, 1), (7, 7), (1000, 64), (1000, 999)])
def test_boxes_of_shares_side_by_side(dtype, count, runs):
    rows = (
        np.random.default_rng(count)
        .normal(0.0, 1e3, (count, 3))
        .astype(np.float64 if dtype is wp.vec3d else np.float32)
    )
    lower, upper = boxes(rows, dtype, runs)
    for share in range(runs):
        np.testing.assert_array_equal(lower[share], rows[share::runs].min(axis=0))
        np.testing.assert_array_equal(upper[share], rows[share::runs].max(axis=0))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [wp.vec3d, wp.vec3f])
@pytest.mark.parametrize("runs", [None, 1])
def test_a_box_around_what_is_not_finite_is_not_finite(bad, runs, dtype):
    for row in (0, 1, 7, 8, 15, 16, 41):
        for axis in range(3):
            rows = np.random.default_rng(row).uniform(-1.0, 1.0, (42, 3))
            rows[row, axis] = bad
            lower, upper = boxes(rows, dtype, runs)
            assert not np.isfinite(lower[0, axis])
            assert not np.isfinite(upper[0, axis])
