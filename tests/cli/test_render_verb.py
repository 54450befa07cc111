"""``geokit render``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow

SIZE = ("--size", "400x300")


def picture(path: Path) -> np.ndarray:
    from matplotlib.image import imread

    return imread(path)[..., :3]


def test_a_mesh(geokit, cube: Path, tmp_path: Path) -> None:
    target = tmp_path / "cube.png"
    done = geokit("render", cube, "-o", target, *SIZE, "--color", "y")
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert "400 x 300" in done.stdout
    drawn = picture(target)
    assert drawn.shape == (300, 400, 3)
    assert (drawn < 0.97).any(axis=-1).mean() > 0.15


def test_a_cloud_by_one_of_its_arrays(geokit, tmp_path: Path) -> None:
    source, target = tmp_path / "cloud.csv", tmp_path / "cloud.png"
    random = np.random.default_rng(0)
    rows = np.column_stack([random.random((300, 3)), np.arange(300)])
    source.write_text("x,y,z,heat\n" + "\n".join(",".join(map(str, row)) for row in rows) + "\n")
    done = geokit("render", source, "-o", target, *SIZE, "--color", "heat")
    assert done.returncode == 0, done.stderr
    drawn = picture(target)[:, :320]
    assert (drawn.max(axis=-1) - drawn.min(axis=-1) > 0.3).sum() > 100


@pytest.mark.parametrize("options", [(), ("--slice", "x")])
def test_a_volume(geokit, cube_sdf: Path, tmp_path: Path, options: tuple[str, ...]) -> None:
    target = tmp_path / "sdf.png"
    done = geokit("render", cube_sdf, "-o", target, *SIZE, *options)
    assert done.returncode == 0, done.stderr
    assert (picture(target) < 0.97).any(axis=-1).mean() > 0.1


def test_refusals(geokit, fails, cube: Path, tmp_path: Path) -> None:
    target = tmp_path / "cube.png"
    fails(geokit("render", cube, "-o", target, "--size", "huge"), 1, "--size", "800x600")
    fails(geokit("render", cube, "-o", target, "--slice", "x"), 1, "for volumes")
    fails(geokit("render", cube, "-o", target, "--color", "no such colour"), 1, "no such colour")
    fails(geokit("render", cube, "-o", tmp_path / "cube.jpg"), 1, ".jpg", ".png")
    assert list(tmp_path.iterdir()) == []
    target.write_text("mine")
    fails(geokit("render", cube, "-o", target, *SIZE), 1, "cube.png", "--force")
    assert target.read_text() == "mine"
