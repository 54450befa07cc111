"""Scenes of other programs: .dae and .fbx as their libraries understand them, with polygons, materials and units."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from tests.support.exchange_files import CUBE, write_collada, write_fbx

WRITERS = {".dae": write_collada, ".fbx": write_fbx}
PNG = b"\x89PNG\r\n\x1a\n" + bytes(20)


@pytest.fixture(params=WRITERS)
def kind(request):
    library = {".dae": "collada", ".fbx": "ufbx"}[request.param]
    if not importlib.util.find_spec(library):
        pytest.skip(f"needs {library}")
    return request.param


def damaged(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


def test_bodies_stand_in_their_places_with_the_digits_of_the_file(kind, tmp_path):
    WRITERS[kind](tmp_path / f"a{kind}")
    mesh = gk.mesh.load(tmp_path / f"a{kind}")
    assert mesh.face_count == 24
    assert [part.name for part in mesh.parts] == (["cube", "cube"] if kind == ".dae" else ["cube", "box"])
    corners = np.unique(mesh.vertices, axis=0)
    # pycollada writes its float32 with all of their digits.
    size = np.float32(0.1) if kind == ".dae" else 0.1
    expected = np.concatenate([CUBE * float(size), CUBE * float(size) + [10.0, 0.0, 0.0]])
    np.testing.assert_allclose(corners, np.unique(expected, axis=0), rtol=0, atol=1e-7 if kind == ".dae" else 1e-15)
    audit = gk.mesh.audit(mesh)
    assert audit.watertight
    assert not audit.inside_out
    assert mesh.meters_per_unit == pytest.approx(0.01 if kind == ".dae" else 0.0254)
    assert mesh.up_axis == "z"


def test_attributes_of_corners_and_materials_come_along(kind, tmp_path):
    WRITERS[kind](tmp_path / f"a{kind}")
    mesh = gk.mesh.load(tmp_path / f"a{kind}")
    triangles = mesh.vertices[mesh.faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.corner_data["normal"], np.repeat(normals[:, None], 3, axis=1), atol=1e-6)
    assert mesh.corner_data["uv"].shape == (24, 3, 2)
    assert np.unique(mesh.corner_data["uv"].reshape(-1, 2), axis=0).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    assert [(one.name, one.color) for one in mesh.materials] == [("red", (1, 0, 0, 1)), ("blue", (0, 0, 1, 1))]
    assert mesh.face_data["material"].tolist() == [0] * 4 + [1] * 8 + [0] * 4 + [1] * 8


def test_a_mirrored_body_keeps_its_outside(tmp_path):
    pytest.importorskip("collada")
    write_collada(tmp_path / "a.dae", matrix=np.diag([-1.0, 1.0, 1.0, 1.0]))
    mesh = gk.mesh.load(tmp_path / "a.dae")
    assert mesh.vertices[:, 0].min() < 0
    assert not gk.mesh.audit(mesh).inside_out


def test_images_are_read_from_allowed_folders_only(kind, tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "other").mkdir()
    for folder in ("own", "other"):
        (tmp_path / folder / "wood.png").write_bytes(PNG)
    path = tmp_path / "own" / f"a{kind}"
    WRITERS[kind](path, image="wood.png")
    texture = gk.mesh.load(path).materials[1].texture
    assert (texture.name, texture.data) == ("wood.png", PNG)
    WRITERS[kind](path, image="../other/wood.png")
    with pytest.warns(UserWarning, match=r"wood\.png.*outside its own folder.*its texture is left out"):
        assert gk.mesh.load(path).materials[1].texture is None
    assert gk.mesh.load(path, reference_folders=[tmp_path / "other"]).materials[1].texture.data == PNG
    WRITERS[kind](path, image="missing.png")
    with pytest.warns(UserWarning, match=r"'missing\.png' is missing: its texture is left out"):
        gk.mesh.load(path)


def test_damaged_files_are_refused_with_their_path(kind, tmp_path):
    path = tmp_path / f"a{kind}"
    WRITERS[kind](path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(gk.FileFormatError, match=f"^{re.escape(str(path))}: "):
        gk.mesh.load(path)
    path.write_bytes(b"no scene\n" * 30)
    with pytest.raises(gk.FileFormatError, match=f"^{re.escape(str(path))}: "):
        gk.mesh.load(path)


def test_fbx_of_many_bodies_is_read_in_a_process_of_its_own_even_if_trusted(tmp_path):
    pytest.importorskip("ufbx")
    names = [f"body {number}" for number in range(40)]
    write_fbx(tmp_path / "a.fbx", bodies=names)
    for trusted in (False, True):
        mesh = gk.mesh.load(tmp_path / "a.fbx", trusted=trusted)
        assert [part.name for part in mesh.parts] == names
        assert mesh.face_count == 12 * 40


def test_fbx_bodies_without_a_node_are_left_out_with_a_warning(tmp_path):
    pytest.importorskip("ufbx")
    write_fbx(tmp_path / "a.fbx")
    damaged(tmp_path / "a.fbx", 'C: "OO",1001,2001', 'C: "OO",1001,2777')
    with pytest.warns(UserWarning, match="1 of its meshes belong to no node and are left out"):
        assert gk.mesh.load(tmp_path / "a.fbx").face_count == 12


def test_fbx_without_a_mesh_is_refused(tmp_path):
    pytest.importorskip("ufbx")
    write_fbx(tmp_path / "a.fbx", bodies=())
    with pytest.raises(gk.FileFormatError, match=r"a\.fbx: holds no visible mesh"):
        gk.mesh.load(tmp_path / "a.fbx")


def test_collada_text_that_is_no_number_is_refused(tmp_path):
    pytest.importorskip("collada")
    write_collada(tmp_path / "a.dae")
    text = (tmp_path / "a.dae").read_text()
    array = re.search(r'<float_array[^>]*id="positions-array"[^>]*>([^<]*)<', text).group(1)
    words = array.split()
    for changed in (words[:-3], [*words[:5], "x", *words[6:]], [*words[:5], "nan", *words[6:]]):
        (tmp_path / "a.dae").write_text(text.replace(array, " ".join(changed)))
        with pytest.raises(gk.FileFormatError, match=r"a\.dae(: |, body)"):
            gk.mesh.load(tmp_path / "a.dae")


def test_collada_with_a_damaged_material_or_a_missing_camera_keeps_its_geometry(tmp_path):
    pytest.importorskip("collada")
    path = tmp_path / "a.dae"
    write_collada(path)
    damaged(path, "<node ", '<node id="eye"><instance_camera url="#gone"/></node><node ')
    mesh = gk.mesh.load(path)
    assert mesh.face_count == 24
    assert len(mesh.materials) == 2
    damaged(path, 'target="#blue-id"', 'target="#gone"')
    with pytest.warns(UserWarning, match="materials are left out"):
        mesh = gk.mesh.load(path)
    assert mesh.face_count == 24
    assert not mesh.materials


def test_collada_with_holes_or_with_geometry_elsewhere_is_refused(tmp_path):
    pytest.importorskip("collada")
    path = tmp_path / "a.dae"
    write_collada(path)
    damaged(path, 'url="#cube-id"', 'url="other.dae#cube-id"')
    with pytest.raises(gk.FileFormatError, match=r"other\.dae"):
        gk.mesh.load(path)
    write_collada(path)
    text = path.read_text()
    start, end = text.index("<polylist"), text.index("</polylist>") + len("</polylist>")
    inputs = re.findall(r"<input[^>]*/>", text[start:end])
    hole = "<ph><p>0 0 0 1 0 1 2 0 2</p><h>0 0 0 1 0 1 2 0 2</h></ph>"
    polygons = f'<polygons count="1">{"".join(inputs)}<p>0 0 0 1 0 1 2 0 2</p>{hole}</polygons>'
    path.write_text(text[:start] + polygons + text[end:])
    with pytest.raises(gk.FileFormatError, match="polygons with holes"):
        gk.mesh.load(path)


@pytest.mark.skipif(not importlib.util.find_spec("collada"), reason="needs collada")
@pytest.mark.parametrize(
    ("said", "axis"), [("<up_axis>Y_UP</up_axis>", "y"), ("<up_axis>X_UP</up_axis>", "x"), ("", None)]
)
def test_the_axis_of_collada_that_points_up(said, axis, tmp_path):
    write_collada(tmp_path / "a.dae")
    assert gk.mesh.load(damaged(tmp_path / "a.dae", "<up_axis>Z_UP</up_axis>", said)).up_axis == axis


@pytest.mark.skipif(not importlib.util.find_spec("collada"), reason="needs collada")
def test_a_skewed_node_of_collada_is_refused(tmp_path):
    write_collada(tmp_path / "a.dae")
    path = damaged(tmp_path / "a.dae", "<instance_geometry", "<skew>30 1 0 0 0 1 0</skew><instance_geometry")
    with pytest.raises(gk.FileFormatError, match="has a node that is skewed, which is not read"):
        gk.mesh.load(path)
