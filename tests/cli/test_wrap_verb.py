"""``geokit wrap``: a closed mesh around meshes and clouds, with lengths in a unit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import geokit as gk


@pytest.fixture
def bowl(tmp_path: Path) -> Path:
    """An open box, each face of its own."""
    box = gk.mesh.box((1.0, 1.0, 1.0))
    gk.mesh.save(tmp_path / "bowl.stl", gk.mesh.TriangleMesh(box.vertices, box.faces[2:]))
    return tmp_path / "bowl.stl"


def test_the_wrap_is_that_of_the_library(geokit, bowl: Path) -> None:
    target = bowl.with_name("solid.ply")
    lengths = ("--tolerance", "0.2", "--gap", "0.1", "--offset", "0.05")
    done = geokit("wrap", bowl, target, *lengths, "--device", "cpu", "--json")
    assert done.returncode == 0, done.stderr
    expected = gk.mesh.wrap(gk.mesh.load(bowl), tolerance=0.2, gap=0.1, offset=0.05, device="cpu")
    assert json.loads(done.stdout) == {
        "target": str(target),
        "vertices": expected.mesh.vertex_count,
        "faces": expected.mesh.face_count,
        "deviation": expected.deviation,
        "bridges": int(expected.bridges.sum()),
        "component_count": expected.component_count,
        "genus": expected.genus,
        "cavity_count": expected.cavity_count,
    }
    made = gk.mesh.load(target)
    np.testing.assert_array_equal(made.faces, expected.mesh.faces)
    assert gk.mesh.audit(made).watertight


def test_a_cloud_and_a_unit(geokit, tmp_path: Path) -> None:
    points = gk.points.sample(gk.mesh.sphere(0.02), 400).points
    gk.points.save(tmp_path / "cloud.csv", points)
    words = ("wrap", tmp_path / "cloud.csv", tmp_path / "skin.3mf", "--tolerance", "8mm", "--from-unit", "m")
    done = geokit(*words, "--offset", "5mm")
    assert done.returncode == 0, done.stderr
    made = gk.mesh.load(tmp_path / "skin.3mf")
    assert made.meters_per_unit == 1.0
    assert gk.mesh.Surface(made).contains(points).all()
    assert "unit m, deviation 0.00" in done.stdout
    found = gk.mesh.Surface(gk.mesh.TriangleMesh(points, np.arange(400)[:, None].repeat(3, axis=1)))
    distance = found.closest_point(made.vertices).distance
    assert 0.005 <= distance.min() <= distance.max() <= 0.013


def test_errors_name_files_and_options(geokit, fails, bowl: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.ply"
    fails(geokit("wrap", bowl, target, "--tolerance", "1mm"), 1, "--tolerance: 1mm has a unit", "--from-unit")
    fails(geokit("wrap", bowl, target, "--tolerance", "thin"), 2, "--tolerance", "'thin' is no length", "2mm")
    fails(geokit("wrap", bowl, target, "--tolerance", "1ell"), 1, "--tolerance: 'ell' is no known unit")
    fails(geokit("wrap", bowl, target, "--tolerance=1", "--from-unit=ell"), 1, "--from-unit: 'ell' is no known unit")
    fails(geokit("wrap", bowl, target, "--tolerance", "0"), 2, "--tolerance: '0' is no length")
    fails(geokit("wrap", bowl, target, "--tolerance", "1", "--gap=-1"), 2, "--gap: '-1' is no length")
    fails(geokit("wrap", bowl, target, "--tolerance", "1", "--offset", "0"), 2, "--offset: '0' is no length")
    fails(
        geokit("wrap", bowl, target, "--tolerance", "1", "--offset", "1e6"), 1, "--offset: 1e+06 is over 250000 sizes"
    )
    fails(geokit("wrap", bowl, target, "--tolerance", "1", "--columns", "a,b,c"), 1, "--columns: has no effect")
    (tmp_path / "none.obj").write_text("v 0 0 0\n")
    fails(geokit("wrap", tmp_path / "none.obj", target, "--tolerance", "1"), 1, "none.obj")
    gk.volume.save(tmp_path / "a.nvdb", gk.volume.from_mesh(gk.mesh.box(), 0.2))
    fails(geokit("wrap", tmp_path / "a.nvdb", target, "--tolerance", "1"), 1, "holds a volume", "a mesh or a cloud")
    assert not target.exists()
    target.write_text("mine")
    fails(geokit("wrap", bowl, target, "--tolerance", "1"), 1, "exists already", "--force")
    assert target.read_text() == "mine"
    assert geokit("wrap", bowl, target, "--tolerance", "0.3", "--force").returncode == 0
