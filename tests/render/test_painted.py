"""Pictures of meshes with textures, colors and normals of their own, and where the camera stands."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import geokit as gk
from geokit import render
from geokit.render._backend import pyvista
from geokit.render.looks.painted import surface_of

SIZE = (160, 160)
RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
FRONT = {"azimuth": 0.0, "elevation": 0.0, "size": SIZE}
# Faces of a square from (0, 0, 0) to (1, 1, 0), seen from the front.
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = [[0, 1, 2], [0, 2, 3]]


def _texture(pixels: Any) -> gk.mesh.Texture:
    data = io.BytesIO()
    Image.fromarray(np.array(pixels, np.uint8)).resize((64, 64), Image.Resampling.NEAREST).save(data, "PNG")
    return gk.mesh.Texture("t.png", data.getvalue())


def _square(**more: Any) -> gk.mesh.TriangleMesh:
    return gk.mesh.TriangleMesh(SQUARE, FACES, **more)


def _picture(path: Path, mesh: gk.mesh.TriangleMesh, **options: Any) -> NDArray[np.int64]:
    target = render.figure(path / "a.png", mesh=mesh, **{**FRONT, **options})
    return np.asarray(Image.open(target).convert("RGB")).astype(np.int64)


def _strongest(color: NDArray[np.int64]) -> tuple[int, ...]:
    """The pure color that is nearest to one under the light."""
    return tuple(int(channel > 0.5 * color.max()) * 255 for channel in color)


def _corners(picture: NDArray[np.int64]) -> list[tuple[int, ...]]:
    """Upper left, upper right, lower left, lower right of the square."""
    return [_strongest(picture[row, column]) for row in (50, 110) for column in (50, 110)]


TEXTURED = {
    "face_data": {"material": [0, 0]},
    "materials": [gk.mesh.Material("m", None, _texture([[RED, GREEN], [BLUE, WHITE]]))],
}


@pytest.mark.parametrize("element", ["vertex", "corner"])
def test_a_texture_lies_the_right_way_up(tmp_path: Path, element: str) -> None:
    uv = SQUARE[:, :2] if element == "vertex" else SQUARE[FACES][..., :2]
    mesh = _square(**{f"{element}_data": {"uv": uv}}, **TEXTURED)
    assert _corners(_picture(tmp_path, mesh)) == [RED, GREEN, BLUE, WHITE]
    assert _corners(_picture(tmp_path, mesh, color="blue")) == [BLUE] * 4


def test_a_texture_repeats_and_takes_the_color_of_its_material(tmp_path: Path) -> None:
    cyan = TEXTURED["materials"][0]._replace(color=(0.0, 1.0, 1.0, 1.0))  # type: ignore[index]
    mesh = _square(vertex_data={"uv": SQUARE[:, :2] + 3.0}, face_data={"material": [0, 0]}, materials=[cyan])
    picture = _picture(tmp_path, mesh)
    assert picture[50, 50].max() < 40  # red times cyan
    assert _corners(picture)[1:] == [GREEN, BLUE, (0, 255, 255)]
    # Black beside a texture is what files say that do not mean it.
    black = _square(
        vertex_data={"uv": SQUARE[:, :2]}, face_data={"material": [0, 0]}, materials=[cyan._replace(color=(0, 0, 0, 1))]
    )
    assert _corners(_picture(tmp_path, black)) == [RED, GREEN, BLUE, WHITE]


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_colors_of_vertices_corners_and_faces(tmp_path: Path, kind: Any) -> None:
    full = 255 if kind is np.uint8 else 1.0

    def colors(*rows: tuple[int, ...]) -> NDArray[Any]:
        return (np.array(rows) / 255.0 * full).astype(kind)

    # Vertices run around the square from the lower left.
    vertex = _picture(tmp_path, _square(vertex_data={"color": colors(BLUE, WHITE, GREEN, RED)}))
    near = [_strongest(vertex[row, column]) for row, column in ((36, 36), (36, 123), (123, 36), (123, 123))]
    assert near == [RED, GREEN, BLUE, WHITE]
    face = _picture(tmp_path, _square(face_data={"color": colors(RED, BLUE)}))
    assert (_strongest(face[110, 110]), _strongest(face[50, 50])) == (RED, BLUE)
    corner = np.repeat(colors(RED, BLUE)[:, None], 3, axis=1)
    np.testing.assert_array_equal(_picture(tmp_path, _square(corner_data={"color": corner})), face)


def test_materials_without_textures_and_faces_without_materials(tmp_path: Path) -> None:
    red = [gk.mesh.Material("red", (1.0, 0.0, 0.0, 1.0))]
    picture = _picture(tmp_path, _square(face_data={"material": [0, -1]}, materials=red))
    assert _strongest(picture[110, 110]) == RED
    plain = _picture(tmp_path, _square())
    np.testing.assert_allclose(picture[50, 50], plain[50, 50], atol=2)
    # Nothing that is drawn: the very same picture.
    unused = _square(vertex_data={"uv": SQUARE[:, :2]}, face_data={"material": [-1, -1]}, materials=red)
    np.testing.assert_array_equal(_picture(tmp_path, unused), plain)
    # As read from a .vtp, which does not hold the materials themselves.
    np.testing.assert_array_equal(_picture(tmp_path, _square(face_data={"material": [3, 0]})), plain)


@pytest.mark.slow
def test_seams_are_no_edges_and_normals_are_those_of_the_mesh(tmp_path: Path) -> None:
    ball = gk.mesh.sphere(1.0)
    white = np.full((ball.face_count, 3), 255, np.uint8)
    whole = gk.mesh.TriangleMesh(ball.vertices, ball.faces, face_data={"color": white})
    loose = gk.mesh.TriangleMesh(
        ball.vertices[ball.faces].reshape(-1, 3),
        np.arange(3 * ball.face_count).reshape(-1, 3),
        face_data={"color": white},
    )
    smooth = _picture(tmp_path, whole)
    np.testing.assert_array_equal(_picture(tmp_path, loose), smooth)
    normals = np.repeat(loose.face_normals, 3, axis=0)
    flat = _picture(
        tmp_path,
        gk.mesh.TriangleMesh(loose.vertices, loose.faces, vertex_data={"normal": normals}, face_data={"color": white}),
    )
    assert np.abs(flat - smooth).max() > 10
    # Turned inside out by the file, or without length: still what the faces say.
    for wrong in (-normals, normals * 7.0):
        turned = gk.mesh.TriangleMesh(
            loose.vertices, loose.faces, vertex_data={"normal": wrong}, face_data={"color": white}
        )
        np.testing.assert_array_equal(_picture(tmp_path, turned), flat)
    none = gk.mesh.TriangleMesh(
        loose.vertices, loose.faces, vertex_data={"normal": normals * 0}, face_data={"color": white}
    )
    np.testing.assert_array_equal(_picture(tmp_path, none), smooth)


def test_an_image_that_cannot_be_decoded_is_named(tmp_path: Path) -> None:
    bad = [gk.mesh.Material("m", None, gk.mesh.Texture("bad.png", b"\x89PNG nothing"))]
    mesh = _square(vertex_data={"uv": SQUARE[:, :2]}, face_data={"material": [0, 0]}, materials=bad)
    with pytest.warns(UserWarning, match="mesh: texture 'bad.png': cannot be decoded .*; drawn without it") as said:
        _picture(tmp_path, mesh)
    assert said[0].filename == __file__


def _filled(picture: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (picture < 250).any(axis=-1)


@pytest.mark.slow
def test_the_camera(tmp_path: Path) -> None:
    # A bar along x with one red end at +x, on the right as seen from the front, and a blue top.
    bar = gk.mesh.box((4.0, 1.0, 1.0))
    colors = np.full((12, 3), 200, np.uint8)
    colors[bar.face_normals[:, 0] > 0.5] = RED
    colors[bar.face_normals[:, 1] > 0.5] = BLUE
    mesh = gk.mesh.TriangleMesh(bar.vertices, bar.faces, face_data={"color": colors})
    middle = (SIZE[1] // 2, SIZE[0] // 2)
    assert _strongest(_picture(tmp_path, mesh, azimuth=90.0)[middle]) == RED
    assert _strongest(_picture(tmp_path, mesh, elevation=90.0)[middle]) == BLUE
    assert _strongest(_picture(tmp_path, mesh, azimuth=-90.0)[middle]) == WHITE
    plain = _filled(_picture(tmp_path, mesh)).sum()
    assert _filled(_picture(tmp_path, mesh, zoom=0.5)).sum() == pytest.approx(plain / 4, rel=0.03)
    far = _filled(_picture(tmp_path, mesh, distance=20.0)).sum()
    assert _filled(_picture(tmp_path, mesh, distance=40.0)).sum() == pytest.approx(far / 4, rel=0.15)
    # From above, the front is at the bottom of the picture, whichever axis is up.
    assert _strongest(_picture(tmp_path, mesh, elevation=90.0, up="y", azimuth=45.0)[middle]) == BLUE


@pytest.mark.slow
def test_edges(tmp_path: Path) -> None:
    mesh = _square()
    plain, lines = _picture(tmp_path, mesh), _picture(tmp_path, mesh, edges=True)
    # The diagonal of the square, and nothing beside it.
    assert np.abs(lines - plain)[80, 75:85].max() > 60
    assert np.abs(lines - plain)[110, 130:140].max() < 3
    field = gk.volume.from_mesh(gk.mesh.sphere(1.0), 0.3, device="cpu")
    bare, lined = (
        np.asarray(Image.open(render.figure(tmp_path / "v.png", volume=field, edges=drawn)).convert("L")).astype(int)
        for drawn in (False, True)
    )
    assert 0.008 < (bare - lined > 40).mean() < 0.3


@pytest.mark.parametrize(
    ("option", "message"),
    [({"elevation": 91}, "elevation: 91 is not from -90"), ({"zoom": 0}, "zoom"), ({"distance": -1}, "distance")],
)
def test_cameras_that_are_none(tmp_path: Path, option: Any, message: str) -> None:
    with pytest.raises(gk.InputError, match=message):
        render.figure(tmp_path / "a.png", mesh=_square(), **option)


def test_surfaces_have_memory_of_their_own():
    pv = pyvista()
    points, faces = np.eye(3), np.array([[0, 1, 2]])
    surface = surface_of(pv, points, faces)
    assert not np.shares_memory(surface.points, points)
    assert not np.shares_memory(pv.convert_array(surface.GetPolys().GetConnectivityArray()), faces)
