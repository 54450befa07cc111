"""``geokit repair``: what it writes and says is what the library does."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import geokit as gk


def test_the_broken_sample(geokit, tmp_path: Path) -> None:
    target = tmp_path / "whole.ply"
    done = geokit("repair", gk.sample_path("broken.obj"), target, "--json")
    assert done.returncode == 0, done.stderr
    made = gk.mesh.load(target)
    assert gk.mesh.audit(made).watertight
    assert json.loads(done.stdout) == {
        "target": str(target),
        "vertices": made.vertex_count,
        "faces": made.face_count,
        "merged": 0,
        "dropped": 35,
        "flipped": 20,
        "filled": 10,
        "open": 0,
        "non_manifold_edges": 0,
        "crossing_pairs": 0,
        "watertight": True,
    }


def test_patches_are_made_fair_where_that_is_asked_for(geokit, tmp_path: Path) -> None:
    target = tmp_path / "ball.ply"
    done = geokit("repair", gk.sample_path("shell.stl"), target, "--fair", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["filled"], said["faired"], said["watertight"]) == (1, 1, True)
    assert abs(gk.mesh.load(target).volume - 4.0 / 3.0 * np.pi) < 1e-3


def test_lengths_have_units(geokit, tmp_path: Path) -> None:
    box = gk.mesh.box((10.0, 10.0, 10.0))
    # Each face of its own, a little apart, and one missing.
    corners = box.vertices[box.faces[1:]].reshape(-1, 3) + 1e-3 * np.random.default_rng(0).uniform(-1, 1, (33, 3))
    gk.mesh.save(tmp_path / "torn.stl", gk.mesh.TriangleMesh(corners, np.arange(33).reshape(-1, 3)))
    words = ("repair", tmp_path / "torn.stl", tmp_path / "closed.3mf", "--from-unit", "mm", "--tolerance", "0.01mm")
    done = geokit(*words, "--max-width", "1in")
    assert done.returncode == 0, done.stderr
    assert "unit mm, merged 25, dropped 0, flipped 0, filled 1, open 0" in done.stdout
    assert geokit(*words, "--max-width", "1mm", "--force").stdout.count("filled 0, open 1") == 1


def test_what_crosses_is_cut_out_where_that_is_asked_for(geokit, fails, tmp_path: Path) -> None:
    ball = gk.mesh.sphere()
    vertices = ball.vertices.copy()
    vertices[600] *= -1.5
    source, target = tmp_path / "spike.ply", tmp_path / "whole.ply"
    gk.mesh.save(source, gk.mesh.TriangleMesh(vertices, ball.faces))
    assert json.loads(geokit("repair", source, target, "--json").stdout)["crossing_pairs"] > 0
    done = geokit("repair", source, target, "--untangle", "8", "--json", "--force")
    assert done.returncode == 0, done.stderr
    said, made = json.loads(done.stdout), gk.mesh.load(target)
    assert (said["places"], said["crossing_pairs"], said["watertight"]) == (2, 0, True)
    assert said["faces"] == made.face_count < ball.face_count
    assert 0 < said["deviation"] < 1
    box = gk.mesh.box()
    gk.mesh.save(source, gk.mesh.TriangleMesh([*box.vertices, *(box.vertices + 0.4)], [*box.faces, *(box.faces + 8)]))
    fails(geokit("repair", source, tmp_path / "no.ply", "--untangle", "8"), 1, "spike.ply", "union")
    fails(geokit("repair", source, tmp_path / "no.ply", "--untangle", "0"), 1, "--untangle: 0")
    assert not (tmp_path / "no.ply").exists()


def test_errors_name_files_and_options(geokit, fails, tmp_path: Path) -> None:
    broken, target = gk.sample_path("broken.obj"), tmp_path / "out.ply"
    fails(geokit("repair", broken, target, "--max-width", "1mm"), 1, "--max-width: 1mm has a unit", "--from-unit")
    fails(geokit("repair", gk.sample_path("cloud.ply"), target), 1, "cloud.ply", "mesh")
    assert not target.exists()
    target.write_text("mine")
    fails(geokit("repair", broken, target), 1, "out.ply", "--force")
    assert target.read_text() == "mine"
