"""``geokit mesh``: simple bodies, pieces, maps and attributes, from file to file."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.cli import main
from tests.support.attributed import painted

BODIES = {
    "box": (["--size", "1", "2", "3"], gk.mesh.box((1, 2, 3))),
    "sphere": (["--radius", "2", "--segments", "9"], gk.mesh.sphere(2, segments=9)),
    "cylinder": (["--radius", "2", "--height", "3"], gk.mesh.cylinder(2, 3)),
    "cone": (["--radius", "2", "--height", "3", "--segments", "5"], gk.mesh.cone(2, 3, segments=5)),
    "torus": (
        ["--radius", "2", "--tube-radius", "0.5", "--tube-segments", "5"],
        gk.mesh.torus(2, 0.5, tube_segments=5),
    ),
    "plane": (["--size", "2", "3", "--segments", "4"], gk.mesh.plane((2, 3), segments=4)),
}


@pytest.fixture(autouse=True)
def _command_line(monkeypatch):
    # The command line shows warnings itself; the tests around must get their own back.
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    warnings.simplefilter("always", UserWarning)


@pytest.mark.parametrize("name", BODIES)
def test_bodies_are_those_of_the_library(tmp_path, capsys, name):
    options, expected = BODIES[name]
    target = tmp_path / "a.ply"
    assert main(["mesh", name, str(target), *options, "--center", "0", "0", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "target": str(target), "vertices": expected.vertex_count, "faces": len(expected)
    }  # fmt: skip
    again = gk.mesh.load(target)
    np.testing.assert_allclose(again.vertices, np.add(expected.vertices, (0, 0, 1)), atol=1e-15)
    np.testing.assert_array_equal(again.faces, expected.faces)
    assert main(["mesh", name, str(target), *options]) == 1
    assert "exists already" in capsys.readouterr().err
    assert main(["mesh", name, str(target), *options, "--force"]) == 0


def test_pieces(tmp_path, capsys):
    mesh = mesh_catalog.join(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.tetrahedron(), (5, 0, 0)))
    gk.mesh.save(tmp_path / "two.obj", mesh)
    out = str(tmp_path / "piece.ply")
    assert main(["mesh", "split", str(tmp_path / "two.obj"), out, "--by", "parts"]) == 0
    assert "piece-2.ply: name tetrahedron, faces 4" in capsys.readouterr().out
    assert [len(gk.mesh.load(tmp_path / f"piece-{n}.ply")) for n in (1, 2)] == [12, 4]
    assert main(["mesh", "split", str(tmp_path / "two.obj"), out]) == 1
    assert main(["mesh", "keep-largest", str(tmp_path / "two.obj"), out]) == 0
    assert len(gk.mesh.load(out)) == 12
    assert main(["mesh", "split", str(tmp_path / "two.obj"), out, "--by", "color"]) == 1
    assert "by: 'color' is not known" in capsys.readouterr().err


def test_maps(tmp_path, capsys):
    gk.mesh.save(tmp_path / "a.ply", mesh_catalog.box())
    source, target = str(tmp_path / "a.ply"), tmp_path / "b.ply"
    options = ["--scale", "2", "--rotate", "0", "0", "3", "90", "--move", "1", "0", "0", "--force"]
    assert main(["mesh", "transform", source, str(target), *options]) == 0
    found = gk.mesh.load(target)
    np.testing.assert_allclose(found.bounds, [[-1, 0, 0], [1, 2, 2]], atol=1e-15)
    assert found.volume == pytest.approx(8.0)
    matrix = [str(number) for number in (-1, 0, 0, 5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1)]
    assert main(["mesh", "transform", source, str(target), "--force", "--matrix", *matrix]) == 0
    mirrored = gk.mesh.load(target)
    assert mirrored.bounds[:, 0].tolist() == [4.0, 5.0]
    assert mirrored.volume == pytest.approx(1.0)
    capsys.readouterr()
    for bad in (["--matrix", *matrix[:15]], ["--matrix", *matrix, "--scale", "2"], ["--rotate", "0", "0", "0", "9"]):
        assert main(["mesh", "transform", source, str(target), "--force", *bad]) == 1
        assert f"geokit: {bad[0]}: " in capsys.readouterr().err


def test_attributes_of_another_mesh_and_what_a_format_drops(tmp_path, capsys):
    with pytest.warns(UserWarning, match="alpha"):
        gk.mesh.save(tmp_path / "painted.obj", painted(gk.mesh.sphere(segments=20)))
    gk.mesh.save(tmp_path / "plain.ply", gk.mesh.sphere(segments=12))
    capsys.readouterr()
    files = [str(tmp_path / name) for name in ("plain.ply", "painted.obj", "out.ply")]
    assert main(["mesh", "transfer", *files, "--name", "color", "--device", "cpu"]) == 0
    again = gk.mesh.load(tmp_path / "out.ply")
    assert list(again.vertex_data) == ["color"]
    assert "'color' of float64 is kept" in capsys.readouterr().err
    assert main(["convert", files[1], str(tmp_path / "a.stl")]) == 0
    said = capsys.readouterr().err
    assert "geokit: warning: " in said
    assert "a.stl: .stl does not hold vertex 'color', corner 'uv', corner 'normal', materials; left out" in said
    assert said.count("warning") == 1
    assert main(["info", files[1], "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["materials"] == ["red", "wood (painted_wood.png, 69 bytes)"]
    assert facts["corner_data"] == ["uv float64 (360, 3, 2)", "normal float64 (360, 3, 3)"]
    assert main(["convert", files[1], str(tmp_path / "a.glb")]) == 0
    said = capsys.readouterr().err
    assert "the unit of the mesh is not known, and the file says meter" in said
    assert said.count("warning") == 1


def test_arrays_of_clouds_that_a_format_lacks_are_named(tmp_path, capsys):
    rgb = np.full((4, 3), 7, np.uint8)
    gk.points.save(tmp_path / "a.ply", np.eye(4, 3), data={"normals": np.eye(4, 3), "rgb": rgb, "age": np.arange(4)})
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.pts")]) == 0
    assert "a.pts: .pts does not hold 'normals', 'age'; left out" in capsys.readouterr().err
    np.testing.assert_array_equal(gk.points.load(tmp_path / "a.pts").data["rgb"], rgb)
