"""The choices of a radius search: own points, self left out, order of rows, radii of each query, blocks and pairs."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree

import geokit as gk
from geokit.core import launcher
from geokit.core.scan import row_offsets
from geokit.points import NeighborGrid
from geokit.points.search import cells as _cells
from geokit.points.search import radius as radius_search
from geokit.points.search.cells_kernels import GATHER_PACKED
from geokit.points.search.radius_cuda_kernels import count_kernel, fill_kernel
from tests.support.effort import of_all

RANDOM = np.random.default_rng(11)
POINTS = RANDOM.random((3000, 3))
QUERIES = RANDOM.random((2500, 3)) * 1.4 - 0.2
RADIUS = 0.09
TREE = cKDTree(POINTS)


def rows(found):
    return [found.indices[a:b].tolist() for a, b in zip(found.offsets[:-1], found.offsets[1:], strict=True)]


def squared(points, queries, owner, indices):
    d = points[indices] - queries[owner]
    return (d[:, 0] ** 2 + d[:, 1] ** 2) + d[:, 2] ** 2


@pytest.fixture(scope="module")
def grid():
    return NeighborGrid(POINTS, RADIUS, device="cpu")


def test_own_points_are_the_queries_when_there_are_none(grid):
    given, own = grid.radius_search(POINTS), grid.radius_search()
    for a, b in zip(given, own, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(grid.count(), grid.count(POINTS))


@pytest.mark.parametrize("queries", [None, POINTS])
def test_self_is_left_out_by_index(grid, queries):
    wanted = [[j for j in row if j != i] for i, row in enumerate(TREE.query_ball_point(POINTS, RADIUS))]
    found = grid.radius_search(queries, exclude_self=True)
    assert rows(found) == [sorted(row) for row in wanted]
    as_found = grid.radius_search(queries, exclude_self=True, order="any")
    assert [sorted(row) for row in rows(as_found)] == rows(found)
    np.testing.assert_array_equal(grid.count(queries, exclude_self=True), [len(row) for row in wanted])


@pytest.mark.slow
@pytest.mark.parametrize("spread", [1.0, 3.0])
@pytest.mark.parametrize("moved", [0.8, 2.0, 30.0])
def test_self_is_left_out_only_where_it_is_found(grid, moved, spread):
    """Queries that stand for points but lie elsewhere: such a point may not be within the radius of its query."""
    random = np.random.default_rng(2)
    queries = POINTS + random.normal(size=POINTS.shape) * moved * RADIUS
    radius = random.uniform(RADIUS, spread * RADIUS, len(POINTS)) if spread > 1.0 else RADIUS
    near = TREE.query_ball_point(queries, radius, return_sorted=True)
    wanted = [[j for j in row if j != i] for i, row in enumerate(near)]
    assert any(i not in row for i, row in enumerate(near))
    found = grid.radius_search(queries, radius=radius, exclude_self=True)
    assert rows(found) == wanted
    counts = grid.count(queries, radius=radius, exclude_self=True)
    np.testing.assert_array_equal(counts, [len(row) for row in wanted])
    blocks = grid.radius_search_blocks(queries, radius=radius, exclude_self=True, memory=20_000)
    assert [row for _, block in blocks for row in rows(block)] == wanted
    single = queries.astype(np.float32)
    np.testing.assert_array_equal(
        grid.count(single, exclude_self=True), grid.count(single.astype(np.float64), exclude_self=True)
    )


def test_duplicates_of_a_point_are_not_left_out_with_it():
    points = np.repeat(POINTS[:50], 3, axis=0)
    found = rows(NeighborGrid(points, 1e-9, device="cpu").radius_search(exclude_self=True))
    assert found == [[j for j in range(i // 3 * 3, i // 3 * 3 + 3) if j != i] for i in range(150)]


def test_self_needs_as_many_queries_as_points(grid):
    for ask in (grid.count, grid.radius_search, grid.radius_search_blocks):
        with pytest.raises(gk.InputError, match="exclude_self: 10 queries are not the 3000 points"):
            ask(POINTS[:10], exclude_self=True)


def test_rows_by_distance_then_index():
    # A lattice: many neighbors at the same distance.
    axis = np.arange(8.0)
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    lattice = lattice[np.random.default_rng(2).permutation(len(lattice))]
    found = NeighborGrid(lattice, 2.0, device="cpu").radius_search(order="distance")
    for i in range(len(lattice)):
        mine = slice(found.offsets[i], found.offsets[i + 1])
        key = np.lexsort((found.indices[mine], found.distance[mine]))
        np.testing.assert_array_equal(key, np.arange(len(key)))
        assert found.indices[mine][0] == i
    by_index = NeighborGrid(lattice, 2.0, device="cpu").radius_search()
    assert [sorted(row) for row in rows(found)] == rows(by_index)


def test_unknown_order(grid):
    for ask in (grid.radius_search, grid.radius_search_blocks):
        with pytest.raises(gk.InputError, match="order: 'size' is not known"):
            ask(order="size")


@pytest.mark.slow
@pytest.mark.parametrize("spread", [1.0, 3.0, 1e3, 1e6])
@pytest.mark.parametrize("own", [False, True])
def test_a_radius_for_each_query(grid, spread, own):
    queries = POINTS if own else QUERIES
    radius = 0.3 * np.exp(-RANDOM.random(len(queries)) * np.log(spread))
    radius[::97] = 0.0
    wanted = TREE.query_ball_point(queries, radius, return_sorted=True)
    found = grid.radius_search(None if own else queries, radius=radius)
    assert rows(found) == [list(row) for row in wanted]
    np.testing.assert_array_equal(grid.count(queries, radius=radius), [len(row) for row in wanted])
    asked = wp.array(queries, dtype=wp.vec3d, device="cpu")
    counted = grid.count(asked, radius=wp.array(radius, dtype=wp.float64, device="cpu"))
    np.testing.assert_array_equal(counted.numpy(), [len(row) for row in wanted])


def test_a_radius_for_each_query_and_self_left_out(grid):
    radius = 0.01 + 0.2 * RANDOM.random(len(POINTS)) ** 4
    wanted = TREE.query_ball_point(POINTS, radius, return_sorted=True)
    found = grid.radius_search(radius=radius, exclude_self=True, order="distance")
    assert [sorted(row) for row in rows(found)] == [[j for j in row if j != i] for i, row in enumerate(wanted)]


def test_radii_are_checked(grid):
    with pytest.raises(gk.InputError, match=r"radius: shape \(5,\) is not one number, nor one for each of the 3000"):
        grid.count(radius=np.ones(5))
    for bad in (-1.0, np.nan, np.inf):
        radius = np.ones(len(POINTS))
        radius[7] = bad
        with pytest.raises(gk.InputError, match="radius: row 7"):
            grid.radius_search(radius=radius)
    with pytest.raises(gk.InputError, match="radius: dtype"):
        grid.count(radius=["a"] * len(POINTS))


@pytest.mark.parametrize("memory", [1, 12, 5_000, 100_000, 10**9])
@pytest.mark.parametrize("own", [False, True])
def test_blocks_are_the_whole(grid, memory, own):
    queries = None if own else QUERIES
    whole = grid.radius_search(queries, order="distance", exclude_self=own)
    first, indices, distance = 0, [], []
    for block in grid.radius_search_blocks(queries, memory=memory, order="distance", exclude_self=own):
        assert block.first == first
        rows_in = len(block.neighbors.offsets) - 1
        assert rows_in == 1 or 12 * len(block.neighbors.indices) <= memory
        np.testing.assert_array_equal(
            block.neighbors.offsets, whole.offsets[first : first + rows_in + 1] - whole.offsets[first]
        )
        first += rows_in
        indices.append(block.neighbors.indices)
        distance.append(block.neighbors.distance)
        if memory < 5_000 and first > 40:
            break
    np.testing.assert_array_equal(np.concatenate(indices), whole.indices[: whole.offsets[first]])
    np.testing.assert_array_equal(np.concatenate(distance), whole.distance[: whole.offsets[first]])
    assert memory < 5_000 or first == len(whole.offsets) - 1


def test_blocks_with_a_radius_for_each_query(grid):
    radius = 0.2 * RANDOM.random(len(QUERIES))
    whole = grid.radius_search(QUERIES, radius=radius)
    parts = [block.neighbors for block in grid.radius_search_blocks(QUERIES, radius=radius, memory=50_000)]
    assert len(parts) > 5
    np.testing.assert_array_equal(np.concatenate([part.indices for part in parts]), whole.indices)


def test_blocks_of_no_queries_and_a_bad_budget(grid):
    assert list(grid.radius_search_blocks(np.zeros((0, 3)))) == []
    with pytest.raises(gk.InputError, match="memory"):
        grid.radius_search_blocks(memory=0)


def test_no_queries_with_a_radius_for_each(grid):
    nothing = np.zeros((0, 3))
    assert grid.count(nothing, radius=np.zeros(0)).shape == (0,)
    assert grid.radius_search(nothing, radius=np.zeros(0)).offsets.tolist() == [0]


def test_pairs_are_those_of_the_tree(grid):
    pairs = grid.pairs()
    wanted = TREE.query_pairs(RADIUS, output_type="ndarray")
    np.testing.assert_array_equal(pairs.indices, wanted[np.lexsort((wanted[:, 1], wanted[:, 0]))])
    exact = np.sqrt(squared(POINTS, POINTS, pairs.indices[:, 0], pairs.indices[:, 1]))
    np.testing.assert_array_equal(pairs.distance, exact)
    assert (pairs.indices.dtype, pairs.distance.dtype) == (np.int32, np.float64)
    assert NeighborGrid(POINTS[:1], 1.0, device="cpu").pairs().indices.shape == (0, 2)


def test_pairs_of_float32_points_are_in_their_container():
    points = wp.array(POINTS[:200].astype(np.float32), dtype=wp.vec3f, device="cpu")
    pairs = NeighborGrid(points, 0.2, device="cpu").pairs()
    assert isinstance(pairs.indices, wp.array)
    assert pairs.indices.shape == (len(pairs.distance), 2)
    assert pairs.distance.dtype == wp.float32


def test_radius_from_the_data():
    for scale in (1e-6, 1.0, 1e9):
        grid = NeighborGrid(POINTS * scale, device="cpu")
        assert 15 < grid.count().mean() < 45
        np.testing.assert_array_equal(grid.count(), cKDTree(POINTS * scale).query_ball_point(
            POINTS * scale, grid.radius, return_length=True
        ))  # fmt: skip
    flat = POINTS * [1.0, 1.0, 0.0]
    assert 6 < NeighborGrid(flat, device="cpu").count().mean() < 20
    assert NeighborGrid(POINTS[:1], device="cpu").radius == 1.0
    assert NeighborGrid(np.zeros((0, 3)), device="cpu").count(POINTS[:2]).tolist() == [0, 0]


def test_a_radius_of_zero_finds_what_is_in_the_same_place():
    points = np.concatenate([POINTS[:100], POINTS[:30], POINTS[:10]])
    grid = NeighborGrid(points, 0.0, device="cpu")
    wanted = cKDTree(points).query_ball_point(points, 0.0, return_sorted=True)
    assert rows(grid.radius_search()) == [list(row) for row in wanted]
    assert rows(NeighborGrid(POINTS, RADIUS, device="cpu").radius_search(points, radius=0.0))[0] == [0]
    assert grid.id


@pytest.mark.parametrize("queries", [POINTS, QUERIES])
@pytest.mark.parametrize("offset", [0.0, 1e7])
def test_the_kernels_of_a_gpu_find_the_same(queries, offset):
    # They run on any device: a thread for each query where the CPU's own have a share of them.
    grid = NeighborGrid(POINTS + offset, RADIUS, device="cpu")
    queries = queries + offset
    whole = grid.radius_search(queries)
    asked, _ = grid._ask(queries, None, False)
    ((cells, sorted_queries, number),) = asked.parts
    counts = wp.empty(len(queries), dtype=wp.int32, device="cpu")
    device = launcher.resolve_device("cpu")
    # The float32 copy, which only a GPU has.
    cells.packed = wp.empty(len(POINTS), dtype=wp.vec4f, device="cpu")
    rows_of = wp.array(POINTS + offset, dtype=wp.vec3d, device="cpu")
    launcher.launch(GATHER_PACKED[wp.vec3d], len(POINTS), [rows_of, cells.index], [cells], device)
    launcher.launch(count_kernel, number, [sorted_queries, cells, asked.radius, 0], [counts], device)
    np.testing.assert_array_equal(counts.numpy(), np.diff(whole.offsets))
    indices = wp.empty(len(whole.indices), dtype=wp.int32, device="cpu")
    distance = wp.empty(len(whole.indices), dtype=wp.float64, device="cpu")
    offsets = row_offsets(counts)
    given = [sorted_queries, cells, asked.radius, radius_search.NOTHING_LEFT_OUT, offsets]
    launcher.launch(fill_kernel, number, given, [indices, distance], device)
    as_found = grid.radius_search(queries, order="any")
    np.testing.assert_array_equal(indices.numpy(), as_found.indices)
    np.testing.assert_array_equal(distance.numpy(), as_found.distance)
    radius_search.sort_by_index(offsets, indices, distance)
    np.testing.assert_array_equal(indices.numpy(), whole.indices)
    np.testing.assert_array_equal(distance.numpy(), whole.distance)


@pytest.mark.slow
@pytest.mark.parametrize("count", [200, 1100, 5000])
def test_more_candidates_than_the_buffer_holds(count):
    # All points in the cells around every query: buffers are emptied several times, rows are longer than 128.
    points = np.random.default_rng(count).random((count, 3)) * 0.5
    assert_rows = cKDTree(points).query_ball_point(points[::7], 0.45, return_sorted=True)
    grid = NeighborGrid(points, 0.45, device="cpu")
    found = grid.radius_search(points[::7])
    assert rows(found) == [list(row) for row in assert_rows]
    as_found = grid.radius_search(points[::7], order="any")
    assert [sorted(row) for row in rows(as_found)] == rows(found)
    owner = np.repeat(np.arange(len(points[::7])), np.diff(as_found.offsets))
    exact = np.sqrt(squared(points, points[::7], owner, as_found.indices))
    np.testing.assert_array_equal(as_found.distance, exact)
    np.testing.assert_array_equal(grid.count(points[::7]), [len(row) for row in assert_rows])


@pytest.mark.slow
@pytest.mark.parametrize("order", of_all(["any"], ["index", "any", "distance"]))
@pytest.mark.parametrize(("noted", "least"), [(0, 64), (4096, 8), (40_000, 64), (200_000, 64), (10**7, 64)])
def test_notes_of_the_count_change_nothing(monkeypatch, order, noted, least):
    """No share has notes, some have, some are incomplete, all have: the filled rows are the same."""
    # A crowd whose candidates fill the buffer twice among all others, and queries without neighbors.
    random = np.random.default_rng(4)
    points = np.concatenate([POINTS, 0.3 + random.random((1500, 3)) * 0.02])
    queries = np.concatenate([QUERIES, points, [[9.0, 9.0, 9.0]] * 300, [[-9.0, 0.0, 0.0]] * 300])
    grid = NeighborGrid(points, RADIUS, device="cpu")
    monkeypatch.setattr(radius_search, "FEWEST_NOTED", 10**9)
    plain = [grid.radius_search(order=order, exclude_self=True), grid.radius_search(queries, order=order)]
    monkeypatch.setattr(radius_search, "FEWEST_NOTED", 1)
    monkeypatch.setattr(radius_search, "NOTED", noted)
    monkeypatch.setattr(radius_search, "LEAST_NOTED", least)
    noted = [grid.radius_search(order=order, exclude_self=True), grid.radius_search(queries, order=order)]
    for before, after in zip(plain, noted, strict=True):
        for a, b in zip(before, after, strict=True):
            np.testing.assert_array_equal(a, b)


def test_the_count_notes_what_the_fill_reads(grid, monkeypatch):
    """With notes the fill does not search again: it returns what the notes say, even if they are wrong."""
    asked, _ = grid._ask(None, None, False)
    counts = radius_search.count(asked, note=True)
    (notes,) = asked.notes
    values = notes.places.numpy()
    # Share after share: 1, and for each query how many it has and where they are.
    np.testing.assert_array_equal(values[:: notes.size], 1)
    assert values[1] == counts.numpy()[asked.parts[0][1].index.numpy()[0]]
    values[2 : 2 + values[1]] = 7
    offsets, indices, _ = radius_search.fill(asked, counts, lambda total: None, order="any")
    first = asked.parts[0][1].index.numpy()[0]
    begin, end = offsets.numpy()[first : first + 2]
    assert set(indices.numpy()[begin:end].tolist()) == {int(asked.parts[0][0].index.numpy()[7])}


def test_threads_do_not_matter(grid, monkeypatch):
    whole = grid.radius_search()
    monkeypatch.setattr(_cells, "COUNTED_SHARE", 100)
    for threads in ("1", "3", "24"):
        monkeypatch.setenv("GEOKIT_THREADS", threads)
        other = NeighborGrid(POINTS, RADIUS, device="cpu").radius_search()
        for a, b in zip(whole, other, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("radius", [0.09, 0.5])
def test_float32_distances_are_those_of_float64_rounded(radius):
    single = POINTS[:1500].astype(np.float32)
    grid = NeighborGrid(single, radius, device="cpu")
    short, long = grid.radius_search(), grid.radius_search(single.astype(np.float64))
    assert (short.distance.dtype, long.distance.dtype) == (np.float32, np.float64)
    np.testing.assert_array_equal(short.indices, long.indices)
    np.testing.assert_array_equal(short.distance, long.distance.astype(np.float32))
    by_distance = grid.radius_search(order="distance")
    assert by_distance.distance.dtype == np.float32
    first = slice(by_distance.offsets[5], by_distance.offsets[6])
    assert (np.diff(by_distance.distance[first]) >= 0).all()
    block = next(iter(grid.radius_search_blocks(memory=1 << 20)))
    assert block.neighbors.distance.dtype == np.float32
