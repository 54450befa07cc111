"""``geokit demo``: the whole chain, once."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from geokit import native
from geokit.accuracy.reference import mesh as reference
from geokit.cli._demo.input import camera_rays, points_on
from geokit.mesh import TriangleMesh
from tests.support.effort import ALL

ROOT = Path(__file__).resolve().parents[2]
IS_SET_UP = Path(sys.prefix) == ROOT / ".venv"


@pytest.fixture(scope="module", params=[pytest.param("demo", marks=pytest.mark.slow)])
def demo(geokit, tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("demo") / "out"
    if ALL and IS_SET_UP:
        # The README's own command, whose set-up has nothing left to do here.
        done = subprocess.run([ROOT / "dev", "demo", folder, "--json"], capture_output=True, text=True)
    else:
        done = geokit("demo", "--out", folder, "--json")
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.skipif(not IS_SET_UP, reason="not in the environment that ./dev makes")
def test_the_readme_s_command_leads_there(tmp_path: Path) -> None:
    done = subprocess.run([ROOT / "dev", "demo", tmp_path / "out", "--help"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Usage: geokit demo" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_every_step_is_right(demo) -> None:
    _, entries = demo
    steps = {entry["step"]: entry for entry in entries}
    left_out = [name for name, entry in steps.items() if entry["left_out"]]
    assert bool(left_out) is not native.available(), left_out
    assert steps["project points"]["count"] == 1_000_000
    assert steps["cast 640 x 480 rays"]["count"] == 640 * 480
    # float64 answers to 1e-12 of the diagonal of 2.7, float32 values to their rounding, round trips bit for bit.
    limits = {
        "narrow-band SDF": 1e-8,
        "read .nvdb back": 0.0,
        "read .vdb back": 0.0,
        "project points": 3e-12,
        "cast 640 x 480 rays": 1e-11,
        "sample the SDF": 1e-7,
        "sample its gradient": 1e-5,
        "neighbors of a cloud": 1e-15,
        "export points.vtp": 0.0,
        "export mesh.vtu": 0.0,
    }
    for name, limit in limits.items():
        if name == "read .vdb back" and not native.available():
            continue
        assert steps[name]["error"] <= limit, (name, steps[name])


def test_the_files_are_there(demo) -> None:
    folder, _ = demo
    expected = {
        *("sdf.nvdb", "points.vtp", "mesh.vtu", "accuracy.csv", "accuracy.png", "summary.csv", "summary.md"),
        *("surface.png", "raycast.png", "slice.png", "neighbors.png"),
        *(("sdf.vdb",) if native.available() else ()),
    }
    assert {path.name for path in folder.iterdir()} == expected
    assert all(path.stat().st_size > 100 for path in folder.iterdir())
    table = list(csv.DictReader(io.StringIO((folder / "summary.csv").read_text())))
    assert [row["step"] for row in table] == [entry["step"] for entry in demo[1]]
    assert len((folder / "summary.md").read_text().splitlines()) == len(table) + 2


@pytest.mark.slow
def test_the_chart_as_lines(tmp_path: Path) -> None:
    from geokit.cli._demo.figures import accuracy_chart
    from geokit.cli._demo.steps import AccuracyPoint

    numbers = dict.fromkeys(AccuracyPoint.__dataclass_fields__, 0.1)
    accuracy_chart(tmp_path / "accuracy.svg", [AccuracyPoint(**numbers)], 0.5, 100)
    assert (tmp_path / "accuracy.svg").read_bytes().startswith(b"<?xml")
    assert (tmp_path / "accuracy.csv").read_text().startswith("voxel_size")


def test_smaller_voxels_are_more_accurate(demo) -> None:
    folder, _ = demo
    rows = list(csv.DictReader(io.StringIO((folder / "accuracy.csv").read_text())))
    sizes, errors = (np.array([float(row[name]) for row in rows]) for name in ("voxel_size", "rms_error"))
    assert (np.diff(sizes) < 0).all()
    assert (np.diff(errors) < 0).all()
    # Faster than linear: the mesh is smooth but for its edges.
    assert errors[0] / errors[-1] > sizes[0] / sizes[-1]


def test_nothing_is_replaced_without_force(geokit, fails, tmp_path: Path) -> None:
    (tmp_path / "summary.csv").write_text("mine")
    fails(geokit("demo", "--out", tmp_path), 1, "summary.csv", "--force")
    (tmp_path / "file").write_text("a file")
    fails(geokit("demo", "--out", tmp_path / "file" / "deeper"), 1, "cannot be made a folder")


TETRAHEDRON = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_points_lie_on_the_mesh_and_cover_it() -> None:
    points = points_on(TETRAHEDRON, 4000, np.random.default_rng(0))
    assert reference.closest_point(TETRAHEDRON.vertices, TETRAHEDRON.faces, points[:200]).distance.max() < 1e-15
    # Half of the slanted face's share: its area is sqrt(3) / 2 of (3 / 2 + sqrt(3) / 2).
    share = (points.sum(axis=1) > 1.0 - 1e-9).mean()
    assert share == pytest.approx(np.sqrt(3.0) / (3.0 + np.sqrt(3.0)), abs=0.03)


def test_the_camera_sees_the_whole_mesh() -> None:
    camera = camera_rays(TETRAHEDRON, 64, 48)
    hits = reference.first_hit(TETRAHEDRON.vertices, TETRAHEDRON.faces, camera.origins, camera.directions)
    hit = (hits.triangle_id >= 0).reshape(48, 64)
    border = np.concatenate([hit[0], hit[-1], hit[:, 0], hit[:, -1]])
    assert hit.sum() > 100
    assert not border.any()
