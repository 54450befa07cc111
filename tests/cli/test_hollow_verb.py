"""``geokit hollow``: walls of one thickness, drains, and what cannot be hollow."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit import native
from geokit.core.memory.available_memory import available_host
from tests.support.assemblies import star

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    gk.mesh.save(tmp_path / "ball.ply", gk.mesh.sphere(10.0, segments=96))
    return tmp_path / "ball.ply"


def test_walls_are_measured(geokit, ball: Path) -> None:
    target = ball.with_name("hollow.ply")
    done = geokit("hollow", ball, target, "--wall", "2", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    solid = gk.volume.from_mesh(gk.mesh.load(ball), 0.4)
    cavity = gk.volume.offset(solid, -2.0)
    expected = gk.mesh.from_volume(gk.volume.difference(solid, cavity), method="dual_contouring")
    made = gk.mesh.load(target)
    np.testing.assert_array_equal(made.faces, expected.faces)
    assert gk.mesh.audit(made).watertight
    assert found["voxel_size"] == pytest.approx(0.4)
    assert found["closed_cavities"] == 1
    # Two balls of the facets' size; the thickness of their walls by the formula of the ball.
    assert found["material"] == pytest.approx(1.0 - 0.8**3, rel=0.01)
    radius = np.linalg.norm(made.vertices, axis=1)
    assert 1.95 < found["wall_min"] <= 10.0 - radius[radius < 9.0].max() + 0.01
    assert 10.0 - radius.min() - 0.01 <= found["wall_max"] < 2.05


def test_drains_open_the_cavity_the_shortest_way(geokit, ball: Path) -> None:
    places = ("--drain", "-10,0,0", "--drain=0,7.07,7.07", "--drain-radius", "1")
    done = geokit("hollow", ball, ball.with_name("hollow.ply"), "--wall", "2", *places, "--json")
    assert done.returncode == 0, done.stderr
    found, made = json.loads(done.stdout), gk.mesh.load(ball.with_name("hollow.ply"))
    assert found["closed_cavities"] == 0
    assert len(gk.mesh.split(made)) == 1
    assert gk.mesh.audit(made).euler_number == 0  # two holes make one handle
    for axis in ([-1.0, 0.0, 0.0], [0.0, 0.5**0.5, 0.5**0.5]):
        at = np.array(axis) * np.linspace(6.0, 12.0, 50)[:, None]
        assert not gk.mesh.Surface(made).contains(at).any()
    assert found["wall_max"] < 2.05
    bored = 2.0 * np.pi * 1.0**2 * 2.0
    assert found["material"] == pytest.approx(1.0 - 0.8**3 - bored / gk.mesh.load(ball).volume, rel=0.01)


def test_lengths_have_units(geokit, tmp_path: Path) -> None:
    box = gk.mesh.box((0.01, 0.02, 0.03))
    gk.mesh.save(tmp_path / "part.3mf", gk.mesh.TriangleMesh(box.vertices, box.faces, meters_per_unit=1.0))
    words = ("--wall", "2mm", "--voxel-size", "0.25 mm", "--drain", "5mm,0,0", "--drain-radius", "0.1cm", "--json")
    done = geokit("hollow", tmp_path / "part.3mf", tmp_path / "out.3mf", *words)
    assert done.returncode == 0, done.stderr
    found, made = json.loads(done.stdout), gk.mesh.load(tmp_path / "out.3mf")
    assert (found["unit"], found["voxel_size"], found["closed_cavities"]) == ("m", pytest.approx(2.5e-4), 0)
    assert (found["wall_min"], found["wall_max"]) == pytest.approx((0.002, 0.002), rel=0.02)
    assert made.meters_per_unit == 1.0
    inner = 0.006 * 0.016 * 0.026
    assert made.volume == pytest.approx(0.01 * 0.02 * 0.03 - inner - np.pi * 0.001**2 * 0.002, rel=0.01)


def test_the_size_is_told_before_it_begins(geokit, fails, ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = ball.with_name("hollow.ply")
    monkeypatch.setattr("geokit.cli.hollow.MANY_FACES", 10_000)
    done = geokit("hollow", ball, target, "--wall", "2")
    told = re.search(r"a wall of 2 in voxels of 0.4 makes about ([\d,]+) faces; larger voxels", done.stderr)
    assert told, done.stderr
    # The inner surface is smaller than the outer one.
    assert 0.7 < gk.mesh.load(target).face_count / int(told[1].replace(",", "")) < 1.0
    assert "makes about" not in geokit("hollow", ball, target, "--wall", "2", "--json", "--force").stderr
    target.unlink()
    done = geokit("hollow", ball, target, "--wall", "1e-6")
    fails(done, 1, "--wall: 1e-06 in voxels of 2e-07 makes about", "MiB free; give --wall 0.0", ", or --voxel-size 0.0")
    wall = re.search(r"give --wall ([\d.e-]+) or more", done.stderr)
    assert wall
    assert 330.0 * 12.0 * np.pi * 10.0**2 / (float(wall[1]) / 5.0) ** 2 < available_host()
    fails(geokit("hollow", ball, target, "--wall", f"{0.7 * float(wall[1]):g}"), 1, "--wall: ", "or more")
    assert not target.exists()


@pytest.mark.parametrize("turned", [1, -1])
def test_the_share_of_material_is_that_of_the_body(geokit, tmp_path: Path, turned: int) -> None:
    boxes = [gk.mesh.box((10.0, 10.0, 10.0), center=(x, 0.0, 0.0)) for x in (0.0, 5.0)]
    vertices, faces = np.concatenate([box.vertices for box in boxes]), [boxes[0].faces, boxes[1].faces + 8]
    part = gk.mesh.TriangleMesh(vertices, np.concatenate(faces)[:, ::turned])
    gk.mesh.save(tmp_path / "part.ply", part)
    done = geokit("hollow", tmp_path / "part.ply", tmp_path / "out.ply", "--wall", "2", "--json")
    found = json.loads(done.stdout)
    assert found["material"] == pytest.approx(1.0 - 11.0 * 6.0 * 6.0 / 1500.0, rel=0.01)
    assert (found["wall_min"], found["wall_max"]) == pytest.approx((2.0, 2.0), abs=0.15)


def test_errors_are_told(geokit, fails, ball: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.stl"
    fails(geokit("hollow", ball, target, "--wall", "2mm"), 1, "--wall: 2mm has a unit", "--from-unit")
    fails(geokit("hollow", ball, target, "--wall", "wide"), 2, "--wall", "'wide' is no length")
    fails(geokit("hollow", ball, target, "--wall", "0"), 2, "--wall: '0' is no length")
    fails(geokit("hollow", ball, target, "--wall", "10.5"), 1, f"no place of {ball} is 10.5 deep", "thinner walls")
    wall = ("--wall", "2", "--voxel-size", "1")
    fails(geokit("hollow", ball, target, *wall, "--drain", "0,0,10"), 2, "--drain and --drain-radius go together")
    fails(geokit("hollow", ball, target, *wall, "--drain", "0,10", "--drain-radius", "1"), 2, "'0,10' is no place")
    words = ("--drain: 0,0,1 is 8.99", "away from the surface; the nearest place there is 0.29")
    fails(geokit("hollow", ball, target, *wall, "--drain", "0,0,1", "--drain-radius", "1"), 1, *words)
    gk.mesh.save(tmp_path / "rod.ply", gk.mesh.union(gk.mesh.load(ball), gk.mesh.cylinder(1.5, 40.0)))
    done = geokit("hollow", tmp_path / "rod.ply", target, *wall, "--drain", "0,0,20", "--drain-radius", "1")
    fails(done, 1, "--drain: 0,0,20 is 11.8", "away from the cavity")
    words = ("shell.stl: is not closed: 96 edges are not those of two faces", "geokit wrap")
    fails(geokit("hollow", gk.sample_path("shell.stl"), target, "--wall", "1"), 1, *words)
    gk.mesh.save(tmp_path / "crossed.ply", star())
    done = geokit("hollow", tmp_path / "crossed.ply", target, *wall)
    fails(done, 1, f"{tmp_path / 'crossed.ply'}: its union is not right", "; geokit wrap makes a closed body")
    assert not target.exists()
    target.write_text("mine")
    fails(geokit("hollow", ball, target, "--wall", "2"), 1, "exists already")
    assert target.read_text() == "mine"
