"""Units and up axes: through convert_unit, and through files of formats that hold them."""

from __future__ import annotations

import json
import re
import struct
import warnings
import zipfile

import numpy as np
import pytest

import geokit as gk
from geokit.errors import InputError

METERS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}


def part(**more):
    box = gk.mesh.box((1.0, 2.0, 3.0), center=(5.0, 6.0, 7.0))
    return gk.mesh.TriangleMesh(box.vertices, box.faces, **more)


def gltf_of(path):
    """The JSON of a .gltf or .glb, by its specification: after a header of 12 bytes the first chunk of a .glb."""
    content = path.read_bytes()
    if path.suffix == ".glb":
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    return json.loads(content)


class TestConvertUnit:
    @pytest.mark.parametrize(
        ("old", "new", "factor"), [("in", "mm", 25.4), ("mm", "m", 1e-3), ("km", "ft", 1e3 / 0.3048)]
    )
    def test_scales_by_the_ratio(self, old, new, factor):
        made = gk.mesh.convert_unit(part(), new, from_unit=old)
        np.testing.assert_allclose(made.vertices, part().vertices * factor, rtol=3e-16)
        assert made.meters_per_unit == pytest.approx({"mm": 1e-3, "m": 1.0, "ft": 0.3048}[new])
        back = gk.mesh.convert_unit(made, old)
        np.testing.assert_allclose(back.vertices, part().vertices, rtol=1e-15)

    @pytest.mark.parametrize("old", "xyz")
    @pytest.mark.parametrize("new", "xyz")
    def test_turns_up_to_up(self, old, new):
        mesh = part(up_axis=old, vertex_data={"normal": np.eye(3)[[0, 1, 2, 0, 1, 2, 0, 1]]})
        made = gk.mesh.convert_unit(mesh, up_axis=new)
        axes = "xyz".index(old), "xyz".index(new)
        np.testing.assert_array_equal(made.vertices[:, axes[1]], mesh.vertices[:, axes[0]])
        assert made.up_axis == new
        assert made.volume == pytest.approx(6.0)
        again = gk.mesh.convert_unit(made, up_axis=old)
        np.testing.assert_array_equal(again.vertices, mesh.vertices)
        np.testing.assert_array_equal(again.vertex_data["normal"], mesh.vertex_data["normal"])

    def test_y_up_to_z_up_is_the_usual_turn(self):
        turned = gk.mesh.convert_unit(part(), up_axis="z", from_up_axis="y")
        x, y, z = part().vertices.T
        np.testing.assert_array_equal(turned.vertices, np.stack([x, -z, y], axis=1))

    def test_says_what_it_is_told(self):
        mesh = gk.mesh.convert_unit(part(), from_unit=0.9144, from_up_axis="z")
        assert (mesh.meters_per_unit, mesh.up_axis) == (0.9144, "z")
        np.testing.assert_array_equal(mesh.vertices, part().vertices)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"unit": "mm"}, "unit: the mesh does not say what its unit is now; give from_unit"),
            ({"up_axis": "z"}, "up_axis: the mesh does not say which axis is up now; give from_up_axis"),
            ({"unit": "mm", "from_unit": "furlong"}, "from_unit: 'furlong' is no known unit; use one of m, mm"),
            ({"unit": -1.0, "from_unit": "mm"}, "unit: -1.0 is no length"),
            ({"up_axis": "w", "from_up_axis": "z"}, "up_axis: 'w'"),
        ],
    )
    def test_refusals(self, options, message):
        with pytest.raises(InputError, match=re.escape(message)):
            gk.mesh.convert_unit(part(), **options)


def test_a_misspelt_unit_is_named_whatever_the_mesh_says():
    with pytest.raises(InputError, match="unit: 'inchh' is no known unit; use one of"):
        gk.mesh.convert_unit(part(), "inchh")


class TestFiles:
    @pytest.mark.parametrize("unit", METERS)
    def test_3mf_keeps_its_unit(self, unit, tmp_path):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            gk.mesh.save(tmp_path / "a.3mf", part(meters_per_unit=METERS[unit], up_axis="z"))
        text = zipfile.ZipFile(tmp_path / "a.3mf").read("3D/3dmodel.model").decode()
        assert f'unit="{unit}"' in text
        loaded = gk.mesh.load(tmp_path / "a.3mf")
        assert (loaded.meters_per_unit, loaded.up_axis) == (METERS[unit], "z")
        np.testing.assert_array_equal(loaded.vertices, part().vertices)

    def test_3mf_of_a_unit_that_it_cannot_name_is_in_meters(self, tmp_path):
        gk.mesh.save(tmp_path / "a.3mf", part(meters_per_unit=0.9144))
        loaded = gk.mesh.load(tmp_path / "a.3mf")
        assert loaded.meters_per_unit == 1.0
        np.testing.assert_allclose(loaded.vertices, part().vertices * 0.9144, rtol=1e-15)

    @pytest.mark.parametrize("kind", ["vtp", "vtk"])
    @pytest.mark.parametrize("axis", [None, "x", "y", "z"])
    def test_vtk_keeps_both(self, kind, axis, tmp_path):
        gk.mesh.save(tmp_path / f"a.{kind}", part(meters_per_unit=0.0254, up_axis=axis))
        loaded = gk.mesh.load(tmp_path / f"a.{kind}")
        assert (loaded.meters_per_unit, loaded.up_axis) == (0.0254, axis)

    def test_pyvista_keeps_both(self):
        mesh = gk.mesh.as_mesh(gk.mesh.to_pyvista(part(meters_per_unit=0.01, up_axis="y")))
        assert (mesh.meters_per_unit, mesh.up_axis) == (0.01, "y")

    @pytest.mark.parametrize(
        "values", [{"meters_per_unit": [-1.0]}, {"meters_per_unit": [1.0, 2.0]}, {"up_axis": ["w"]}]
    )
    def test_what_other_programs_call_so_is_no_unit(self, values, tmp_path):
        surface = gk.mesh.to_pyvista(part())
        for name, value in values.items():
            surface.field_data[name] = value
        surface.save(tmp_path / "a.vtp")
        loaded = gk.mesh.load(tmp_path / "a.vtp")
        assert (loaded.meters_per_unit, loaded.up_axis) == (None, None)

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["glb", "gltf"])
    def test_gltf_is_in_meters_with_y_up(self, kind, tmp_path):
        path = tmp_path / f"a.{kind}"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            gk.mesh.save(path, part(meters_per_unit=1.0, up_axis="y"))
        loaded = gk.mesh.load(path)
        assert (loaded.meters_per_unit, loaded.up_axis) == (1.0, "y")
        np.testing.assert_array_equal(loaded.vertices, part().vertices)

    @pytest.mark.parametrize("kind", ["glb", "gltf"])
    @pytest.mark.parametrize("more", [{}, {"vertex_data": {"normal": np.tile([0.0, 0.0, 1.0], (8, 1))}}])
    def test_gltf_is_scaled_and_turned_to_that(self, kind, more, tmp_path):
        path = tmp_path / f"a.{kind}"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            gk.mesh.save(path, part(meters_per_unit=0.0254, up_axis="z", **more))
        content = gltf_of(path)
        (primitive,) = content["meshes"][0]["primitives"]
        box = content["accessors"][primitive["attributes"]["POSITION"]]
        (lx, ly, lz), (ux, uy, uz) = part().bounds * 0.0254
        np.testing.assert_allclose([box["min"], box["max"]], [[lx, lz, -uy], [ux, uz, -ly]], rtol=1e-6)
        loaded = gk.mesh.load(path)
        assert loaded.volume == pytest.approx(6.0 * 0.0254**3, rel=1e-5)
        if more:
            np.testing.assert_array_equal(loaded.vertex_data["normal"], np.tile([0.0, 1.0, 0.0], (8, 1)))

    def test_gltf_of_a_known_unit_and_no_axis_is_scaled_only(self, tmp_path):
        gk.mesh.save(tmp_path / "a.glb", part(meters_per_unit=0.001))
        np.testing.assert_allclose(gk.mesh.load(tmp_path / "a.glb").vertices, part().vertices / 1000, rtol=1e-6)

    @pytest.mark.parametrize(("kind", "unit"), [("glb", "meter"), ("gltf", "meter"), ("3mf", "millimeter")])
    def test_a_file_that_states_a_unit_says_so(self, kind, unit, tmp_path):
        path = tmp_path / f"a.{kind}"
        told = rf"a\.{kind}: the unit of the mesh is not known, and the file says {unit}; say it with convert_unit"
        with pytest.warns(UserWarning, match=told):
            gk.mesh.save(path, part())
        np.testing.assert_array_equal(gk.mesh.load(path).vertices, part().vertices)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            gk.mesh.save(path, gk.mesh.convert_unit(part(), from_unit="mm"))
            gk.mesh.save(tmp_path / "a.stl", part())

    def test_a_length_beyond_float32_in_meters_is_refused(self, tmp_path):
        with pytest.raises(InputError, match=r"mesh: vertex 1 .*is beyond the float32 of \.glb"):
            gk.mesh.save(tmp_path / "a.glb", part(meters_per_unit=1e39))

    @pytest.mark.parametrize(("kind", "usual", "other"), [("obj", "y", "z"), ("ply", "y", "x"), ("stl", "z", "y")])
    def test_an_axis_that_others_take_for_up_is_told(self, kind, usual, other, tmp_path):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            gk.mesh.save(tmp_path / f"a.{kind}", part(up_axis=usual))
        with pytest.warns(UserWarning, match=rf"does not hold that {other} is up \({usual} is in most such files\)"):
            gk.mesh.save(tmp_path / f"a.{kind}", part(up_axis=other))

    def test_gltf_to_3mf_turns_z_up(self, tmp_path):
        gk.mesh.save(tmp_path / "a.glb", part())
        loaded = gk.mesh.load(tmp_path / "a.glb")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            gk.mesh.save(tmp_path / "a.3mf", loaded)
            gk.mesh.save(tmp_path / "b.3mf", gk.mesh.convert_unit(loaded, "mm", up_axis="z"))
        assert gk.mesh.load(tmp_path / "a.3mf").bounds[1].tolist() == [5.5, -5.5, 7.0]
        assert gk.mesh.load(tmp_path / "b.3mf").bounds[1].tolist() == [5500.0, -5500.0, 7000.0]


@pytest.mark.parametrize(("unit", "from_unit"), [(1e-320, 1.0), (1e308, 5e-324), ("mm", 1e308)])
def test_ratios_beyond_float64_are_refused(unit, from_unit):
    # 0 would be a body at one point.
    with pytest.raises(gk.InputError, match=r"unit: .* leaves the range of float64"):
        gk.mesh.convert_unit(gk.mesh.box(), unit, from_unit=from_unit)
