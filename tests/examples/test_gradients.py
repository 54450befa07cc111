"""The examples of gradients reach what they are for."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.support.scripts import run_script

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.slow


def run(script: str, *arguments: object, cwd: Path) -> str:
    pytest.importorskip("torch")
    return run_script(ROOT / "examples" / "gradients" / script, *arguments, folder=cwd)


def numbers(said: str, word: str) -> list[float]:
    line = next(line for line in said.splitlines() if line.startswith(word))
    return [float(number) for number in re.findall(r"-?\d+\.\d+", line)]


def test_a_sphere_becomes_the_scan(tmp_path: Path) -> None:
    said = run("fit_mesh.py", "--steps", 60, "--segments", 24, "--count", 1000, cwd=tmp_path)
    assert numbers(said, "scan to mesh")[0] < 0.03
    assert (tmp_path / "fit_mesh.png").stat().st_size > 10_000


def test_a_sphere_gets_the_hole_of_a_torus(tmp_path: Path) -> None:
    said = run("fit_level_set.py", "--steps", 60, "--resolution", 32, "--count", 1000, cwd=tmp_path)
    assert numbers(said, "scan to mesh")[0] < 0.02
    assert "handles: 1\n" in said
    assert (tmp_path / "fit_level_set.png").stat().st_size > 10_000


def test_a_camera_finds_where_it_stood(tmp_path: Path) -> None:
    said = run("pose_from_depth.py", "--steps", 100, "--width", 32, cwd=tmp_path)
    before, after = numbers(said, "before"), numbers(said, "after")
    assert before == [8.0, 0.05]
    assert after[0] < 0.25 * before[0]
    assert (tmp_path / "pose.png").stat().st_size > 5_000


def test_a_path_bends_around_an_obstacle(tmp_path: Path) -> None:
    said = run("collision_loss.py", "--steps", 120, cwd=tmp_path)
    assert numbers(said, "before")[0] < -0.2
    # By the exact mesh: the field's voxels are 0.03 wide, and the loss allows for a little less than 0.05.
    assert numbers(said, "after")[0] > -0.01
    assert (tmp_path / "path.png").stat().st_size > 10_000


def test_training_samples_are_distances(tmp_path: Path) -> None:
    import geokit as gk

    said = run("sdf_training_samples.py", "--count", 5000, cwd=tmp_path)
    assert "5000 samples" in said
    mesh = gk.mesh.load(ROOT / "data" / "samples" / "broken.obj")
    with np.load(tmp_path / "samples.npz") as found:
        points, distance, gradient = (found[name].astype(np.float64) for name in ("points", "distance", "gradient"))
    size = float(np.ptp(mesh.bounds, axis=0).max())
    exact = gk.mesh.Surface(mesh, device="cpu").closest_point(points)
    np.testing.assert_allclose(np.abs(distance), exact.distance, atol=1e-6 * size)
    # A step against the gradient by the distance arrives at the surface.
    np.testing.assert_allclose(points - distance[:, None] * gradient, exact.points, atol=1e-5 * size)
    near = np.abs(distance) < 0.02 * size
    assert 0.4 < near.mean() < 0.8
