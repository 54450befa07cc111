"""Level sets of unions of balls against brute force, and what is refused."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import warp as wp

from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, InputError
from geokit.volume._dense import to_dense
from geokit.volume._from_points import from_points
from geokit.volume.nanovdb.checks import check_grid
from tests.support.reference import union_of_balls

# A value is rounded to float32 once; radii, voxel size and coordinates below 100 voxels add some 1e-14 of a voxel.
ROUNDING = 6.0e-8


def assert_exact(points, radius, voxel_size, half_width=3.0):
    points, radii = np.asarray(points, np.float64), np.broadcast_to(radius, len(points))
    volume = from_points(points, radius, voxel_size=voxel_size, half_width=half_width, device="cpu")
    check_grid(volume.nanovdb, "points")
    pad = radii.max() + (half_width + 9) * voxel_size
    lower = np.floor((points.min(axis=0) - pad) / voxel_size).astype(int)
    upper = np.ceil((points.max(axis=0) + pad) / voxel_size).astype(int)
    dense = to_dense(volume, bounds=[lower, upper], device="cpu").values
    voxels = lower + np.argwhere(np.ones(dense.shape, bool))
    exact = union_of_balls(voxels * voxel_size, points, radii).reshape(dense.shape)
    band = half_width * voxel_size
    np.testing.assert_allclose(dense, np.clip(exact, -band, band), rtol=0, atol=ROUNDING * band)
    # Voxels within rounding of the band's end may fall on either side of it.
    sure = np.abs(np.abs(exact) - band) > ROUNDING * band
    active = (np.abs(exact) < band)[sure].sum()
    assert active <= volume.info.active_voxel_count <= active + (~sure).sum()
    return volume


@pytest.mark.parametrize("half_width", [1.0, 3.0, 12.0])
@pytest.mark.parametrize("radius", [0.3, 2.0, 25.0])
def test_one_ball(radius, half_width):
    assert_exact([[0.3, -4.1, 7.77]], radius, 1.0, half_width)


def test_equal_balls():
    points = np.random.default_rng(0).uniform(-1, 1, (60, 3))
    volume = assert_exact(points, 0.2, 0.05)
    assert volume.info.grid_class == "level set"
    assert volume.info.background == np.float32(0.15)


@pytest.mark.slow
def test_balls_of_all_sizes():
    rng = np.random.default_rng(1)
    volume = assert_exact(rng.uniform(-1, 1, (50, 3)), 10.0 ** rng.uniform(-2.5, -0.1, 50), 0.05)
    assert volume.info.metadata["geokit:lost_points"] > 0


@pytest.mark.slow
def test_balls_that_cover_whole_nodes():
    # 300 voxels across: tiles of upper nodes inside, and blocks that are ruled out before they become tiles.
    assert_exact([[0.0, 0.0, 0.0], [40.0, 3.0, 2.0]], [150.0, 2.0], 2.0, 1.0)


def test_touching_and_equal_points():
    assert_exact([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0]], [1.0, 0.7, 1.0], 0.1)


def test_lists_of_any_length_are_cut(monkeypatch):
    points = np.random.default_rng(2).uniform(-1, 1, (200, 3))
    radii = np.random.default_rng(3).uniform(0.05, 0.4, 200)
    whole = from_points(points, radii, voxel_size=0.05, device="cpu")
    module = importlib.import_module("geokit.volume._from_points")
    monkeypatch.setattr(module, "MOST_LISTED", 50)
    monkeypatch.setattr(module, "TILES_AT_A_TIME", 100)
    monkeypatch.setattr(module, "BUCKETS_AT_A_TIME", 3)
    assert np.array_equal(from_points(points, radii, voxel_size=0.05, device="cpu").nanovdb, whole.nanovdb)


def test_containers():
    points = np.random.default_rng(4).uniform(-1, 1, (9, 3)).astype(np.float32)
    radii = np.linspace(0.1, 0.4, 9)
    expected = from_points(points, radii, voxel_size=0.05, device="cpu").nanovdb
    for given in (points.tolist(), wp.array(points, dtype=wp.vec3f, device="cpu"), points.astype(np.float64)):
        assert np.array_equal(from_points(given, radii.tolist(), voxel_size=0.05, device="cpu").nanovdb, expected)
    on_device = wp.array(radii, dtype=wp.float64, device="cpu")
    assert np.array_equal(from_points(points, on_device, voxel_size=0.05, device="cpu").nanovdb, expected)


@pytest.mark.parametrize(("radius", "center", "lost"), [(0.05, 0.5, 1), (0.05, 0.02, 0), (0.87, 0.5, 0), (0.5, 0.5, 1)])
def test_balls_without_a_voxel_are_counted(radius, center, lost):
    volume = from_points([[center] * 3, [30.0, 0.0, 0.0]], [radius, 3.0], voxel_size=1.0, device="cpu")
    assert volume.info.metadata["geokit:lost_points"] == lost
    around = to_dense(volume, bounds=[[0, 0, 0], [1, 1, 1]], device="cpu").values
    assert (around < 0.0).any() == (not lost)


def test_what_it_came_from_is_known():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    first, same, other = (
        from_points(points, r, voxel_size=0.1, name="p", device="cpu").info for r in (0.3, [0.3, 0.3], 0.31)
    )
    assert first.name == "p"
    assert first.metadata["geokit:voxel_size"] == 0.1
    assert first.metadata["geokit:source_sha256"] == same.metadata["geokit:source_sha256"]
    assert first.metadata["geokit:source_sha256"] != other.metadata["geokit:source_sha256"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"points": [[0.0, 0.0]]}, "points: shape"),
        ({"points": [[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]}, "points: row 1"),
        ({"points": np.empty((0, 3))}, "points: there are none"),
        ({"radius": 0.0}, "radius: 0.0"),
        ({"radius": [1.0, -1.0]}, "radius: row 1 is -1.0"),
        ({"radius": [np.nan, 1.0]}, "radius: row 0 is nan"),
        ({"radius": [1.0, np.inf]}, "radius: row 1 is inf"),
        ({"radius": [1.0]}, "radius: shape"),
        ({"radius": "x"}, "radius"),
        ({"voxel_size": 0.0}, "voxel_size"),
        ({"voxel_size": np.nan}, "voxel_size"),
        ({"voxel_size": 1e-8}, "voxel_size"),
        ({"voxel_size": 5e-324}, "voxel_size"),
        ({"points": np.full((2, 3), 1e-40), "radius": 1e-40, "voxel_size": 1e-41}, "float32"),
        ({"points": np.full((2, 3), 1e-30), "radius": 1e300, "voxel_size": 1e-30}, "voxel_size"),
        ({"half_width": 0.9}, "half_width"),
        ({"half_width": np.inf}, "half_width"),
        ({"name": "x" * 300}, "name"),
        ({"device": "no device"}, "device"),
    ],
)
def test_refused(options, message):
    given = {"points": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], "radius": 0.5, "voxel_size": 0.2, "device": "cpu", **options}
    with pytest.raises(InputError, match=message):
        from_points(given.pop("points"), given.pop("radius"), **given)


def test_too_many_voxels_are_refused(monkeypatch):
    monkeypatch.setattr(available_memory, "available_host", lambda: 1 << 20)
    with pytest.raises(DeviceMemoryError, match="voxel_size"):
        from_points([[0.0, 0.0, 0.0]], 1.0, voxel_size=0.02, device="cpu")
