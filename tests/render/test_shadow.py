"""Shadows on the ground, what is seen through, and the axis that points up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import geokit as gk
from geokit import render
from geokit.errors import InputError
from geokit.render._camera import up_of, up_of_points
from geokit.render._shadow import hidden_sky
from geokit.render.looks.checks import figure_bytes

SIZE = (160, 120)


def _picture(path: Path, **scene: Any) -> NDArray[np.int64]:
    return np.asarray(Image.open(render.figure(path / "a.png", size=SIZE, **scene)).convert("RGB")).astype(np.int64)


@pytest.mark.parametrize("height", [0.2, 0.5, 1.0])
def test_a_disc_hides_what_its_form_factor_says(height: float) -> None:
    count, radius = 256, 0.5
    step = 4.0 / count
    place = step * (np.arange(count) - 0.5 * count)
    inside = np.hypot(place[:, None], place) <= radius
    disc = np.where(inside, height, np.nan)
    hidden = hidden_sky(disc, disc, step)[count // 2, count // 2]
    assert hidden == pytest.approx(radius**2 / (radius**2 + height**2), abs=0.01)
    assert not hidden_sky(np.full((8, 8), np.nan), np.full((8, 8), np.nan), 1.0).any()


@pytest.mark.slow
@pytest.mark.parametrize("up", ["y", "z", "-x"])
def test_a_ball_throws_its_shadow_below_itself(tmp_path: Path, up: str) -> None:
    ball = gk.mesh.sphere(1.0)
    front = {"mesh": ball, "up": up, "azimuth": 0.0, "elevation": 20.0}
    plain, shaded = (_picture(tmp_path, **front, shadow=on) for on in (False, True))
    assert (plain[-1] == 255).all()
    # The same on both sides, darkest below the middle, and nothing above.
    gray = shaded[..., 0]
    below = gray[-8]
    np.testing.assert_allclose(below, below[::-1], atol=4)
    assert below[SIZE[0] // 2] < below[5] - 20
    assert (shaded[:5] == 255).all()
    clear = np.asarray(Image.open(render.figure(tmp_path / "b.png", size=SIZE, **front, shadow=True, transparent=True)))
    assert clear[-8, SIZE[0] // 2, 3] > 20 + clear[-8, 5, 3]


def test_the_ground_is_not_seen_from_below(tmp_path: Path) -> None:
    ball = gk.mesh.sphere(1.0)
    seen = _picture(tmp_path, mesh=ball, shadow=True, elevation=-40.0)
    assert (seen[:, :8] == 255).all()


def test_points_throw_shadows_of_their_size(tmp_path: Path) -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 40)] * 2), axis=-1).reshape(-1, 2)
    sheet = np.stack([grid[:, 0], np.full(len(grid), 0.5), grid[:, 1]], axis=1)
    points = np.concatenate([sheet, [[0.0, 0.0, 0.0]]])
    shaded = _picture(tmp_path, points=points, shadow=True, azimuth=0.0, elevation=10.0)
    # Points are red, shadows gray.
    gray = shaded[np.ptp(shaded, axis=2) == 0][:, 0]
    assert 120 < gray.min() < 235


def test_fog_has_no_shadow_here(tmp_path: Path) -> None:
    fog = gk.volume.from_dense(np.ones((4, 4, 4)))
    with pytest.raises(InputError, match="shadow: fog throws none"):
        render.figure(tmp_path / "a.png", volume=fog, shadow=True)


# Two squares, one behind the other, seen from the front; the nearer one comes first or last in the file.
NEAR, FAR = ([[x, y, z] for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))] for z in (0.5, 0.0))
BOTH = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
HALF_RED, BLUE = (1.0, 0.0, 0.0, 0.5), (0.0, 0.0, 1.0, 1.0)
FRONT: Any = {"azimuth": 0.0, "elevation": 0.0, "up": "y"}


@pytest.mark.slow
def test_alpha_of_colors_is_seen_through_in_any_order(tmp_path: Path) -> None:
    found = []
    for first, second, colors in ((NEAR, FAR, (HALF_RED, BLUE)), (FAR, NEAR, (BLUE, HALF_RED))):
        rows = np.repeat(colors, 4, axis=0)
        mesh = gk.mesh.TriangleMesh(np.array([*first, *second], float), BOTH, vertex_data={"color": rows})
        found.append(_picture(tmp_path, mesh=mesh, **FRONT)[60, 80])
    np.testing.assert_allclose(found[0], found[1], atol=2)
    red, green, blue = found[0]
    assert min(red, blue) > 60 > green


@pytest.mark.parametrize(("cutoff", "colors"), [(None, "mixed"), (0.0, "red"), (0.25, "red"), (0.75, "blue")])
def test_alpha_of_textures(tmp_path: Path, cutoff: float | None, colors: str) -> None:
    import io

    data = io.BytesIO()
    Image.fromarray(np.full((4, 4, 4), (255, 0, 0, 128), np.uint8)).save(data, "PNG")
    clear = gk.mesh.Material("clear", None, gk.mesh.Texture("t.png", data.getvalue()), cutoff)
    blue = gk.mesh.Material("blue", (0.0, 0.0, 1.0, 1.0))
    vertices = np.array([*NEAR, *FAR], float)
    mesh = gk.mesh.TriangleMesh(
        vertices,
        BOTH,
        vertex_data={"uv": vertices[:, :2]},
        face_data={"material": [0, 0, 1, 1]},
        materials=[clear, blue],
    )
    red, _, seen = _picture(tmp_path, mesh=mesh, **FRONT)[60, 80]
    assert (red > 60, seen > 60) == {"mixed": (True, True), "red": (True, False), "blue": (False, True)}[colors]
    # As glTF says it, and as it is read again.
    gk.mesh.save(tmp_path / "a.glb", mesh)
    assert [each.alpha_cutoff for each in gk.mesh.load(tmp_path / "a.glb", trusted=True).materials] == [cutoff, None]
    assert gk.mesh.as_mesh(gk.mesh.to_trimesh(mesh)).materials[0].alpha_cutoff == cutoff


def test_memory_counts_textures() -> None:
    import io

    data = io.BytesIO()
    Image.fromarray(np.zeros((300, 200, 3), np.uint8)).save(data, "PNG")
    material = gk.mesh.Material("a", None, gk.mesh.Texture("t.png", data.getvalue()))
    ball = gk.mesh.sphere(1.0)
    textured = gk.mesh.TriangleMesh(ball.vertices, ball.faces, materials=[material, material])
    assert figure_bytes(mesh=textured) - figure_bytes(mesh=ball) == 20 * 300 * 200


def test_the_axis_that_points_up() -> None:
    post = gk.mesh.cylinder(0.2, 2.0)
    lying = gk.mesh.TriangleMesh(post.vertices[:, [0, 2, 1]], post.faces[:, ::-1])
    ball = gk.mesh.sphere(1.0)
    assert [up_of(mesh) for mesh in (post, lying, ball, gk.mesh.box())] == ["z", "y", "y", "y"]
    assert [up_of(mesh, "z") for mesh in (post, lying, ball)] == ["z", "y", "z"]
    named = gk.mesh.TriangleMesh(post.vertices, post.faces, up_axis="x")
    assert up_of(named) == up_of(named, "z") == "x"
    # A map that turns the axis forgets it; others keep it.
    turn = np.eye(4)[[1, 0, 2, 3]] * [[1], [-1], [1], [1]]
    assert (named.transform(turn).up_axis, named.transform(np.diag([2.0, 1, 1, 1])).up_axis) == (None, "x")
    seen = np.array([[-0.5, 0.2, 1.0], [0.5, -0.3, 2.0]])
    assert (up_of_points(seen), up_of_points(seen, "z"), up_of_points(-seen, "z")) == ("-y", "-y", "z")
    assert up_of_points(seen + np.array([9.0, 0, 0]), "z") == "z"


def test_clouds_are_drawn_in_their_own_colors(tmp_path: Path) -> None:
    points = np.random.default_rng(0).random((4000, 3))
    for kind, full in ((np.uint8, 255), (np.uint16, 255), (np.float32, 1.0)):
        cloud = gk.points.PointCloud(points, {"rgb": np.tile(np.array([0, full, 0], kind), (4000, 1))})
        center = _picture(tmp_path, points=cloud)[50:70, 70:90].reshape(-1, 3)
        assert tuple(center[np.argmin(center.sum(axis=1))]) == (0, 255, 0)
    red = _picture(tmp_path, points=cloud, color="red")[50:70, 70:90].reshape(-1, 3)
    assert red[:, 0].mean() > red[:, 1].mean() + 50


def test_the_up_axis_of_usd(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    box = gk.mesh.box()
    gk.mesh.save(tmp_path / "a.usda", gk.mesh.TriangleMesh(box.vertices, box.faces, up_axis="z"))
    assert gk.mesh.load(tmp_path / "a.usda", trusted=True).up_axis == "z"
    gk.mesh.save(tmp_path / "b.usda", box)
    assert gk.mesh.load(tmp_path / "b.usda").up_axis is None
