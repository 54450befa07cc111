"""downsample on hand-sized inputs: each method's answer, containers, edges and every error."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.core import launcher
from geokit.points._downsample import Cover, Downsampled, cover, downsample
from geokit.points.clouds import voxel_centroids
from geokit.points.clouds.farthest_points_kernels import GROUP_POINTS, LEAF_POINTS
from geokit.points.clouds.voxel_centroids import VoxelOrder, centroids_by_pieces
from tests.support.reference import farthest_point_order, poisson_disk_indices, voxel_means

LINE = np.array([[0.1, 0, 0], [0.3, 0, 0], [1.2, 0, 0], [2.9, 0, 0]])


def test_voxels_of_a_line():
    found = downsample(LINE, voxel_size=1.0, device="cpu")
    assert isinstance(found, Downsampled)
    assert found.points.tolist() == [[0.2, 0, 0], [1.2, 0, 0], [2.9, 0, 0]]
    # Both points of the first voxel are 0.1 from its centroid to a rounding: the lower index is one of the nearest.
    assert found.indices[1:].tolist() == [2, 3]
    assert found.indices[0] in (0, 1)


def test_voxels_begin_at_the_origin_and_hold_their_lower_faces():
    points = np.array([[-0.5, 0.5, 0.5], [0.0, 0.5, 0.5], [-1.0, 0.5, 0.5], [np.nextafter(-1.0, -2.0), 0.5, 0.5]])
    found = downsample(points, voxel_size=1.0, device="cpu")
    assert found.points[:, 0].tolist() == [points[3, 0], -0.75, 0.0]
    assert found.indices.tolist() == [3, 0, 1]


def test_voxels_come_by_z_then_y_then_x():
    corners = np.array([[x, y, z] for x in (0.5, 1.5) for y in (0.5, 1.5) for z in (0.5, 1.5)])
    found = downsample(corners, voxel_size=1.0, device="cpu")
    np.testing.assert_array_equal(found.points, sorted(corners.tolist(), key=lambda p: p[::-1]))


def test_the_point_nearest_to_the_centroid_is_named_of_equal_ones_the_first():
    square = np.array([[0.5, 0.5, 0.25], [0.25, 0.5, 0.5], [0.75, 0.5, 0.5], [0.5, 0.5, 0.75]])
    assert downsample(square, voxel_size=1.0, device="cpu").indices.tolist() == [0]
    assert downsample(np.vstack([square, [[0.5, 0.5, 0.5]]]), voxel_size=1.0, device="cpu").indices.tolist() == [4]


@pytest.mark.slow
@pytest.mark.parametrize("voxel_size", [1e-6, 0.013, 0.1, 0.4, 3.0])
def test_voxels_equal_the_reference(voxel_size):
    points = np.random.default_rng(0).normal(size=(3000, 3))
    found = downsample(points, voxel_size=voxel_size, device="cpu")
    centroids, nearest = voxel_means(points, voxel_size)
    np.testing.assert_allclose(found.points, centroids, rtol=0.0, atol=1e-15)
    np.testing.assert_array_equal(found.indices, nearest)


@pytest.mark.parametrize("far", [1e6, 1e9, 1e12])
def test_more_voxels_than_a_key_has_bits_for(far):
    # 1e12 voxels an axis: layers are numbered axis by axis, and the order stays.
    random = np.random.default_rng(1)
    points = np.concatenate([random.random((300, 3)), random.random((300, 3)) * far, random.random((40, 3)) - far])
    found = downsample(points, voxel_size=0.5, device="cpu")
    centroids, nearest = voxel_means(points, 0.5)
    np.testing.assert_array_equal(found.indices, nearest)
    np.testing.assert_allclose(found.points, centroids, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("sizes", [[1], [1023], [1024], [1025], [1, 3000, 1024, 2, 5000], [20_000]])
def test_pieces_of_large_voxels_give_the_same_bits(sizes):
    # The GPU uses a thread for each piece, the CPU one for each voxel.
    random = np.random.default_rng(sum(sizes))
    points = np.concatenate([random.random((size, 3)) + np.array([3.0 * i, 0.0, 7.0]) for i, size in enumerate(sizes)])
    wanted = downsample(points, voxel_size=3.0, device="cpu")
    given = [
        wp.array(rows, dtype=dtype, device="cpu")
        for rows, dtype in (
            (points, wp.vec3d), (np.arange(len(points)), wp.int32), (np.cumsum([0, *sizes]), wp.int32)
        )
    ]  # fmt: skip
    centroids, indices = centroids_by_pieces(VoxelOrder(*given))
    np.testing.assert_array_equal(centroids.numpy(), wanted.points)
    np.testing.assert_array_equal(indices.numpy(), wanted.indices)


@pytest.mark.parametrize("voxel_size", [0.05, 0.4])
def test_sorted_and_counted_voxels_are_the_same(voxel_size, monkeypatch):
    points = np.random.default_rng(4).normal(size=(5000, 3))
    counted = downsample(points, voxel_size=voxel_size, device="cpu")
    for limit in ("MOST_COUNTS", "MOST_KEYS"):
        # First without a table of counts, then without a key for the whole box either.
        monkeypatch.setattr(voxel_centroids, limit, 0)
        other = downsample(points, voxel_size=voxel_size, device="cpu")
        np.testing.assert_array_equal(other.points, counted.points)
        np.testing.assert_array_equal(other.indices, counted.indices)


def test_farthest_points_of_a_line():
    found = downsample(LINE, count=4, device="cpu")
    assert found.indices.tolist() == [0, 3, 2, 1]
    np.testing.assert_array_equal(found.points, LINE[[0, 3, 2, 1]])
    assert downsample(LINE, count=2, start=2, device="cpu").indices.tolist() == [2, 3]


LEAF, GROUP = int(LEAF_POINTS), int(GROUP_POINTS)


@pytest.mark.parametrize("count", [1, 2, LEAF - 1, LEAF, LEAF + 1, GROUP - 1, GROUP, GROUP + 1, 9 * GROUP + 7])
def test_farthest_points_across_the_ends_of_leaves_and_groups(count):
    points = np.random.default_rng(count).random((count, 3))
    wanted = min(count, 150)
    found = downsample(points, count=wanted, start=count // 2, device="cpu")
    np.testing.assert_array_equal(found.indices, farthest_point_order(points, wanted, count // 2))


def test_farthest_points_of_a_lattice_with_ties_everywhere():
    axis = np.arange(12.0)
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    found = downsample(lattice, count=len(lattice), device="cpu")
    np.testing.assert_array_equal(found.indices, farthest_point_order(lattice, len(lattice), 0))


def test_farthest_points_take_none_twice():
    points = np.repeat(np.random.default_rng(0).random((7, 3)), 40, axis=0)
    found = downsample(points, count=280, device="cpu")
    assert sorted(found.indices.tolist()) == list(range(280))
    # Duplicates have distance 0, and come by index once every place is taken.
    assert len(np.unique(found.points[:7], axis=0)) == 7
    assert (np.diff(found.indices[7:]) > 0).all()


@pytest.mark.parametrize("scale", [1e-250, 1e-160, 1e-8, 1e8, 1e160, 1e250])
def test_farthest_points_whose_squares_vanish_or_overflow(scale):
    points = np.random.default_rng(2).random((500, 3))
    # Powers of two scale without rounding: the same points are taken.
    factor = 2.0 ** np.round(np.log2(scale))
    np.testing.assert_array_equal(
        downsample(points * factor, count=200, device="cpu").indices, farthest_point_order(points, 200, 0)
    )


def test_poisson_disk_subset_of_a_line():
    found = downsample(LINE, radius=0.5, device="cpu")
    # Tried in the order 2, 0, 1, 3.
    assert found.indices.tolist() == [0, 2, 3]
    np.testing.assert_array_equal(found.points, LINE[found.indices])


@pytest.mark.slow
@pytest.mark.parametrize("radius", [1e-9, 0.03, 0.2, 0.7, 50.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_poisson_disk_subset_is_that_of_trying_one_after_the_other(radius, seed):
    points = np.random.default_rng(3).normal(size=(2500, 3))
    found = downsample(points, radius=radius, seed=seed, device="cpu")
    np.testing.assert_array_equal(found.indices, poisson_disk_indices(points, radius, seed))


@pytest.mark.parametrize("steps", [1.0, 2.0, np.sqrt(2.0), np.sqrt(3.0)])
def test_points_at_exactly_the_radius_may_both_stay(steps):
    axis = np.arange(8.0)
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    found = downsample(lattice, radius=steps, device="cpu")
    np.testing.assert_array_equal(found.indices, poisson_disk_indices(lattice, steps, 0))
    assert len(found.indices) == 512 if steps == 1.0 else len(found.indices) < 400


def test_seeds_give_other_subsets():
    points = np.random.default_rng(0).random((500, 3))
    first, second = (downsample(points, radius=0.2, seed=seed, device="cpu").indices.tolist() for seed in (0, 1))
    assert first != second


def test_radius_whose_square_vanishes_keeps_everything():
    points = np.zeros((5, 3))
    assert downsample(points, radius=1e-170, device="cpu").indices.tolist() == [0, 1, 2, 3, 4]
    assert downsample(points, radius=1e-150, device="cpu").indices.size == 1


def test_cover_of_a_line():
    found = cover(LINE, tolerance=0.5, device="cpu")
    assert isinstance(found, Cover)
    # Tried in the order 2, 0, 1, 3: the second point is near to the first.
    assert found.indices.tolist() == [0, 2, 3]
    np.testing.assert_array_equal(found.points, LINE[found.indices])
    assert found.deviation == LINE[1, 0] - LINE[0, 0]
    assert found.deviation_p999 == found.deviation


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-9, 0.1, 0.7, 50.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_cover_is_the_poisson_disk_subset_and_its_deviation_that_of_all_pairs(tolerance, seed):
    points = np.random.default_rng(8).normal(size=(2000, 3))
    found = cover(points, tolerance=tolerance, seed=seed, device="cpu")
    np.testing.assert_array_equal(found.indices, poisson_disk_indices(points, tolerance, seed))
    apart = np.array([np.sqrt(((points[found.indices] - p) ** 2).sum(axis=1).min()) for p in points])
    assert found.deviation == pytest.approx(apart.max(), rel=1e-15)
    assert found.deviation <= tolerance
    # No more than two of 2000 are farther.
    assert found.deviation_p999 == pytest.approx(np.sort(apart)[1998], rel=1e-15)
    same = downsample(points, tolerance=tolerance, seed=seed, device="cpu")
    np.testing.assert_array_equal(same.indices, found.indices)
    np.testing.assert_array_equal(same.points, found.points)


def test_cover_keeps_container_and_type():
    single = cover(LINE.astype(np.float32), tolerance=0.5, device="cpu")
    assert (single.points.dtype, single.indices.dtype) == (np.float32, np.int32)
    given = wp.array(LINE, dtype=wp.vec3d, device="cpu")
    found = cover(given, tolerance=0.5, device="cpu")
    assert isinstance(found.points, wp.array)
    assert isinstance(found.indices, wp.array)
    assert isinstance(found.deviation, float)
    np.testing.assert_array_equal(given.numpy(), LINE)


def test_one_point_covers_itself_and_its_copies():
    found = cover(np.full((7, 3), 1e8), tolerance=1e-9, device="cpu")
    assert len(found.points) == 1
    assert found.deviation == found.deviation_p999 == 0.0


def test_nothing_to_cover():
    with pytest.raises(gk.InputError, match="nothing to cover"):
        cover(np.zeros((0, 3)), tolerance=1.0, device="cpu")


@pytest.mark.parametrize("choice", [{"voxel_size": 0.5}, {"count": 3}, {"radius": 0.5}, {"tolerance": 0.5}])
def test_types_and_containers(choice):
    found = downsample(LINE, **choice, device="cpu")
    assert (found.points.dtype, found.indices.dtype) == (np.float64, np.int32)
    assert found.points.shape == (len(found.indices), 3)
    single = downsample(LINE.astype(np.float32), **choice, device="cpu")
    assert single.points.dtype == np.float32
    given = wp.array(LINE, dtype=wp.vec3d, device="cpu")
    taken = downsample(given, **choice, device="cpu")
    assert all(isinstance(array, wp.array) for array in taken)
    np.testing.assert_array_equal(taken.points.numpy(), found.points)
    np.testing.assert_array_equal(given.numpy(), LINE)


@pytest.mark.parametrize("choice", [{"voxel_size": 0.5}, {"radius": 0.5}, {"tolerance": 0.5}])
def test_no_points(choice):
    found = downsample(np.zeros((0, 3)), **choice, device="cpu")
    assert found.points.shape == (0, 3)
    assert found.indices.shape == (0,)


@pytest.mark.parametrize("choice", [{"voxel_size": 0.5}, {"count": 1}, {"radius": 0.5}])
def test_one_point(choice):
    found = downsample([[1.0, -2.0, 3.0]], **choice, device="cpu")
    assert found.points.tolist() == [[1.0, -2.0, 3.0]]
    assert found.indices.tolist() == [0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["voxel_centroids", "farthest_points", "poisson_disk"])
def test_cuda_code_has_no_fused_arithmetic(name, tmp_path):
    launcher.resolve_device("cpu")
    module = importlib.import_module(f"geokit.points.clouds.{name}_kernels")
    wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    code = "".join(file.read_text() for file in tmp_path.rglob("*.ptx"))
    assert "mul.rn.f64" in code
    assert "fma.rn.f64" not in code


@pytest.mark.parametrize(
    "choice",
    [{}, {"voxel_size": 1.0, "count": 2}, {"count": 2, "radius": 1.0}, {"radius": 1.0, "tolerance": 1.0}],
)
def test_exactly_one_method(choice):
    with pytest.raises(gk.InputError, match="exactly one"):
        downsample(LINE, **choice, device="cpu")


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "wide"])
def test_tolerance_of_a_cover_must_be_positive_and_finite(value):
    with pytest.raises(gk.InputError, match="tolerance"):
        cover(LINE, tolerance=value, device="cpu")


@pytest.mark.parametrize("name", ["voxel_size", "radius", "tolerance"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "wide"])
def test_lengths_must_be_positive_and_finite(name, value):
    with pytest.raises(gk.InputError, match=name):
        downsample(LINE, **{name: value}, device="cpu")


@pytest.mark.parametrize("value", [0, -1, 5, 2.0, True, "two"])
def test_count_must_be_a_whole_number_of_points(value):
    with pytest.raises(gk.InputError, match="count"):
        downsample(LINE, count=value, device="cpu")


@pytest.mark.parametrize("value", [-1, 4, 1.0, True])
def test_start_must_be_a_point(value):
    with pytest.raises(gk.InputError, match="start"):
        downsample(LINE, count=2, start=value, device="cpu")


@pytest.mark.parametrize("value", [-1, 0.5, True])
def test_seed_must_be_a_whole_number(value):
    with pytest.raises(gk.InputError, match="seed"):
        downsample(LINE, radius=1.0, seed=value, device="cpu")
    with pytest.raises(gk.InputError, match="seed"):
        cover(LINE, tolerance=1.0, seed=value, device="cpu")


@pytest.mark.parametrize("choice", [{"voxel_size": 0.5}, {"count": 1}, {"radius": 0.5}])
def test_points_are_checked(choice):
    bad = LINE.copy()
    bad[2, 1] = np.inf
    with pytest.raises(gk.InputError, match="points: row 2"):
        downsample(bad, **choice, device="cpu")
    with pytest.raises(gk.InputError, match=r"points: shape \(4, 2\)"):
        downsample(LINE[:, :2], **choice, device="cpu")
    with pytest.raises(gk.InputError, match="device"):
        downsample(LINE, **choice, device="abacus")


def test_points_of_a_cover_are_checked():
    bad = LINE.copy()
    bad[2, 1] = np.inf
    with pytest.raises(gk.InputError, match="points: row 2"):
        cover(bad, tolerance=1.0, device="cpu")
    with pytest.raises(gk.InputError, match="device"):
        cover(LINE, tolerance=1.0, device="abacus")


def test_voxels_below_the_resolution_of_the_coordinates():
    with pytest.raises(gk.InputError, match=r"voxel_size: 1e-08 is too small for coordinates of 1e\+09"):
        downsample([[1e9, 0, 0]], voxel_size=1e-8, device="cpu")
    assert len(downsample([[1e9, 0, 0]], voxel_size=1e-6, device="cpu").points) == 1
