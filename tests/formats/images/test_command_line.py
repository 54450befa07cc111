"""Dense volumes on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.cli import main


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    values = np.full((20, 18, 16), -1000, np.int16)
    values[5:15, 6:14, 4:11] = 300
    np.save(tmp_path / "scan.npy", values)
    return tmp_path / "scan.npy"


def test_convert_says_the_background_and_takes_another(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = scan.with_suffix(".nvdb")
    assert main(["convert", str(scan), str(target), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["background"] == -1000
    assert gk.volume.load(target).info.active_voxel_count == 560
    options = ["--background", "-990", "--background-tolerance", "20", "--grid-type", "float", "--force"]
    assert main(["convert", str(scan), str(target), *options]) == 0
    info = gk.volume.load(target).info
    assert (info.background, info.grid_type, info.active_voxel_count) == (-990.0, "float", 560)


def test_whole_numbers_become_a_mesh(scan: Path) -> None:
    target = scan.with_suffix(".stl")
    assert main(["convert", str(scan), str(target), "--isovalue", "0"]) == 0
    mesh = gk.mesh.load(target)
    assert gk.mesh.audit(mesh).watertight
    assert mesh.bounds[0].min() > 3.0


@pytest.mark.slow
def test_sparse_to_dense_and_back_and_info(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a.nvdb", "b.mha", "c.vti", "d.nvdb"):
        assert main(["convert", str(scan), str(scan.with_name(name))]) == 0
        scan = scan.with_name(name)
    capsys.readouterr()
    assert main(["info", str(scan.with_name("b.mha")), "--json"]) == 0
    (grid,) = json.loads(capsys.readouterr().out)["grids"]
    assert (grid["type"], grid["background"]) == ("int16", -1000)
    assert grid["index_bounds"] == [[5, 6, 4], [14, 13, 10]]
    info = gk.volume.load(scan).info
    assert (info.grid_type, info.active_voxel_count, info.index_bounds.tolist()[0]) == ("int16", 560, [5, 6, 4])


def test_tables_of_numpy_are_clouds_still(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "a.npy", np.random.default_rng(1).random((9, 3)))
    np.save(tmp_path / "b.npy", np.random.default_rng(1).random((4, 5, 3)))
    for name, count in (("a", 9), ("b", 20)):
        assert main(["convert", str(tmp_path / f"{name}.npy"), str(tmp_path / f"{name}.xyz")]) == 0
        assert len(gk.points.load(tmp_path / f"{name}.xyz")) == count


def test_options_of_dense_volumes_have_no_effect_on_sparse_ones(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", str(scan), str(scan.with_suffix(".nvdb"))]) == 0
    assert main(["convert", str(scan.with_suffix(".nvdb")), str(scan.with_name("b.mha")), "--background", "1"]) == 1
    assert "background: has no effect on .nvdb" in capsys.readouterr().err
