"""Points sorted by cell on a CPU: by counting and by a sort, from float32 and float64, on any number of threads."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.points import NeighborGrid
from geokit.points.search import cells as _cells

CLOUDS = {
    "uniform": lambda random, count: random.random((count, 3)),
    "plane": lambda random, count: random.random((count, 3)) * [1.0, 1.0, 0.0],
    "one place": lambda random, count: np.full((count, 3), 0.7),
    "far": lambda random, count: random.random((count, 3)) + 1e5,
    # Several intervals an axis.
    "clusters": lambda random, count: random.random((count, 3)) + random.choice([0.0, 1e4, 1e6], (count, 1)),
    "a far point": lambda random, count: np.concatenate([random.random((count - 1, 3)), [[1e6, -1e6, 1e6]]]),
}


def parts(grid):
    """The arrays that the kernels read: positions, indices of their points, and the beginning of each cell."""
    cells, count = grid._cells.grid, len(grid)
    arrays = {name: getattr(cells, name).numpy()[:count] for name in ("x", "y", "z", "index")}
    return arrays | {"start": cells.start.numpy()}


def assert_same(one, other):
    for name, array in parts(one).items():
        np.testing.assert_array_equal(array, parts(other)[name], err_msg=name)


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("count", [1, 7, 8, 9, 1000, 5003])
def test_float32_points_are_sorted_as_their_float64_ones(name, count):
    points = CLOUDS[name](np.random.default_rng(count), count).astype(np.float32)
    assert_same(NeighborGrid(points, 0.1, device="cpu"), NeighborGrid(points.astype(np.float64), 0.1, device="cpu"))


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("threads", ["1", "3"])
def test_counting_is_a_stable_sort(monkeypatch, name, dtype, threads):
    points = CLOUDS[name](np.random.default_rng(3), 4001).astype(dtype)
    monkeypatch.setenv("GEOKIT_THREADS", threads)
    monkeypatch.setattr(_cells, "COUNTED_SHARE", 700)
    # Room for the table of each thread, and a table that is direct.
    monkeypatch.setattr(_cells, "COUNTS_PER_POINT", 10**5)
    monkeypatch.setattr(_cells, "TABLE_ENTRIES_PER_POINT", 10**5)
    counted = []
    by_count = _cells._place_by_count
    monkeypatch.setattr(_cells, "_place_by_count", lambda *given: (counted.append(given[-1]), by_count(*given)))
    grid = NeighborGrid(points, 0.1, device="cpu")
    if not counted:
        pytest.fail("these points were not counted")
    assert counted == [int(threads)]
    monkeypatch.setattr(_cells, "COUNTS_PER_POINT", 0)
    monkeypatch.setattr(_cells, "TABLE_ENTRIES_MORE", 0)
    assert_same(grid, NeighborGrid(points, 0.1, device="cpu"))
    assert len(counted) == 1


def test_the_caller_s_points_may_change_afterwards():
    points = np.random.default_rng(0).random((3000, 3)).astype(np.float32)
    grid = NeighborGrid(points, 0.1, device="cpu")
    before = grid.count()
    points[:] = 0.0
    np.testing.assert_array_equal(grid.count(), before)
    assert grid.knn(k=2).distance[:, 1].min() > 0.0
