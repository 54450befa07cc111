"""``geokit compare``: the deviations of a scan, as numbers, as a page and as files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import geokit as gk

DESIGN = Path(gk.sample_path("torus.ply"))


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """The torus with a dent."""
    points = gk.points.sample(gk.mesh.load(DESIGN), 3000).points
    dent = 0.03 * np.exp(-((points - [1.4, 0.0, 0.0]) ** 2).sum(axis=1) / 0.15**2)
    gk.points.save(tmp_path / "scan.npz", points - dent[:, None] * [1.0, 0.0, 0.0])
    return tmp_path / "scan.npz"


def test_numbers_are_those_of_the_library(geokit, scan: Path) -> None:
    done = geokit("compare", scan, DESIGN, "--limit", "0.01", "--json")
    assert done.returncode == 0, done.stderr
    found, points = json.loads(done.stdout), gk.points.load(scan).points
    off = gk.mesh.Surface(gk.mesh.load(DESIGN)).signed_distance(points).distance
    assert found["deviation_mean"] == off.mean()
    assert found["deviation_std"] == off.std()
    assert found["deviation_rms"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-14)
    for percent in (5, 50, 95):
        assert found[f"deviation_p{percent}"] == np.percentile(off, percent)
    assert (found["deviation_min"], found["deviation_max"]) == (off.min(), off.max())
    assert found["deviation_min_at"] == points[off.argmin()].tolist()
    assert found["deviation_max_at"] == points[off.argmax()].tolist()
    assert found["beyond_limit"] == np.mean(abs(off) > 0.01) > 0.0
    assert np.linalg.norm(np.subtract(found["deviation_min_at"], [1.37, 0.0, 0.0])) < 0.06


@pytest.mark.parametrize("kind", [".csv", ".npz", ".ply", ".vtp"])
def test_files_hold_points_and_deviations(geokit, scan: Path, kind: str) -> None:
    target = scan.with_name(f"out{kind}")
    done = geokit("compare", scan, DESIGN, target)
    assert done.returncode == 0, done.stderr
    cloud, points = gk.points.load(target), gk.points.load(scan).points
    np.testing.assert_array_equal(cloud.points, points)
    expected = gk.mesh.Surface(gk.mesh.load(DESIGN)).signed_distance(points).distance
    np.testing.assert_array_equal(cloud.data["deviation"], expected)


def test_a_scan_is_aligned_first(geokit, scan: Path) -> None:
    points, turn = gk.points.load(scan).points, np.radians(4.0)
    rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    gk.points.save(scan, points @ rotation.T + [0.05, -0.03, 0.02])
    far = json.loads(geokit("compare", scan, DESIGN, "--json").stdout)
    done = geokit("compare", scan, DESIGN, scan.with_name("moved.ply"), "--align", "--json")
    near = json.loads(done.stdout)
    assert far["deviation_rms"] > 0.02 > 5 * near["deviation_rms"]
    assert near["deviation_min"] == pytest.approx(-0.03, abs=0.003)
    # The axis of the torus comes back to z, and the file holds the points there.
    matrix = np.array(near["align_transform"])
    assert np.degrees(np.arccos(min((matrix[:3, :3] @ rotation)[2, 2], 1.0))) < 0.1
    moved = gk.points.load(scan).points @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(gk.points.load(scan.with_name("moved.ply")).points, moved, atol=1e-15)


def test_a_scan_without_any_deviation_is_aligned(geokit, cube: Path, tmp_path: Path) -> None:
    gk.points.save(tmp_path / "corners.npz", gk.mesh.load(cube).vertices)
    done = geokit("compare", tmp_path / "corners.npz", cube, tmp_path / "out.html", "--align", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["align_rmse"], found["deviation_max"]) == (0.0, 0.0)


def test_a_mesh_is_sampled_and_units_agree(geokit, fails, tmp_path: Path) -> None:
    ball = gk.mesh.sphere(10.0, segments=24)
    for name, scale, unit in (("scan", 1.01, 0.001), ("design", 1.0, 0.001), ("inches", 1.0, 0.0254)):
        mesh = gk.mesh.TriangleMesh(scale * ball.vertices, ball.faces, meters_per_unit=unit)
        gk.mesh.save(tmp_path / f"{name}.3mf", mesh)
    scan, design, inches = (tmp_path / f"{name}.3mf" for name in ("scan", "design", "inches"))
    done = geokit("compare", scan, design, "--limit", "0.0005cm", "--json")
    found = json.loads(done.stdout)
    assert (found["points"], found["unit"], found["limit"]) == (100_000, "mm", pytest.approx(0.005))
    assert 0.09 < found["deviation_min"] < found["deviation_max"] < 0.1001
    assert found["beyond_limit"] == 1.0
    done = geokit("compare", scan, inches)
    fails(done, 1, f"{scan}: meters_per_unit differs", f"of {inches}; geokit convert --unit")
    done = geokit("compare", scan, design, "--columns", "a,b,c")
    fails(done, 1, "--columns: has no effect on a mesh")


def test_the_page_has_a_map_a_histogram_and_the_numbers(geokit, scan: Path) -> None:
    target, named = scan.with_name("page.html"), scan.with_name("<b>.npz")
    scan.rename(named)
    done = geokit("compare", named, DESIGN, target, "--limit", "0.01")
    assert done.returncode == 0, done.stderr
    assert f"output            {target}" in done.stdout
    page = target.read_text()
    assert "<h1>&lt;b&gt;.npz against torus.ply</h1>" in page
    assert "<b>" not in page
    assert page.count("<iframe") == page.count("<svg") == page.count("</table>") == 1
    counts = [int(count.replace(",", "")) for count in re.findall(r": ([\d,]+)</title></rect>", page)]
    off = gk.mesh.Surface(gk.mesh.load(DESIGN)).signed_distance(gk.points.load(named).points).distance
    expected = np.histogram(np.clip(off, -0.01, 0.01), bins=48, range=(-0.01, 0.01))[0]
    assert counts == expected.tolist()
    for name, value in re.findall(r"^(deviation_\w+) +(\S+)$", done.stdout, re.MULTILINE):
        assert f"<td>{name.replace('_', ' ')}</td><td>{value}</td>" in page
    fills = re.findall(r'fill="(#\w{6})"', page)
    assert fills[0] != fills[24] != fills[-1]


def test_errors_are_told(geokit, fails, scan: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    fails(geokit("compare", scan, DESIGN, tmp_path / "out.stl"), 1, ".stl", "not a result format", ".html")
    fails(geokit("compare", scan, DESIGN, target, "--limit", "0"), 2, "--limit: '0' is no length")
    fails(geokit("compare", scan, DESIGN, target, "--limit", "1mm"), 1, "--limit: 1mm has a unit", "--from-unit")
    fails(geokit("compare", DESIGN, scan, target), 1, f"{scan}: holds a cloud", "needs a mesh")
    (tmp_path / "two.csv").write_text("x,y,z\n1,0,0\n0,1,0\n")
    done = geokit("compare", tmp_path / "two.csv", DESIGN, target, "--align")
    fails(done, 1, "--align: 2 of the source's 2 points have a partner", "needs 6; leave it out")
    assert not target.exists()
    target.write_text("mine")
    fails(geokit("compare", scan, DESIGN, target), 1, "exists already")
    assert target.read_text() == "mine"
