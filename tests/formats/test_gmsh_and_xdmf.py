"""Arrays of .msh by the tags of their rows; what XDMF says of binary numbers and of the first vertex."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.formats.text_files.decimal import SMALLEST

pytestmark = pytest.mark.slow

VERTICES = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
FACES = np.array([[quad[0], quad[at], quad[at + 1]] for quad in QUADS for at in (1, 2)])
TAGS = [10, 3, 77, 5, 1000, 2, 8, 9]
ELEMENTS = [100 - 7 * row for row in range(12)]


def loaded(path: Path, content: str | bytes) -> gk.mesh.TriangleMesh:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = gk.mesh.load(path)
    audit = gk.mesh.audit(mesh)
    assert (audit.face_count, audit.watertight, audit.signed_volume) == (12, True, 6.0)
    return mesh


# --- Gmsh -------------------------------------------------------------------------------------------------------------


def lines(rows: list[list[object]]) -> str:
    return "".join(" ".join(map(str, row)) + "\n" for row in rows)


def data(kind: str, name: str, rows: list[list[object]]) -> str:
    width = len(rows[0]) - 1
    return f'${kind}\n1\n"{name}"\n1\n0.0\n3\n0\n{width}\n{len(rows)}\n{lines(rows)}$End{kind}\n'


def gmsh(version: str) -> str:
    corners = [[TAGS[corner] for corner in face] for face in FACES.tolist()]
    places = VERTICES.tolist()
    if version == "2.2":
        nodes = "8\n" + lines([[tag, *place] for tag, place in zip(TAGS, places, strict=True)])
        cells = "12\n" + lines([[tag, 2, 2, 1, 1, *face] for tag, face in zip(ELEMENTS, corners, strict=True)])
    else:
        # Two blocks of nodes, and two of elements.
        parts = [f"2 {block + 1} 0 4\n{lines([[tag] for tag in TAGS[4 * block :][:4]])}" for block in (0, 1)]
        parts = [part + lines(places[4 * block :][:4]) for block, part in enumerate(parts)]
        nodes = "2 8 2 1000\n" + "".join(parts)
        rows = [[tag, *face] for tag, face in zip(ELEMENTS, corners, strict=True)]
        cells = f"2 12 1 100\n2 1 2 5\n{lines(rows[:5])}2 2 2 7\n{lines(rows[5:])}"
    return f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n$Nodes\n{nodes}$EndNodes\n$Elements\n{cells}$EndElements\n"


@pytest.mark.parametrize("version", ["2.2", "4.1"])
def test_rows_of_arrays_go_to_the_nodes_and_elements_of_their_tags(tmp_path: Path, version: str) -> None:
    random = np.random.default_rng(4)
    nodes, vectors, elements = random.random(8), random.random((8, 3)), random.random(12)
    order, turned = random.permutation(8), random.permutation(12)
    text = gmsh(version)
    text += data("NodeData", "a b", [[TAGS[row], nodes[row]] for row in order])
    text += data("NodeData", "v", [[TAGS[row], *vectors[row]] for row in order])
    text += data("NodeData", "some", [[TAGS[row], nodes[row]] for row in order[:3]])
    text += data("ElementData", "e", [[ELEMENTS[row], elements[row]] for row in turned])
    for end in ("\n", "\r\n"):
        mesh = loaded(tmp_path / "a.msh", text.replace("\n", end))
        np.testing.assert_array_equal(mesh.vertex_data["a b"], nodes)
        np.testing.assert_array_equal(mesh.vertex_data["v"], vectors)
        np.testing.assert_array_equal(mesh.face_data["e"], elements)
        expected = np.where(np.isin(np.arange(8), order[:3]), nodes, np.nan)
        np.testing.assert_array_equal(mesh.vertex_data["some"], expected)
    (tmp_path / "a.msh").write_text(text + data("NodeData", "b", [[4, 0.5]]))
    with pytest.warns(UserWarning, match="the array 'b' is left out: it has values for tags that are not there"):
        assert "a b" in gk.mesh.load(tmp_path / "a.msh").vertex_data


def test_binary_nodes_in_another_order_than_their_tags(tmp_path: Path) -> None:
    order = np.random.default_rng(5).permutation(8)
    nodes = struct.pack("<4Q3iQ8Q", 1, 8, 1, 8, 2, 1, 0, 8, *(order + 1)) + VERTICES[order].tobytes()
    cells = struct.pack("<4Q3iQ", 1, 12, 1, 12, 2, 1, 2, 12)
    cells += np.column_stack([np.arange(1, 13), FACES + 1]).astype("<u8").tobytes()
    values = b"".join(struct.pack("<id", row + 1, row / 3) for row in range(8))
    content = b"$MeshFormat\n4.1 1 8\n\1\0\0\0\n$EndMeshFormat\n$Nodes\n" + nodes + b"\n$EndNodes\n$Elements\n" + cells
    content += b'\n$EndElements\n$NodeData\n1\n"a"\n1\n0.0\n3\n0\n1\n8\n' + values + b"\n$EndNodeData\n"
    mesh = loaded(tmp_path / "a.msh", content)
    np.testing.assert_array_equal(mesh.vertices, VERTICES[order])
    np.testing.assert_array_equal(mesh.vertex_data["a"], order / 3)


@pytest.mark.parametrize("version", ["2.2", "4.0", "4.1"])
def test_binary_elements_in_another_order_than_their_tags(tmp_path: Path, version: str) -> None:
    nodes_in = np.random.default_rng(6).permutation(8) if version == "4.0" else np.arange(8)
    turned = np.random.default_rng(7).permutation(12)
    rows = np.column_stack([turned + 1, FACES + 1])
    if version == "4.1":
        nodes = struct.pack("<4Q3iQ8Q", 1, 8, 1, 8, 2, 1, 0, 8, *range(1, 9)) + VERTICES.tobytes()
        cells = struct.pack("<4Q3iQ", 1, 12, 1, 12, 2, 1, 2, 12) + rows.astype("<u8").tobytes()
    else:
        nodes = b"".join(struct.pack("<i3d", row + 1, *VERTICES[row]) for row in nodes_in)
        nodes = (b"8\n" if version == "2.2" else struct.pack("<2Q3iQ", 1, 8, 1, 2, 0, 8)) + nodes
        cells = struct.pack("<2Q3iQ", 1, 12, 1, 2, 2, 12) + rows.astype("<i4").tobytes()
    if version == "2.2":
        # A block of each element, as Gmsh writes them.
        cells = b"12\n" + b"".join(struct.pack("<9i", 2, 1, 2, row[0], 1, 1, *row[1:]) for row in rows.tolist())
    content = f"$MeshFormat\n{version} 1 8\n".encode() + b"\1\0\0\0\n$EndMeshFormat\n$Nodes\n" + nodes
    content += b"\n$EndNodes\n$Elements\n" + cells + b"\n$EndElements\n"
    for kind, count in ((b"Node", 8), (b"Element", 12)):
        values = b"".join(struct.pack("<id", row + 1, row / 3) for row in range(count))
        content += b'$%sData\n1\n"a"\n1\n0.0\n3\n0\n1\n%d\n%s\n$End%sData\n' % (kind, count, values, kind)
    mesh = loaded(tmp_path / "a.msh", content)
    np.testing.assert_array_equal(mesh.vertices, VERTICES[nodes_in])
    np.testing.assert_array_equal(mesh.vertex_data["a"], nodes_in / 3)
    np.testing.assert_array_equal(mesh.face_data["a"], turned / 3)


def packed(order: str, kinds: str, *numbers: float) -> bytes:
    return struct.pack(order + kinds, *numbers)


def binary(version: str, order: str, *, parameters: int = 0, size: int = 8) -> bytes:
    """The box in two blocks of nodes and of elements, with tags that are neither in order nor without gaps."""
    length = "Q" if size == 8 or version == "4.0" else "I"
    tag = length if version == "4.1" else "i"
    places = [[*place, *[0.5] * parameters] for place in VERTICES.tolist()]
    corners = [[TAGS[corner] for corner in face] for face in FACES.tolist()]
    nodes, cells = b"", b""
    for first in (0, 4):
        part, rows = TAGS[first:][:4], places[first:][:4]
        head = (1, 2) if version == "4.0" else (2, 1)
        if version != "2.2":
            nodes += packed(order, f"3i{length}", *head, int(parameters > 0), 4)
        if version == "4.1":
            nodes += packed(order, f"4{tag}", *part) + np.array(rows).astype(order + "f8").tobytes()
        else:
            nodes += b"".join(packed(order, f"i{len(row)}d", at, *row) for at, row in zip(part, rows, strict=True))
    for first, count in ((0, 5), (5, 7)):
        head = (2, count, 2) if version == "2.2" else (1, 2, 2, count) if version == "4.0" else (2, 1, 2, count)
        cells += packed(order, "3i" if version == "2.2" else f"3i{length}", *head)
        for at, face in zip(ELEMENTS[first:][:count], corners[first:][:count], strict=True):
            row = (at, 6, 1, *face) if version == "2.2" else (at, *face)
            cells += packed(order, f"{len(row)}{tag}", *row)
    heads = {
        "2.2": (b"8\n", b"12\n"),
        "4.0": (packed(order, "2Q", 2, 8), packed(order, "2Q", 2, 12)),
        "4.1": (packed(order, f"4{length}", 2, 8, 2, 1000), packed(order, f"4{length}", 2, 12, 1, 100)),
    }[version]
    return b"$MeshFormat\n%s 1 %d\n%s\n$EndMeshFormat\n$Nodes\n%s\n$EndNodes\n$Elements\n%s\n$EndElements\n" % (
        version.encode(), size, packed(order, "i", 1), heads[0] + nodes, heads[1] + cells,
    )  # fmt: skip


def binary_data(order: str, kind: str, name: str, rows: list[list[float]], step: int = 0) -> bytes:
    content = b"".join(packed(order, f"i{len(row) - 1}d", *row) for row in rows)
    head = f'${kind}\n1\n"{name}"\n1\n0.0\n3\n{step}\n{len(rows[0]) - 1}\n{len(rows)}\n'
    return head.encode() + content + f"\n$End{kind}\n".encode()


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("version", "size"), [("2.2", 8), ("4.0", 8), ("4.1", 8), ("4.1", 4)])
def test_binary_rows_go_to_the_nodes_and_elements_of_their_tags(
    tmp_path: Path, version: str, size: int, order: str
) -> None:
    random = np.random.default_rng(4)
    nodes, vectors, elements = random.random(8), random.random((8, 3)), random.random(12)
    some, turned = random.permutation(8), random.permutation(12)
    content = binary(version, order, size=size)
    content += binary_data(order, "NodeData", "a", [[TAGS[row], nodes[row]] for row in some[:5]])
    content += binary_data(order, "NodeData", "v", [[TAGS[row], *vectors[row]] for row in some])
    content += binary_data(order, "ElementData", "e", [[ELEMENTS[row], elements[row]] for row in turned])
    mesh = loaded(tmp_path / "a.msh", content)
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(mesh.vertex_data["a"], np.where(np.isin(np.arange(8), some[:5]), nodes, np.nan))
    np.testing.assert_array_equal(mesh.vertex_data["v"], vectors)
    np.testing.assert_array_equal(mesh.face_data["e"], elements)
    assert set(mesh.face_data) == ({"e", "physical"} if version == "2.2" else {"e"})
    for cut in range(0, content.index(b"$EndElements"), 97):
        (tmp_path / "b.msh").write_bytes(content[:cut])
        with pytest.raises(gk.FileFormatError, match=r"b\.msh"):
            gk.mesh.load(tmp_path / "b.msh", trusted=True)


@pytest.mark.parametrize("version", ["4.0", "4.1"])
def test_parameters_of_nodes_are_passed_over(tmp_path: Path, version: str) -> None:
    rows = [[1, 0, 0, 0, 0.5, 0.5], [2, 1, 0, 0, 0.5, 0.5], [3, 0, 1, 0, 0.5, 0.5]]
    nodes, cells = f"1 3\n1 2 1 3\n{lines(rows)}", "1 1\n1 2 2 1\n1 1 2 3\n"
    if version == "4.1":
        nodes = f"1 3 1 3\n2 1 1 3\n1\n2\n3\n{lines([row[1:] for row in rows])}"
        cells = "1 1 1 1\n2 1 2 1\n1 1 2 3\n"
    path = tmp_path / "a.msh"
    path.write_text(
        f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n$Nodes\n{nodes}$EndNodes\n$Elements\n{cells}$EndElements\n"
    )
    np.testing.assert_array_equal(gk.mesh.load(path).vertices, np.array(rows)[:, 1:4])
    mesh = loaded(tmp_path / "b.msh", binary(version, "<", parameters=2))
    np.testing.assert_array_equal(mesh.vertices, VERTICES)


ENTITIES = """$PhysicalNames
2
2 4 "wall"
2 9 "roof"
$EndPhysicalNames
$Entities
0 0 2 0
1 0 0 0 1 1 1 2 4 9 0
2 0 0 0 1 1 1 0 0
$EndEntities
"""


def test_groups_of_some_entities_and_steps_of_arrays(tmp_path: Path) -> None:
    text = gmsh("4.1").replace("$Nodes", f"{ENTITIES}$Nodes", 1).replace("2 2 2 7\n", "2 2 2 7\n")
    text += data("NodeData", "t", [[tag, 1.0] for tag in TAGS])
    text += data("NodeData", "t", [[tag, 2.0] for tag in TAGS]).replace("3\n0\n1\n", "3\n7\n1\n")
    corners = [[tag, 3, tag + 0.25, tag + 0.5, tag + 0.75] for tag in ELEMENTS[::-1]]
    text += data("ElementNodeData", "c", corners).replace("3\n0\n4\n", "3\n0\n1\n")
    (tmp_path / "a.msh").write_text(text)
    with pytest.warns(UserWarning, match="5 faces are of several physical groups, and the first is kept") as said:
        mesh = gk.mesh.load(tmp_path / "a.msh")
    assert "the array 't' has 2 time steps; the last (7) is kept" in str(said[0].message)
    assert mesh.face_data["physical"].tolist() == [4] * 5 + [0] * 7
    assert set(mesh.vertex_data["t"]) == {2.0}
    np.testing.assert_array_equal(mesh.corner_data["c"], np.array(ELEMENTS)[:, None] + [0.25, 0.5, 0.75])


def test_names_of_groups_are_those_of_parts(tmp_path: Path) -> None:
    mesh = loaded(tmp_path / "a.msh", gmsh("4.1").replace("$Nodes", f"{ENTITIES.replace('2 4 9 0', '1 9 0')}$Nodes", 1))
    assert [(part.name, part.first_face, part.face_count) for part in mesh.parts] == [("roof", 0, 5), ("", 5, 7)]
    # In version 2 elements have their groups, and a name may have any signs.
    names = '$PhysicalNames\n3\n1 7 "edge"\n2 7 "top \xe4 side"\n2 8 ""\n$EndPhysicalNames\n'
    text = gmsh("2.2").replace(" 2 2 1 1 ", " 2 2 7 1 ", 5).replace(" 2 2 1 1 ", " 2 2 8 1 ")
    mesh = loaded(tmp_path / "a.msh", text.replace("$Nodes", f"{names}$Nodes", 1))
    assert [(part.name, part.face_count) for part in mesh.parts] == [("top \xe4 side", 5), ("8", 7)]
    assert mesh.face_data["physical"].tolist() == [7] * 5 + [8] * 7
    # One group is the whole mesh.
    assert not loaded(tmp_path / "a.msh", gmsh("2.2").replace("$Nodes", f"{names}$Nodes", 1)).parts
    (tmp_path / "a.msh").write_text(text.replace("$Nodes", f"{names.replace('2 7', 'two 7')}$Nodes", 1))
    with pytest.raises(gk.FileFormatError, match="where the name of a group belongs"):
        gk.mesh.load(tmp_path / "a.msh")


def test_names_of_groups_whose_faces_alternate_are_told(tmp_path: Path) -> None:
    many = 1200
    cells = "".join(f"{row + 1} 2 2 {1 + row % 2} 1 10 3 77\n" for row in range(many))
    nodes = gmsh("2.2").partition("$Elements")[0]
    names = '$PhysicalNames\n2\n2 1 "a"\n2 2 "b"\n$EndPhysicalNames\n'
    (tmp_path / "a.msh").write_text(
        nodes.replace("$Nodes", f"{names}$Nodes", 1) + f"$Elements\n{many}\n{cells}$EndElements\n"
    )
    with pytest.warns(UserWarning, match="groups are left out, for their faces alternate: 1 'a', 2 'b'"):
        mesh = gk.mesh.load(tmp_path / "a.msh")
    assert not mesh.parts
    assert mesh.face_data["physical"][:3].tolist() == [1, 2, 1]


def test_groups_of_partitions(tmp_path: Path) -> None:
    parts = "$PartitionedEntities\n2\n0\n0 0 2 0\n1 2 5 1 1 0 0 0 1 1 1 1 4 0\n2 2 5 1 2 0 0 0 1 1 1 1 4 0\n"
    mesh = loaded(tmp_path / "a.msh", gmsh("4.1").replace("$Nodes", f"{parts}$EndPartitionedEntities\n$Nodes", 1))
    assert set(mesh.face_data["physical"]) == {4}


def test_elements_of_several_types_in_any_order(tmp_path: Path) -> None:
    rows = ["7 15 2 0 1 3", "1 2 2 4 1 10 5 77", "9 1 0 10 3", "2 3 3 6 1 8 10 3 5 77", "3 4 2 6 1 10 3 5 77"]
    nodes = gmsh("2.2").partition("$Elements")[0]
    text = f"{nodes}$Elements\n5\n" + "\n".join(rows) + "\n$EndElements\n"
    text += data("ElementData", "e", [[2, 0.5], [1, 0.25], [3, 0.125]]) + data("ElementData", "f", [[3, 0.5]])
    (tmp_path / "a.msh").write_text(text)
    with pytest.warns(UserWarning, match="the array 'f' is left out: it has no values on the surface") as said:
        mesh = gk.mesh.load(tmp_path / "a.msh")
    told = "its volume cells (1 tetra) are left out; its points (1) are left out; its lines (1) are left out"
    assert told in str(said[0].message)
    assert mesh.face_data["physical"].tolist() == [4, 6, 6]
    assert mesh.face_data["e"].tolist() == [0.25, 0.5, 0.5]
    assert mesh.faces[0].tolist() == [0, 3, 2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("$NOD\n1\n1 0 0 0\n$ENDNOD\n", "is of version 1 of .msh, which is not read; save it as 4.1"),
        ("$MeshFormat\n3.0 0 8\n$EndMeshFormat\n", "is of version '3.0' of .msh, which is not read"),
        (gmsh("2.2").replace("\n2 ", "\n10 ", 1), "two of its nodes have the tag 10"),
        (gmsh("4.1").replace("100 10 ", "100 11 "), "an element has the node 11, which is not there"),
        (gmsh("4.1").replace("2 2 2 7\n", "2 2 34 7\n"), "elements of Gmsh's type 34, which are not read"),
        (gmsh("2.2").partition("$Elements")[0], "has no section Elements"),
        (gmsh("2.2").replace("$EndElements\n", ""), "ends within its section Elements"),
        (gmsh("4.1").replace(" 2.0 ", " two "), "has words among its numbers"),
    ],
)
def test_gmsh_files_that_are_not_read_are_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.msh").write_text(text)
    with pytest.raises(gk.FileFormatError, match=message):
        gk.mesh.load(tmp_path / "a.msh")


def long_text(version: str, side: int, first: int) -> tuple[str, np.ndarray, np.ndarray]:
    """A grid of triangles whose tags are in no order and begin with ``first``, its positions and its faces."""
    random = np.random.default_rng(9)
    places = random.normal(size=(side * side, 3)) * 10.0 ** random.integers(-9, 9, (side * side, 1))
    tags = first + random.permutation(side * side)
    at = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.stack([at, at + 1, at + side], 1), np.stack([at + 1, at + side + 1, at + side], 1)])
    corners, count = tags[faces].tolist(), len(places)
    if version == "2.2":
        nodes = f"{count}\n" + lines([[tag, *place] for tag, place in zip(tags.tolist(), places.tolist(), strict=True)])
        cells = f"{len(faces)}\n" + lines([[row + 1, 2, 2, 3, 1, *face] for row, face in enumerate(corners)])
    else:
        nodes = f"1 {count} 1 {count}\n2 1 0 {count}\n" + lines([[tag] for tag in tags.tolist()])
        nodes += lines(places.tolist())
        cells = f"1 {len(faces)} 1 9\n2 1 2 {len(faces)}\n" + lines(
            [[row + 1, *face] for row, face in enumerate(corners)]
        )
    text = f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n$Nodes\n{nodes}$EndNodes\n$Elements\n{cells}$EndElements\n"
    return text, places, faces


@pytest.mark.parametrize(("version", "first"), [("2.2", 1), ("4.1", 1), ("4.1", (1 << 53) + 1)])
def test_long_text_is_read_as_short_text_is(tmp_path: Path, version: str, first: int) -> None:
    """By the parser of plain numbers, but for tags that float64 does not hold."""
    text, places, faces = long_text(version, 30, first)
    assert len(text) > 4 * SMALLEST
    for end in ("\n", "\r\n", " \t\n"):
        (tmp_path / "a.msh").write_bytes(text.replace("\n", end).encode())
        mesh = gk.mesh.load(tmp_path / "a.msh", trusted=True)
        np.testing.assert_array_equal(mesh.vertices, places)
        np.testing.assert_array_equal(mesh.faces, faces)


@pytest.mark.parametrize("version", ["2.2", "4.1"])
@pytest.mark.parametrize(
    ("section", "word", "message"),
    [
        ("Nodes", "x1", "has words among its numbers"),
        ("Elements", "x1", "has words among its numbers"),
        ("Elements", "1,5", "has words among its numbers"),
        ("Elements", "1.5", "has words among its numbers|is not whole"),
        ("Elements", "nan", "has words among its numbers|is not whole"),
        ("Elements", "", "ends within"),
    ],
)
def test_damage_in_long_text_is_named(tmp_path: Path, version: str, section: str, word: str, message: str) -> None:
    head, found, rest = long_text(version, 30, 1)[0].partition(f"${section}\n")
    body, end, tail = rest.partition(f"$End{section}")
    rows = body.split("\n")
    rows[-2] = " ".join([*rows[-2].split()[:-1], word])
    (tmp_path / "a.msh").write_text(head + found + "\n".join(rows) + end + tail)
    with pytest.raises(gk.FileFormatError, match=rf"a\.msh: .*({message})"):
        gk.mesh.load(tmp_path / "a.msh", trusted=True)


# --- XDMF -------------------------------------------------------------------------------------------------------------


def xdmf(item: str, topology: str = "", corners: np.ndarray = FACES, more: str = "") -> str:
    return (
        '<Xdmf Version="3.0"><Domain><Grid Name="g">'
        f'<Topology TopologyType="Triangle" NumberOfElements="12" {topology}>'
        f'<DataItem Dimensions="12 3" NumberType="Int" Format="XML">{lines(corners.tolist())}</DataItem></Topology>'
        f'<Geometry GeometryType="XYZ">{item}</Geometry>{more}</Grid></Domain></Xdmf>'
    )


PLAIN = f'<DataItem Dimensions="8 3" Format="XML">{lines(VERTICES.tolist())}</DataItem>'


@pytest.mark.parametrize("kind", ["<f8", ">f8", ">f4"])
@pytest.mark.parametrize("before", [0, 24])
def test_binary_numbers_in_their_order_of_bytes(tmp_path: Path, kind: str, before: int) -> None:
    (tmp_path / "a.bin").write_bytes(b"x" * before + VERTICES.astype(kind).tobytes() + b"y" * before)
    endian = {"<": "Little", ">": "Big"}[kind[0]]
    said = f'Endian="{endian}" Precision="{kind[2]}" ' + (f'Seek="{before}"' if before else "")
    loaded(tmp_path / "a.xdmf", xdmf(f'<DataItem Dimensions="8 3" Format="Binary" {said}>a.bin</DataItem>'))


def test_the_first_vertex_has_the_number_that_the_file_says(tmp_path: Path) -> None:
    mesh = loaded(tmp_path / "a.xdmf", xdmf(PLAIN, 'BaseOffset="1"', FACES + 1))
    np.testing.assert_array_equal(mesh.faces, FACES)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (xdmf(PLAIN, 'Order="2 1 0"'), "corners of its cells in the order 2 1 0"),
        (xdmf(f'<DataItem ItemType="Function" Dimensions="8 3">{PLAIN}</DataItem>'), "an array of the type Function"),
        (xdmf('<DataItem Dimensions="8 3" Format="Binary" Compression="Zlib">a.bin</DataItem>'), "are compressed"),
    ],
)
def test_what_is_not_read_is_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.bin").write_bytes(VERTICES.tobytes())
    (tmp_path / "a.xdmf").write_text(text)
    with pytest.raises(gk.FileFormatError, match=message):
        gk.mesh.load(tmp_path / "a.xdmf")


def test_arrays_of_the_whole_grid_are_left_out_with_a_word(tmp_path: Path) -> None:
    item = '<DataItem Dimensions="1" Format="XML">5</DataItem>'
    more = f'<Attribute Name="time" Center="Grid">{item}</Attribute>'
    (tmp_path / "a.xdmf").write_text(xdmf(PLAIN, more=more))
    with pytest.warns(UserWarning, match="the array 'time' is left out: it is of center 'Grid'"):
        assert gk.mesh.load(tmp_path / "a.xdmf").face_count == 12
