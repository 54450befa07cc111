"""Attributes of meshes in files: what is saved comes back where the format holds it, and what it does not is named."""

from __future__ import annotations

import errno
import json
import os
import re
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.formats.table import FORMATS, extensions
from geokit.mesh import Material, Texture, TriangleMesh
from tests.support.attributed import PNG, numbered, painted

GLTF = (".glb", ".gltf")
TORUS = mesh_catalog.torus(6, 5)
# Formats whose readers start no process.
QUICK = (".obj", ".ply", ".off")


def kinds(*, slow=True):
    """Formats that are written; those that start a process for reading are slow."""
    return [
        pytest.param(kind, marks=[pytest.mark.slow] * (FORMATS[kind].process and slow))
        for kind in extensions("mesh", "w")
    ]


def saved(mesh: TriangleMesh, path: Path) -> tuple[TriangleMesh, list[str]]:
    """The mesh after saving and loading, and the warnings of saving."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        gk.mesh.save(path, mesh)
    return gk.mesh.load(path), [str(warning.message) for warning in said]


def at_corners(mesh: TriangleMesh, name: str) -> np.ndarray | None:
    """An attribute of vertices or corners at each corner."""
    if name in mesh.corner_data:
        return mesh.corner_data[name]
    return mesh.vertex_data[name][mesh.faces] if name in mesh.vertex_data else None


def as_floats(colors: np.ndarray) -> np.ndarray:
    return colors / np.iinfo(colors.dtype).max if colors.dtype.kind in "iu" else colors.astype(np.float64)


# --- every format ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", kinds())
def test_numbers_come_back_where_the_table_says(tmp_path, kind):
    mesh, row = numbered(TORUS), FORMATS[kind]
    again, said = saved(mesh, tmp_path / f"a{kind}")
    lost = " ".join(said)
    tolerance = 2e-7 if kind in GLTF else 0.0
    for name in ("v", "v2", "c", "c2"):
        allowed = row.vertex if name[0] == "v" else row.corner or row.vertex
        found, expected = at_corners(again, name), at_corners(mesh, name)
        assert (found is not None) == ("*" in allowed)
        assert (f"'{name}'" in lost) == ("*" not in allowed)
        if found is not None:
            np.testing.assert_allclose(found, expected, rtol=tolerance, atol=0.0)
    for name, values in mesh.face_data.items():
        assert (name in again.face_data) == (row.face == "*") == (f"face '{name}'" not in lost)
        if name in again.face_data:
            np.testing.assert_array_equal(again.face_data[name], values)
    assert ("materials" in lost) == (not row.materials)
    assert ("the unit of 0.001 m" in lost) == (not row.unit and not row.default_unit)
    # By its specification, glTF is in meters.
    unsaid = 1.0 if kind in (".glb", ".gltf") else None
    assert again.meters_per_unit == (0.001 if row.unit else unsaid)
    assert len(said) == (1 if lost else 0)


@pytest.mark.parametrize("kind", kinds())
def test_normals_colors_and_textures_come_back_where_the_table_says(tmp_path, kind):
    mesh, row = painted(TORUS), FORMATS[kind]
    again, said = saved(mesh, tmp_path / f"a{kind}")
    lost = " ".join(said)
    # A glTF has the faces of each material together.
    order = np.argsort(mesh.face_data["material"], kind="stable") if kind in GLTF else np.arange(60)
    for name, allowed in (("normal", row.vertex), ("color", row.vertex), ("uv", row.corner or row.vertex)):
        found, expected = at_corners(again, name), at_corners(mesh, name)
        held = "*" in allowed or name in allowed.replace("rgb", "color")
        assert (found is not None) == held == (f"'{name}'" not in lost.replace("the alpha of vertex 'color'", ""))
        if not held:
            continue
        expected = expected[order]
        if name == "color":
            rgba = as_floats(found)
            np.testing.assert_allclose(rgba, as_floats(expected)[..., : rgba.shape[-1]], rtol=0, atol=3e-8)
            assert ("alpha" in lost) == (rgba.shape[-1] == 3)
        else:
            # glTF turns texture coordinates over in float32.
            np.testing.assert_allclose(found, expected, rtol=0, atol=6e-8 if kind in GLTF and name == "uv" else 0.0)
    if row.materials:
        assert [material[:2] for material in again.materials] == [material[:2] for material in mesh.materials]
        assert again.materials[0].texture is None
        assert again.materials[1].texture.data == PNG
        assert again.materials[1].texture.name.endswith("wood.png")
    if row.materials or row.face == "*":
        np.testing.assert_array_equal(again.face_data["material"], mesh.face_data["material"][order])


@pytest.mark.parametrize("kind", kinds())
def test_a_mesh_without_attributes_is_the_same_file(tmp_path, kind):
    """Attributes that the format drops leave the bytes of the mesh without them."""
    plain = TriangleMesh(TORUS.vertices, TORUS.faces, name="a")
    gk.mesh.save(tmp_path / f"a{kind}", plain)
    if FORMATS[kind].vertex == "":
        with pytest.warns(UserWarning, match=f"{kind} does not hold vertex 'normal', vertex 'color', corner 'uv'"):
            gk.mesh.save(tmp_path / f"b{kind}", TriangleMesh(**vars(painted(plain))))
        if kind == ".stl":
            assert (tmp_path / f"b{kind}").read_bytes() == (tmp_path / f"a{kind}").read_bytes()
    again = gk.mesh.load(tmp_path / f"a{kind}")
    assert not (again.vertex_data)
    assert not (again.face_data)
    assert not (again.corner_data)
    assert not (again.materials)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [kind] * (1 + (FORMATS[kind].vertex == ""))


DTYPES = "?bBhHiIlLefd"


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in extensions("mesh", "w") if FORMATS[kind].vertex == "*"])
def test_all_types_are_written(tmp_path, kind):
    values = {np.dtype(code).name: np.arange(30).astype(np.dtype(code)) for code in DTYPES}
    data = {f"one_{name}": given for name, given in values.items()}
    data |= {f"five_{name}": np.repeat(given[:, None], 5, axis=1) for name, given in values.items()}
    mesh = TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data=data, meters_per_unit=1.0)
    again, said = saved(mesh, tmp_path / f"a{kind}")
    assert not said
    assert set(again.vertex_data) == set(data)
    for name, given in data.items():
        np.testing.assert_array_equal(again.vertex_data[name], given, err_msg=name)


@pytest.mark.parametrize("kind", [".ply", ".glb"])
def test_integers_that_a_format_lacks_are_named(tmp_path, kind):
    data = {"large": np.arange(30) + 2**40}
    with pytest.warns(UserWarning, match="does not hold vertex 'large'; left out"):
        gk.mesh.save(tmp_path / f"a{kind}", TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data=data))


def test_arguments_of_the_call_replace_arrays_of_the_mesh(tmp_path):
    mesh = numbered(TORUS)
    with pytest.warns(UserWarning, match=r"\.ply does not hold materials"):
        gk.mesh.save(tmp_path / "a.ply", mesh, point_data={"v": np.full(30, 7.5)}, cell_data={"more": np.arange(60)})
    again = gk.mesh.load(tmp_path / "a.ply")
    assert again.vertex_data["v"].tolist() == [7.5] * 30
    np.testing.assert_array_equal(again.face_data["more"], np.arange(60))
    np.testing.assert_array_equal(again.face_data["f"], mesh.face_data["f"])


def test_names_that_columns_cannot_have(tmp_path):
    data = {"a b": np.arange(30), "a_b": np.arange(30) + 1, "x": np.arange(30) + 2, "é": np.arange(30) + 3}
    gk.mesh.save(tmp_path / "a.ply", TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data=data))
    again = gk.mesh.load(tmp_path / "a.ply")
    np.testing.assert_array_equal(again.vertices, TORUS.vertices)
    assert sorted(values[0] for values in again.vertex_data.values()) == [0, 1, 2, 3]


@pytest.mark.process
@pytest.mark.parametrize("name", ["{x}", "a}", "a\0b"])
def test_names_that_vtk_cannot_write_are_left_out(tmp_path, name):
    # VTK ends the process for a brace in a .vtk, and cannot read the control characters that it writes.
    data = {name: np.arange(30.0), "good": np.arange(30.0)}
    with pytest.warns(UserWarning, match=f".vtk does not hold vertex {re.escape(repr(name))}; left out"):
        gk.mesh.save(tmp_path / "a.vtk", TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data=data))
    assert [*gk.mesh.load(tmp_path / "a.vtk").vertex_data] == ["good"]


@pytest.mark.parametrize(("name", "written"), [("a\0b", "a_b"), ("a\x1b", "a_"), ("a\nb", "a_b"), ("{x}", "{x}")])
def test_signs_that_xml_cannot_hold_are_replaced(tmp_path, name, written):
    for kind in (".vtp", ".vtu"):
        gk.mesh.save(
            tmp_path / f"a{kind}", TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data={name: np.arange(30.0)})
        )
        assert [*gk.mesh.load(tmp_path / f"a{kind}").vertex_data] == [written]
    gk.points.save(tmp_path / "a.vtp", np.eye(3), data={name: np.arange(3)})
    assert [*gk.points.load(tmp_path / "a.vtp").data] == [written]


def test_half_of_a_surrogate_pair_is_no_name():
    with pytest.raises(gk.InputError, match=r"vertex_data: the name '\\ud800' cannot be encoded"):
        TriangleMesh(np.eye(3), [[0, 1, 2]], vertex_data={"\ud800": np.arange(3)})


# --- files of other programs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_ply_of_trimesh(tmp_path, form):
    import trimesh

    colors = np.random.default_rng(0).integers(0, 256, (30, 4)).astype(np.uint8)
    mesh = trimesh.Trimesh(TORUS.vertices, TORUS.faces, process=False, vertex_colors=colors)
    mesh.export(tmp_path / "t.ply", encoding=form, vertex_normal=True)
    again = gk.mesh.load(tmp_path / "t.ply")
    np.testing.assert_array_equal(again.vertex_data["color"], colors)
    assert again.vertex_data["color"].dtype == np.uint8
    np.testing.assert_allclose(again.vertex_data["normal"], mesh.vertex_normals, atol=1e-6)


def test_ply_with_wedge_coordinates_of_meshlab(tmp_path):
    text = (
        "ply\nformat ascii 1.0\ncomment TextureFile a.png\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nproperty float quality\n"
        "element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
        "property int texnumber\nend_header\n"
        "0 0 0 255 0 0 0.5\n1 0 0 0 255 0 1\n1 1 0 0 0 300 2\n0 1 0 9 9 9 3\n"
        "4 0 1 2 3 8 0 0 1 0 1 1 0 1 0\n3 0 1 2 0 7\n"
    )
    (tmp_path / "m.ply").write_text(text)
    with pytest.warns(UserWarning, match=r"'a.png' is missing: its texture is left out"):
        mesh = gk.mesh.load(tmp_path / "m.ply")
    assert mesh.corner_data["uv"][:2].tolist() == [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]]
    assert np.isnan(mesh.corner_data["uv"][2]).all()
    assert mesh.face_data["material"].tolist() == [0, 0, -1]
    assert mesh.vertex_data["quality"].tolist() == [0.5, 1, 2, 3]
    # 300 does not fit into the declared type: the column stays what the text says.
    assert mesh.vertex_data["blue"].tolist() == [0, 0, 300, 9]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_ply_holds_colors_as_bytes_where_these_are_exact(tmp_path, dtype):
    pyvista = pytest.importorskip("pyvista")
    bytes_ = np.array([[255, 128, 0, 255], [1, 2, 3, 4], [254, 51, 77, 0]], np.uint8)
    for name, exact in (("vertex_data", bytes_), ("face_data", bytes_[:1])):
        colors = (exact / 255.0).astype(dtype)
        again, _ = saved(TriangleMesh(np.eye(3), [[0, 1, 2]], **{name: {"color": colors}}), tmp_path / "a.ply")
        assert getattr(again, name)["color"].dtype == np.uint8
        np.testing.assert_array_equal(getattr(again, name)["color"], exact)
        colors[0, 0] = np.nextafter(colors[0, 0], dtype(0.5))
        again, _ = saved(TriangleMesh(np.eye(3), [[0, 1, 2]], **{name: {"color": colors}}), tmp_path / "b.ply")
        np.testing.assert_array_equal(getattr(again, name)["color"], colors)
    gk.points.save(tmp_path / "c.ply", np.eye(3), data={"rgb": (bytes_[:, :3] / 255.0).astype(dtype)})
    # Written as floats they were black there.
    np.testing.assert_array_equal(pyvista.read(tmp_path / "c.ply")["RGB"], bytes_[:, :3])


@pytest.mark.parametrize("kind", ["float", "double", "int", "uint"])
def test_colors_of_ply_are_bytes_by_one_rule(tmp_path, kind):
    whole = kind in ("int", "uint")
    scale = 1 if whole else 255.0
    shown = [[100 * at if whole else 100 * at / scale, 255 if whole else 1.0] for at in range(3)]
    rows = "".join(f"{at} 0 {at * at} {red!r} 0 {blue!r}\n" for at, (red, blue) in enumerate(shown))
    colors = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    places = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex 3\n{places}{colors}"
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(f"{head}{faces}{rows}3 0 1 2\n")
    mesh = gk.mesh.load(tmp_path / "a.ply")
    assert mesh.vertex_data["color"].dtype == np.uint8
    np.testing.assert_array_equal(mesh.vertex_data["color"], [[100 * at, 0, 255] for at in range(3)])
    given = np.array([[100 * at, 0, 255] for at in range(3)]) / scale
    given = given.astype({"float": "f4", "double": "f8", "int": "i4", "uint": "u4"}[kind])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gk.mesh.save(tmp_path / "b.ply", TriangleMesh(np.eye(3), [[0, 1, 2]], vertex_data={"color": given}))
    assert b"property uchar red" in (tmp_path / "b.ply").read_bytes()


def test_colors_that_ply_shows_wrong_elsewhere_are_told(tmp_path):
    mesh = TriangleMesh(np.eye(3), [[0, 1, 2]], vertex_data={"color": np.full((3, 3), 40000, np.uint16)})
    with pytest.warns(UserWarning, match=r"'color' of uint16 is kept.* in Python: np.rint\(color / 65535 \* 255\)"):
        gk.mesh.save(tmp_path / "a.ply", mesh)
    with pytest.warns(UserWarning, match="'rgb' of float64 is kept"):
        gk.points.save(tmp_path / "b.ply", np.eye(3), data={"rgb": np.full((3, 3), 0.3)})


@pytest.mark.parametrize(("kind", "read"), [("int", np.uint8), ("float", np.uint8), ("ushort", np.uint16)])
def test_ply_colors_from_0_to_255_of_wider_types_are_bytes(tmp_path, kind, read):
    colors = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        f"{colors}element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 0 128 255\n1 0 0 1 2 3\n0 1 0 4 5 6\n3 0 1 2\n"
    )
    mesh, cloud = gk.mesh.load(tmp_path / "a.ply"), gk.points.load(tmp_path / "a.ply")
    for found in (mesh.vertex_data["color"], cloud.data["rgb"]):
        assert found.dtype == read
        assert found[0].tolist() == [0, 128, 255]


@pytest.mark.slow
def test_xdmf_keeps_all_digits_of_float32(tmp_path):
    values = np.random.default_rng(0).random(TORUS.vertex_count).astype(np.float32)
    mesh = TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data={"a": values})
    again, _ = saved(mesh, tmp_path / "a.xdmf")
    assert again.vertex_data["a"].dtype == np.float32
    np.testing.assert_array_equal(again.vertex_data["a"], values)


@pytest.mark.slow
def test_integers_that_a_float64_does_not_hold_are_left_out_of_msh(tmp_path):
    for most, said in ((2**53, []), (2**53 + 1, ["vertex 'a'"])):
        values = np.arange(TORUS.vertex_count) + most - TORUS.vertex_count + 1
        again, lost = saved(TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data={"a": values}), tmp_path / "a.msh")
        assert [name for name in said if name in " ".join(lost)] == said
        assert len(lost) == len(said)
        assert said or np.array_equal(again.vertex_data["a"], values)


@pytest.mark.slow
def test_one_name_on_several_elements_of_usd(tmp_path):
    vertex, face, corner = ((len(TORUS.vertices),), (len(TORUS.faces),), (len(TORUS.faces), 3))
    rng = np.random.default_rng(1)
    mesh = TriangleMesh(
        TORUS.vertices,
        TORUS.faces,
        vertex_data={"color": rng.random((*vertex, 3)), "a": rng.random(vertex), "uv": rng.random((*vertex, 2))},
        face_data={"color": rng.random((*face, 3)), "a": rng.random(face)},
        corner_data={"a": rng.random(corner), "uv": rng.random((*corner, 2))},
    )
    again, lost = saved(mesh, tmp_path / "a.usda")
    assert not lost
    for name in ("vertex_data", "face_data", "corner_data"):
        given, found = getattr(mesh, name), getattr(again, name)
        assert found.keys() == given.keys()
        for key, values in given.items():
            np.testing.assert_allclose(found[key], values, atol=1e-7)
    # Names that become one.
    names = {sign: rng.random(vertex) for sign in ("a b", "a-b", "a_b", "a+b")}
    again, _ = saved(TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data=names), tmp_path / "b.usda")
    assert {values.tobytes() for values in again.vertex_data.values()} == {each.tobytes() for each in names.values()}


OBJ = """mtllib a.mtl
v 0 0 0 1 0 0
v 1 0 0 0 1 0
v 1 1 0 0 0 1
v 0 1 0 0.5 0.5 0.5
vt 0 0
vt 1 0 0
vt 1 1
vt 0.5 0.5
vn 0 0 1
f 1/1/1 2/2/1 3/3/1 4/-1/-1
usemtl wood
f 1//1 2//1 3//1
usemtl my red
f 1/1 2/2 3/3 # a comment
f 1 2 3
usemtl
f 2 3 4
"""


def test_obj_with_all_kinds_of_corners(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text(
        "newmtl my red\nKd 1 0 0\nTr 0.75\nnewmtl unused\nmap_Kd nothing.png\n"
        "newmtl\twood\t\nKa 1 1 1\nmap_Kd -s 2 2 1 -clamp on my wood.png\nd 0.5\n"
    )
    (tmp_path / "my wood.png").write_bytes(PNG)
    mesh = gk.mesh.load(tmp_path / "a.obj")
    assert mesh.vertex_data["color"].tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0.5]]
    uv, normal = mesh.corner_data["uv"], mesh.corner_data["normal"]
    assert uv[:2].tolist() == [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0.5, 0.5]]]
    assert np.isnan(uv[2]).all()
    np.testing.assert_array_equal(uv[3], uv[0])
    assert np.isnan(uv[4:]).all()
    assert (normal[:3] == [0, 0, 1]).all()
    assert np.isnan(normal[3:]).all()
    assert mesh.face_data["material"].tolist() == [-1, -1, 0, 1, 1, -1]
    assert mesh.materials == (
        Material("wood", (1.0, 1.0, 1.0, 0.5), Texture("my wood.png", PNG)),
        Material("my red", (1.0, 0.0, 0.0, 0.25)),
    )
    gk.mesh.save(tmp_path / "b c.obj", mesh)
    again = gk.mesh.load(tmp_path / "b c.obj")
    assert {path.name for path in tmp_path.iterdir()} >= {"b_c.mtl", "b_c_my_wood.png"}
    np.testing.assert_array_equal(again.corner_data["uv"], uv)
    np.testing.assert_array_equal(again.corner_data["normal"], normal)
    np.testing.assert_array_equal(again.face_data["material"], mesh.face_data["material"])
    assert [material.color for material in again.materials] == [material.color for material in mesh.materials]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("4/-1/-1", "4/9/1"), r"'uv' is left out: corner 3 refers to number 9 of 4 vt"),
        (("4/-1/-1", "4/-9/1"), r"'uv' is left out: corner 3 refers to number -4 of 4 vt"),
        (("vn 0 0 1", "vn 0 0"), r"'normal' is left out: row 0 of vn has too few numbers"),
        (("vt 0.5 0.5", "vt 0.5 x"), r"'uv' is left out: 'x'"),
    ],
)
def test_damaged_references_of_an_obj_leave_the_geometry(tmp_path, change, message):
    (tmp_path / "a.obj").write_text(OBJ.replace("mtllib a.mtl", "").replace(*change))
    with pytest.warns(UserWarning, match=message):
        mesh = gk.mesh.load(tmp_path / "a.obj")
    assert mesh.face_count == 6
    assert len(mesh.corner_data) == 1


def test_colors_that_are_no_numbers(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl wood\nKd nan 0 0\nnewmtl my red\nKd 1 0 0\n")
    (tmp_path / "a.obj").write_text(OBJ)
    with pytest.warns(UserWarning, match="the color of material 'wood' is left out"):
        first, second = gk.mesh.load(tmp_path / "a.obj").materials
    assert (first.color, second.color) == (None, (1.0, 0.0, 0.0, 1.0))
    # As JSON of glTF they would be no JSON.
    for changed, named in ({"color": (np.nan, 0, 0, 1)}, r"\[0\].color"), ({"alpha_cutoff": np.inf}, "alpha_cutoff"):
        with pytest.raises(gk.InputError, match=f"materials.*{named}"):
            TriangleMesh(np.eye(3), [[0, 1, 2]], materials=[Material("m")._replace(**changed)])


def test_a_library_whose_name_is_too_long_leaves_the_geometry(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ.replace("a.mtl", "x" * 5000))
    with pytest.warns(UserWarning, match="materials have only their names"):
        assert gk.mesh.load(tmp_path / "a.obj").face_count == 6


def test_files_that_an_obj_lacks_are_named_and_none_outside_is_read(tmp_path):
    folder = tmp_path / "here"
    folder.mkdir()
    (folder / "a.obj").write_text(OBJ)
    with pytest.warns(UserWarning, match=r"a\.obj: 'a\.mtl' is missing: materials have only their names"):
        assert [material.name for material in gk.mesh.load(folder / "a.obj").materials] == ["wood", "my red"]
    (tmp_path / "wood.png").write_bytes(PNG)
    (folder / "a.mtl").write_text("newmtl wood\nmap_Kd ..\\wood.png\nmap_Bump b.png\nnewmtl my red\nmap_Kd c.png\n")
    expected = r"outside its own folder.*its texture is left out.*'c.png' is missing.*not map_bump"
    with pytest.warns(UserWarning, match=expected):
        assert gk.mesh.load(folder / "a.obj").materials[0].texture is None
    with pytest.warns(UserWarning, match="'c.png' is missing"):
        mesh = gk.mesh.load(folder / "a.obj", reference_folders=[tmp_path])
    assert mesh.materials[0].texture == Texture("wood.png", PNG)
    (folder / "a.mtl").unlink()
    os.mkfifo(folder / "a.mtl")
    with pytest.warns(UserWarning, match=r"a\.mtl', which is not a regular file"):
        gk.mesh.load(folder / "a.obj")


def test_a_full_disk_keeps_the_library_and_the_images_of_an_obj(tmp_path, monkeypatch):
    old = {"a.obj": b"mtllib a.mtl\n", "a.mtl": b"old"}
    for name, content in old.items():
        (tmp_path / name).write_bytes(content)
    mesh = TriangleMesh(
        np.eye(3),
        [[0, 1, 2]],
        vertex_data={"uv": np.zeros((3, 2))},
        face_data={"material": np.zeros(1, int)},
        materials=[Material("wood", None, Texture("wood.png", PNG))],
    )
    write = type(tmp_path).write_bytes
    library = b"# by geokit\nnewmtl wood\nmap_Kd a_wood.png\n"
    for last, named in ((PNG, "a_wood.png"), (library, "a.mtl")):

        def until(path, data, last=last):
            if data == last:
                raise OSError(errno.ENOSPC, "No space left on device")
            return write(path, data)

        monkeypatch.setattr(type(tmp_path), "write_bytes", until)
        with pytest.raises(gk.FileAccessError, match=rf"{re.escape(named)}: writing failed"):
            gk.mesh.save(tmp_path / "a.obj", mesh)
        assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == old


def test_images_of_one_name_become_two_files(tmp_path):
    other = PNG + b"\0"
    materials = [Material("a", None, Texture("t.png", PNG)), Material("a", None, Texture("t.png", other))]
    materials.append(Material("c", None, Texture("x/t.png", PNG)))
    faces = {"material": np.arange(60) % 3}
    gk.mesh.save(tmp_path / "m.obj", TriangleMesh(TORUS.vertices, TORUS.faces, face_data=faces, materials=materials))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.mtl", "m.obj", "m_t.png", "m_t_2.png"]
    again = gk.mesh.load(tmp_path / "m.obj").materials
    assert [material.texture.data for material in again] == [PNG, other, PNG]
    assert [material.name for material in again] == ["a", "a_2", "c"]


@pytest.mark.parametrize(
    ("head", "rows", "expected"),
    [
        ("COFF", ["255 0 0 255", "0 255 0 255", "0 0 255 9"], [[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 9]]),
        ("COFF", ["1 0 0", "0 1 0", "0 0 0.5"], [[1, 0, 0], [0, 1, 0], [0, 0, 0.5]]),
    ],
)
def test_off_with_colors(tmp_path, head, rows, expected):
    points = ["0 0 0", "1 0 0", "0 1 0"]
    text = (
        f"{head}\n3 1 0\n" + "".join(f"{a} {b}\n" for a, b in zip(points, rows, strict=True)) + "3 0 1 2 0.5 0.25 1\n"
    )
    (tmp_path / "a.off").write_text(text)
    mesh = gk.mesh.load(tmp_path / "a.off")
    assert mesh.vertex_data["color"].tolist() == expected
    assert mesh.face_data["color"].tolist() == [[0.5, 0.25, 1.0]]


def test_off_whose_lines_are_not_as_its_header_says(tmp_path):
    (tmp_path / "a.off").write_text("NOFF\n3 2 0\n0 0 0 1 0 0\n1 0 0\n0 1 0 1 0 0\n3 0 1 2 255 0 0\n3 0 2 1\n")
    with pytest.warns(UserWarning, match="the attributes of vertices are left out.*; the colors of faces are left out"):
        assert not gk.mesh.load(tmp_path / "a.off").vertex_data
    # Colors, as many programs write them without a word in the header.
    (tmp_path / "b.off").write_text("OFF\n3 1 0\n0 0 0 9 9 9\n1 0 0 9 9 9\n0 1 0 9 9 9\n3 0 1 2\n")
    with pytest.warns(UserWarning, match="the attributes of vertices are left out: their lines are not as long as"):
        assert not gk.mesh.load(tmp_path / "b.off").vertex_data


def glb_parts(data: bytes) -> tuple[dict, bytes]:
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def test_glb_holds_the_bytes_of_the_image_once(tmp_path):
    mesh = painted(TORUS)
    twice = TriangleMesh(**{**vars(mesh), "materials": (mesh.materials[1], mesh.materials[1])})
    gk.mesh.save(tmp_path / "a.glb", twice)
    header, binary = glb_parts((tmp_path / "a.glb").read_bytes())
    assert [image["mimeType"] for image in header["images"]] == ["image/png"]
    assert binary.count(PNG) == 1
    assert header["meshes"][0]["primitives"][0]["material"] == 0
    tga = Material("a", None, Texture("a.tga", b"not one of them"))
    with pytest.warns(UserWarning, match=r"does not hold the texture 'a\.tga', the texture 'a\.tga'; left out"):
        gk.mesh.save(tmp_path / "b.glb", TriangleMesh(**{**vars(mesh), "materials": (tga, tga)}))


@pytest.mark.slow
def test_glb_of_geokit_in_trimesh(tmp_path):
    import trimesh

    mesh = painted(TORUS)
    gk.mesh.save(tmp_path / "a.glb", mesh)
    scene = trimesh.load_scene(tmp_path / "a.glb", process=False)
    assert sum(len(part.faces) for part in scene.geometry.values()) == 60
    for number, part in enumerate(scene.geometry.values()):
        rows = mesh.face_data["material"] == number
        np.testing.assert_allclose(part.triangles, mesh.vertices[mesh.faces[rows]], atol=1e-6)
        np.testing.assert_allclose(part.visual.uv[part.faces], mesh.corner_data["uv"][rows], atol=6e-8)
        normals = mesh.vertex_data["normal"][mesh.faces[rows]]
        np.testing.assert_allclose(part.vertex_normals[part.faces], normals, atol=1e-6)
        colors = part.visual.vertex_attributes["color"][part.faces]
        np.testing.assert_array_equal(colors, mesh.vertex_data["color"][mesh.faces[rows]])
        assert part.visual.material.name == mesh.materials[number].name
    assert scene.geometry["a_1" if "a_1" in scene.geometry else list(scene.geometry)[1]].visual.material


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".glb", ".gltf"])
def test_gltf_of_trimesh(tmp_path, kind):
    import trimesh
    from PIL import Image

    uv = np.random.default_rng(1).random((30, 2))
    image = Image.new("RGB", (2, 2), (255, 128, 0))
    surface = trimesh.visual.material.PBRMaterial(
        name="painted", baseColorFactor=[255, 0, 0, 255], baseColorTexture=image, normalTexture=image
    )
    mesh = trimesh.Trimesh(TORUS.vertices, TORUS.faces, process=False, vertex_normals=TORUS.vertices)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=surface)
    mesh.vertex_attributes["_heat"] = np.arange(30, dtype=np.float32)
    if kind == ".glb":
        (tmp_path / "a.glb").write_bytes(trimesh.Scene(mesh).export(file_type="glb", include_normals=True))
    else:
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh), include_normals=True).items():
            (tmp_path / name.replace("model", "a")).write_bytes(data)
    with pytest.warns(UserWarning, match="of its textures only those of the base color are read"):
        again = gk.mesh.load(tmp_path / f"a{kind}")
    np.testing.assert_allclose(again.vertex_data["uv"], uv, atol=6e-8)
    np.testing.assert_array_equal(again.vertex_data["heat"], np.arange(30))
    expected = TORUS.vertices / np.linalg.norm(TORUS.vertices, axis=1, keepdims=True)
    np.testing.assert_allclose(again.vertex_data["normal"], expected, atol=1e-6)
    (material,) = again.materials
    assert (material.name, material.color) == ("painted", (1.0, 0.0, 0.0, 1.0))
    assert material.texture.data.startswith(b"\x89PNG")
    assert again.face_data["material"].tolist() == [0] * 60


@pytest.mark.slow
def test_bodies_of_a_scene_are_joined(tmp_path):
    """One body with colors of three channels and a turned frame, one with four, one without."""
    import trimesh

    turn = np.array([[0, -2, 0, 5], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]], float)
    box = mesh_catalog.moved(mesh_catalog.box(), (1, 2, 3))
    scene = trimesh.Scene()
    for name, attributes in (
        ("rgb", {"_C": np.full((8, 3), 0.5, np.float32), "_N": box.vertices.astype(np.float32), "_own": np.ones(8)}),
        ("rgba", {"_C": np.full((8, 4), 0.25, np.float32)}),
        ("none", {"_own": np.ones((8, 2), np.float32)}),
    ):
        part = trimesh.Trimesh(box.vertices, box.faces, process=False, vertex_attributes=attributes)
        scene.add_geometry(part, node_name=name, geom_name=name, transform=turn if name == "rgb" else np.eye(4))

    def named(tree):
        for mesh in tree["meshes"]:
            names = {"_C": "COLOR_0", "_N": "NORMAL"}
            (part,) = mesh["primitives"]
            part["attributes"] = {names.get(name, name): at for name, at in part["attributes"].items()}

    (tmp_path / "a.glb").write_bytes(trimesh.exchange.gltf.export_glb(scene, tree_postprocessor=named))
    with pytest.warns(UserWarning, match="the array 'own' is left out: it has not the same width in all bodies"):
        mesh = gk.mesh.load(tmp_path / "a.glb")
    first = {part.name: mesh.faces[part.first_face : part.first_face + part.face_count].min() for part in mesh.parts}
    rows = {name: mesh.vertex_data["color"][at : at + 8] for name, at in first.items()}
    assert (rows["rgb"] == [0.5, 0.5, 0.5, 1.0]).all()
    assert (rows["rgba"] == 0.25).all()
    assert np.isnan(rows["none"]).all()
    normal = mesh.vertex_data["normal"][first["rgb"] : first["rgb"] + 8]
    expected = box.vertices @ np.linalg.inv(turn[:3, :3])
    expected *= np.linalg.norm(box.vertices, axis=1, keepdims=True) / np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(normal, expected, atol=1e-6)
    assert np.isnan(mesh.vertex_data["normal"][first["none"]]).all()


@pytest.mark.slow
def test_primvars_of_usd(tmp_path):
    from pxr import Sdf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.0254)
    prim = UsdGeom.Mesh.Define(stage, "/square")
    prim.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    prim.CreateFaceVertexCountsAttr([4])
    prim.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    prim.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    prim.CreateNormalsAttr([(0, 0, 1)] * 4)
    prim.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    primvars = UsdGeom.PrimvarsAPI(prim)
    primvars.CreatePrimvar("map1", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying").Set([(0, 0), (1, 0), (1, 1)])
    primvars.GetPrimvar("map1").SetIndices([0, 1, 2, 0])
    primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "constant").Set([(1, 0.5, 0)])
    primvars.CreatePrimvar("heat", Sdf.ValueTypeNames.HalfArray, "vertex").Set([1, 2, 3, 4])
    primvars.CreatePrimvar("names", Sdf.ValueTypeNames.StringArray, "vertex").Set(["a", "b", "c", "d"])
    primvars.CreatePrimvar("short", Sdf.ValueTypeNames.FloatArray, "vertex").Set([1])
    stage.GetRootLayer().Save()
    with pytest.warns(UserWarning, match="the array 'short' of /square is left out: it has 1 rows for 4$"):
        mesh = gk.mesh.load(tmp_path / "a.usda")
    assert mesh.faces.tolist() == [[2, 1, 0], [3, 2, 0]]
    assert mesh.corner_data["uv"].tolist() == [[[1, 1], [1, 0], [0, 0]], [[0, 0], [1, 1], [0, 0]]]
    assert mesh.corner_data["normal"].tolist() == [[[0, 0, 1]] * 3] * 2
    assert mesh.face_data["color"].tolist() == [[1, 0.5, 0]] * 2
    assert mesh.vertex_data["heat"].tolist() == [1, 2, 3, 4]
    assert mesh.meters_per_unit == 0.0254
    assert set(mesh.vertex_data) == {"heat"}


@pytest.mark.slow
def test_vtk_marks_normals_and_texture_coordinates(tmp_path):
    import pyvista

    mesh = painted(TORUS)
    with pytest.warns(UserWarning, match="materials"):
        gk.mesh.save(tmp_path / "a.vtp", mesh)
    found = pyvista.read(tmp_path / "a.vtp")
    assert found.point_data.active_normals_name == "normal"
    assert found.point_data.active_texture_coordinates_name == "uv"
    theirs = pyvista.Sphere(theta_resolution=8, phi_resolution=8)
    theirs.texture_map_to_sphere(inplace=True)
    theirs.cell_data["rank"] = np.arange(theirs.n_cells)
    theirs.save(tmp_path / "b.vtp")
    again = gk.mesh.load(tmp_path / "b.vtp")
    np.testing.assert_array_equal(again.vertex_data["normal"], theirs.point_data["Normals"])
    np.testing.assert_array_equal(again.vertex_data["uv"], theirs.active_texture_coordinates)
    np.testing.assert_array_equal(again.face_data["rank"], np.arange(theirs.n_cells))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".vtk", ".vtp", ".vtu"])
@pytest.mark.parametrize("number", [np.inf, np.nan, 1e200, 2**60])
def test_rows_whose_length_is_no_number(tmp_path, kind, number):
    rows = np.full((TORUS.vertex_count, 3), number)
    mesh = TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data={"v": rows})
    again, said = saved(mesh, tmp_path / f"a{kind}")
    assert not said
    np.testing.assert_array_equal(again.vertex_data["v"], rows)
    # As VTK itself writes them, with a note that its readers refuse.
    pyvista = pytest.importorskip("pyvista")
    surface = pyvista.PolyData.from_regular_faces(TORUS.vertices, TORUS.faces)
    surface["v"] = rows
    (surface.cast_to_unstructured_grid() if kind == ".vtu" else surface).save(tmp_path / f"b{kind}")
    np.testing.assert_array_equal(gk.mesh.load(tmp_path / f"b{kind}").vertex_data["v"], rows)
    if kind == ".vtp":
        np.testing.assert_array_equal(gk.points.load(tmp_path / "b.vtp").data["v"], rows)
        gk.points.save(tmp_path / "c.vtp", TORUS.vertices, data={"v": rows})
        assert b"L2_NORM" not in (tmp_path / "c.vtp").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".msh", ".vtp", ".vtu", ".xdmf"])
def test_names_that_are_no_text_of_xml(tmp_path, kind):
    names = ["a<b", "a>b", "a&b", 'a"b', "a\nb", "\x01", "ä€"]
    data = {name: np.full(TORUS.vertex_count, float(at)) for at, name in enumerate(names)}
    again, _ = saved(TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data=data), tmp_path / f"a{kind}")
    quote = "_" if kind in (".msh", ".xdmf") else '"'
    expected = {"a<b": 0, "a>b": 1, "a&b": 2, f"a{quote}b": 3, "a_b_" if quote == "_" else "a_b": 4, "_": 5, "ä€": 6}
    assert {name: values[0] for name, values in again.vertex_data.items()} == expected
    if kind == ".vtp":
        gk.points.save(tmp_path / "b.vtp", TORUS.vertices, data=data)
        assert gk.points.load(tmp_path / "b.vtp").data.keys() == expected.keys()


@pytest.mark.slow
def test_cells_keep_their_rows_beside_lines_and_strips(tmp_path):
    import pyvista

    points = np.random.default_rng(3).random((6, 3))
    mixed = pyvista.PolyData(points, faces=[3, 0, 1, 2], lines=[2, 0, 1, 2, 3, 4], strips=[4, 0, 1, 2, 3])
    mixed.cell_data["row"] = np.arange(mixed.n_cells)
    mixed.save(tmp_path / "a.vtp")
    with pytest.warns(UserWarning, match=r"its lines \(2\) are left out"):
        assert gk.mesh.load(tmp_path / "a.vtp").face_data["row"].tolist() == [2, 3, 3]


@pytest.mark.slow
def test_physical_groups_of_gmsh(tmp_path):
    import meshio

    content = meshio.Mesh(
        TORUS.vertices,
        [("triangle", TORUS.faces[:40]), ("triangle", TORUS.faces[40:])],
        cell_data={name: [np.full(40, 1), np.full(20, 2)] for name in ("gmsh:physical", "gmsh:geometrical")},
    )
    meshio.write(tmp_path / "a.msh", content, file_format="gmsh22")
    mesh = gk.mesh.load(tmp_path / "a.msh")
    assert list(mesh.face_data) == ["physical"]
    assert mesh.face_data["physical"].tolist() == [1] * 40 + [2] * 20


def test_an_alpha_cutoff_that_mtl_cannot_hold_is_said_once(tmp_path):
    materials = [gk.mesh.Material("leaf", (0.0, 1.0, 0.0, 0.7), alpha_cutoff=0.5), gk.mesh.Material("wall")]
    box = gk.mesh.box()
    rows = np.arange(box.face_count) % 2
    mesh = gk.mesh.TriangleMesh(box.vertices, box.faces, face_data={"material": rows}, materials=materials)
    with pytest.warns(UserWarning, match=r"\.obj does not hold the alpha cutoff of material 'leaf'; left out") as said:
        gk.mesh.save(tmp_path / "a.obj", mesh)
    assert len(said) == 1
    assert gk.mesh.load(tmp_path / "a.obj").materials[0].color == (0.0, 1.0, 0.0, 0.7)
    # Opaque whatever the alpha: that is what .mtl can say.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opaque = [material._replace(alpha_cutoff=0.0) for material in materials]
        gk.mesh.save(
            tmp_path / "b.obj",
            gk.mesh.TriangleMesh(box.vertices, box.faces, face_data={"material": rows}, materials=opaque),
        )
    assert gk.mesh.load(tmp_path / "b.obj").materials[0].color[3] == 1.0
