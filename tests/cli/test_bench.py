"""``geokit bench``."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

from geokit.cli.bench import bench
from geokit.errors import InputError

QUICK = ("--quick", "--device", "cpu")


@pytest.mark.slow
def test_a_report_of_every_kind_and_of_what_fails(geokit, cube: Path, cube_sdf: Path, tmp_path: Path) -> None:
    out, cloud, few = tmp_path / "report", tmp_path / "cloud.csv", tmp_path / "few.csv"
    points = np.random.default_rng(0).random((200, 3))
    cloud.write_text("x,y,z\n" + "\n".join(",".join(map(str, point)) for point in points) + "\n")
    few.write_text("x,y,z\n0,0,0\n1,0,0\n")
    charts = ("closest_point", "neighbors", "sampling")
    options = [word for name in charts for word in ("--chart", name)]
    done = geokit("bench", cube, cube_sdf, cloud, few, "--out", out, *QUICK, *options)
    assert done.returncode == 0, done.stderr

    assert {path.name for path in out.iterdir()} == {"results.csv", "report.html", "figures"}
    assert {path.stem for path in (out / "figures").iterdir()} == {
        "closest_point-cube-obj",
        "neighbors-cloud-csv",
        "sampling-cube-nvdb",
    }
    rows = list(csv.DictReader(io.StringIO((out / "results.csv").read_text())))
    assert {(row["chart"], row["subject"], row["device"]) for row in rows} == {
        ("closest_point", "cube.obj", "cpu"),
        ("neighbors", "cloud.csv", "cpu"),
        ("sampling", "cube.nvdb", "cpu"),
    }
    exact = [row for row in rows if row["method"] == "closest_point, float64"]
    assert len(exact) >= 1
    assert all(float(row["max_error"]) < 1e-14 and float(row["wrong_share"]) == 0.0 for row in exact)
    assert all(float(row["seconds"]) > 0.0 and int(row["checked"]) > 0 for row in rows)
    assert f"{len(rows)} rows, 1 failures: {out / 'report.html'}" in done.stdout
    assert "cube.obj" in done.stdout
    assert "closest_point, cube.obj, cpu: " in done.stderr
    page = (out / "report.html").read_text(encoding="utf-8")
    for text in (done.stderr, page):
        assert "few.csv" in text
        assert "InputError" in text

    # An earlier report is replaced by a later one, also by one in which nothing could be measured.
    again = geokit("bench", few, "--out", out, *QUICK, "--json", "--force")
    assert again.returncode == 1, again.stderr
    assert json.loads(again.stdout) == []
    assert list((out / "figures").iterdir()) == []
    assert (out / "report.html").read_text(encoding="utf-8") != page


@pytest.mark.slow
def test_refusals(geokit, fails, cube: Path, tmp_path: Path) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "stability.md").write_text("mine")
    fails(geokit("bench", cube, "--out", full), 1, "not empty", "--force")
    fails(geokit("bench", cube, "--out", tmp_path / "a", "--chart", "speed", *QUICK), 1, "speed", "closest_point")
    assert {path.name for path in tmp_path.iterdir()} == {"full"}
    assert (full / "stability.md").read_text() == "mine"


def test_refusals_before_any_work(cube: Path, tmp_path: Path) -> None:
    # In this process: a new one for each takes longer than the rest of the test.
    (tmp_path / "stability.md").write_text("mine")
    with pytest.raises(InputError, match=r"stability\.md: exists already; add --force"):
        bench(stability=True, out=tmp_path)
    new = tmp_path / "new"
    for options in ({"quick": True}, {"chart": ["sign"]}, {"json": True}, {"grid": "x"}, {"device": ["cpu", "cuda:0"]}):
        with pytest.raises(InputError, match="--stability"):
            bench(stability=True, out=new, **options)
    with pytest.raises(InputError, match="--stability"):
        bench(cube, stability=True, out=new)
    with pytest.raises(InputError, match="--grid is for volumes"):
        bench(cube, grid="x", out=new)
    assert [path.name for path in tmp_path.iterdir()] == ["stability.md"]
