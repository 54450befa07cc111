"""The examples about points run, from another folder, and leave what they say."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from tests.support.scripts import run_script

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]


def run(name: str, *arguments: object, cwd: Path) -> str:
    return run_script(ROOT / "examples" / name, *arguments, "--device", "cpu", folder=cwd)


def number(said: str, label: str, column: int = 0) -> float:
    (line,) = re.findall(rf"^{re.escape(label)} +(.*)$", said, re.MULTILINE)
    return float(line.split()[column].rstrip("%"))


def colors(path: Path) -> np.ndarray:
    from matplotlib import image

    return image.imread(path)[..., :3].reshape(-1, 3)


def test_project_cloud_makes_up_a_scan(tmp_path: Path) -> None:
    said = run("project_cloud.py", "--count", 3000, "--out", "scan", cwd=tmp_path)
    assert number(said, "points") == 3000
    # A dent of 2% of the size, 40, is found, and nothing like it outwards.
    assert -1.1 < number(said, "least, greatest") < -0.6
    assert 0.2 < number(said, "least, greatest", 1) < 0.5
    assert 0.3 < number(said, "more than 0.4 inside") < 5.0
    assert number(said, "more than 0.4 outside") == 0.0
    cloud = gk.points.load(tmp_path / "scan.vtp")
    bracket = gk.mesh.load(ROOT / "data/samples/bracket.obj")
    found = gk.mesh.Surface(bracket, device="cpu").signed_distance(cloud.points)
    np.testing.assert_array_equal(cloud.data["distance"], found.distance)
    np.testing.assert_array_equal(cloud.data["foot"], found.points)
    # Red, blue and grey: points on both sides.
    shown = colors(tmp_path / "scan.png")
    assert (shown[:, 2] - shown[:, 0]).max() > 0.3
    assert (shown[:, 0] - shown[:, 2]).max() > 0.1


def test_project_cloud_reads_a_file(tmp_path: Path) -> None:
    samples = ROOT / "data" / "samples"
    said = run("project_cloud.py", samples / "cloud.ply", "--mesh", samples / "torus.ply", "--out", "on", cwd=tmp_path)
    assert number(said, "points") == 20000
    # The README of the samples: a normal noise of 0.002.
    assert number(said, "root mean square") == pytest.approx(0.002, abs=1.1e-4)
    assert number(said, "normals within 30 deg") == 100.0


def test_differentiable_fit(tmp_path: Path) -> None:
    said = run("differentiable_fit.py", "--count", 1500, "--resolution", 64, cwd=tmp_path)
    for name in ("turn x", "turn y", "turn z", "shift x", "shift y", "shift z"):
        tape, differences, error = (number(said, name, column) for column in range(3))
        assert tape == pytest.approx(differences, abs=1e-3)
        assert error < 1e-3
    assert number(said, "before") == 25.0
    # 1500 points with a noise of 0.002 sizes: what is left is noise over the root of their number, and then some.
    assert number(said, "after") < 0.1
    assert number(said, "after", 1) < 5e-4
    assert colors(tmp_path / "fit.png").std() > 0.1
