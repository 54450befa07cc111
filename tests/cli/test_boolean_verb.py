"""``geokit boolean``: unions, differences and intersections of mesh files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import geokit as gk


@pytest.fixture
def boxes(tmp_path: Path) -> list[Path]:
    """Two unit cubes that share a half, and one far away."""
    paths = [tmp_path / f"{name}.obj" for name in "abc"]
    for path, x in zip(paths, (0.0, 0.5, 9.0), strict=True):
        gk.mesh.save(path, gk.mesh.box(center=(x, 0.0, 0.0)))
    return paths


@pytest.mark.parametrize(
    ("name", "area", "volume"), [("union", 8.0, 1.5), ("difference", 4.0, 0.5), ("intersection", 4.0, 0.5)]
)
def test_results_are_those_of_the_library(geokit, boxes, tmp_path: Path, name: str, area: float, volume: float) -> None:
    target = tmp_path / "out.ply"
    done = geokit("boolean", name, *boxes[:2], target, "--json")
    assert done.returncode == 0, done.stderr
    expected = getattr(gk.mesh, name)(*map(gk.mesh.load, boxes[:2]))
    found = json.loads(done.stdout)
    assert (found["faces"], found["area"], found["volume"]) == (expected.face_count, area, volume)
    np.testing.assert_array_equal(gk.mesh.load(target).vertices, expected.vertices)


def test_one_mesh_and_three(geokit, boxes, tmp_path: Path) -> None:
    gk.mesh.save(tmp_path / "three.stl", gk.mesh.union(*map(gk.mesh.load, boxes)))
    done = geokit("boolean", "union", *boxes, tmp_path / "out.ply")
    assert "area 14, volume 2.5" in done.stdout
    done = geokit("boolean", "union", tmp_path / "three.stl", tmp_path / "one.ply")
    assert "area 14, volume 2.5" in done.stdout


def test_an_open_result_has_no_volume(geokit, boxes, tmp_path: Path) -> None:
    (tmp_path / "sheet.obj").write_text("v 5 5 5\nv 6 5 5\nv 5 6 5\nf 1 2 3\n")
    done = geokit("boolean", "union", boxes[0], tmp_path / "sheet.obj", tmp_path / "out.ply")
    assert "area 6.5, boundary_edge_count 3" in done.stdout
    assert "volume" not in done.stdout


def test_errors_name_files_and_write_nothing(geokit, fails, boxes, tmp_path: Path) -> None:
    target = tmp_path / "out.ply"
    words = ("out.ply: the intersection is empty", "nothing is written")
    fails(geokit("boolean", "intersection", boxes[0], boxes[2], target), 1, *words)
    fails(geokit("boolean", "difference", boxes[0], boxes[0], target), 1, "out.ply: the difference is empty")
    fails(geokit("boolean", "difference", boxes[0], target), 2, "difference: 2 files given")
    sheet = tmp_path / "sheet.obj"
    sheet.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for files in ((boxes[0], sheet), (sheet, boxes[0])):
        done = geokit("boolean", "difference", *files, target)
        fails(done, 1, f"{sheet}: is open", "geokit wrap makes a closed body of it")
        assert "others" not in done.stderr
        assert "from_volume" not in done.stderr
    for name, unit in (("mm.3mf", 0.001), ("in.3mf", 0.0254)):
        box = gk.mesh.box()
        gk.mesh.save(tmp_path / name, gk.mesh.TriangleMesh(box.vertices, box.faces, meters_per_unit=unit))
    done = geokit("boolean", "union", tmp_path / "mm.3mf", tmp_path / "in.3mf", target)
    fails(
        done, 1, f"{tmp_path / 'in.3mf'}: meters_per_unit differs", f"of {tmp_path / 'mm.3mf'}; geokit convert --unit"
    )
    gk.points.save(tmp_path / "cloud.csv", np.eye(3))
    fails(geokit("boolean", "union", boxes[0], tmp_path / "cloud.csv", target), 1, "holds a cloud", "needs a mesh")
    assert not target.exists()
    target.write_text("mine")
    fails(geokit("boolean", "union", *boxes, target), 1, "exists already")
    assert target.read_text() == "mine"
