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
from geokit.cli._demo_input import camera_rays, points_on
from geokit.cli._reference import closest_distance, first_hit, neighbors_of, trilinear
from geokit.mesh import TriangleMesh

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def demo(geokit, tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("demo") / "out"
    if Path(sys.prefix) == ROOT / ".venv":
        # The README's own command, whose set-up has nothing left to do here.
        done = subprocess.run([ROOT / "dev", "demo", folder, "--json"], capture_output=True, text=True)
    else:
        done = geokit("demo", "--out", folder, "--json")
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


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
        "neighbours of a cloud": 1e-15,
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


# The references themselves, against answers that are known.

TETRAHEDRON = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_reference_distance() -> None:
    points = np.array([[0.2, 0.2, -1.0], [-1.0, -1.0, 0.5], [2.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.25, 0.25, 0.0]])
    expected = [1.0, np.sqrt(2.0), 1.0, 2.0 / np.sqrt(3.0), 0.0]
    np.testing.assert_allclose(closest_distance(TETRAHEDRON, points), expected, rtol=1e-15, atol=1e-15)


def test_reference_hit() -> None:
    origins = np.array([[0.2, 0.2, 5.0], [0.2, 0.2, -5.0], [2.0, 2.0, 5.0]])
    directions = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(first_hit(TETRAHEDRON, origins, directions), [2.2, 5.0, np.inf], rtol=1e-15)


def test_reference_neighbors() -> None:
    indices, distance = neighbors_of(np.array([[0.0, 0, 0], [3.0, 4, 0], [9.0, 0, 0]]), np.zeros(3), 5.0)
    assert indices.tolist() == [0, 1]
    assert distance.tolist() == [0.0, 5.0]


def test_reference_trilinear() -> None:
    random = np.random.default_rng(0)
    fraction = random.random((20, 3))
    x, y, z = np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0], indexing="ij")
    # Of the functions that trilinear interpolation reproduces.
    corners = np.broadcast_to(1.0 + 2.0 * x - 3.0 * y + x * z, (20, 2, 2, 2))
    value, gradient = trilinear(corners, fraction)
    u, v, w = fraction.T
    np.testing.assert_allclose(value, 1.0 + 2.0 * u - 3.0 * v + u * w, atol=1e-14)
    np.testing.assert_allclose(gradient, np.stack([2.0 + w, np.full(20, -3.0), u], axis=1), atol=1e-14)


def test_points_lie_on_the_mesh_and_cover_it() -> None:
    points = points_on(TETRAHEDRON, 4000, np.random.default_rng(0))
    assert closest_distance(TETRAHEDRON, points[:200]).max() < 1e-15
    # Half of the slanted face's share: its area is sqrt(3) / 2 of (3 / 2 + sqrt(3) / 2).
    share = (points.sum(axis=1) > 1.0 - 1e-9).mean()
    assert share == pytest.approx(np.sqrt(3.0) / (3.0 + np.sqrt(3.0)), abs=0.03)


def test_the_camera_sees_the_whole_mesh() -> None:
    camera = camera_rays(TETRAHEDRON, 64, 48)
    hit = np.isfinite(first_hit(TETRAHEDRON, camera.origins, camera.directions)).reshape(48, 64)
    border = np.concatenate([hit[0], hit[-1], hit[:, 0], hit[:, -1]])
    assert hit.sum() > 100
    assert not border.any()
