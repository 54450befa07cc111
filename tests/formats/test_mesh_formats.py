"""Each mesh format, read from files that other programs or plain text made, and written for others to read."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.formats.polygons import triangulate
from geokit.formats.table import FORMATS, extensions

MESH = mesh_catalog.l_profile()
# Coordinates that float32 cannot hold: a format that keeps float64 must give them back bit for bit.
FINE = gk.mesh.TriangleMesh(
    mesh_catalog.torus(12, 8).vertices / 3.0 + 1e3, mesh_catalog.torus(12, 8).faces, name="fine"
)
FLOAT32 = (".stl", ".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz")


def corners(mesh) -> np.ndarray:
    """Corner positions (F, 3, 3): the geometry, whatever the numbering of the vertices."""
    return mesh.vertices[mesh.faces]


def rolled(triangles: np.ndarray) -> np.ndarray:
    """Triangles (F, 3, 3) in one order, each from its lowest corner on: equal for equal sets of wound triangles."""
    keys = []
    for triangle in np.asarray(triangles, np.float64).tolist():
        first = min(range(3), key=triangle.__getitem__)
        keys.append([triangle[(first + k) % 3] for k in range(3)])
    return np.array(sorted(keys))


def signed_volume(mesh) -> float:
    a, b, c = np.moveaxis(corners(mesh), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


# --- round trips -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", extensions("mesh", "w"))
def test_saved_file_reads_back(tmp_path, kind):
    path = tmp_path / f"mesh{kind}"
    gk.mesh.save(path, FINE)
    again = gk.mesh.load(path)
    expected = FINE.vertices.astype(np.float32).astype(np.float64) if kind in FLOAT32 else FINE.vertices
    if kind == ".stl":
        np.testing.assert_array_equal(corners(again), expected[FINE.faces])
        assert len(again.vertices) == len(np.unique(expected, axis=0))
    else:
        np.testing.assert_array_equal(again.vertices, expected)
        np.testing.assert_array_equal(again.faces, FINE.faces)
    assert again.name == "mesh"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [path.name]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in extensions("mesh", "w") if kind not in (".stl", ".usd", ".usda")])
def test_nothing_is_merged_or_dropped(tmp_path, kind):
    mesh = mesh_catalog.join(
        mesh_catalog.soup(mesh_catalog.box()),
        mesh_catalog.duplicate_faces(),
        mesh_catalog.zero_area_triangles(),
        mesh_catalog.collapsed_faces(),
        mesh_catalog.unreferenced_vertices(),
    )
    path = tmp_path / f"mesh{kind}"
    gk.mesh.save(path, mesh)
    again = gk.mesh.load(path)
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)


def test_parts_survive_obj(tmp_path):
    mesh = mesh_catalog.join(mesh_catalog.box(), mesh_catalog.tetrahedron())
    gk.mesh.save(tmp_path / "two.obj", mesh)
    assert gk.mesh.load(tmp_path / "two.obj").parts == mesh.parts == (("box", 0, 12), ("tetrahedron", 12, 4))


def test_name_can_be_given(tmp_path):
    gk.mesh.save(tmp_path / "a.off", MESH)
    assert gk.mesh.load(tmp_path / "a.off", name="profile").name == "profile"
    assert gk.mesh.load(str(tmp_path / "a.off")).name == "a"


# --- polygons --------------------------------------------------------------------------------------------------------


def polygon_area(points: np.ndarray) -> float:
    x, y = points[:, 0], points[:, 1]
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


CONCAVE = {
    "dart, reflex corner first": [(1, 1), (0, 4), (0, 0), (4, 0)],
    "dart, reflex corner second": [(4, 0), (1, 1), (0, 4), (0, 0)],
    "dart, reflex corner third": [(0, 0), (4, 0), (1, 1), (0, 4)],
    "L": [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)],
    "comb": [(0, 0), (7, 0), (7, 3), (6, 3), (6, 1), (5, 1), (5, 3), (4, 3), (4, 1), (3, 1), (3, 3), (0, 3)],
    "seam to a hole": [(0, 0), (6, 0), (6, 6), (0, 6), (0, 0), (2, 2), (2, 4), (4, 4), (4, 2), (2, 2)],
    "spiral": [(0, 0), (5, 0), (5, 5), (1, 5), (1, 2), (3, 2), (3, 3), (2, 3), (2, 4), (4, 4), (4, 1), (0, 1)],
    "flat corners": [(0, 0), (1, 0), (2, 0), (2, 2), (1, 2), (1, 1), (0, 1)],
}


@pytest.mark.parametrize("outline", CONCAVE.values(), ids=CONCAVE.keys())
@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_concave_polygons_are_not_flipped(outline, reverse, offset):
    flat = np.array(outline[::-1] if reverse else outline, np.float64)
    # On a slanted plane that is a shear of z = 0: areas along z stay those of the outline.
    points = np.c_[flat, 0.5 * flat[:, 0] - 0.25 * flat[:, 1]] + offset
    faces, polygon = triangulate(points, np.array([len(flat)]), np.arange(len(flat)))
    assert len(faces) == len(flat) - 2
    assert not polygon.any()
    areas = np.array([polygon_area(points[face, :2] - offset) for face in faces])
    # Each triangle winds like the outline, and together they cover it once.
    assert (areas * polygon_area(flat) >= 0).all()
    assert abs(areas).sum() == pytest.approx(abs(polygon_area(flat)), rel=1e-8)


def test_triangulation_keeps_the_order_of_polygons():
    points = np.random.default_rng(1).normal(size=(9, 3))
    counts = np.array([4, 3, 5, 3])
    faces, polygon = triangulate(points, counts, np.array([0, 1, 2, 3, 4, 5, 6, 0, 2, 4, 6, 8, 1, 3, 5]))
    assert polygon.tolist() == [0, 0, 1, 2, 2, 2, 3]
    assert faces[2].tolist() == [4, 5, 6]
    assert faces[6].tolist() == [1, 3, 5]


def test_convex_polygons_are_fans():
    angle = np.linspace(0, 2 * np.pi, 7)[:-1]
    points = np.c_[np.cos(angle), np.sin(angle), np.zeros(6)]
    faces, _ = triangulate(points, np.array([6]), np.arange(6))
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]


# --- .obj ------------------------------------------------------------------------------------------------------------


def test_obj_text(tmp_path):
    path = write(
        tmp_path / "text.obj",
        "# comment\nmtllib none.mtl\no first\nv 0 0 0\nv 1 0 0 # trailing\r\nv 1.0 1e0 0\nv 0 1 0 0.5 0.5 0.5\n"
        "vt 0 0\nvn 0 0 1\ns off\nusemtl red\nf 1/1/1 2//1 3/1 4\n\to second name\nv\t0 0 1\n"
        "f -5 -4 \\\n -1\nl 1 2\np 1\ng third\nf 1 3 5 # end\n",
    )
    with pytest.warns(UserWarning, match=r"'none\.mtl' is missing"):
        mesh = gk.mesh.load(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4], [0, 2, 4]]
    assert mesh.parts == (("first", 0, 2), ("second name", 2, 1), ("third", 3, 1))


def test_obj_of_trimesh(tmp_path):
    import trimesh

    trimesh.Trimesh(MESH.vertices, MESH.faces, process=False).export(tmp_path / "t.obj")
    np.testing.assert_allclose(corners(gk.mesh.load(tmp_path / "t.obj")), corners(MESH), atol=1e-7)


# --- .ply ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_of_trimesh(tmp_path, encoding):
    import trimesh

    mesh = trimesh.Trimesh(MESH.vertices, MESH.faces, process=False)
    mesh.visual.vertex_colors = np.full((len(MESH.vertices), 4), 7, np.uint8)
    mesh.export(tmp_path / "t.ply", encoding=encoding, vertex_normal=True)
    np.testing.assert_array_equal(corners(gk.mesh.load(tmp_path / "t.ply")), corners(MESH))


@pytest.mark.parametrize("binary", [False, True])
def test_ply_of_meshio_with_mixed_polygons(tmp_path, binary):
    import meshio

    points = np.c_[np.random.default_rng(0).normal(size=(6, 2)), np.arange(6.0)]
    content = meshio.Mesh(points, [("triangle", [[0, 1, 2]]), ("quad", [[2, 3, 4, 5]]), ("triangle", [[5, 1, 0]])])
    content.write(tmp_path / "m.ply", binary=binary)
    mesh = gk.mesh.load(tmp_path / "m.ply")
    np.testing.assert_array_equal(mesh.vertices, points)
    assert mesh.faces[0].tolist() == [0, 1, 2]
    assert mesh.faces[-1].tolist() == [5, 1, 0]
    assert set(mesh.faces[1:3].ravel().tolist()) == {2, 3, 4, 5}


@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_binary_with_other_elements_and_properties(tmp_path, order):
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = (
        f"ply\r\nformat {name} 1.0\r\nobj_info made by hand\r\nelement note 2\r\nproperty list ushort char text\r\n"
        "element vertex 4\r\nproperty uchar red\r\nproperty float z\r\nproperty double x\r\nproperty short y\r\n"
        "element face 2\r\nproperty list uchar float texcoord\r\nproperty list uint8 uint16 vertex_index\r\n"
        "property int flags\r\nend_header\r\n"
    )
    body = struct.pack(f"{order}H2b", 2, 65, 66) + struct.pack(f"{order}H", 0)
    for x, y, z in [(0, 0, 0), (1, 0, 0), (1, 1, 0.5), (0, 1, 0.25)]:
        body += struct.pack(f"{order}Bfdh", 9, z, x, y)
    body += struct.pack(f"{order}B2fB4Hi", 2, 0, 0, 4, 0, 1, 2, 3, -1) + struct.pack(f"{order}BB3Hi", 0, 3, 0, 1, 2, 5)
    with pytest.warns(UserWarning, match="the list 'texcoord' of the faces is left out: its lengths"):
        mesh = gk.mesh.load(write(tmp_path / "hand.ply", header.encode() + body))
    assert mesh.vertex_data["red"].tolist() == [9] * 4
    assert mesh.face_data["flags"].tolist() == [-1, -1, 5]
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0.25]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


def test_ply_ascii_with_lists_of_several_lengths(tmp_path):
    text = (
        "ply\nformat ascii 1.0\ncomment x\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar alpha\nelement face 3\nproperty list uchar int vertex_indices\nproperty uchar red\n"
        "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
        "0 0 0 1\n1 0 0 1\n1 1 0 1\n0 1 0 1\n0.1 0 1 1\n3 0 1 2 8\n4 0 1 2 3 9\n3 0 1 4 7\n0 1\n"
    )
    with pytest.warns(UserWarning, match="its 1 entries of 'edge' are left out"):
        mesh = gk.mesh.load(write(tmp_path / "mixed.ply", text))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 1, 4]]
    # 0.1 in the text is the float64 0.1, not its float32 neighbor.
    assert mesh.vertices[4, 0] == 0.1


@pytest.mark.parametrize("file", ["airplane.ply", "ant.ply", "nut.ply", "sphere.ply"])
def test_ply_examples_of_pyvista(file):
    import pyvista

    path = Path(pyvista.examples.__file__).parent / file
    ours, theirs = gk.mesh.load(path), pyvista.read(path)
    # VTK rounds the text to float32.
    np.testing.assert_array_equal(ours.vertices.astype(np.float32), theirs.points)
    np.testing.assert_array_equal(ours.faces, theirs.regular_faces)


# --- .stl ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file_type", ["stl", "stl_ascii"])
def test_stl_of_trimesh(tmp_path, file_type):
    import trimesh

    content = trimesh.Trimesh(MESH.vertices, MESH.faces, process=False).export(file_type=file_type)
    mesh = gk.mesh.load(write(tmp_path / "t.stl", content))
    np.testing.assert_array_equal(corners(mesh), corners(MESH))
    assert len(mesh.vertices) == len(MESH.vertices)


def test_stl_binary_whose_header_says_solid(tmp_path):
    gk.mesh.save(tmp_path / "a.stl", MESH)
    data = bytearray((tmp_path / "a.stl").read_bytes())
    data[:80] = b"solid lies".ljust(80)
    np.testing.assert_array_equal(corners(gk.mesh.load(write(tmp_path / "b.stl", bytes(data)))), corners(MESH))


def test_stl_ascii_solids_are_parts(tmp_path):
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 {z}\nvertex 1 0 {z}\nVERTEX 0 1 -0.0\nendloop\nendfacet\n"
    text = f"solid lower part\n{facet.format(z=0)}endsolid lower part\nsolid\n{facet.format(z=1) * 2}endsolid\n"
    mesh = gk.mesh.load(write(tmp_path / "two.stl", text))
    assert mesh.parts == (("lower part", 0, 1), ("", 1, 2))
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 4, 2], [3, 4, 2]]


def test_stl_normals_are_those_of_the_faces(tmp_path):
    import trimesh

    gk.mesh.save(tmp_path / "a.stl", MESH)
    normals = np.frombuffer((tmp_path / "a.stl").read_bytes()[84:], np.dtype([("n", "<f4", 3), ("", "V38")]))["n"]
    assert len(normals) == len(MESH.faces)
    expected = trimesh.Trimesh(MESH.vertices, MESH.faces, process=False).face_normals
    np.testing.assert_allclose(normals, expected, atol=1e-7)


# --- .off ------------------------------------------------------------------------------------------------------------


def test_off_of_trimesh(tmp_path):
    import trimesh

    trimesh.Trimesh(MESH.vertices, MESH.faces, process=False).export(tmp_path / "t.off")
    np.testing.assert_allclose(corners(gk.mesh.load(tmp_path / "t.off")), corners(MESH), atol=1e-9)


@pytest.mark.parametrize("header", ["OFF\n4 2 0", "OFF 4 2 0", "# note\nCOFF\n# note\n4 2 0 # counts", "NOFF\n4 2"])
def test_off_text(tmp_path, header):
    text = f"{header}\n0 0 0 1 1 1\n1 0 0 1 1 1\n\n1 1 0 1 1 1\n0 1 0 1 1 1\n4 0 1 2 3 255 0 0\n3 0 1 2 0.5\n"
    with pytest.warns(UserWarning, match="the colors of faces are left out"):
        mesh = gk.mesh.load(write(tmp_path / "t.off", text))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert list(mesh.vertex_data) == ["color"] * ("COFF" in header) + ["normal"] * ("NOFF" in header)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


# --- scenes ----------------------------------------------------------------------------------------------------------


def transform(scale=(1.0, 1.0, 1.0), move=(0.0, 0.0, 0.0)) -> np.ndarray:
    matrix = np.diag([*scale, 1.0])
    matrix[:3, 3] = move
    return matrix


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["glb", "gltf", "3mf"])
def test_scene_graph_of_trimesh(tmp_path, kind):
    import trimesh

    part = trimesh.Trimesh(MESH.vertices, MESH.faces, process=False)
    scene = trimesh.Scene()
    scene.add_geometry(part, node_name="here", geom_name="profile")
    scene.graph.update(frame_to="frame", matrix=transform(move=(10, 0, 0)))
    scene.add_geometry(part, node_name="there", geom_name="profile", parent_node_name="frame")
    scene.add_geometry(
        part, node_name="mirrored", geom_name="profile", transform=transform((-1, 2, 1)), parent_node_name="frame"
    )
    if kind == "gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(scene).items():
            (tmp_path / name).write_bytes(content)
        path = tmp_path / "model.gltf"
    else:
        path = write(tmp_path / f"scene.{kind}", scene.export(file_type=kind))
    mesh = gk.mesh.load(path)
    assert len(mesh.faces) == 3 * len(MESH.faces)
    assert len(mesh.parts) == 3
    assert [part.face_count for part in mesh.parts] == [len(MESH.faces)] * 3
    # Volumes 3, 3 and, twice as wide and still outwards in the mirror, 6.
    assert signed_volume(mesh) == pytest.approx(12.0, abs=1e-9)
    assert mesh.bounds.tolist() == [[0, 0, 0], [12, 4, 1]]
    if kind != "3mf":
        assert {part.name for part in mesh.parts} == {"here", "there", "mirrored"}


@pytest.mark.slow
def test_glb_of_points_is_refused(tmp_path):
    import trimesh

    scene = trimesh.Scene([trimesh.PointCloud(MESH.vertices)])
    with pytest.raises(gk.FileFormatError, match=r"points\.glb: holds only points; .*faces"):
        gk.mesh.load(write(tmp_path / "points.glb", scene.export(file_type="glb")))


# --- VTK and meshio --------------------------------------------------------------------------------------------------


def poly_data():
    import pyvista

    points = np.array([[0, 0, 0], [4, 0, 0], [1, 1, 0], [0, 4, 0], [0, 0, 2], [1, 0, 2], [0, 1, 2], [1, 1, 2]]) / 3.0
    # A concave quad, a triangle, and a strip of two triangles.
    mesh = pyvista.PolyData(points, faces=[4, 0, 1, 2, 3, 3, 0, 1, 4], strips=[4, 4, 5, 6, 7])
    mesh.lines = [2, 0, 4]
    return mesh


@pytest.mark.slow
@pytest.mark.parametrize(("file", "binary"), [("p.vtp", True), ("p.vtp", False), ("p.vtk", True), ("p.vtk", False)])
def test_poly_data_of_pyvista(tmp_path, file, binary):
    data = poly_data()
    data.save(tmp_path / file, binary=binary)
    with pytest.warns(UserWarning, match=r"its lines \(1\) are left out"):
        mesh = gk.mesh.load(tmp_path / file)
    # Legacy ASCII keeps about ten digits.
    tolerance = 0.0 if binary or file.endswith("p") else 1e-8
    np.testing.assert_allclose(mesh.vertices, data.points, rtol=0, atol=tolerance)
    assert [sorted(face) for face in mesh.faces.tolist()] == [[0, 2, 3], [0, 1, 2], [0, 1, 4], [4, 5, 6], [5, 6, 7]]
    normals = np.cross(*(corners(mesh)[:, k] - corners(mesh)[:, 0] for k in (1, 2)))
    assert (normals[[0, 1, 3, 4], 2] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("file", ["g.vtu", "g.vtk"])
def test_unstructured_grid_of_pyvista(tmp_path, file):
    import pyvista

    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]], np.float64) / 3.0
    cells = [3, 0, 1, 4, 4, 0, 1, 2, 3, 4, 0, 1, 3, 2, 4, 0, 1, 2, 4, 2, 0, 4, 5, 0, 1, 2, 3, 4, 4, 0, 1, 3, 2]
    types = [5, 9, 8, 10, 3, 7, 6]
    pyvista.UnstructuredGrid(cells, types, points).save(tmp_path / file)
    with pytest.warns(UserWarning, match=r"its lines \(1\), tetrahedra \(1\) are left out"):
        mesh = gk.mesh.load(tmp_path / file)
    np.testing.assert_array_equal(mesh.vertices, points)
    # Strip and pixel, then triangle, quad, polygon; the tetrahedron and the line are left out.
    assert len(mesh.faces) == 2 + 2 + 1 + 2 + 3
    flat = corners(mesh)[(corners(mesh)[:, :, 2] == 0).all(axis=1)]
    assert len(flat) == 2 + 2 + 2 + 2
    assert (np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])[:, 2] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "options"),
    [
        ("m.vtu", {}),
        ("m.vtk", {"binary": False}),
        ("m.msh", {"file_format": "gmsh22", "binary": False}),
        ("m.xdmf", {"data_format": "HDF"}),
        ("m.xdmf", {"data_format": "XML"}),
    ],
    ids=str,
)
def test_files_of_meshio(tmp_path, file, options):
    import meshio

    points = FINE.vertices[:6]
    blocks = [("line", [[0, 1]]), ("quad", [[0, 1, 2, 3]]), ("triangle", [[0, 1, 4]]), ("tetra", [[0, 1, 2, 5]])]
    meshio.Mesh(points, blocks).write(tmp_path / file, **options)
    with pytest.warns(UserWarning, match=r"(tetrahedra \(1\)|1 tetra\)) are left out"):
        mesh = gk.mesh.load(tmp_path / file)
    np.testing.assert_array_equal(mesh.vertices, points)
    assert len(mesh.faces) == 3
    assert mesh.faces[2].tolist() == [0, 1, 4]


@pytest.mark.slow
@pytest.mark.parametrize("file", ["v.vtu", "v.msh"])
def test_volume_cells_alone_are_refused(tmp_path, file):
    import meshio

    meshio.Mesh(np.eye(4, 3), [("tetra", [[0, 1, 2, 3]])]).write(tmp_path / file)
    with pytest.raises(gk.FileFormatError, match=r"holds .*tetra.* but no surface cells; extract the surface"):
        gk.mesh.load(tmp_path / file)


@pytest.mark.slow
@pytest.mark.parametrize("file", ["c.vtu", "c.msh"])
def test_curved_cells_are_refused(tmp_path, file):
    import meshio

    content = meshio.Mesh(np.random.default_rng(0).normal(size=(6, 3)), [("triangle6", [[0, 1, 2, 3, 4, 5]])])
    content.write(tmp_path / file, file_format={"c.vtu": "vtu", "c.msh": "gmsh"}[file])
    with pytest.raises(gk.FileFormatError, match="first-order"):
        gk.mesh.load(tmp_path / file)


def test_image_data_is_refused(tmp_path):
    import pyvista

    pyvista.ImageData(dimensions=(3, 3, 3)).save(tmp_path / "image.vtk")
    with pytest.raises(gk.FileFormatError, match="not a surface"):
        gk.mesh.load(tmp_path / "image.vtk")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".vtk", ".vtp", ".vtu", ".msh", ".xdmf"])
def test_data_is_written_for_others(tmp_path, kind):
    import meshio
    import pyvista

    path = tmp_path / f"data{kind}"
    distance = np.linspace(0, 1, len(FINE.vertices)) / 3
    points = {"distance": distance, "normal": FINE.vertices - 1e3, "inside": distance > 0.2}
    cells = {
        "id": np.arange(len(FINE.faces)),
        "kind": np.arange(len(FINE.faces), dtype=np.uint8),
        "direction": np.ones((len(FINE.faces), 3)),
    }
    gk.mesh.save(path, FINE, point_data=points, cell_data=cells)
    if kind in (".vtp", ".vtk"):
        again = pyvista.read(path)
        found_points, found_cells = again.point_data, again.cell_data
    else:
        again = meshio.read(path)
        found_points, found_cells = again.point_data, {name: values[0] for name, values in again.cell_data.items()}
    np.testing.assert_array_equal(again.points, FINE.vertices)
    for name, values in points.items():
        np.testing.assert_array_equal(np.squeeze(found_points[name]), values)
    for name, values in cells.items():
        np.testing.assert_array_equal(np.squeeze(found_cells[name]), values)
    np.testing.assert_array_equal(gk.mesh.load(path).vertices, FINE.vertices)


# --- USD -------------------------------------------------------------------------------------------------------------


def usd_mesh(stage, path: str, *, clockwise: bool = False):
    from pxr import UsdGeom

    prim = UsdGeom.Mesh.Define(stage, path)
    faces = MESH.faces[:, ::-1] if clockwise else MESH.faces
    prim.CreatePointsAttr(MESH.vertices.tolist())
    prim.CreateFaceVertexCountsAttr([3] * len(faces))
    prim.CreateFaceVertexIndicesAttr(faces.ravel().tolist())
    if clockwise:
        prim.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    return prim


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["usda", "usdc", "usdz"])
def test_usd_transforms_orientation_and_visibility(tmp_path, kind):
    from pxr import Usd, UsdGeom, UsdUtils

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.XformCommonAPI(UsdGeom.Xform.Define(stage, "/world")).SetTranslate((10, 0, 0))
    UsdGeom.XformCommonAPI(usd_mesh(stage, "/world/scaled")).SetScale((2, 1, 1))
    UsdGeom.XformCommonAPI(usd_mesh(stage, "/world/mirrored")).SetScale((-1, 1, 1))
    usd_mesh(stage, "/lefthanded", clockwise=True)
    mirrored_left = usd_mesh(stage, "/both", clockwise=True)
    mirrored_left.AddScaleOp().Set((1, 1, -1))
    usd_mesh(stage, "/hidden").MakeInvisible()
    usd_mesh(stage, "/guide").CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdGeom.BasisCurves.Define(stage, "/hair")
    path = tmp_path / f"scene.{'usdc' if kind == 'usdz' else kind}"
    stage.GetRootLayer().Export(str(path))
    if kind == "usdz":
        path = tmp_path / "scene.usdz"
        assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "scene.usdc"), str(path))
    with pytest.warns(UserWarning, match="its prims of type BasisCurves are left out$"):
        mesh = gk.mesh.load(path)
    assert [part.name for part in mesh.parts] == ["/world/scaled", "/world/mirrored", "/lefthanded", "/both"]
    volumes = []
    for part in mesh.parts:
        faces = mesh.faces[part.first_face : part.first_face + part.face_count]
        volumes.append(signed_volume(gk.mesh.TriangleMesh(mesh.vertices, faces)))
    assert volumes == pytest.approx([6, 3, 3, 3], abs=1e-9)
    first = mesh.vertices[mesh.faces[: len(MESH.faces)]].reshape(-1, 3)
    assert [first.min(axis=0).tolist(), first.max(axis=0).tolist()] == [[10, 0, 0], [14, 2, 1]]


def test_usd_instances(tmp_path):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.Xform.Define(stage, "/source").MakeInvisible()
    usd_mesh(stage, "/source/part")
    for number in range(2):
        prim = UsdGeom.Xform.Define(stage, f"/copy{number}")
        prim.GetPrim().GetReferences().AddInternalReference("/source")
        prim.GetPrim().SetInstanceable(True)
        prim.CreateVisibilityAttr(UsdGeom.Tokens.inherited)
        prim.AddTranslateOp().Set((0, 0, 5.0 * number))
    instancer = UsdGeom.PointInstancer.Define(stage, "/scatter")
    UsdGeom.XformCommonAPI(instancer).SetTranslate((0, 100, 0))
    usd_mesh(stage, "/scatter/prototypes/part").AddScaleOp().Set((2, 1, 1))
    instancer.CreatePrototypesRel().SetTargets(["/scatter/prototypes/part"])
    instancer.CreateProtoIndicesAttr([0, 0, 0])
    instancer.CreatePositionsAttr([(0, 0, 0), (10, 0, 0), (20, 0, 0)])
    instancer.CreateIdsAttr([4, 5, 6])
    instancer.CreateInvisibleIdsAttr([5])
    stage.GetRootLayer().Export(str(tmp_path / "instances.usda"))
    mesh = gk.mesh.load(tmp_path / "instances.usda")
    boxes = [
        mesh.vertices[mesh.faces[part.first_face : part.first_face + part.face_count]].reshape(-1, 3)
        for part in mesh.parts
    ]
    found = [(box.min(axis=0).tolist(), box.max(axis=0).tolist()) for box in boxes]
    assert found == [
        ([0, 0, 0], [2, 2, 1]),
        ([0, 0, 5], [2, 2, 6]),
        ([0, 100, 0], [4, 102, 1]),
        ([20, 100, 0], [24, 102, 1]),
    ]


def test_usd_with_time_samples_only(tmp_path):
    from pxr import Usd

    stage = Usd.Stage.CreateInMemory()
    prim = usd_mesh(stage, "/moving")
    prim.GetPointsAttr().Clear()
    prim.GetPointsAttr().Set(MESH.vertices.tolist(), 3.0)
    prim.GetPointsAttr().Set((MESH.vertices + 7).tolist(), 4.0)
    move = prim.AddTranslateOp()
    move.Set((1, 0, 0), 3.0)
    move.Set((9, 0, 0), 4.0)
    stage.GetRootLayer().Export(str(tmp_path / "moving.usdc"))
    with pytest.warns(UserWarning, match="its animations are left out"):
        mesh = gk.mesh.load(tmp_path / "moving.usdc")
    np.testing.assert_array_equal(mesh.vertices, MESH.vertices + np.array([1, 0, 0]))


@pytest.mark.slow
def test_usd_assets_of_warp():
    import warp
    from pxr import Usd, UsdGeom

    loaded = 0
    for path in sorted((Path(warp.__file__).parent / "examples" / "assets").glob("*.usd*")):
        points, counts, flat = [], [], []
        stage = Usd.Stage.Open(str(path))
        for prim in stage.Traverse():
            if prim.IsA(UsdGeom.Mesh):
                matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
                local = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(), np.float64)
                points.append(np.c_[local, np.ones(len(local))] @ matrix)
                counts.append(np.array(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get()))
                flat.append(np.array(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get()))
        if not points:
            continue
        mesh = gk.mesh.load(path)
        np.testing.assert_allclose(mesh.vertices, np.concatenate(points)[:, :3], rtol=1e-14, atol=0)
        assert len(mesh.faces) == sum(int((count - 2).sum()) for count in counts)
        assert set(np.unique(mesh.faces)) == set(np.unique(np.concatenate(flat)))
        assert gk.mesh.audit(mesh).oriented
        loaded += 1
    assert loaded >= 7


@pytest.mark.slow
def test_usd_without_meshes_is_refused(tmp_path):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.BasisCurves.Define(stage, "/hair")
    stage.GetRootLayer().Export(str(tmp_path / "hair.usda"))
    with pytest.raises(gk.FileFormatError, match="no visible Mesh prim; it holds BasisCurves"):
        gk.mesh.load(tmp_path / "hair.usda")


def test_missing_usd_core_is_named(tmp_path, monkeypatch):
    gk.mesh.save(tmp_path / "a.usda", MESH)
    shadow = tmp_path / "shadow" / "pxr"
    shadow.mkdir(parents=True)
    write(shadow / "__init__.py", "raise ImportError('no module named pxr')\n")
    monkeypatch.syspath_prepend(str(shadow.parent))
    with pytest.raises(gk.MissingDependencyError, match=r"geokit-nanovdb\[usd\]"):
        gk.mesh.load(tmp_path / "a.usda")
    for name in [name for name in sys.modules if name.split(".")[0] == "pxr"]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(gk.MissingDependencyError, match=r"geokit-nanovdb\[usd\]"):
        gk.mesh.save(tmp_path / "b.usda", MESH)
    assert not (tmp_path / "b.usda").exists()


# --- refusals --------------------------------------------------------------------------------------------------------


def test_unknown_extension_lists_the_formats(tmp_path):
    with pytest.raises(gk.InputError, match=r"'\.doc' is not a mesh format.*\.glb.*\.obj"):
        gk.mesh.load(tmp_path / "a.doc")
    with pytest.raises(gk.InputError, match=r"'\.dae' is only read; use one of"):
        gk.mesh.save(tmp_path / "a.dae", MESH)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(gk.FileAccessError, match="no such file"):
        gk.mesh.load(tmp_path / "absent.obj")
    with pytest.raises(gk.FileAccessError, match="does not exist"):
        gk.mesh.save(tmp_path / "absent" / "a.obj", MESH)


@pytest.mark.parametrize("kind", extensions("mesh", "r"))
def test_empty_file(tmp_path, kind):
    with pytest.raises(gk.FileFormatError, match="is empty"):
        gk.mesh.load(write(tmp_path / f"empty{kind}", b""))


BAD_TEXT = {
    "points.obj": ("v 0 0 0\nv 1 0 0\n", "holds 2 points but no faces"),
    "nothing.obj": ("just words\n", "neither points nor faces"),
    "index.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 4\n", r"face 1 \(counted from 0\) uses vertex 3"),
    "zero.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "face 0 uses vertex 0, but .obj indices start at 1"),
    "before.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n", "face 0 .*uses vertex -1"),
    "word.obj": ("v 0 0 zero\nf 1 1 1\n", "'zero'"),
    "short.obj": ("v 0 0\nf 1 1 1\n", "vertex 0 has 2 coordinates"),
    "line.obj": ("v 0 0 0\nv 1 0 0\nf 1 2\n", "face 0 has 2 corners"),
    "nan.obj": ("v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n", r"vertex 1 \(counted from 0\) is not finite"),
    "huge.obj": ("v 0 0 0\nv 1 1e999 0\nv 0 1 0\nf 1 2 3\n", "vertex 1 .*is not finite"),
    "points.off": ("OFF\n2 0 0\n0 0 0\n1 0 0\n", "holds 2 points but no faces"),
    "header.off": ("4 2 0\n", "does not start with OFF"),
    "binary.off": ("OFF BINARY\n", "does not start with OFF"),
    "counts.off": ("OFF\n\n", "counts is missing"),
    "short.off": ("OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "holds 4 lines; it is truncated"),
    "thin.off": ("OFF\n3 1 0\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "vertex 1 has 2 coordinates"),
    "corner.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "truncated|damaged"),
    "index.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "face 0 .*uses vertex 3"),
    "minus.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n-3 0 1 2\n", "truncated|damaged"),
    "facet.stl": ("solid a\nfacet normal 0 0 1\nouter loop\nendsolid a\n", "facets of three vertices"),
    "end.stl": ("solid a\nfacet normal 0 0 1\n", "no 'endsolid'"),
    "none.stl": ("solid a\nendsolid a\n", "no points|neither points nor faces"),
    "text.stl": ("hello", "too few"),
    "bytes.stl": ("x" * 34, "too few"),
    "text.ply": ("hello", "does not start with 'ply'"),
    "header.ply": ("ply\nformat ascii 1.0\nelement vertex 3\n", "header has no end"),
    "format.ply": ("ply\nformat ebcdic 1.0\nend_header\n", "'format ebcdic 1.0' is not understood"),
    "noformat.ply": ("ply\nelement vertex 0\nproperty float x\nend_header\n", "no format"),
    "novertex.ply": ("ply\nformat ascii 1.0\nend_header\n", "no vertex element"),
    "bare.ply": ("ply\nformat ascii 1.0\nelement vertex 9999999999\nend_header\n", "without properties"),
    "plane.ply": ("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "no x, y and z"),
}
PLY = (
    "ply\nformat {format} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {faces}\nproperty list {count} {index} vertex_indices\nend_header\n"
)
ASCII = {"format": "ascii", "vertices": 3, "faces": 1, "count": "uchar", "index": "int"}
TRIANGLE = "0 0 0\n1 0 0\n0 1 0\n"
BAD_TEXT |= {
    "points.ply": (PLY.format(**{**ASCII, "faces": 0}) + TRIANGLE, "holds 3 points but no faces"),
    "index.ply": (PLY.format(**ASCII) + TRIANGLE + "3 0 1 3\n", "face 0 .*uses vertex 3"),
    "minus.ply": (PLY.format(**ASCII) + TRIANGLE + "-3 0 1 2\n", "truncated"),
    "missing.ply": (PLY.format(**ASCII) + TRIANGLE + "3 0 1\n", "face entries it declares; it is truncated"),
    "vertices.ply": (PLY.format(**{**ASCII, "vertices": 10**12}) + TRIANGLE, "1000000000000 vertex entries"),
    "more.ply": (PLY.format(**ASCII) + TRIANGLE + "3 0 1 2\n7\n", "1 values more"),
    "word.ply": (PLY.format(**ASCII) + TRIANGLE + "3 0 1 x\n", "'x'"),
    "float.ply": (PLY.format(**{**ASCII, "index": "float"}) + TRIANGLE + "3 0 1 2\n", "not integers"),
    "pair.ply": (PLY.format(**ASCII) + TRIANGLE + "2 0 1\n", "face 0 has 2 corners"),
    "inf.ply": (PLY.format(**ASCII) + "0 0 0\ninf 0 0\n0 1 0\n3 0 1 2\n", "vertex 1 .*is not finite"),
}


@pytest.mark.parametrize(("file", "content", "message"), [(f, *rest) for f, rest in BAD_TEXT.items()], ids=BAD_TEXT)
def test_bad_text_is_named(tmp_path, file, content, message):
    with pytest.raises(gk.FileFormatError, match=message) as caught:
        gk.mesh.load(write(tmp_path / file, content))
    assert str(tmp_path / file) in str(caught.value)


@pytest.mark.parametrize("kind", [".ply", ".stl"])
@pytest.mark.parametrize("change", [-1, -50, -300, +1])
def test_binary_of_wrong_length(tmp_path, kind, change):
    gk.mesh.save(tmp_path / f"a{kind}", MESH)
    data = (tmp_path / f"a{kind}").read_bytes()
    damaged = data[:change] if change < 0 else data + b"x" * change
    if kind == ".stl" and change > 0:
        with pytest.warns(UserWarning, match="1 bytes behind the last of its 20 triangles are left out"):
            assert gk.mesh.load(write(tmp_path / f"b{kind}", damaged)).face_count == MESH.face_count
        return
    with pytest.raises(gk.FileFormatError, match=r"truncated|damaged"):
        gk.mesh.load(write(tmp_path / f"b{kind}", damaged))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".vtp", ".vtu", ".msh", ".xdmf", ".glb", ".usda"])
def test_indices_out_of_range_in_other_formats(tmp_path, kind):
    import meshio
    import pyvista

    path = tmp_path / f"bad{kind}"
    points, faces = np.eye(3), np.array([[0, 1, 2], [0, 1, 7]])
    if kind == ".vtp":
        text = pyvista.PolyData.from_regular_faces(points, np.array([[0, 1, 2], [0, 1, 2]]))
        text.save(path, binary=False)
        content = path.read_text()
        assert content.count("0 1 2 0 1 2") == 1
        write(path, content.replace("0 1 2 0 1 2", "0 1 2 0 1 7"))
    elif kind == ".usda":
        gk.mesh.save(path, gk.mesh.TriangleMesh(points, [[0, 1, 2], [0, 1, 2]]))
        content = path.read_text()
        assert content.count("[0, 1, 2, 0, 1, 2]") == 1
        write(path, content.replace("[0, 1, 2, 0, 1, 2]", "[0, 1, 2, 0, 1, 7]"))
    elif kind == ".glb":
        good = np.array([[0, 1, 2], [0, 2, 1]], "<u4")
        gk.mesh.save(path, gk.mesh.TriangleMesh(points, good))
        content = path.read_bytes()
        assert content.count(good.tobytes()) == 1
        write(path, content.replace(good.tobytes(), np.array([[0, 1, 2], [0, 2, 7]], "<u4").tobytes()))
    else:
        meshio.Mesh(points, [("triangle", faces)]).write(path)
    with pytest.raises(gk.FileFormatError, match=str(path)):
        gk.mesh.load(path)


def test_not_a_number_in_other_formats(tmp_path):
    import meshio

    points = np.eye(3)
    points[1, 2] = np.nan
    meshio.Mesh(points, [("triangle", [[0, 1, 2]])]).write(tmp_path / "nan.vtu")
    with pytest.raises(gk.FileFormatError, match=r"vertex 1 \(counted from 0\) is not finite"):
        gk.mesh.load(tmp_path / "nan.vtu")


BAD_DATA = [
    ({"point_data": {"d": np.zeros(3)}}, r"point_data\['d'\]: shape \(3,\)"),
    ({"cell_data": {"d": np.zeros((2, 3))}}, r"cell_data\['d'\]: shape \(2, 3\)"),
    ({"point_data": {"d": np.zeros((12, 3, 3))}}, "shape"),
    ({"point_data": {"d": np.array(["a"] * 12)}}, "dtype"),
    ({"point_data": {"d": np.zeros(12, complex)}}, "dtype"),
    ({"point_data": {"": np.zeros(12)}}, "name"),
]


@pytest.mark.parametrize(("data", "message"), BAD_DATA, ids=range(len(BAD_DATA)))
def test_data_that_does_not_fit(tmp_path, data, message):
    with pytest.raises(gk.InputError, match=message):
        gk.mesh.save(tmp_path / "a.vtp", MESH, **data)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [kind for kind in extensions("mesh", "w") if FORMATS[kind].vertex != "*"])
def test_formats_without_data_name_those_with(tmp_path, kind):
    with pytest.raises(gk.InputError, match=r"holds no data arrays; use one of .*\.vtp"):
        gk.mesh.save(tmp_path / f"a{kind}", MESH, point_data={"d": np.zeros(len(MESH.vertices))})


@pytest.mark.parametrize("kind", FLOAT32)
def test_coordinates_beyond_float32_are_refused(tmp_path, kind):
    with pytest.raises(gk.InputError, match="beyond the float32"):
        gk.mesh.save(tmp_path / f"a{kind}", mesh_catalog.scaled(MESH, 1e39))
    assert not list(tmp_path.iterdir())


def test_mesh_without_faces_is_not_written(tmp_path):
    with pytest.raises(gk.InputError, match="no faces"):
        gk.mesh.save(tmp_path / "a.ply", gk.mesh.TriangleMesh(np.zeros((2, 3)), np.zeros((0, 3), int)))
    with pytest.raises(gk.InputError, match="not a TriangleMesh"):
        gk.mesh.save(tmp_path / "a.ply", MESH.vertices)


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    from geokit.formats import ply

    path = tmp_path / "a.ply"
    gk.mesh.save(path, MESH)
    before = path.read_bytes()

    def fail(part, mesh):
        part.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ply, "write_mesh", fail)
    with pytest.raises(gk.FileAccessError, match="No space left"):
        gk.mesh.save(path, mesh_catalog.box())
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.ply"]


# --- the readers' process --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_reader_that_does_not_start_does_not_blame_the_file(tmp_path, monkeypatch):
    path = tmp_path / "a.vtu"
    gk.mesh.save(path, MESH)
    program = write(tmp_path / "python", "#!/bin/sh\necho no memory >&2\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with pytest.raises(gk.WorkerError, match=r"did not start \(status 3: no memory\)"):
        gk.mesh.load(path)


@pytest.mark.slow
@pytest.mark.parametrize("gigabytes", [4, 16])
def test_a_hard_limit_of_address_space_is_kept(tmp_path, gigabytes):
    path = tmp_path / "a.vtu"
    gk.mesh.save(path, MESH)
    script = (
        f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({gigabytes} << 30,) * 2)\n"
        f"import geokit as gk; print(gk.mesh.load({str(path)!r}).face_count)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.strip() == str(MESH.face_count), done.stderr


def test_modules_in_the_working_folder_are_not_imported(tmp_path, monkeypatch):
    gk.mesh.save(tmp_path / "a.vtu", MESH)
    write(tmp_path / "numpy.py", "raise RuntimeError('the wrong numpy')\n")
    monkeypatch.chdir(tmp_path)
    assert len(gk.mesh.load("a.vtu").faces) == len(MESH.faces)


@pytest.mark.slow
def test_readers_print_nothing(tmp_path):
    kinds = [".obj", ".msh", ".vtp", ".vtu", ".glb", ".usda"]
    paths = [write(tmp_path / f"bad{kind}", "this is not a mesh\n" * 20) for kind in kinds]
    code = (
        "import sys, geokit as gk\n"
        "for path in sys.argv[1:]:\n"
        "    try: gk.mesh.load(path)\n"
        "    except gk.FileFormatError as error: assert path in str(error) and '\\n' not in str(error)\n"
        "    else: raise SystemExit(f'{path}: read it')\n"
        "    heavy = {'trimesh', 'pyvista', 'vtkmodules', 'meshio', 'scipy', 'warp', 'pxr'}\n"
        "    assert not heavy & set(sys.modules), path\n"
    )
    root = Path(gk.__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, paths)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_tolerance_is_for_curved_faces_only(tmp_path):
    gk.mesh.save(tmp_path / "a.ply", MESH)
    with pytest.raises(gk.InputError, match=r"tolerance: \.ply has no curved faces; leave it out"):
        gk.mesh.load(tmp_path / "a.ply", tolerance=0.1)
    for wrong in (0.0, -1.0, np.nan, "fine"):
        with pytest.raises(gk.InputError, match="tolerance"):
            gk.mesh.load(tmp_path / "a.step", tolerance=wrong)
