"""``geokit render``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import geokit as gk

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
    fails(geokit("render", cube, "-o", target, "--size", "huge"), 2, "--size", "800x600")
    fails(geokit("render", cube, "-o", target, "--slice", "x"), 1, "for volumes")
    fails(geokit("render", cube, "-o", target, "--color", "no such color"), 1, "no such color")
    fails(geokit("render", cube, "-o", tmp_path / "cube.jpg"), 1, ".jpg", ".png")
    assert list(tmp_path.iterdir()) == []
    target.write_text("mine")
    fails(geokit("render", cube, "-o", target, *SIZE), 1, "cube.png", "--force")
    assert target.read_text() == "mine"


def _extent(path: Path) -> tuple[int, int]:
    """Height and width of what is drawn."""
    rows, columns = np.nonzero((picture(path) < 0.97).any(axis=-1))
    return int(np.ptp(rows)), int(np.ptp(columns))


def test_a_mesh_in_its_own_colors_and_by_an_array(geokit, tmp_path: Path) -> None:
    box = gk.mesh.box((1.0, 1.0, 1.0))
    data = {"color": np.tile(np.uint8([255, 0, 0]), (8, 1)), "heat": box.vertices[:, 1]}
    gk.mesh.save(tmp_path / "box.ply", gk.mesh.TriangleMesh(box.vertices, box.faces, vertex_data=data))
    seen = {}
    for name, options in (("own", ()), ("blue", ("--color", "blue")), ("heat", ("--color", "heat"))):
        done = geokit("render", tmp_path / "box.ply", "-o", tmp_path / f"{name}.png", *SIZE, *options)
        assert (done.returncode, done.stderr) == (0, ""), done.stderr
        seen[name] = picture(tmp_path / f"{name}.png")[150, 160]
    assert seen["own"][0] > 3 * seen["own"][1:].max()
    assert seen["blue"][2] > 3 * seen["blue"][:2].max()
    # The color bar of the array stands at the right.
    assert (picture(tmp_path / "heat.png")[:, 340:] < 0.97).any()


def test_the_format_says_what_is_up_and_the_camera_goes_around(geokit, fails, tmp_path: Path) -> None:
    tower = gk.mesh.box((1.0, 2.0, 6.0))
    for name in ("tower.stl", "tower.obj"):
        gk.mesh.save(tmp_path / name, tower)
    shapes = {}
    for name, source, options in (
        ("stl", "tower.stl", ()),
        ("obj", "tower.obj", ("--azimuth", "90", "--elevation", "0")),
        ("up", "tower.obj", ("--up", "z", "--azimuth", "0", "--elevation", "0", "--edges")),
        ("small", "tower.obj", ("--up", "z", "--azimuth", "0", "--elevation", "0", "--zoom", "0.5")),
    ):
        done = geokit("render", tmp_path / source, "-o", tmp_path / f"{name}.png", *SIZE, *options)
        assert done.returncode == 0, done.stderr
        shapes[name] = _extent(tmp_path / f"{name}.png")
    assert shapes["stl"][0] > 2 * shapes["stl"][1]  # stands
    assert shapes["obj"][1] == pytest.approx(3 * shapes["obj"][0], rel=0.05)  # lies, seen from its side
    assert shapes["up"][0] == pytest.approx(6 * shapes["up"][1], rel=0.05)
    assert shapes["small"][0] == pytest.approx(shapes["up"][0] / 2, abs=2)
    box = tmp_path / "tower.obj"
    fails(geokit("render", box, "-o", tmp_path / "a.png", "--elevation", "100"), 1, "elevation: 100", "-90")


def test_slices_have_no_camera(geokit, fails, cube_sdf: Path, tmp_path: Path) -> None:
    done = geokit("render", cube_sdf, "-o", tmp_path / "a.png", "--slice", "x", "--zoom", "2")
    fails(done, 1, "--zoom", "not for --slice")


def test_smoke_and_slices_as_lines(geokit, fails, cube_sdf: Path, tmp_path: Path) -> None:
    fog = tmp_path / "fog.nvdb"
    gk.volume.save(fog, gk.volume.from_dense(np.ones((9, 9, 9)), grid_class="fog volume", name="density"))
    done = geokit("render", fog, "-o", tmp_path / "fog.png", *SIZE, "--look", "smoke")
    assert done.returncode == 0, done.stderr
    drawn = picture(tmp_path / "fog.png")
    assert drawn[0, 0].max() < 0.15
    assert drawn.max() > 0.5
    fails(geokit("render", cube_sdf, "-o", tmp_path / "a.png", "--look", "smoke"), 1, "look: smoke is drawn alone")
    done = geokit("render", cube_sdf, "-o", tmp_path / "a.svg", "--slice", "x")
    assert done.returncode == 0, done.stderr
    assert "<svg" in (tmp_path / "a.svg").read_text()
