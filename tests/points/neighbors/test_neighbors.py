"""NeighborGrid on hand-sized inputs: answers, containers, edges and every error."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree

import geokit as gk
from geokit.core import launcher
from geokit.core.memory import available_memory
from geokit.points import NeighborGrid

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0], [0, 0, -2]])


def rows(found):
    return [found.indices[a:b].tolist() for a, b in zip(found.offsets[:-1], found.offsets[1:], strict=True)]


def assert_like_tree(points, queries, radius, *, build_radius=None):
    """Counts, indices and distances are those of scipy's tree, index for index."""
    grid = NeighborGrid(points, build_radius or radius, device="cpu")
    found = grid.radius_search(queries, radius=radius)
    wanted = cKDTree(points).query_ball_point(queries, radius, return_sorted=True)
    assert rows(found) == [list(row) for row in wanted]
    np.testing.assert_array_equal(grid.count(queries, radius=radius), [len(row) for row in wanted])
    owner = np.repeat(np.arange(len(queries)), np.diff(found.offsets))
    d = np.asarray(points)[found.indices] - np.asarray(queries)[owner]
    np.testing.assert_array_equal(found.distance, np.sqrt((d[:, 0] ** 2 + d[:, 1] ** 2) + d[:, 2] ** 2))


def test_a_hand_made_set():
    grid = NeighborGrid(CORNERS, 1.0, device="cpu")
    found = grid.radius_search([[0, 0, 0], [2, 0, 0], [9, 9, 9]])
    assert rows(found) == [[0, 1, 2], [1, 3], []]
    assert found.distance.tolist() == [0.0, 1.0, 1.0, 1.0, 1.0]
    assert grid.count([[0, 0, 0], [2, 0, 0], [9, 9, 9]]).tolist() == [3, 2, 0]


def test_types_and_shapes():
    grid = NeighborGrid(CORNERS, 1.0, device="cpu")
    found = grid.radius_search(CORNERS)
    assert found._fields == ("offsets", "indices", "distance")
    assert (found.offsets.dtype, found.indices.dtype, found.distance.dtype) == (np.int64, np.int32, np.float64)
    assert found.offsets.shape == (6,)
    assert grid.count(CORNERS).dtype == np.int32
    single = grid.radius_search(CORNERS.astype(np.float32))
    assert single.distance.dtype == np.float32
    assert single.offsets.dtype == np.int64


def test_attributes():
    grid = NeighborGrid(CORNERS, 0.5, device="cpu")
    assert (grid.radius, grid.device, len(grid)) == (0.5, "cpu", 5)
    assert repr(grid) == "NeighborGrid(5 points, radius=0.5, device='cpu')"


def test_warp_in_warp_out():
    grid = NeighborGrid(wp.array(CORNERS, dtype=wp.vec3d, device="cpu"), 1.0, device="cpu")
    found = grid.radius_search(wp.array(CORNERS, dtype=wp.vec3f, device="cpu"))
    assert all(isinstance(array, wp.array) for array in found)
    assert found.distance.dtype == wp.float32
    assert isinstance(grid.count(wp.array(CORNERS, dtype=wp.vec3d, device="cpu")), wp.array)
    assert found.offsets.numpy().tolist() == [0, 3, 5, 7, 8, 9]


@pytest.mark.parametrize("spacing", [1.0, 0.1, 1.0 / 3.0, 1e-3])
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_points_at_exactly_the_radius_on_a_lattice(spacing, steps):
    # Multiples of 0.1 and 1/3 are rounded: which of the lattice's points are within the radius is up to the last bit.
    axis = np.arange(7) * spacing
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    assert_like_tree(lattice, lattice, steps * spacing)


@pytest.mark.parametrize("seed", range(4))
def test_radius_that_is_one_of_the_distances(seed):
    random = np.random.default_rng(seed)
    points = random.random((400, 3))
    for i, j in random.integers(0, 400, (8, 2)):
        d = points[i] - points[j]
        radius = float(np.sqrt((d[0] ** 2 + d[1] ** 2) + d[2] ** 2))
        if radius > 0.0:
            # One rounding more or less of the squared distance decides here.
            for r in (np.nextafter(radius, 0.0), radius, np.nextafter(radius, 9.0)):
                assert_like_tree(points, points[[i, j]], float(r))


def test_squared_distance_is_rounded_term_by_term():
    # The contracted form fma(dz, dz, fma(dy, dy, dx * dx)) puts these on the other side of the radius.
    random = np.random.default_rng(3)
    points = random.random((20_000, 3))
    a, b, c = (points[:, axis] ** 2 for axis in range(3))
    limit = (a + b) + c
    exact = a.astype(np.longdouble) + points[:, 1].astype(np.longdouble) ** 2 + points[:, 2].astype(np.longdouble) ** 2
    differs = np.flatnonzero(exact.astype(np.float64) != limit)
    assert len(differs) > 100
    for i in differs[:40]:
        radius = np.sqrt(limit[i])
        for r in (radius, np.nextafter(radius, 0.0), np.nextafter(radius, 2.0)):
            counted = NeighborGrid(points[i : i + 1], r, device="cpu").count(np.zeros((1, 3)))
            assert counted[0] == (limit[i] <= r * r)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cells_kernels", "radius_cuda_kernels", "periodic_kernels", "verlet_kernels"])
def test_cuda_code_has_no_fused_arithmetic(name, tmp_path):
    # nvrtc contracts by default; the compiler comes with warp, so no GPU is needed to inspect its output.
    launcher.resolve_device("cpu")
    module = importlib.import_module(f"geokit.points.search.{name}")
    wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    code = "".join(file.read_text() for file in tmp_path.rglob("*.ptx"))
    assert "mul.rn.f64" in code
    assert "fma.rn.f64" not in code


@pytest.mark.parametrize("radius", [1e-3, 0.04, 0.1, 0.3, 2.0, 1e9])
@pytest.mark.parametrize("build_radius", [0.02, 0.1, 5.0])
def test_query_radius_may_differ_from_the_grid_s(radius, build_radius):
    random = np.random.default_rng(0)
    points, queries = random.random((500, 3)), random.random((60, 3)) * 1.4 - 0.2
    assert_like_tree(points, queries, radius, build_radius=build_radius)


def test_radii_in_turn_on_one_grid():
    points = np.random.default_rng(0).random((300, 3))
    grid, tree = NeighborGrid(points, 0.1, device="cpu"), cKDTree(points)
    for radius in (0.1, 0.5, 0.01, 0.5, 0.1, 3.0, 0.2):
        np.testing.assert_array_equal(
            grid.count(points, radius=radius), tree.query_ball_point(points, radius, return_length=True)
        )


@pytest.mark.parametrize("count", [1, 7, 8, 9, 63, 64, 65, 129, 1500])
def test_identical_points(count):
    points = np.full((count, 3), 0.7)
    found = NeighborGrid(points, 1e-3, device="cpu").radius_search(points[:2])
    assert rows(found) == [list(range(count))] * min(count, 2)
    assert not found.distance.any()


@pytest.mark.parametrize("axes", [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2)])
def test_points_on_lines_and_planes(axes):
    points = np.zeros((400, 3))
    points[:, axes] = np.random.default_rng(1).random((400, len(axes)))
    assert_like_tree(points, points[:50] + 0.01, 0.05)


def test_no_points():
    grid = NeighborGrid(np.zeros((0, 3)), 1.0, device="cpu")
    assert len(grid) == 0
    assert grid.count(CORNERS).tolist() == [0] * 5
    assert grid.radius_search(CORNERS, radius=50.0).offsets.tolist() == [0] * 6


def test_no_queries():
    grid = NeighborGrid(CORNERS, 1.0, device="cpu")
    found = grid.radius_search([])
    assert found.offsets.tolist() == [0]
    assert found.offsets.dtype == np.int64
    assert found.indices.shape == found.distance.shape == (0,)
    assert grid.count(np.zeros((0, 3))).shape == (0,)


def test_inputs_stay_as_they_are_and_are_copied():
    points = np.random.default_rng(0).random((100, 3))
    kept = points.copy()
    grid = NeighborGrid(points, 0.2, device="cpu")
    before = grid.count(kept)
    np.testing.assert_array_equal(points, kept)
    points[:] = 0.0
    np.testing.assert_array_equal(grid.count(kept), before)


@wp.kernel
def hash_grid_count_kernel(
    grid: wp.uint64, points: wp.array(dtype=wp.vec3f), radius: float, out_count: wp.array(dtype=int)
):
    i = wp.tid()
    for j in wp.hash_grid_query(grid, points[i], radius):
        if wp.length_sq(points[j] - points[i]) <= radius * radius:
            out_count[i] += 1


def test_id_works_in_the_user_s_own_kernel():
    # Distances on this lattice are nowhere near the radius: float32 and float64 agree.
    axis = np.arange(6.0)
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    lattice = lattice[np.random.default_rng(0).permutation(len(lattice))]
    grid = NeighborGrid(lattice, 1.2, device="cpu")
    points = wp.array(lattice, dtype=wp.vec3f, device="cpu")
    counts = wp.zeros(len(lattice), dtype=int, device="cpu")
    wp.launch(hash_grid_count_kernel, len(lattice), [grid.id, points, 1.2], [counts], device="cpu")
    np.testing.assert_array_equal(counts.numpy(), grid.count(lattice))
    assert grid.id == grid.id


@pytest.mark.parametrize("radius", [-1.0, -5e-324, np.nan, np.inf, "wide"])
def test_radius_must_be_finite_and_not_negative(radius):
    with pytest.raises(gk.InputError, match="radius"):
        NeighborGrid(CORNERS, radius, device="cpu")
    grid = NeighborGrid(CORNERS, 1.0, device="cpu")
    for ask in (grid.count, grid.radius_search, grid.radius_search_blocks):
        with pytest.raises(gk.InputError, match="radius"):
            ask(CORNERS, radius=radius)
    with pytest.raises(gk.InputError, match="radius"):
        grid.pairs(radius=radius)


def test_points_and_queries_are_checked():
    bad = CORNERS.copy()
    bad[3, 1] = np.nan
    with pytest.raises(gk.InputError, match="points: row 3"):
        NeighborGrid(bad, 1.0, device="cpu")
    grid = NeighborGrid(CORNERS, 1.0, device="cpu")
    for ask in (grid.count, grid.radius_search):
        with pytest.raises(gk.InputError, match="queries: row 3"):
            ask(bad)
        with pytest.raises(gk.InputError, match=r"queries: shape \(5, 2\)"):
            ask(CORNERS[:, :2])


def test_spread_beyond_float64_is_refused():
    with pytest.raises(gk.InputError, match="points: they spread"):
        NeighborGrid([[-1.5e308, 0, 0], [1.5e308, 0, 0]], 1.0, device="cpu")


def test_unknown_device():
    with pytest.raises(gk.InputError, match="device"):
        NeighborGrid(CORNERS, 1.0, device="abacus")


def test_more_neighbors_than_memory(monkeypatch):
    points = np.zeros((1000, 3))
    grid = NeighborGrid(points, 1.0, device="cpu")
    monkeypatch.setattr(available_memory, "available", lambda device: 11_999_999)
    with pytest.raises(gk.DeviceMemoryError, match=r"1000 queries have 1000000 neighbors, which need about 11.4"):
        grid.radius_search(points)
    monkeypatch.setattr(available_memory, "available", lambda device: 12_000_000)
    assert len(grid.radius_search(points).indices) == 1_000_000


@pytest.mark.slow
def test_more_neighbors_than_one_result_holds(monkeypatch):
    # 65,536 x 32,768 = 2^31, one more than int32 can count; nothing of that size is allocated.
    monkeypatch.setattr(available_memory, "available", lambda device: 1 << 62)
    grid = NeighborGrid(np.zeros((1 << 15, 3)), 1.0, device="cpu")
    with pytest.raises(gk.DeviceMemoryError, match="at most 2147483647"):
        grid.radius_search(np.zeros((1 << 16, 3)))
