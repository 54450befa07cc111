""".3mf as slicers write it: parts in files of their own, components, units, what is set aside, and what is refused."""

from __future__ import annotations

import warnings
import zipfile

import numpy as np
import pytest

import geokit as gk
from geokit.formats.exchange import three_mf

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
PRODUCTION = "http://schemas.microsoft.com/3dmanufacturing/production/2015/06"
START = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
RELATIONS = (
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/{}" Id="r" Type="{}"/></Relationships>'
)


def body(number, size=(10.0, 20.0, 5.0), **attributes):
    """An object that is a box with a corner at the origin."""
    box = gk.mesh.box(size, center=np.array(size) / 2)
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in box.vertices)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in box.faces)
    mesh = f"<mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>"
    return f"<object id='{number}' {written(attributes)}>{mesh}</object>"


def joined(number, *components, **attributes):
    return f"<object id='{number}' {written(attributes)}><components>{''.join(components)}</components></object>"


def component(number, file="", transform=""):
    path = f'p:path="{file}" ' if file else ""
    return f'<component objectid="{number}" {path}' + (f'transform="{transform}"' if transform else "") + "/>"


def item(number, file="", transform=""):
    return component(number, file, transform).replace("component", "item")


def written(attributes):
    return " ".join(f'{name}="{value}"' for name, value in attributes.items())


def model(objects, items="", unit='unit="millimeter"', required="p"):
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><model {unit} xmlns="{CORE}" xmlns:p="{PRODUCTION}" '
        f'requiredextensions="{required}"><resources>{objects}</resources><build>{items}</build></model>'
    )


def moved(x, y, z):
    return f"1 0 0 0 1 0 0 0 1 {x} {y} {z}"


@pytest.fixture
def load(tmp_path):
    def loaded(root, others=None, start="3D/3dmodel.model", quiet=True):
        path = tmp_path / "a.3mf"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("_rels/.rels", RELATIONS.format(start, START))
            archive.writestr(start, root)
            for name, text in (others or {}).items():
                archive.writestr(name, text)
        with warnings.catch_warnings():
            warnings.simplefilter("error" if quiet else "always")
            return gk.mesh.load(path)

    return loaded


class TestParts:
    def test_ids_belong_to_their_file(self, load):
        """Two parts in two files, both with id 1, as Bambu Studio writes plates."""
        parts = {
            "3D/Objects/object_1.model": model(body(1)),
            "3D/Objects/object_2.model": model(body(1, (30.0, 20.0, 5.0))),
        }
        objects = "".join(joined(n, component(1, f"/3D/Objects/object_{n - 1}.model")) for n in (2, 3))
        mesh = load(model(objects, item(2, transform=moved(100, 0, 0)) + item(3)), parts)
        assert mesh.face_count == 24
        assert mesh.volume == pytest.approx(4000.0)
        assert mesh.bounds.tolist() == [[0, 0, 0], [110, 20, 5]]
        assert len(mesh.parts) == 2

    def test_items_may_name_a_file(self, load):
        parts = {"3D/Objects/Object_1.model": model(body(1))}
        mesh = load(model("", item(1, "/3d/objects/object_1.model", moved(5, 0, 0))), parts)
        assert mesh.bounds.tolist() == [[5, 0, 0], [15, 20, 5]]

    def test_a_part_that_no_item_uses_is_none(self, load):
        parts = {"3D/Objects/object_1.model": model(body(1))}
        assert load(model(body(9, (1.0, 1.0, 1.0)), item(9)), parts).volume == pytest.approx(1.0)

    def test_objects_beside_components_in_other_files(self, load):
        parts = {"3D/Objects/object_1.model": model(body(1))}
        objects = joined(2, component(1, "/3D/Objects/object_1.model")) + body(5, (1.0, 1.0, 1.0))
        assert load(model(objects, item(2) + item(5)), parts).face_count == 24

    def test_components_of_components(self, load):
        """A matrix is that of the component, then of what holds it; rows of the file are columns."""
        turn = "0 1 0 -1 0 0 0 0 1 2 0 0"  # x to y
        objects = body(1) + joined(2, component(1, transform=turn)) + joined(3, component(2, transform=moved(0, 0, 7)))
        mesh = load(model(objects, item(3, transform="2 0 0 0 2 0 0 0 2 0 0 0")))
        assert mesh.bounds.tolist() == [[-36, 0, 14], [4, 20, 24]]

    def test_mirrored_places_stay_outwards(self, load):
        mesh = load(model(body(1), item(1, transform="-1 0 0 0 1 0 0 0 1 0 0 0")))
        assert mesh.volume == pytest.approx(1000.0)

    def test_names_and_another_start(self, load):
        objects = body(1, name="Knob &amp; co") + body(2)
        mesh = load(model(objects, item(1) + item(2)), start="models/plate.model")
        assert [part.name for part in mesh.parts] == ["Knob & co", "2"]


class TestUnits:
    @pytest.mark.parametrize(("text", "meters"), [("", 1e-3), ('unit="inch"', 0.0254), ('unit="foot"', 0.3048)])
    def test_are_what_the_file_says(self, load, text, meters):
        mesh = load(model(body(1), item(1), unit=text))
        assert (mesh.meters_per_unit, mesh.up_axis) == (meters, "z")

    def test_of_parts_that_differ_are_named(self, load):
        parts = {"3D/o.model": model(body(1), unit='unit="inch"')}
        with pytest.warns(UserWarning, match="parts in inch are taken as the file's millimeter"):
            load(model("", item(1, "/3D/o.model")), parts, quiet=False)


class TestSetAside:
    @pytest.mark.parametrize("kind", ["support", "solidsupport", "other"])
    def test_supports_and_cutters_are_left_out_with_a_word(self, load, kind):
        objects = body(1) + body(2, (90.0, 90.0, 90.0), type=kind) + joined(3, component(1), component(2))
        with pytest.warns(UserWarning, match="1 supports, cutters or modifiers are left out"):
            assert load(model(objects, item(3)), quiet=False).face_count == 12

    def test_surfaces_are_read(self, load):
        assert load(model(body(1, type="surface"), item(1))).face_count == 12


class TestRefusals:
    @pytest.mark.parametrize(
        ("root", "message"),
        [
            (model(body(1), ""), "its build names no object"),
            (model(body(1), item(4)), r"has no object '4'"),
            (model(body(1), item(1, "/3D/lost.model")), r"refers to '3D/lost.model', which is not in it"),
            (model(joined(1, component(2)) + joined(2, component(1)), item(1)), "is part of itself"),
            (model(body(1), item(1), unit='unit="cubit"'), r"its unit is 'cubit', none of micron"),
            (model(body(1), item(1, transform="1 0 0")), r"3dmodel\.model: line 1: cannot be read"),
            (model(body(1).replace('x="10.0"', 'x="ten"'), item(1)), "line 1: cannot be read .*ten"),
            (model(body(1).replace('v1="0"', 'q="0"'), item(1)), "line 1: cannot be read .*v1"),
            (model(body(1), item(1))[:-9], "is no XML"),
            (model(body(1), item(1), required="b"), "requires the 3MF extension 'b', which is not read"),
            ('<!DOCTYPE a [<!ENTITY b "c">]>' + model("", "")[38:], "declares a document type, which 3MF forbids"),
            (model(body(1).replace('v1="0"', 'v1="99"'), item(1)), "vertex 99"),
        ],
    )
    def test_say_what_and_where(self, load, root, message):
        with pytest.raises(gk.FileFormatError, match=message):
            load(root)

    def test_beams_that_are_required(self, load):
        beams = 'xmlns:b="http://schemas.microsoft.com/3dmanufacturing/beamlattice/2017/02"'
        root = model(body(1), item(1), required="p b").replace("<model ", f"<model {beams} ")
        with pytest.raises(gk.FileFormatError, match=r"requires the 3MF extension 'http.*beamlattice"):
            load(root)

    def test_more_bodies_than_anyone_prints(self, load, tmp_path, monkeypatch):
        """Components of components: a small file, a hundred million bodies. They are counted, none is placed."""
        levels = "".join(joined(n, *([component(n - 1)] * 10)) for n in range(2, 10))
        with pytest.raises(gk.FileFormatError, match="places more than 65,536 bodies"):
            load(model(body(1) + levels, item(9)))
        monkeypatch.setattr(three_mf, "_body", lambda *_: pytest.fail("a body is placed"))
        with pytest.raises(gk.FileFormatError, match="places more than 65,536 bodies"):
            three_mf.read_mesh(tmp_path / "a.3mf")

    def test_as_many_bodies_as_are_taken(self, load, tmp_path, monkeypatch):
        """Supports do not count, nor does what stands below them."""
        monkeypatch.setattr(three_mf, "_MOST_BODIES", 5)
        taken = body(1) + joined(2, component(1), component(1)) + joined(3, *[component(1)] * 9, type="support")
        with pytest.warns(UserWarning, match="1 supports"):
            load(model(taken, item(2) + item(1) + item(1) + item(3)), quiet=False)
        assert len(three_mf.read_mesh(tmp_path / "a.3mf")) == 4
        load(model(taken, item(2) + item(2)))
        with pytest.raises(gk.FileFormatError, match="places more than 5 bodies"):
            three_mf.read_mesh(tmp_path / "a.3mf")

    def test_archives_that_are_none_of_3mf(self, tmp_path):
        with zipfile.ZipFile(tmp_path / "a.3mf", "w") as archive:
            archive.writestr("readme.txt", "nothing")
        with pytest.raises(gk.FileFormatError, match=r"holds no 3D/3dmodel\.model"):
            gk.mesh.load(tmp_path / "a.3mf")
        (tmp_path / "a.3mf").write_bytes(b"PK nothing")
        with pytest.raises(gk.FileFormatError, match="is not an archive"):
            gk.mesh.load(tmp_path / "a.3mf")


def test_what_is_written_is_what_trimesh_reads(tmp_path):
    import trimesh

    rng = np.random.default_rng(2)
    box = gk.mesh.box((1.0, 2.0, 3.0))
    mesh = gk.mesh.TriangleMesh(box.vertices + rng.normal(size=(8, 3)), box.faces, name="<a & 'b'>\x07")
    gk.mesh.save(tmp_path / "a.3mf", mesh)
    theirs = trimesh.load_scene(tmp_path / "a.3mf", process=False).to_geometry()
    np.testing.assert_array_equal(theirs.vertices, mesh.vertices)
    np.testing.assert_array_equal(theirs.faces, mesh.faces)
    ours = gk.mesh.load(tmp_path / "a.3mf")
    np.testing.assert_array_equal(ours.vertices, mesh.vertices)
    text = zipfile.ZipFile(tmp_path / "a.3mf").read("3D/3dmodel.model").decode()
    assert "&lt;a &amp; 'b'&gt; " in text


@pytest.mark.parametrize(
    "look",
    [
        '<basematerials id="9"><base name="red" displaycolor="#FF0000"/></basematerials>',
        '<m:colorgroup xmlns:m="http://schemas.microsoft.com/3dmanufacturing/material/2015/02" id="9"/>',
    ],
)
def test_colors_that_are_left_out_are_said(load, look):
    with pytest.warns(UserWarning, match="its colors and materials are left out$"):
        assert load(model(look + body(1), item(1)), quiet=False).face_count == 12
