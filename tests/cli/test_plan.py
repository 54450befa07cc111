"""``geokit plan``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


def test_the_first_of_a_plan_is_what_convert_makes(geokit, cube: Path, tmp_path: Path) -> None:
    options = ("--tolerance", "0.02", "--order", "1", "--device", "cpu", "--json")
    planned = geokit("plan", cube, *options)
    assert planned.returncode == 0, planned.stderr
    fields = json.loads(planned.stdout)["fields"]
    assert [field["method"] for field in fields].count("adaptive_from_mesh") == 1
    first = next(field for field in fields if field["method"] == "from_mesh")
    made = geokit("convert", cube, tmp_path / "cube.nvdb", *options)
    assert made.returncode == 0, made.stderr
    report = json.loads(made.stdout)
    assert report["voxel_size"] == first["voxel_size"]
    assert report["types"] == first["codec"]
    assert 0.0 < report["achieved_error"] <= 0.02
    assert all(field["error"] <= 0.02 and field["order"] == 1 for field in fields)


def test_a_table_for_people(geokit, cube: Path) -> None:
    done = geokit("plan", cube, "--tolerance", "0.05", "--order", "1", "--codec", "float")
    assert done.returncode == 0, done.stderr
    head, *rows = done.stdout.splitlines()
    assert head.split()[:5] == ["made", "by", "levels", "order", "codec"]
    assert {tuple(row.split()[i] for i in (0, 2, 3)) for row in rows if row.strip()} == {
        ("from_mesh", "1", "float"),
        ("adaptive_from_mesh", "1", "float"),
    }
    assert "convert --tolerance" in done.stderr


def test_refusals(geokit, fails, cube: Path, cube_sdf: Path) -> None:
    fails(geokit("plan", cube_sdf, "--tolerance", "0.1"), 1, "needs a mesh")
    fails(geokit("plan", cube, "--tolerance", "0"), 1, "tolerance")
    fails(geokit("plan", cube), 2, "tolerance")
