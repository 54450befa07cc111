"""Points in .vdb files: what geokit writes it reads again, and what other programs write is read by its names."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit import native
from geokit.cli import main
from geokit.errors import FileFormatError, InputError, MissingDependencyError, UnsupportedGridError
from geokit.native import _openvdb

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

# Made by foreign_points.cpp.
FOREIGN = Path(__file__).parents[1] / "support" / "foreign_points.vdb"
RNG = np.random.default_rng(5)
COUNT = 3000
CLOUD = RNG.normal(size=(COUNT, 3)) * [1.0, 20.0, 0.01] + [5e6, -3e5, 2.0]
DATA = {
    "rgb": RNG.integers(0, 256, (COUNT, 3)).astype(np.uint8),
    "normals": RNG.normal(size=(COUNT, 3)).astype(np.float32),
    "radius": RNG.random(COUNT),
    "half": RNG.random(COUNT).astype(np.float16),
    "velocity": RNG.normal(size=(COUNT, 3)),
    "cell": RNG.integers(-9, 9, (COUNT, 3)).astype(np.int32),
    "tensor": RNG.normal(size=(COUNT, 9)).astype(np.float32),
    "column": np.arange(COUNT, dtype=np.int64)[:, None],
    "is inside": RNG.random(COUNT) < 0.5,
    "is_inside": np.ones(COUNT, bool),
    "P": np.zeros(COUNT, np.int8),
    "naïve": RNG.integers(0, 2**32, COUNT, dtype=np.uint32),
    "big": RNG.integers(0, 2**62, COUNT, dtype=np.uint64),
    "two": RNG.integers(0, 2**16, (COUNT, 2)).astype(np.uint16),
    "index": np.arange(COUNT, dtype=np.int32),
}


@pytest.fixture(params=["worker", "trusted"])
def trusted(request) -> bool:
    return request.param == "trusted"


def in_order(cloud: gk.points.PointCloud) -> np.ndarray:
    order = np.argsort(cloud.data["index"])
    np.testing.assert_array_equal(np.sort(cloud.data["index"]), np.arange(len(cloud)))
    return order


def test_points_and_arrays_come_back(tmp_path, trusted):
    gk.points.save(tmp_path / "a.vdb", CLOUD, data=DATA)
    cloud = gk.points.load(tmp_path / "a.vdb", trusted=trusted)
    order = in_order(cloud)
    # An edge holds about 8 points of the box, and is at most twice that.
    edge = 2.0 * (np.prod(np.ptp(CLOUD, axis=0)) * 8 / COUNT) ** (1 / 3)
    bound = 2.0**-26 * edge + 4 * np.spacing(np.abs(CLOUD))
    assert (np.abs(cloud.points[order] - CLOUD) <= bound).all()
    assert set(cloud.data) == set(DATA)
    for name, values in DATA.items():
        assert cloud.data[name].dtype == values.dtype
        np.testing.assert_array_equal(cloud.data[name][order], values)


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        np.array([[1.5, -2.5, 1e300]]),
        np.repeat([[0.1, 0.2, 0.3]], 500, axis=0),  # all in one voxel
        np.array([[0.0, 0.0, 0.0], [1e-300, 0.0, 0.0], [0.0, 0.0, 3e-300]]),
        np.array([[-1e9, 0.0, 0.0], [1e9, 1e-3, 7.0]]),
        np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], axis=1),
    ],
    ids=["none", "one", "equal", "tiny", "far apart", "a line"],
)
def test_clouds_of_all_shapes_come_back(points, tmp_path):
    gk.points.save(tmp_path / "a.vdb", points, data={"index": np.arange(len(points))})
    cloud = gk.points.load(tmp_path / "a.vdb", trusted=True)
    assert cloud.points.shape == points.shape
    if len(points):
        edge = max(np.ptp(points, axis=0).max(), 2.0**-16, np.abs(points).max() * 2.0**-25)
        np.testing.assert_allclose(cloud.points[in_order(cloud)], points, rtol=1e-15, atol=2.0**-26 * edge)


def test_the_same_cloud_gives_the_same_file_but_for_its_id(tmp_path):
    for name in ("a.vdb", "b.vdb"):
        gk.points.save(tmp_path / name, CLOUD, data=DATA)
    first, second = ((tmp_path / name).read_bytes() for name in ("a.vdb", "b.vdb"))
    # OpenVDB's header has a random number of 36 characters.
    assert len(first) == len(second)
    assert sum(a != b for a, b in zip(first, second, strict=True)) <= 36


def place(i: np.ndarray) -> np.ndarray:
    return np.stack([0.37 * i + 10, np.sin(1.3 * i) + 20, 2.0 + 0.1 * (i % 7) + 30], axis=1)


@pytest.mark.parametrize(("grid", "count", "error"), [("spray", 40, 3e-6), ("foam", 20, 0.5 / 65535 + 3e-6)])
def test_grids_of_other_programs(grid, count, error, trusted):
    with pytest.warns(UserWarning, match=r"foreign_points\.vdb: attributes .* left out: frame, label"):
        cloud = gk.points.load(FOREIGN, grid=grid, trusted=trusted)
    i = cloud.data["id"]
    np.testing.assert_array_equal(np.sort(i), np.arange(count))
    np.testing.assert_allclose(cloud.points, place(i), rtol=0, atol=error)
    np.testing.assert_array_equal(cloud.data["pscale"], 0.125 * i)
    np.testing.assert_array_equal(cloud.data["rgb"], np.stack([0.25 * (i % 4), 0.5 + 0 * i, 1 + 0 * i], axis=1))
    np.testing.assert_array_equal(cloud.data["weights"], np.full((count, 4), 1.5))
    np.testing.assert_array_equal(cloud.data["odd"], i % 2 == 1)
    assert cloud.data["odd"].dtype == bool
    assert sorted(cloud.data) == ["id", "odd", "pscale", "rgb", "weights"]


@pytest.mark.slow
def test_volumes_beside_points_are_read_as_before(tmp_path):
    assert gk.volume.load(FOREIGN, grid="density").sample([[1.0, 2.0, 3.0]], order=0) == 1.0
    assert [info.grid_type for info in gk.volume.inspect(FOREIGN)] == ["points", "float", "points"]
    with pytest.raises(UnsupportedGridError, match=r"'spray' holds points; load them with geokit\.points\.load"):
        gk.volume.load(FOREIGN, grid="spray")


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (None, r"has several grids of points; choose one with grid=; the file holds 'spray', 'foam'"),
        ("density", r"no grid of points named 'density'; the file holds 'spray', 'foam'"),
        ("Spray", r"no grid of points named 'Spray'"),
    ],
)
def test_a_grid_is_chosen_by_name(grid, message, trusted):
    with pytest.raises(InputError, match=message):
        gk.points.load(FOREIGN, grid=grid, trusted=trusted)


def test_a_file_of_volumes_holds_no_points(tmp_path):
    gk.volume.save(tmp_path / "a.vdb", gk.volume.from_dense(np.ones((3, 3, 3), np.float32), voxel_size=1.0, name="d"))
    with pytest.raises(InputError, match=r"a\.vdb: holds no points but volumes, .*'d'"):
        gk.points.load(tmp_path / "a.vdb")


def test_refusals(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"data\['id'\]: holds numbers beyond 63 bits"):
        gk.points.save(tmp_path / "a.vdb", [[0, 0, 0]], data={"id": np.array([2**63], np.uint64)})
    with pytest.raises(InputError, match="lie too far apart"):
        gk.points.save(tmp_path / "a.vdb", [[-1e308, 0, 0], [1e308, 0, 0]])
    gk.points.save(tmp_path / "a.csv", [[0, 0, 0]])
    with pytest.raises(InputError, match=r"grid: \.csv holds one cloud; leave it out"):
        gk.points.load(tmp_path / "a.csv", grid="a")
    with pytest.raises(InputError, match="grid"):
        gk.points.load(FOREIGN, grid=7)
    assert not (tmp_path / "a.vdb").exists()
    monkeypatch.setattr(_openvdb, "_load", lambda: (None, "not built"))
    with pytest.raises(MissingDependencyError, match="without OpenVDB"):
        gk.points.load(FOREIGN, grid="foam")
    with pytest.raises(MissingDependencyError, match="without OpenVDB"):
        gk.points.save(tmp_path / "a.vdb", [[0, 0, 0]])


def test_truncated_and_flipped_files_are_refused_or_read(tmp_path):
    gk.points.save(tmp_path / "a.vdb", CLOUD[:200], data={name: DATA[name][:200] for name in ("rgb", "radius")})
    sound, path, rng = (tmp_path / "a.vdb").read_bytes(), tmp_path / "b.vdb", np.random.default_rng(2)
    refused = 0
    for i in range(40):
        data = bytearray(sound if i % 2 else sound[: rng.integers(1, len(sound))])
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        try:
            assert len(gk.points.load(path, finite_only=True)) <= 200
        except (FileFormatError, InputError, UnsupportedGridError):
            refused += 1
    assert refused >= 20  # all that are cut


@pytest.mark.slow
def test_the_command_line_converts_points(tmp_path, capsys):
    gk.points.save(tmp_path / "a.vdb", CLOUD, data={"rgb": DATA["rgb"]})
    assert main(["convert", str(tmp_path / "a.vdb"), str(tmp_path / "a.ply")]) == 0, capsys.readouterr().err
    assert gk.points.load(tmp_path / "a.ply").data["rgb"].shape == (COUNT, 3)
    assert main(["info", str(tmp_path / "a.vdb")]) == 0
    assert "3000" in capsys.readouterr().out
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Where volumes are beside the points, the name of a grid says what is meant.
        assert main(["convert", str(FOREIGN), str(tmp_path / "foam.csv"), "--grid", "foam"]) == 0
        assert len(gk.points.load(tmp_path / "foam.csv")) == 20
        assert main(["convert", str(FOREIGN), str(tmp_path / "d.nvdb"), "--grid", "density"]) == 0
