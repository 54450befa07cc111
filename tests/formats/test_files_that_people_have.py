"""Files of kinds that real collections are full of; each is written here as its program writes it."""

from __future__ import annotations

import base64
import contextlib
import json
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit import native
from geokit.formats.table import extensions

BOX = mesh_catalog.box()


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# --- glTF ------------------------------------------------------------------------------------------------------------

TETRAHEDRON = np.array([[0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]])
FACES = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}


def scene(
    kind: str = "f4", *, required: Any = (), node: Any = None, mode: int = 4, **accessor: Any
) -> tuple[Any, bytes]:
    """Tree and buffer of a tetrahedron, with rows of positions that begin at multiples of four bytes."""
    rows = TETRAHEDRON.astype("<" + kind)
    step = -(-3 * rows.itemsize // 4) * 4
    body = np.zeros((4, step), np.uint8)
    body[:, : 3 * rows.itemsize] = rows.view(np.uint8).reshape(4, -1)
    content = body.tobytes() + np.array(FACES, "<u2").tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}],
        "accessors": [
            {"bufferView": 0, "componentType": CODES[kind], "count": 4, "type": "VEC3", **accessor},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 4 * step, "byteStride": step},
            {"buffer": 0, "byteOffset": 4 * step, "byteLength": 24},
        ],
        "buffers": [{"byteLength": len(content)}],
        "extensionsRequired": list(required),
        "extensionsUsed": list(required),
    }
    return tree, content


def glb(path: Path, tree: Any, content: bytes) -> Path:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(content), 0x004E4942) + content
    return write(path, struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts)


@pytest.mark.parametrize(
    "name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression", "ACME_anything"]
)
def test_required_extensions_that_are_not_understood(tmp_path: Path, name: str) -> None:
    path = glb(tmp_path / "a.glb", *scene(required=[name]))
    with pytest.raises(gk.FileFormatError, match=f"requires the glTF extension '{name}', which is not read; export"):
        gk.mesh.load(path)


def test_a_compressed_mesh_as_its_exporter_writes_it(tmp_path: Path) -> None:
    # Accessors of compressed meshes have no buffer: trimesh gives their vertices as zeros.
    tree, content = scene(required=["KHR_draco_mesh_compression"])
    for accessor in tree["accessors"]:
        del accessor["bufferView"]
    places = {"bufferView": 0, "attributes": {"POSITION": 0}}
    tree["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": places}
    with pytest.raises(gk.FileFormatError, match="KHR_draco_mesh_compression"):
        gk.mesh.load(glb(tmp_path / "a.glb", tree, content))


def test_required_extensions_of_looks_are_none_of_a_mesh(tmp_path: Path) -> None:
    path = glb(
        tmp_path / "a.glb", *scene(required=["KHR_materials_unlit", "KHR_texture_transform", "EXT_texture_webp"])
    )
    np.testing.assert_array_equal(gk.mesh.load(path).vertices, TETRAHEDRON)


def test_a_file_that_names_no_scene_has_one_of_all_nodes(tmp_path: Path) -> None:
    tree, content = scene()
    del tree["scenes"]
    tree["nodes"] = [{"mesh": 0, "children": [1]}, {"mesh": 0, "translation": [5, 0, 0]}]
    mesh = gk.mesh.load(glb(tmp_path / "a.glb", tree, content))
    np.testing.assert_array_equal(mesh.vertices, np.concatenate([TETRAHEDRON, TETRAHEDRON + np.array([5, 0, 0])]))


def test_diffuse_colors_of_the_older_materials_are_base_colors(tmp_path: Path) -> None:
    tree, content = scene(required=["KHR_materials_pbrSpecularGlossiness"])
    old = {"diffuseFactor": [0.25, 0.5, 0.75, 1.0], "glossinessFactor": 0.5}
    tree["materials"] = [{"name": "m", "extensions": {"KHR_materials_pbrSpecularGlossiness": old}}]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    assert gk.mesh.load(glb(tmp_path / "a.glb", tree, content)).materials[0].color == (0.25, 0.5, 0.75, 1.0)


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2"])
@pytest.mark.parametrize("normalized", [False, True])
def test_quantized_positions(tmp_path: Path, kind: str, normalized: bool) -> None:
    most = np.iinfo(kind).max
    tree, content = scene(kind, required=["KHR_mesh_quantization"], normalized=normalized, node={"scale": [2.0] * 3})
    expected = TETRAHEDRON * (2.0 / most if normalized else 2.0)
    np.testing.assert_allclose(gk.mesh.load(glb(tmp_path / "a.glb", tree, content)).vertices, expected, rtol=1e-7)
    # The same with its buffer in another file.
    tree["buffers"][0]["uri"] = "my%20buffer.bin"
    write(tmp_path / "my buffer.bin", content)
    path = write(tmp_path / "a.gltf", json.dumps(tree))
    np.testing.assert_allclose(gk.mesh.load(path).vertices, expected, rtol=1e-7)


def test_what_would_be_lost_is_refused(tmp_path: Path) -> None:
    with pytest.raises(gk.FileFormatError, match="has levels of detail"):
        gk.mesh.load(glb(tmp_path / "a.glb", *scene(node={"extensions": {"MSFT_lod": {"ids": [1]}}})))


def test_another_version_is_not_called_damaged(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gltf", json.dumps({"asset": {"version": "1.0"}, "meshes": {}}))
    with pytest.raises(gk.FileFormatError, match=r"is glTF 1\.0, and only 2 is read") as error:
        gk.mesh.load(path)
    assert "damaged" not in str(error.value)
    # Its binary form has another header.
    (tmp_path / "a.glb").write_bytes(b"glTF" + struct.pack("<4I", 1, 22, 2, 0) + b"{}")
    with pytest.raises(gk.FileFormatError, match=r"is glTF 1, and only 2 is read; convert it"):
        gk.mesh.load(tmp_path / "a.glb")


def test_what_readers_warn_of_reaches_the_user(tmp_path: Path) -> None:
    from geokit.formats.reader.warnings import collected

    with collected() as found:
        import logging

        logging.getLogger("trimesh").warning("placeholder %s", "zeros")
        warnings.warn("two\nlines", UserWarning, stacklevel=1)
        warnings.warn("for developers", DeprecationWarning, stacklevel=1)
        import sys

        print("Warning: printed by\nmeshio", file=sys.stderr)
    assert found == ["placeholder zeros", "two lines", "printed by meshio"]


def test_what_vtk_warns_of_reaches_the_user(tmp_path: Path) -> None:
    # Legacy files of later versions are read as far as they are understood.
    text = "# vtk DataFile Version 9.7\nx\nASCII\nDATASET POLYDATA\nPOINTS 3 float\n0 0 0 1 0 0 0 1 0\n"
    text += "POLYGONS 2 3\nOFFSETS vtktypeint64\n0 3\n"
    text += "CONNECTIVITY vtktypeint64\n0 1 2\n"
    path = write(tmp_path / "a.vtk", text)
    with pytest.warns(UserWarning, match=r"a\.vtk: Reading file version: 9\.7 with older reader version \S+$"):
        assert gk.mesh.load(path).face_count == 1


# --- clones without large files, and files of no bytes ---------------------------------------------------------------

POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'ab' * 32}\nsize 12345\n"


@pytest.mark.parametrize("kind", extensions("mesh", "r"))
def test_pointers_of_git_in_place_of_meshes(tmp_path: Path, kind: str) -> None:
    with pytest.raises(
        gk.FileFormatError, match="is a Git LFS pointer, not the file itself; get it with: git lfs pull"
    ):
        gk.mesh.load(write(tmp_path / f"a{kind}", POINTER))


@pytest.mark.parametrize("kind", extensions("points", "r"))
def test_pointers_of_git_in_place_of_clouds(tmp_path: Path, kind: str) -> None:
    with pytest.raises(gk.FileFormatError, match="Git LFS pointer"):
        gk.points.load(write(tmp_path / f"a{kind}", POINTER))


@pytest.mark.parametrize("kind", [".vdb", ".nvdb"])
def test_pointers_of_git_in_place_of_volumes(tmp_path: Path, kind: str) -> None:
    if kind == ".vdb" and not native.available():
        pytest.skip("built without OpenVDB")
    for ask in (gk.volume.load, gk.volume.inspect):
        with pytest.raises(gk.FileFormatError, match="Git LFS pointer"):
            ask(write(tmp_path / f"a{kind}", POINTER))
        with pytest.raises(gk.FileFormatError, match="empty"):
            ask(write(tmp_path / f"b{kind}", ""))


@pytest.mark.slow
def test_a_pointer_in_place_of_a_buffer(tmp_path: Path) -> None:
    tree, _ = scene()
    tree["buffers"][0]["uri"] = "a.bin"
    write(tmp_path / "a.bin", POINTER)
    with pytest.raises(gk.FileFormatError, match=r"a\.bin: is a Git LFS pointer"):
        gk.mesh.load(write(tmp_path / "a.gltf", json.dumps(tree)))


@pytest.mark.parametrize("kind", extensions("points", "r"))
def test_empty_clouds(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path / f"a{kind}", "")
    if kind in (".csv", ".txt", ".xyz"):
        assert len(gk.points.load(path)) == 0
        return
    with pytest.raises(gk.FileFormatError, match="is empty; get a whole copy"):
        gk.points.load(path)


@pytest.mark.parametrize("kind", [".vtk", ".vtp", ".vtu"])
def test_errors_of_vtk_show_no_addresses(tmp_path: Path, kind: str) -> None:
    with pytest.raises(gk.FileFormatError, match=r"cannot be read \(") as error:
        gk.mesh.load(write(tmp_path / f"a{kind}", "nothing of this kind\n" * 9))
    assert "0x" not in str(error.value)
    assert "vtkInformation" not in str(error.value)


# --- faces -----------------------------------------------------------------------------------------------------------


def test_off_faces_over_several_lines(tmp_path: Path) -> None:
    # As libigl's tutorial has them: a line for the count, and one for each corner or several.
    text = "OFF\n4 3 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4\n0 1\n2 3\n3 0 1 2 255 0 0\n3\n0\n2\n3\n"
    with pytest.warns(UserWarning, match="the colors of faces are left out: not each face has one"):
        mesh = gk.mesh.load(write(tmp_path / "a.off", text))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 3]]
    with pytest.raises(gk.FileFormatError, match=r"truncated|fewer corners"):
        gk.mesh.load(write(tmp_path / "b.off", text[:-4]))


def test_off_counts_right_behind_the_header(tmp_path: Path) -> None:
    text = "OFF3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    assert gk.mesh.load(write(tmp_path / "a.off", text)).face_count == 1


def _strips(encoding: str) -> bytes:
    """A square of four triangles in one list of two strips, and a strip that two equal corners join."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0]], "<f4")
    strip = np.array([0, 1, 2, 3, -1, 2, 3, 3, 4, 5], "<i4")
    head = f"ply\nformat {encoding} 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    if encoding == "ascii":
        rows = "\n".join(" ".join(map(str, row)) for row in vertices.tolist())
        return (head + rows + f"\n{len(strip)} " + " ".join(map(str, strip.tolist())) + "\n").encode()
    return head.encode() + vertices.tobytes() + struct.pack("<i", len(strip)) + strip.tobytes()


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply_of_triangle_strips(tmp_path: Path, encoding: str) -> None:
    path = write(tmp_path / "a.ply", _strips(encoding))
    mesh = gk.mesh.load(path)
    # The stitch 2 3 3 | 3 3 4 has no faces, and keeps the count of turns: 3 4 5 is the fourth, and is turned.
    assert mesh.faces.tolist() == [[0, 1, 2], [2, 1, 3], [3, 4, 5]]
    from geokit.cli._kinds import kind_of_input

    assert kind_of_input(path) == "mesh"


def test_ply_strips_agree_with_trimesh_on_winding(tmp_path: Path) -> None:
    # A cube as one strip, from the literature: closed and oriented.
    cube = [6, 7, 4, 5, 1, 7, 3, 6, 2, 4, 0, 1, 2, 3]
    corners = np.array([[x, y, z] for y in (0, 1) for z in (0, 1) for x in (0, 1)], "<f4")
    head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    rows = "\n".join(" ".join(map(str, row)) for row in corners.tolist())
    mesh = gk.mesh.load(write(tmp_path / "a.ply", f"{head}{rows}\n14 {' '.join(map(str, cube))}\n"))
    report = gk.mesh.audit(mesh)
    assert (report.face_count, report.watertight, report.oriented) == (12, True, True)


# --- shapes of USD ---------------------------------------------------------------------------------------------------


def _stage(path: Path, define: Any) -> Path:
    from pxr import Usd

    stage = Usd.Stage.CreateInMemory()
    define(stage)
    stage.GetRootLayer().Export(str(path))
    return path


SHAPES = {
    "Cube": ({"size": 3.0}, 27.0, [3.0, 3.0, 3.0]),
    "Sphere": ({"radius": 1.5}, 4.0 / 3.0 * np.pi * 1.5**3, [3.0, 3.0, 3.0]),
    "Cylinder": ({"radius": 0.5, "height": 4.0}, np.pi * 0.25 * 4.0, [1.0, 1.0, 4.0]),
    "Cone": ({"radius": 0.5, "height": 4.0}, np.pi * 0.25 * 4.0 / 3.0, [1.0, 1.0, 4.0]),
    "Capsule": ({"radius": 0.5, "height": 4.0}, np.pi * 0.25 * 4.0 + np.pi * 0.5**3 * 4 / 3, [1.0, 1.0, 5.0]),
}


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_shapes_of_usd(tmp_path: Path, kind: str, axis: str) -> None:
    pytest.importorskip("pxr")
    from pxr import UsdGeom

    given, volume, size = SHAPES[kind]

    def define(stage: Any) -> None:
        shape = getattr(UsdGeom, kind).Define(stage, "/shape")
        for name, value in given.items():
            shape.GetPrim().GetAttribute(name).Set(value)
        if shape.GetPrim().HasAttribute("axis"):
            shape.GetPrim().GetAttribute("axis").Set(axis)
        UsdGeom.Xformable(shape).AddTranslateOp().Set((10.0, 20.0, 30.0))

    mesh = gk.mesh.load(_stage(tmp_path / "a.usda", define))
    report = gk.mesh.audit(mesh)
    assert (report.watertight, report.oriented, report.degenerate_count) == (True, True, 0)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    # Inside of the exact shape, by no more than the chords of its circles, and wound outwards.
    enclosed = float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
    assert 0.993 * volume <= enclosed <= volume * (1.0 + 1e-12)
    expected = np.roll(size, {"X": 1, "Y": 2, "Z": 0}[axis]) if kind not in ("Cube", "Sphere") else size
    np.testing.assert_allclose(np.diff(mesh.bounds, axis=0)[0], expected, rtol=1e-12)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), [10.0, 20.0, 30.0], rtol=1e-12)


def test_the_cone_points_along_its_axis(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import UsdGeom

    mesh = gk.mesh.load(_stage(tmp_path / "a.usda", lambda stage: UsdGeom.Cone.Define(stage, "/c").CreateAxisAttr("Y")))
    assert mesh.vertices[mesh.vertices[:, 1].argmax()].tolist() == [0.0, 1.0, 0.0]
    assert (mesh.vertices[:, 1] == 1.0).sum() == 1


@pytest.mark.parametrize(("axis", "size"), [("X", [0, 4, 3]), ("Y", [3, 0, 4]), ("Z", [3, 4, 0])])
def test_planes_of_usd(tmp_path: Path, axis: str, size: list[float]) -> None:
    pytest.importorskip("pxr")
    from pxr import UsdGeom

    def define(stage: Any) -> None:
        plane = UsdGeom.Plane.Define(stage, "/plane")
        plane.CreateWidthAttr(3.0), plane.CreateLengthAttr(4.0), plane.CreateAxisAttr(axis)

    mesh = gk.mesh.load(_stage(tmp_path / "a.usda", define))
    assert np.diff(mesh.bounds, axis=0)[0].tolist() == size
    assert mesh.face_normals[0].tolist() == [float(name == axis) for name in "XYZ"]


def test_what_is_left_out_of_a_stage_is_said(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import Sdf, UsdGeom

    def define(stage: Any) -> None:
        UsdGeom.BasisCurves.Define(stage, "/curves")
        UsdGeom.Points.Define(stage, "/points")
        mesh = UsdGeom.Mesh.Define(stage, "/mesh")
        mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
        mesh.CreateFaceVertexCountsAttr([3]), mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
        for name, values in (("short", [1.0, 2.0]), ("skel:weights", [1.0, 2.0])):
            kind = Sdf.ValueTypeNames.FloatArray
            UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, UsdGeom.Tokens.vertex).Set(values)

    path = _stage(tmp_path / "a.usda", define)
    with pytest.warns(UserWarning, match="left out") as said:
        assert len(gk.mesh.load(path)) == 1
    text = "the array 'short' of /mesh is left out: it has 2 rows for 3; its prims of type BasisCurves, Points are left"
    assert [str(warning.message) for warning in said] == [f"{path}: {text} out"]


def test_mesh_prims_without_points_are_named_as_such(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import UsdGeom

    path = _stage(tmp_path / "a.usda", lambda stage: UsdGeom.Mesh.Define(stage, "/m"))
    with pytest.raises(gk.FileFormatError, match="its Mesh prims have no points, or are hidden"):
        gk.mesh.load(path)


# --- clouds ----------------------------------------------------------------------------------------------------------


def test_structured_arrays_of_pdal(tmp_path: Path) -> None:
    rows = np.zeros(5, [("X", "f8"), ("Y", "f8"), ("Z", "f8"), ("Intensity", "u2"), ("GpsTime", "f8"), ("Name", "U3")])
    rows["X"], rows["Y"], rows["Z"], rows["Intensity"] = np.arange(5), 1.5, -2.0, 7
    np.save(tmp_path / "a.npy", rows)
    with pytest.warns(UserWarning, match="left out: 'Name'"):
        cloud = gk.points.load(tmp_path / "a.npy")
    np.testing.assert_array_equal(cloud.points, np.stack([np.arange(5), np.full(5, 1.5), np.full(5, -2.0)], axis=1))
    assert {name: values.dtype.str for name, values in cloud.data.items()} == {"Intensity": "<u2", "GpsTime": "<f8"}
    np.save(tmp_path / "b.npy", np.zeros(5, [("a", "f4"), ("b", "f4")]))
    with pytest.raises(gk.FileFormatError, match="has no x, y and z; its columns are a, b"):
        gk.points.load(tmp_path / "b.npy")
    np.save(tmp_path / "c.npy", np.zeros(5, [("x", "f4", 2), ("y", "f4"), ("z", "f4")]))
    with pytest.raises(gk.FileFormatError, match="field 'x' holds several numbers"):
        gk.points.load(tmp_path / "c.npy")


def test_arrays_of_the_shape_of_an_image(tmp_path: Path) -> None:
    image = np.random.default_rng(1).random((4, 6, 3))
    np.save(tmp_path / "a.npy", image)
    np.testing.assert_array_equal(gk.points.load(tmp_path / "a.npy").points, image.reshape(-1, 3))


def test_pcd_with_capitals(tmp_path: Path) -> None:
    text = "VERSION .7\nFIELDS X Y Z I\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\n"
    cloud = gk.points.load(write(tmp_path / "a.pcd", text + "POINTS 2\nDATA ascii\n0 1 2 3\n4 5 6 7\n"))
    assert cloud.points.tolist() == [[0, 1, 2], [4, 5, 6]]
    assert cloud.data["I"].tolist() == [3, 7]


ORGANIZED = (
    "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 2\nPOINTS 4\nDATA ascii\n"
    "0 1 2\nnan nan nan\n4 5 6\nnan nan nan\n"
)


def test_organized_clouds(tmp_path: Path) -> None:
    path = write(tmp_path / "a.pcd", ORGANIZED)
    with pytest.raises(gk.FileFormatError, match="leave out all 2 such points with finite_only=True"):
        gk.points.load(path)
    assert gk.points.load(path, finite_only=True).points.tolist() == [[0, 1, 2], [4, 5, 6]]


def test_units_of_usd_in_single_precision(tmp_path: Path) -> None:
    """As some exporters write them; OpenUSD's own function refuses them."""
    pytest.importorskip("pxr")
    from pxr import Tf, Usd, UsdGeom

    unit = float(np.float32(0.5**0.5))
    box = gk.mesh.box()
    path = tmp_path / "a.usdc"
    gk.mesh.save(path, gk.mesh.TriangleMesh(box.vertices, box.faces, meters_per_unit=unit))
    # A double that is a float is stored as one, with the type of double, 9, behind it; 8 is float.
    stored = struct.pack("<fHBB", unit, 0, 9, 0x40)
    assert path.read_bytes().count(stored) == 1
    path.write_bytes(path.read_bytes().replace(stored, struct.pack("<fHBB", unit, 0, 8, 0x40)))
    with pytest.raises(Tf.ErrorException):
        UsdGeom.GetStageMetersPerUnit(Usd.Stage.Open(str(path)))
    assert gk.mesh.load(path).meters_per_unit == unit


def test_materials_that_nobody_would_see(tmp_path: Path) -> None:
    """``Tr 1`` of exporters that take it for ``d``."""
    (tmp_path / "a.mtl").write_text("newmtl bottle\nKd 1 0 0\nTr 1.0\nnewmtl glass\nKd 1 1 1\nTr 0.75\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl bottle\nf 1 2 3\nusemtl glass\nf 3 2 1\n"
    )
    colors = [material.color for material in gk.mesh.load(tmp_path / "a.obj").materials]
    assert colors == [(1.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0, 0.25)]


def test_what_is_no_face_is_left_out_with_a_word(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nl 1 2\nl 2 3\np 3\ncurv 0 1 1 2\nend\n")
    with pytest.warns(UserWarning, match=r"a.obj: its lines \(2\), points \(1\), free-form curves \(1\) are left out$"):
        assert gk.mesh.load(tmp_path / "a.obj").face_count == 1


@pytest.mark.parametrize(
    ("header", "attribute", "said"),
    [(b"", 0, False), (b"", 17, False), (b"", 0x8000 | 31 << 10, True), (b"COLOR=\xff\x00\x00\xff", 31, True)],
)
def test_colors_of_binary_stl_are_left_out_with_a_word(tmp_path, header, attribute, said):
    corners = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, attribute)
    (tmp_path / "a.stl").write_bytes(header.ljust(80, b" ") + struct.pack("<I", 1) + corners)
    with pytest.warns(UserWarning, match="the colors of its faces are left out") if said else contextlib.nullcontext():
        assert gk.mesh.load(tmp_path / "a.stl").face_count == 1


def test_lines_and_points_of_gltf_are_told(tmp_path):
    places = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "<f4")
    uri = "data:application/octet-stream;base64," + base64.b64encode(places.tobytes()).decode()
    content = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": mode} for mode in (5, 1, 1, 0)]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}],
        "buffers": [{"byteLength": 48, "uri": uri}],
    }
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    with pytest.warns(UserWarning, match=r"its lines \(of 2 primitives\) are left out; its points \(of 1 primitive\)"):
        assert gk.mesh.audit(gk.mesh.load(tmp_path / "a.gltf")).area == 1.0
