"""Byte order marks, blanks that are not seen, ends of lines, keywords in capitals: in every format of text."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.formats.text_files.plain import plain_text

VERTICES = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
ROWS = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in VERTICES.tolist())
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 6\nproperty list uchar int vertex_indices\nend_header\n"
)
FACETS = "".join(
    "facet normal 0 0 0\nouter loop\n"
    + "".join("vertex " + " ".join(map(repr, VERTICES[corner].tolist())) + "\n" for corner in (q[0], q[at], q[at + 1]))
    + "endloop\nendfacet\n"
    for q in QUADS
    for at in (1, 2)
)
MESHES = {
    "a.obj": "".join(f"v {row}\n" for row in ROWS.splitlines())
    + "".join("f " + " ".join(str(corner + 1) for corner in quad) + "\n" for quad in QUADS),
    "a.ply": PLY + ROWS + "".join(f"4 {' '.join(map(str, quad))}\n" for quad in QUADS),
    "a.off": "OFF\n8 6 0\n" + ROWS + "".join(f"4 {' '.join(map(str, quad))}\n" for quad in QUADS),
    "a.stl": f"solid box\n{FACETS}endsolid box\n",
}
CLOUDS = {
    "b.obj": "".join(f"v {row}\n" for row in ROWS.splitlines()),
    "b.ply": PLY.replace("element face 6\nproperty list uchar int vertex_indices\n", "") + ROWS,
    "b.pcd": "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 8\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 8\nDATA ascii\n" + ROWS,
    "b.pts": "8\n" + ROWS,
    "b.xyz": ROWS,
    "b.txt": "# x y z\n" + ROWS,
    "b.csv": "x,y,z\n" + ROWS.replace(" ", ","),
}
WAYS = {
    "mark": lambda text: ("\ufeff" + text).encode(),
    "UTF-16": lambda text: text.encode("utf-16"),
    "UTF-16, other order": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "UTF-32": lambda text: text.encode("utf-32"),
    "CR": lambda text: text.replace("\n", "\r").encode(),
    "CRLF": lambda text: text.replace("\n", "\r\n").encode(),
    "some CR": lambda text: text.replace("\n", "\r", 4).encode(),
    "no-break spaces": lambda text: text.replace(" ", "\u00a0").encode(),
    "no-break spaces of Latin-1": lambda text: text.replace(" ", "\u00a0").encode("latin-1"),
    "narrow spaces": lambda text: text.replace(" ", "\u202f ").encode(),
    "zero-width spaces": lambda text: text.replace(" ", " \u200b").replace("\n", "\u200b\n").encode(),
    "marks within": lambda text: text.replace("\n", "\n\ufeff").encode(),
    "blanks at the ends": lambda text: text.replace("\n", " \n").encode(),
    "exponents of Fortran": lambda text: (
        text.replace("2 3\n", "0.2D+01 3.0d0\n").replace("2,3\n", "0.2D+01,3.0d0\n").encode()
    ),
    "no newline at the end": lambda text: text.rstrip("\n").encode(),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", MESHES)
def test_meshes_are_read_whole(tmp_path: Path, name: str, way: str) -> None:
    path = tmp_path / name
    path.write_bytes(WAYS[way](MESHES[name]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        audit = gk.mesh.audit(gk.mesh.load(path))
    assert (audit.face_count, audit.watertight, audit.signed_volume) == (12, True, 6.0)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_are_read_whole(tmp_path: Path, name: str, way: str) -> None:
    path = tmp_path / name
    path.write_bytes(WAYS[way](CLOUDS[name]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cloud = gk.points.load(path)
    assert cloud.points.tolist() == VERTICES.tolist()
    assert not cloud.data


@pytest.mark.parametrize("name", [*MESHES, *CLOUDS])
def test_capitals(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    text = {**MESHES, **CLOUDS}[name]
    path.write_text(text.upper().replace("VERTEX_INDICES", "vertex_indices"))
    if name in MESHES:
        assert gk.mesh.audit(gk.mesh.load(path)).signed_volume == 6.0
    else:
        assert gk.points.load(path).points.tolist() == VERTICES.tolist()


@pytest.mark.parametrize("name", [*MESHES, *CLOUDS])
@pytest.mark.parametrize("order", ["le", "be"])
def test_utf_16_without_a_mark_is_named(tmp_path: Path, name: str, order: str) -> None:
    path = tmp_path / name
    path.write_bytes({**MESHES, **CLOUDS}[name].encode(f"utf-16-{order}"))
    with pytest.raises(gk.FileFormatError, match="UTF-16 without a byte order mark"):
        (gk.mesh.load if name in MESHES else gk.points.load)(path)


def test_what_is_plain_is_left_alone(tmp_path: Path) -> None:
    for data in (b"", b"v 1 2 3\r\nv 4 5 6\n", "# Höhe über Grund\n1 2 3\n".encode()):
        assert plain_text(data, tmp_path) == data
    ascii_text = b"1 2 3\r\n"
    assert plain_text(ascii_text, tmp_path) is ascii_text


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_a_mark_before_binary_content(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a.{kind}"
    gk.points.save(path, VERTICES)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert gk.points.load(path).points.tolist() == VERTICES.tolist()


def test_a_mark_before_a_streamed_file(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    mesh = gk.mesh.TriangleMesh(VERTICES, [[q[0], q[at], q[at + 1]] for q in QUADS for at in (1, 2)])
    gk.mesh.save(path, mesh)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert gk.mesh.audit_file(path).signed_volume == 6.0
    path.write_bytes(("\ufeff" + MESHES["a.ply"]).encode())
    with pytest.raises(gk.FileFormatError, match="is text"):
        gk.mesh.audit_file(path)


def test_unknown_lines_of_an_obj_are_told_once(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("# a box\n" + MESHES["a.obj"] + "s off\nl 1 2\nfoo 1\nbar\nfoo 2\n")
    with pytest.warns(UserWarning, match=r"3 lines begin with words .*the first is line 18, 'foo'") as said:
        assert gk.mesh.audit(gk.mesh.load(path)).signed_volume == 6.0
    assert len(said) == 1
    with pytest.warns(UserWarning, match="line 18, 'foo'"):
        assert len(gk.points.load(path).points) == 8


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("v 1 2", r"line 2 \('v 1 2'\) is not a vertex: vertex 1 has 2 coordinates"),
        ("V 1 2 x", r"line 2 \('V 1 2 x'\) is not a vertex: 'x' is not a number"),
        ("v1 2 3", r"line 2 \('v1 2 3'\) begins with no known word"),
        ("v,1,2,3", "line 2 .* begins with no known word"),
        ("v 1 \\\n2", r"line 2 .* is not a vertex"),
    ],
)
def test_a_vertex_that_is_none_is_named_by_its_line(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "a.obj"
    path.write_text(f"v 0 0 0\n{line}\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for load in (gk.mesh.load, gk.points.load):
        with pytest.raises(gk.FileFormatError, match=message):
            load(path)


@pytest.mark.parametrize("name", ["a.obj", "a.off", "a.ply"])
def test_an_unused_vertex_that_is_not_finite_is_left_out(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    text = MESHES[name].replace("8 6 0", "9 6 0").replace("vertex 8", "vertex 9")
    head, last, faces = text.partition("1 2 3\n")
    path.write_text(head + last + ("v " if name == "a.obj" else "") + "nan 0 -nan(ind)\n" + faces)
    with pytest.warns(UserWarning, match="not finite and that no face uses are left out: 1, the first is vertex 8"):
        mesh = gk.mesh.load(path)
    assert gk.mesh.audit(mesh).signed_volume == 6.0
    assert len(mesh.vertices) == 8


def test_attributes_follow_when_a_vertex_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v nan 0 0 0 0 0\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nf 2 3 4\n")
    with pytest.warns(UserWarning, match="left out: 1, the first is vertex 0"):
        mesh = gk.mesh.load(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert mesh.vertex_data["color"].tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    path.write_text("v nan 0 0\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 3 4\n")
    with pytest.raises(gk.FileFormatError, match=r"vertex 0 .* is not finite"):
        gk.mesh.load(path)
