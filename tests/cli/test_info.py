"""``geokit info``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog.sphere_volumes import sphere
from geokit.errors import UnsupportedGridError
from geokit.volume import _io
from tests.support.analytic_volumes import field


@pytest.mark.slow
def test_a_closed_mesh(geokit, cube: Path) -> None:
    done = geokit("info", cube, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    report = json.loads(done.stdout)
    assert report["kind"] == "mesh"
    assert report["name"] == "cube"
    assert (report["vertex_count"], report["face_count"]) == (8, 12)
    assert report["watertight"] is True
    assert report["manifold"] is True
    assert report["oriented"] is True
    assert report["bounds"] == [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
    assert report["signed_volume"] == pytest.approx(1.0)
    assert report["byte_count"] == cube.stat().st_size


@pytest.mark.slow
def test_the_same_as_text(geokit, cube: Path) -> None:
    lines = dict(line.split(maxsplit=1) for line in geokit("info", cube).stdout.splitlines())
    assert lines["face_count"] == "12"
    assert lines["watertight"] == "yes"
    assert lines["bounds"] == "((0, 0, 0), (1, 1, 1))"


@pytest.mark.slow
def test_an_open_mesh(geokit, tmp_path: Path) -> None:
    path = tmp_path / "one.off"
    path.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    report = json.loads(geokit("info", path, "--json").stdout)
    assert report["watertight"] is False
    assert report["boundary_edge_count"] == 3


@pytest.mark.slow
def test_a_volume(geokit, cube_sdf: Path) -> None:
    report = json.loads(geokit("info", cube_sdf, "--json").stdout)
    assert (report["kind"], report["grid_count"]) == ("volume", 1)
    (grid,) = report["grids"]
    assert (grid["type"], grid["class"]) == ("float", "level set")
    assert grid["voxel_size"] == [0.0625] * 3
    assert grid["background"] == pytest.approx(3 * 0.0625)
    assert grid["active_voxel_count"] > 1000
    text = geokit("info", cube_sdf).stdout
    assert "level set" in text


def refused(path: Path) -> None:
    raise UnsupportedGridError(f"{path}: a frustum")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["vdb", "nvdb"])
def test_the_range_of_values_of_each_grid(geokit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    if kind == "vdb":
        pytest.importorskip("geokit.native._bridge")
    path = tmp_path / f"two.{kind}"
    flow = field(lambda p: p + 9.0, background=np.zeros(3), leaves=1, name="flow")
    gk.volume.save(path, sphere(12.0), flow, gk.volume.from_dense(np.zeros((1, 1, 1), np.float32), name="nothing"))
    report = json.loads(geokit("info", path, "--json").stdout)
    for grid in report["grids"][:2]:
        found = gk.volume.statistics(gk.volume.load(path, grid=grid["grid"]))
        assert grid["value_range"] == pytest.approx([found.minimum, found.maximum], rel=1e-6)
    assert report["grids"][2]["value_range"] is None
    with monkeypatch.context() as patched:  # as where one of them cannot be read
        patched.setattr(gk.volume, "load_all", refused)
        assert json.loads(geokit("info", path, "--json").stdout) == report
    monkeypatch.setattr(_io, "READ_AT_ONCE", 0)
    assert geokit("info", path).stdout.count("not known (geokit volume statistics asks each voxel)") == 3


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["csv", "npy", "ply"])
def test_a_point_cloud(geokit, tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"cloud.{kind}"
    points = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    if kind == "csv":
        path.write_text("x,y,z\n0,1,2\n3,4,5\n")
    elif kind == "npy":
        np.save(path, points)
    else:
        header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        path.write_text(header + "end_header\n0 1 2\n3 4 5\n")
    report = json.loads(geokit("info", path, "--json").stdout)
    assert report["kind"] == "cloud"
    assert report["point_count"] == 2
    assert report["bounds"] == points.tolist()


@pytest.mark.slow
def test_damaged_files(geokit, fails, tmp_path: Path, cube_sdf: Path) -> None:
    truncated = tmp_path / "half.nvdb"
    truncated.write_bytes(cube_sdf.read_bytes()[:1000])
    fails(geokit("info", truncated), 1, "half.nvdb")
    nonsense = tmp_path / "text.ply"
    nonsense.write_text("this is no mesh\n")
    fails(geokit("info", nonsense), 1, "text.ply")
    empty = tmp_path / "empty.obj"
    empty.write_bytes(b"")
    fails(geokit("info", empty), 1, "empty.obj")


@pytest.mark.slow
def test_columns_of_a_table_are_chosen(geokit, fails, cube: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,a,b,c d\n0,1,2,3\n1,4,5,6\n")
    fails(geokit("info", path), 1, "'time', 'a', 'b', 'c d'", "--columns time,a,b")
    done = geokit("info", path, "--columns", "a, b, c d", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["bounds"] == [[1, 2, 3], [4, 5, 6]]
    fails(geokit("info", path, "--columns", "a,b"), 1, "--columns: ", "three different names")
    fails(geokit("info", path, "--columns", "a,b,q"), 1, "--columns: 'q' is not the name")
    fails(geokit("info", cube, "--columns", "a,b,c"), 1, "--columns: has no effect on a mesh")
    target = tmp_path / "a.ply"
    assert geokit("convert", path, target, "--columns", "b,a,c d").returncode == 0
    from geokit.points import load

    assert load(target).points.tolist() == [[2, 1, 3], [5, 4, 6]]
    fails(geokit("convert", cube, tmp_path / "b.ply", "--columns", "a,b,c"), 1, "--columns: has no effect")


@pytest.mark.slow
def test_every_command_that_takes_points_takes_columns(geokit, fails, cube: Path, tmp_path: Path) -> None:
    path, rays, other = tmp_path / "a.csv", tmp_path / "rays.csv", tmp_path / "b.npy"
    path.write_text("time,a,b,c\n0,1,2,3\n1,4,5,6\n")
    rays.write_text("time,a,b,c,d,e,f\n0,0,0,-3,0,0,1\n")
    np.save(other, [[1.0, 2.0, 3.0]])
    asked = ("--columns", "a,b,c", "--json")
    closest = json.loads(geokit("query", "closest", cube, path, *asked).stdout)
    assert closest["distance_min"] == pytest.approx(np.sqrt(5.0))
    assert json.loads(geokit("query", "signed", cube, path, *asked).stdout)["inside"] == 0
    for pair in ((path, other), (other, path), (path,)):
        assert json.loads(geokit("query", "neighbors", *pair, "--nearest", "1", *asked).stdout)["neighbors"] > 0
    fails(geokit("query", "neighbors", other, "--nearest", "1", *asked), 1, "--columns: .npy says itself")
    field = tmp_path / "field.nvdb"
    assert geokit("convert", cube, field, "--voxel-size", "0.1").returncode == 0
    assert json.loads(geokit("query", "sample", field, path, *asked).stdout)["queries"] == 2
    fails(geokit("query", "ray", cube, rays), 1, "not named as those of rays", "--columns time,a,b,c,d,e")
    hits = json.loads(geokit("query", "ray", cube, rays, "--columns", "a,b,c,d,e,f", "--json").stdout)
    assert (hits["hits"], hits["t_min"]) == (1, 3.0)
    for verb, target in (("render", "a.png"), ("view", "a.html")):
        assert geokit(verb, path, "-o", tmp_path / target, "--columns", "a,b,c").returncode == 0
        fails(
            geokit(verb, cube, "-o", tmp_path / target, "--force", "--columns", "a,b,c"), 1, "--columns: has no effect"
        )
    fails(
        geokit("bench", path, "--out", tmp_path / "report", "--columns", "a,b,z"), 1, "--columns: 'z' is not the name"
    )


@pytest.mark.slow
def test_what_was_not_computed_is_not_none(geokit, cube: Path, tmp_path: Path) -> None:
    path = tmp_path / "field.npy"
    np.save(path, np.zeros((4, 4, 4), np.float32))
    shown, report = geokit("info", path).stdout, json.loads(geokit("info", path, "--json").stdout)
    assert "not asked" in shown
    assert "none" not in shown
    assert report["grids"][0]["active_voxel_count"] is None
    assert "none" not in geokit("info", cube).stdout
