"""``geokit query``: answers for a unit cube and a small cloud, which anyone can check."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

from geokit.points import load

pytestmark = pytest.mark.slow


@pytest.fixture
def points(tmp_path: Path) -> Path:
    path = tmp_path / "points.csv"
    path.write_text("x,y,z\n0.5,0.4,2\n0.5,0.5,0.9\n-3,0.5,0.5\n")
    return path


def test_closest_points_into_csv(geokit, cube: Path, points: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    done = geokit("query", "closest", cube, points, "-o", target, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["queries"], report["hits"]) == (3, 3)
    assert report["distance_max"] == 3.0
    rows = list(csv.DictReader(io.StringIO(target.read_text())))
    np.testing.assert_allclose([float(row["distance"]) for row in rows], [1.0, 0.1, 3.0], atol=1e-12)
    assert [float(rows[0][f"closest_{axis}"]) for axis in "xyz"] == [0.5, 0.4, 1.0]


def test_a_search_radius_makes_misses(geokit, cube: Path, points: Path) -> None:
    done = geokit("query", "closest", cube, points, "--max-distance", "1.5", "--json")
    report = json.loads(done.stdout)
    assert (report["queries"], report["hits"]) == (3, 2)
    assert report["distance_max"] == 1.0


def test_signed_distances_on_stdout(geokit, cube: Path, points: Path) -> None:
    done = geokit("query", "signed", cube, points, "-o", "-")
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    np.testing.assert_allclose([float(row["distance"]) for row in rows], [1.0, -0.1, 3.0], atol=1e-12)
    assert rows[2]["x"] == "-3.0"


def test_the_sign_beside_a_sheet(geokit, points: Path, tmp_path: Path) -> None:
    sheet, found = tmp_path / "sheet.obj", {}
    sheet.write_text("v -9 -9 0\nv 9 -9 0\nv 9 9 0\nv -9 9 0\nf 1 2 3 4\n")
    (tmp_path / "two.csv").write_text("x,y,z\n1,2,0.2\n1,2,-0.2\n")
    for options in ((), ("--sign", "pseudonormal"), ("--sign", "winding")):
        done = geokit("query", "signed", sheet, tmp_path / "two.csv", "-o", tmp_path / "out.npz", "--json", *options)
        assert done.returncode == 0, done.stderr
        report = json.loads(done.stdout)
        found[report["sign_method"], report["sign_reason"][:16]] = load(tmp_path / "out.npz").data["distance"].tolist()
        (tmp_path / "out.npz").unlink()
    assert list(found) == [
        ("pseudonormal", "encloses nothing"),
        ("pseudonormal", "asked for"),
        ("winding", "asked for"),
    ]
    assert list(found.values())[:2] == [[0.2, -0.2]] * 2
    done = geokit("query", "signed", sheet, points, "--sign", "normal")
    assert done.returncode != 0
    assert "pseudonormal" in done.stderr


@pytest.mark.parametrize("kind", ["vtp", "npz", "ply"])
def test_every_output_format_holds_the_answers(geokit, cube: Path, points: Path, tmp_path: Path, kind: str) -> None:
    target = tmp_path / f"out.{kind}"
    done = geokit("query", "signed", cube, points, "-o", target)
    assert done.returncode == 0, done.stderr
    cloud = load(target)
    np.testing.assert_allclose(cloud.data["distance"], [1.0, -0.1, 3.0], atol=1e-12)
    np.testing.assert_array_equal(cloud.points, load(points).points)
    assert "inside" in done.stdout


def test_rays(geokit, cube: Path, tmp_path: Path) -> None:
    rays, target = tmp_path / "rays.csv", tmp_path / "hits.npz"
    rays.write_text("ox,oy,oz,dx,dy,dz\n0.3,0.4,5,0,0,-2\n0.3,0.4,5,0,0,2\n")
    done = geokit("query", "ray", cube, rays, "-o", target, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["hits"] == 1
    with np.load(target) as found:
        assert found["t"].tolist() == [2.0, np.inf]
        assert found["triangle_id"][1] == -1
        np.testing.assert_allclose(found["hit"][0], [0.3, 0.4, 1.0], atol=1e-12)
        assert np.isnan(found["hit"][1]).all()


def test_samples_and_gradients(geokit, cube_sdf: Path, points: Path, tmp_path: Path) -> None:
    target = tmp_path / "samples.npz"
    done = geokit("query", "sample", cube_sdf, points, "--gradient", "-o", target)
    assert done.returncode == 0, done.stderr
    with np.load(target) as found:
        np.testing.assert_allclose(found["value"], [0.1875, -0.1, 0.1875], atol=1e-6)
        np.testing.assert_allclose(found["gradient"][1], [0.0, 0.0, 1.0], atol=1e-5)


def test_neighbors(geokit, tmp_path: Path) -> None:
    cloud, target = tmp_path / "cloud.xyz", tmp_path / "near.npz"
    cloud.write_text("0 0 0\n1 0 0\n0 1 0\n9 9 9\n")
    done = geokit("query", "neighbors", cloud, "--radius", "1.2", "-o", target, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["neighbors"] == 8
    with np.load(target) as found:
        assert found["count"].tolist() == [3, 2, 2, 1]
        assert found["offsets"].tolist() == [0, 3, 5, 7, 8]
        assert sorted(found["indices"][3:5].tolist()) == [0, 1]
        assert found["distance"].max() == 1.0
    queries = tmp_path / "queries.csv"
    queries.write_text("x,y,z\n9,9,8\n")
    done = geokit("query", "neighbors", cloud, queries, "--radius", "1", "-o", "-")
    assert done.stdout == "x,y,z,count\n9.0,9.0,8.0,1\n"


def test_no_points_is_an_empty_answer(geokit, cube: Path, tmp_path: Path) -> None:
    points, target = tmp_path / "none.csv", tmp_path / "out.npz"
    points.write_text("x,y,z\n")
    done = geokit("query", "closest", cube, points, "-o", target, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["queries"] == 0
    with np.load(target) as found:
        assert found["distance"].shape == (0,)


def test_refusals(geokit, fails, cube: Path, cube_sdf: Path, points: Path, tmp_path: Path) -> None:
    taken = tmp_path / "taken.csv"
    taken.write_text("mine")
    fails(geokit("query", "closest", cube, points, "-o", taken), 1, "taken.csv", "--force")
    assert taken.read_text() == "mine"
    fails(geokit("query", "closest", cube, points, "-o", tmp_path / "out.txt"), 1, "out.txt", ".csv")
    fails(geokit("query", "closest", cube_sdf, points), 1, "holds a volume", "needs a mesh")
    fails(geokit("query", "sample", cube, points), 1, "holds a mesh", "needs a volume")
    fails(geokit("query", "closest", cube, points, "--max-distance", "-1"), 1, "max_distance")
    bad = tmp_path / "bad.csv"
    bad.write_text("x,y,z\n1,2,3\n1,nan,3\n")
    fails(geokit("query", "closest", cube, bad, "--no-finite-only"), 1, "bad.csv", "point 1")


def test_nearest_points_and_those_within_a_radius(geokit, tmp_path: Path) -> None:
    cloud, queries = tmp_path / "cloud.csv", tmp_path / "queries.csv"
    cloud.write_text("x,y,z\n0,0,0\n1,0,0\n3,0,0\n")
    queries.write_text("x,y,z\n0.9,0,0\n-5,0,0\n")
    table = tmp_path / "nearest.npz"
    done = geokit("query", "neighbors", cloud, queries, "--nearest", "2", "-o", table, "--json")
    assert done.returncode == 0, done.stderr
    found = np.load(table)
    assert found["index"].tolist() == [[1, 0], [0, 1]]
    np.testing.assert_allclose(found["distance"], [[0.1, 0.9], [5.0, 6.0]])
    done = geokit("query", "neighbors", cloud, queries, "--nearest", "2", "--radius", "0.5", "-o", "-")
    assert done.stdout.splitlines()[1:] == [
        "0.9,0.0,0.0,1,1,-1,0.09999999999999998,inf",
        "-5.0,0.0,0.0,0,-1,-1,inf,inf",
    ]
