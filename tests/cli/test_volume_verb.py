"""``geokit volume``: every operation from file to file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from geokit import native
from geokit.volume import from_dense, load, load_all, save

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB"),
]


@pytest.fixture(scope="module")
def bodies(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    from tests.support.analytic_volumes import ball, cubes, level_set

    folder = tmp_path_factory.mktemp("bodies")
    for name, x in (("a", -0.3), ("b", 0.4)):
        save(folder / f"{name}.vdb", level_set(ball(0.8, (x, 0.0, 0.0)), transform=cubes(0.1), name=name))
    return folder / "a.vdb", folder / "b.vdb"


@pytest.fixture(scope="module")
def flow(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.support.analytic_volumes import field

    path = tmp_path_factory.mktemp("flow") / "flow.vdb"
    save(path, field(lambda p: p @ np.diag([1.0, 2.0, 3.0]), background=np.zeros(3), leaves=1, name="flow"))
    return path


def test_union_of_three_is_written(geokit, bodies, tmp_path: Path) -> None:
    target = tmp_path / "out.nvdb"
    done = geokit("volume", "union", *bodies, bodies[0], target, "--smooth", "0.1", "--codec", "zip")
    assert done.returncode == 0, done.stderr
    assert "out.nvdb: float" in done.stdout
    volume = load(target)
    assert volume.info.grid_class == "level set"
    inside = np.asarray(volume.sample(np.array([[-0.3, 0, 0], [0.4, 0, 0], [2, 0, 0]]), device="cpu")) < 0
    assert inside.tolist() == [True, True, False]


@pytest.mark.parametrize("operation", ["intersection", "difference"])
def test_other_combinations(geokit, bodies, tmp_path: Path, operation: str) -> None:
    done = geokit("volume", operation, *bodies, tmp_path / "out.vdb", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["operation"] == operation
    assert report["active_voxels"] == [load(tmp_path / "out.vdb").info.active_voxel_count]


@pytest.mark.parametrize(
    ("operation", "options"),
    [
        ("offset", ["--distance", "-0.15"]),
        ("dilate", ["--distance", "0.1"]),
        ("erode", ["--distance", "0.1"]),
        ("opening", ["--distance", "0.1"]),
        ("closing", ["--distance", "0.1"]),
        ("renormalize", ["--half-width", "4"]),
        ("smooth", ["--method", "median", "--width", "2", "--iterations", "2"]),
        ("resample", ["--voxel-size", "0.2", "--device", "cpu"]),
        ("prune", ["--tolerance", "0.01"]),
        ("clip", ["--lower", "-1", "-1", "-1", "--upper", "0", "1", "1"]),
        ("gradient", ["--device", "cpu"]),
        ("laplacian", ["--device", "cpu"]),
        ("segment", []),
        ("connected-components", ["--device", "cpu"]),
    ],
)
def test_one_volume_into_another(geokit, bodies, tmp_path: Path, operation: str, options: list[str]) -> None:
    target = tmp_path / "out.vdb"
    done = geokit("volume", operation, bodies[0], target, *options, "--grid", "a")
    assert done.returncode == 0, done.stderr
    assert load(target).info.name == "a"
    assert load(target).info.active_voxel_count > 0


@pytest.mark.parametrize("operation", ["divergence", "curl"])
def test_vectors(geokit, flow: Path, tmp_path: Path, operation: str) -> None:
    done = geokit("volume", operation, flow, tmp_path / "out.nvdb", "--device", "cpu")
    assert done.returncode == 0, done.stderr
    value = np.asarray(load(tmp_path / "out.nvdb").sample(np.zeros((1, 3)), device="cpu"))
    np.testing.assert_allclose(value.ravel(), [6.0] if operation == "divergence" else [0.0, 0.0, 0.0], atol=1e-5)


def test_resample_like_another(geokit, bodies, tmp_path: Path) -> None:
    coarse = tmp_path / "coarse.nvdb"
    assert geokit("volume", "resample", bodies[1], coarse, "--voxel-size", "0.16", "--device", "cpu").returncode == 0
    done = geokit("volume", "resample", bodies[0], tmp_path / "out.nvdb", "--like", coarse, "--device", "cpu")
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(load(tmp_path / "out.nvdb").info.transform, load(coarse).info.transform)


def test_labels_are_resampled_with_order_0(geokit, tmp_path: Path) -> None:
    labels = np.arange(1, 9, dtype=np.int32).reshape(2, 2, 2)
    save(tmp_path / "labels.vdb", from_dense(labels, voxel_size=1.0, name="labels"))
    arguments = ["volume", "resample", tmp_path / "labels.vdb", tmp_path / "fine.vdb", "--voxel-size", "0.5"]
    refused = geokit(*arguments, "--device", "cpu")
    assert (refused.returncode, "use order=0" in refused.stderr) == (1, True)
    done = geokit(*arguments, "--device", "cpu", "--order", "0")
    assert done.returncode == 0, done.stderr
    fine = load(tmp_path / "fine.vdb")
    assert (fine.info.grid_type, fine.info.name, fine.info.active_voxel_count) == ("int32", "labels", 64)


def test_components_are_grids_of_one_file(geokit, bodies, tmp_path: Path) -> None:
    apart, both, parts = (tmp_path / name for name in ("apart.vdb", "both.vdb", "parts.vdb"))
    assert geokit("volume", "erode", bodies[0], apart, "--distance", "0.56").returncode == 0
    assert geokit("volume", "erode", bodies[1], parts, "--distance", "0.56").returncode == 0
    assert geokit("volume", "union", apart, parts, both).returncode == 0
    done = geokit("volume", "segment", both, parts, "--force", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["grids"] == len(load_all(parts)) == 2


def test_statistics(geokit, bodies) -> None:
    done = geokit("volume", "statistics", bodies[0], "--json")
    report = json.loads(done.stdout)
    assert report["grid"] == "a"
    assert report["count"] == load(bodies[0]).info.active_voxel_count
    assert report["volume"] == pytest.approx(4.0 / 3.0 * np.pi * 0.8**3, rel=0.02)
    plain = geokit("volume", "statistics", bodies[0])
    assert "standard_deviation" in plain.stdout


def test_refusals(geokit, fails, bodies, cube: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.vdb"
    fails(geokit("volume", "union", bodies[0], target), 2, "two to read")
    fails(geokit("volume", "offset", bodies[0], target, "--distance", "inf"), 1, "distance")
    fails(geokit("volume", "offset", cube, target, "--distance", "1"), 1, "cube.obj", "needs a volume; geokit convert")
    fails(geokit("volume", "prune", bodies[0], tmp_path / "out.ply"), 1, "out.ply", ".vdb")
    fails(geokit("volume", "prune", bodies[0], target, "--grid", "smoke"), 1, "smoke")
    fails(geokit("volume", "erode", bodies[0], tmp_path / "no" / "out.vdb", "--distance", "0.1"), 1, "does not exist")
    assert not target.exists()
    target.write_text("mine")
    fails(geokit("volume", "prune", bodies[0], target), 1, "--force")
    assert target.read_text() == "mine"
    fails(geokit("volume", "offset", bodies[0], target), 2, "--distance")
