"""STL, OBJ, OFF, XDMF and USD as programs write them beside the letter of the format."""

from __future__ import annotations

import contextlib
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

import geokit as gk

VERTICES = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
FACES = np.array([[quad[0], quad[at], quad[at + 1]] for quad in QUADS for at in (1, 2)])
FACETS = "".join(
    "facet normal 0 0 0\n outer loop\n"
    + "".join(f"  vertex {x!r} {y!r} {z!r}\n" for x, y, z in VERTICES[face].tolist())
    + " endloop\nendfacet\n"
    for face in FACES
)
HALVES = ["endfacet\n".join([*part, ""]) for part in (FACETS.split("endfacet\n")[:6], FACETS.split("endfacet\n")[6:-1])]
RECORDS = b"".join(struct.pack("<12fH", 0, 0, 0, *VERTICES[face].ravel(), 0) for face in FACES)


def loaded(path: Path, content: str | bytes) -> gk.mesh.TriangleMesh:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    mesh = gk.mesh.load(path)
    audit = gk.mesh.audit(mesh)
    assert (audit.face_count, audit.watertight, audit.signed_volume) == (12, True, 6.0)
    return mesh


# --- STL --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        f"solid a\n{FACETS}end solid a\n",
        f"solid a\n{FACETS}endsolid",
        f"SOLID a\n{FACETS.upper()}END SOLID a\n",
        f"solid a\r{FACETS}endsolid a\r".replace("\n", "\r"),
        " ".join(f"solid a\n{FACETS}endsolid a\n".split()),
        f"solid a\n{FACETS}endsolid a\n".replace("outer", "color 1 0 0\n outer"),
        f"solid a\n color 0.5 0.5 0.5\n{FACETS}endsolid a\n".replace("0 0 0\n", "0 0 0\n COLOR 1 0 0\n"),
        f"solid a\n{FACETS}endsolid a\n".replace("1.0", "0.1D+01"),
        f"solid my facet normal part\n{FACETS}endsolid my facet normal part\n",
    ],
)
def test_text_of_stl(tmp_path: Path, text: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded(tmp_path / "a.stl", text)


def test_stl_without_endsolid_is_read_and_told(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="the last solid has no 'endsolid'"):
        loaded(tmp_path / "a.stl", f"solid a\n{FACETS}")
    with pytest.warns(UserWarning, match="a solid has no 'endsolid' before the next"):
        mesh = loaded(tmp_path / "a.stl", f"solid a\n{HALVES[0]}solid b\n{HALVES[1]}endsolid b\n")
    assert [(part.name, part.face_count) for part in mesh.parts] == [("a", 6), ("b", 6)]


@pytest.mark.parametrize("cut", ["endfacet\n", " endloop\nendfacet\n", "0\n  vertex 1.0 2.0 3.0\n endloop\nendfacet\n"])
def test_stl_that_ends_in_a_facet_is_refused(tmp_path: Path, cut: str) -> None:
    path = tmp_path / "a.stl"
    path.write_text(f"solid a\n{FACETS}"[: -len(cut)])
    with pytest.raises(gk.FileFormatError, match="no 'endsolid'"):
        gk.mesh.load(path)


@pytest.mark.parametrize("head", [b"", b"solid of a CAD", b"solid facet normal outer loop vertex"])
@pytest.mark.parametrize("behind", [1, 37, 49, 51, 1234])
def test_bytes_behind_a_binary_stl(tmp_path: Path, head: bytes, behind: int) -> None:
    path = tmp_path / "a.stl"
    with pytest.warns(UserWarning, match=f"{behind} bytes behind the last of its 12 triangles"):
        loaded(path, head.ljust(80) + struct.pack("<I", 12) + RECORDS + b"\x01" * behind)
    with pytest.warns(UserWarning, match=f"{behind} bytes behind the last of its 12 triangles"):
        assert gk.mesh.audit_file(path).signed_volume == 6.0


@pytest.mark.parametrize("count", [0, 11, 2, 13, 1 << 31])
def test_a_wrong_count_of_triangles_is_refused(tmp_path: Path, count: int) -> None:
    path = tmp_path / "a.stl"
    path.write_bytes(b"".ljust(80) + struct.pack("<I", count) + RECORDS)
    with pytest.raises(gk.FileFormatError, match=f"declares {count} triangles"):
        gk.mesh.load(path)
    with pytest.raises(gk.FileFormatError, match=f"not those of {count} triangles"):
        gk.mesh.audit_file(path)


# --- OBJ --------------------------------------------------------------------------------------------------------------

LINES = [f"v {x!r} {y!r} {z!r}" for x, y, z in VERTICES.tolist()]
TRIANGLES = [f"f {a} {b} {c}" for a, b, c in (FACES + 1).tolist()]


def obj(behind: str = "") -> str:
    return "\n".join([*(line + behind for line in LINES), *TRIANGLES, ""])


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_backslash_ends_a_comment_of_an_obj(tmp_path: Path, end: str) -> None:
    # As in "# exported to C:\\models\\"; the vertex or the face below was taken for more of the comment.
    text = obj().replace(LINES[3], f"# C:\\models\\\n{LINES[3]}").replace(TRIANGLES[0], f"# C:\\\\\n{TRIANGLES[0]}")
    text = text.replace(LINES[5], LINES[5] + " # C:\\").replace("f 1 2 ", "f 1 \\\n 2 ")
    loaded(tmp_path / "a.obj", text.replace("\n", end))
    assert len(gk.points.load(tmp_path / "a.obj").points) == 8


def test_what_stands_behind_vertices_of_an_obj(tmp_path: Path) -> None:
    for behind in ("", " 1.0", " # a b c", " 1.0 # 2 3 4"):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert not loaded(tmp_path / "a.obj", obj(behind)).vertex_data
    for behind, color in ((" 1 0.5 0 # red", [1.0, 0.5, 0.0]), (" 255 128 0", [255, 128, 0]), (" 1 0 1", [1.0, 0, 1])):
        mesh = loaded(tmp_path / "a.obj", obj(behind))
        assert mesh.vertex_data["color"].dtype == (np.uint8 if color[0] == 255 else np.float64)
        assert mesh.vertex_data["color"].tolist() == [color] * 8
        cloud = gk.points.load(tmp_path / "a.obj")
        assert cloud.data["rgb"].dtype == mesh.vertex_data["color"].dtype
        assert cloud.data["rgb"].tolist() == [color] * 8
    with pytest.warns(UserWarning, match="numbers behind the coordinates of vertices are left out"):
        assert not loaded(tmp_path / "a.obj", obj(" 1.0 1 0.5 0")).vertex_data


def test_files_that_an_obj_calls_are_told(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"its called files \(1\) are left out"):
        loaded(tmp_path / "a.obj", "call b.obj\n" + obj())


# --- OFF --------------------------------------------------------------------------------------------------------------

_ROWS = "".join(f"{x} {y} {z}\n" for x, y, z in VERTICES.tolist())
_FACES = "".join(f"3 {a} {b} {c}\n" for a, b, c in FACES.tolist())


@pytest.mark.parametrize(
    "text",
    [
        f"OFF8 12 0\n{_ROWS}{_FACES}",
        f"off\n8 12 0\n{_ROWS}{_FACES}",
        f"coff 8 12 0\n{_ROWS.replace(chr(10), ' 255 0 0 255' + chr(10))}{_FACES}",
        f"8 12 0\n{_ROWS}{_FACES}",
        f"# no word\n8 12\n\n{_ROWS}{_FACES}",
        f"OFF\n8 12 0\n{_ROWS}{_FACES.replace(' ', chr(10), 1)}",
        f"OFF\n8 12 0\n{_ROWS}{_FACES.replace('3 ', '3' + chr(10))}",
        f"OFF # a box\r# counts\r8 12 0\r{_ROWS}{_FACES}".replace("\n", "\r"),
    ],
)
def test_text_of_off(tmp_path: Path, text: str) -> None:
    loaded(tmp_path / "a.off", text)


@pytest.mark.parametrize(
    ("word", "behind"),
    [
        ("CNOFF", "0.5 0 1 {color}"), ("STCNOFF", "0.5 0 1 {color} 0.25 0.75"),  # as Geomview
        ("NCOFF", "{color} 0.5 0 1"), ("NCSTOFF", "{color} 0.5 0 1 0.25 0.75"),  # as MeshLab
        ("NSTOFF", "0.5 0 1 0.25 0.75"), ("CSTOFF", "{color} 0.25 0.75"), ("NOFF", "0.5 0 1"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("color", ["17 34 51", "17 34 51 255"])
def test_attributes_of_off_in_two_orders(tmp_path: Path, word: str, behind: str, color: str) -> None:
    rows = "".join(f"{row} {behind.format(color=color)}\n" for row in _ROWS.splitlines())
    mesh = loaded(tmp_path / "a.off", f"{word}\n8 12 0\n{rows}{_FACES}")
    expected = {"normal": [0.5, 0, 1]} if "N" in word else {}
    expected |= {"color": [int(part) for part in color.split()]} if "C" in word else {}
    expected |= {"uv": [0.25, 0.75]} if "ST" in word else {}
    assert {name: values.tolist() for name, values in mesh.vertex_data.items()} == {
        name: [row] * 8 for name, row in expected.items()
    }


@pytest.mark.parametrize(
    "text", [f"8 12 0\n{_ROWS}", f"8 12 0\n{_ROWS}{_FACES}3 0 1 2\n", f"8 0 0\n{_ROWS}", f"{_ROWS}", "4OFF\n8 12 0\n"]
)
def test_counts_without_a_word_have_as_many_lines(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.off"
    path.write_text(text)
    with pytest.raises(gk.FileFormatError, match="does not start with OFF"):
        gk.mesh.load(path)


# --- XDMF -------------------------------------------------------------------------------------------------------------

_GRID = (
    '<Grid Name="{name}" GridType="Uniform"><Geometry GeometryType="{kind}"><DataItem Dimensions="4 3" Format="XML">'
    "0 0 0 1 0 0 0 1 0 1 1 0</DataItem></Geometry>"
    '<Topology TopologyType="Triangle" NumberOfElements="2"><DataItem Dimensions="2 3" Format="XML" NumberType="Int">'
    "0 1 3 0 3 2</DataItem></Topology></Grid>"
)
_ONE = _GRID.format(name="g", kind="XYZ")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (f'<Grid GridType="Collection" CollectionType="Temporal">{_ONE * 12}</Grid>', "a time series of 12 steps"),
        (
            f'<Grid GridType="Collection" CollectionType="Temporal">{_ONE}</Grid>',
            r"a time series of 1 step; choose one with step=0",
        ),
        (f'<Grid GridType="Collection" CollectionType="Spatial">{_ONE * 2}</Grid>', "a collection of 2 grids"),
        (f'<Grid GridType="Tree">{_ONE * 3}</Grid>', "a collection of 3 grids"),
        (_ONE * 2, "holds 2 grids"),
        (_GRID.format(name="g", kind="X_Y_Z"), "geometry of type X_Y_Z"),
        (_ONE.replace("Triangle", "2DSMesh"), "has cells of the type 2DSMesh, which are not read; export triangles"),
        (
            _ONE.replace("Triangle", "Mixed").replace('"2 3"', '"4"').replace("0 1 3 0 3 2", "77 3 0 1"),
            "of the type 77",
        ),
    ],
)
def test_xdmf_of_more_than_a_mesh_is_called_what_it_is(tmp_path: Path, body: str, message: str) -> None:
    path = tmp_path / "a.xdmf"
    path.write_text(f'<?xml version="1.0"?><Xdmf Version="3.0"><Domain>{body}</Domain></Xdmf>')
    with pytest.raises(gk.FileFormatError, match=message) as caught:
        gk.mesh.load(path)
    assert "damaged" not in str(caught.value)
    path.write_text(f'<?xml version="1.0"?><Xdmf Version="3.0"><Domain>{_ONE}</Domain></Xdmf>')
    assert gk.mesh.audit(gk.mesh.load(path)).area == 1.0


@pytest.mark.parametrize(
    ("kind", "count", "numbers", "told"),
    [
        ("Polygon", 2, "0 1 3 0 3 2", ""),
        ("TRIANGLE", 2, "0 1 3 0 3 2", ""),
        ("Mixed", 1, "3 4 0 1 3 2", ""),
        ("Mixed", 2, "4 0 1 3 3 3 0 3 2", ""),
        # A point, two points, a line of two and one of three, a tetrahedron, and one as a body of faces.
        ("Mixed", 3, "1 1 0 1 2 1 3 5 0 1 3 2", r"points \(2\) are left out"),
        ("Mixed", 3, "2 2 0 1 2 3 0 1 2 5 0 1 3 2", r"lines \(2\) are left out"),
        ("Mixed", 3, "6 0 1 2 3 16 4 3 0 1 2 3 0 1 3 3 0 2 3 3 1 2 3 5 0 1 3 2", r"volume cells \(2 tetra\)"),
    ],
)
def test_cells_of_mixed_types(tmp_path: Path, kind: str, count: int, numbers: str, told: str) -> None:
    path = tmp_path / "a.xdmf"
    text = _ONE.replace("Triangle", kind).replace("0 1 3 0 3 2", numbers).replace('Elements="2"', f'Elements="{count}"')
    if kind == "Mixed":
        text = text.replace('"2 3"', f'"{len(numbers.split())}"')
    values = " ".join(map(str, range(count)))
    told_cells = f'<Attribute Name="e" Center="Cell"><DataItem Dimensions="{count}">{values}</DataItem></Attribute>'
    path.write_text(f'<Xdmf Version="3.0"><Domain>{text.replace("</Grid>", told_cells + "</Grid>")}</Domain></Xdmf>')
    with pytest.warns(UserWarning, match=told) if told else contextlib.nullcontext():
        mesh = gk.mesh.load(path)
    assert gk.mesh.audit(mesh).area == 1.0
    assert mesh.face_data["e"].tolist() == ([0.0, 1.0] if count == 2 else [count - 1.0] * 2)
    if kind == "Mixed":
        path.write_text(path.read_text().replace(numbers, numbers[:-2]).replace(f'"{len(numbers.split())}"', '""'))
        with pytest.raises(gk.FileFormatError, match="ends within a cell; the file is damaged"):
            gk.mesh.load(path)


def test_what_meshio_stumbles_over(tmp_path: Path) -> None:
    path = tmp_path / "a.xdmf"
    mesh = _ONE.replace("<Geometry ", '<Information Name="by" Value="me"/><Set Name="s"/><Geometry ', 1)
    item = '<DataItem Name="p" Dimensions="4 3" Precision="8">0 0 0 1 0 0 0 1 0 1 1 0</DataItem>'
    pointer = '<DataItem Reference="XML">/Xdmf/Domain/DataItem[@Name="p"]</DataItem>'
    start, end = mesh.index("<DataItem"), mesh.index("</Geometry>")
    flat = '<Attribute Name="v"><DataItem Dimensions="12">1 2 3 4 5 6 7 8 9 10 11 12</DataItem></Attribute>'
    mesh = (mesh[:start] + pointer + mesh[end:]).replace("</Grid>", f"{flat}</Grid>")
    path.write_text(f'<Xdmf Version="2.0"><Domain>{item}{mesh}</Domain></Xdmf>')
    with pytest.warns(UserWarning, match="the set 's' is left out"):
        found = gk.mesh.load(path)
    assert gk.mesh.audit(found).area == 1.0
    np.testing.assert_array_equal(found.vertex_data["v"], np.arange(1.0, 13.0).reshape(4, 3))
    path.write_text(path.read_text().replace('[@Name="p"]<', '[@Name="q"]<'))
    with pytest.raises(gk.FileFormatError, match=r"refers to .*, which is not there"):
        gk.mesh.load(path)


_STEP = '<Grid Name="s{at}" GridType="Uniform">{mesh}<Time Value="{at}"/>{data}</Grid>'
_DATA = (
    '<Attribute Name="height" AttributeType="Scalar" Center="Node"><DataItem Dimensions="4" Format="XML">'
    "{at} {at} {at} {at}</DataItem></Attribute>"
)
_SERIES = '<Grid Name="all" GridType="Collection" CollectionType="Temporal">{steps}</Grid>'
_WHOLE = _ONE[_ONE.index("<Geometry") : -len("</Grid>")]
_INCLUDE = "<xi:include xpointer='xpointer({where}/*[self::Topology or self::Geometry])'/>"


@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize(
    ("first", "later", "beside"),
    [
        (_WHOLE, _WHOLE, ""),
        # As DOLFIN writes a mesh that stays, and as meshio does.
        (_WHOLE, _INCLUDE.format(where='//Grid[@Name="all"]/Grid[1]'), ""),
        (_INCLUDE.format(where='//Grid[@Name="g"]'), _INCLUDE.format(where='//Grid[@Name="g"]'), _ONE),
    ],
)
def test_a_step_of_a_time_series(tmp_path: Path, first: str, later: str, beside: str, trusted: bool) -> None:
    path = tmp_path / "a.xdmf"
    steps = [_STEP.format(at=at, mesh=later if at else first, data=_DATA.format(at=at)) for at in range(3)]
    head = '<Xdmf Version="3.0" xmlns:xi="http://www.w3.org/2001/XInclude">'
    path.write_text(f"{head}<Domain>{beside}{_SERIES.format(steps=''.join(steps))}</Domain></Xdmf>")
    for step, height in ((0, 0.0), (1, 1.0), (2, 2.0), (-1, 2.0), (-3, 0.0)):
        mesh = gk.mesh.load(path, step=step, trusted=trusted)
        assert gk.mesh.audit(mesh).area == 1.0
        assert mesh.vertex_data["height"].tolist() == [height] * 4
    for step in (3, -4):
        with pytest.raises(gk.FileFormatError, match=f"has no step {step}; its time series has 3"):
            gk.mesh.load(path, step=step)
    with pytest.raises(gk.FileFormatError, match="a time series of 3 steps; choose one with step=0 to step=2"):
        gk.mesh.load(path)
    for step in (1.5, "last", True):
        with pytest.raises(gk.InputError, match=r"^step: .* is not a whole number"):
            gk.mesh.load(path, step=step)


def test_steps_that_are_not_there(tmp_path: Path) -> None:
    path = tmp_path / "a.xdmf"
    lost = _STEP.format(at=0, mesh=_INCLUDE.format(where='//Grid[@Name="other"]'), data="")
    path.write_text(f'<Xdmf Version="3.0"><Domain>{_ONE}</Domain></Xdmf>')
    with pytest.raises(gk.FileFormatError, match="holds 0 time series"):
        gk.mesh.load(path, step=0)
    head = '<Xdmf Version="3.0" xmlns:xi="http://www.w3.org/2001/XInclude">'
    path.write_text(f"{head}<Domain>{_SERIES.format(steps=lost)}</Domain></Xdmf>")
    with pytest.raises(gk.FileFormatError, match=r"step 0 refers to .*other.*, which is not there"):
        gk.mesh.load(path, step=0)
    with pytest.raises(gk.InputError, match=r"step: \.obj holds no time series; leave it out"):
        gk.mesh.load(tmp_path / "a.obj", step=0)


def test_the_time_of_a_single_mesh_is_no_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.xdmf"
    timed = _ONE.replace("<Geometry ", '<Time Value="2"/><Geometry ', 1)
    path.write_text(f'<Xdmf Version="3.0"><Domain>{timed}</Domain></Xdmf>')
    assert gk.mesh.audit(gk.mesh.load(path)).area == 1.0


def test_the_command_line_takes_a_step(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from geokit.cli import main

    path = tmp_path / "a.xdmf"
    steps = "".join(_STEP.format(at=at, mesh=_WHOLE, data="") for at in range(2))
    path.write_text(f'<Xdmf Version="3.0"><Domain>{_SERIES.format(steps=steps)}</Domain></Xdmf>')
    assert main(["info", str(path)]) == 1
    assert "--time-step" in capsys.readouterr().err
    assert main(["info", str(path), "--time-step", "1"]) == 0


# --- USD --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_holes_of_usd_are_left_out_with_their_data(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    path = tmp_path / "a.usda"
    path.write_text(
        """#usda 1.0
def Mesh "a" {
    int[] faceVertexCounts = [4, 4, 3]
    int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4, 3, 4, 6]
    int[] holeIndices = [1]
    point3f[] points = [(0,0,0),(1,0,0),(2,0,0),(0,1,0),(1,1,0),(2,1,0),(0,2,0)]
    float[] primvars:weight = [1, 2, 3] (interpolation = "uniform")
    float[] primvars:corner = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10] (interpolation = "faceVarying")
}
"""
    )
    mesh = gk.mesh.load(path)
    assert gk.mesh.audit(mesh).area == 1.5
    assert mesh.face_data["weight"].tolist() == [1, 1, 3]
    assert mesh.corner_data["corner"].tolist() == [[0, 1, 2], [0, 2, 3], [8, 9, 10]]
