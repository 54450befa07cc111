"""Materials of USD stages: UsdPreviewSurface on prims and on subsets of faces, read into those of meshes."""

import os
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

import geokit as gk

pytest.importorskip("pxr")
pytestmark = pytest.mark.slow

PNG = b"\x89PNG\r\n\x1a\n" + bytes(40)


class Scene:
    """A stage that grows in memory."""

    def __init__(self, path: Path) -> None:
        from pxr import Usd

        self.path = path
        self.stage = Usd.Stage.CreateInMemory()

    def square(self, name: str):
        """Two quads beside each other."""
        from pxr import UsdGeom

        mesh = UsdGeom.Mesh.Define(self.stage, name)
        mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0)])
        mesh.CreateFaceVertexCountsAttr([4, 4])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3, 1, 4, 5, 2])
        return mesh

    def material(self, name: str, prims=(), *, shader: str = "UsdPreviewSurface", **inputs):
        """A material with values of its surface, bound to prims."""
        from pxr import Sdf, UsdShade

        material = UsdShade.Material.Define(self.stage, f"/looks/{name}")
        surface = UsdShade.Shader.Define(self.stage, f"/looks/{name}/surface")
        surface.CreateIdAttr(shader)
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        for label, value in inputs.items():
            kind = Sdf.ValueTypeNames.Float if isinstance(value, float) else Sdf.ValueTypeNames.Color3f
            given = surface.CreateInput(label, kind)
            if value is not None:
                given.Set(value)
        for prim in prims:
            UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
        return material, surface

    def texture(self, material, given, file: str, output: str = "rgb", varname: str = "", **inputs):
        """Have an input of a surface come from an image."""
        from pxr import Sdf, UsdShade

        types = Sdf.ValueTypeNames
        place = str(material.GetPath())
        texture = UsdShade.Shader.Define(self.stage, f"{place}/{given.GetBaseName()}_image")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", types.Asset).Set(file)
        for label, value in inputs.items():
            texture.CreateInput(label, types.Float4).Set(value)
        if varname:
            reader = UsdShade.Shader.Define(self.stage, f"{place}/reader")
            reader.CreateIdAttr("UsdPrimvarReader_float2")
            name = material.CreateInput("name", types.Token)
            name.Set(varname)
            reader.CreateInput("varname", types.Token).ConnectToSource(name)
            reader.CreateOutput("result", types.Float2)
            texture.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        texture.CreateOutput(output, types.Float3 if output == "rgb" else types.Float)
        given.ConnectToSource(texture.ConnectableAPI(), output)
        return texture

    def load(self, **options):
        """The mesh of the stage's file, and what was said."""
        if self.path.suffix == ".usdz":
            with zipfile.ZipFile(self.path, "w", zipfile.ZIP_STORED) as archive:
                archive.writestr("layer.usda", self.stage.GetRootLayer().ExportToString())
                archive.writestr("images/wood.png", PNG)
        else:
            self.stage.GetRootLayer().Export(str(self.path))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            return gk.mesh.load(self.path, **options), "; ".join(str(each.message) for each in said)


@pytest.mark.parametrize("kind", ["usda", "usdc"])
def test_colors_on_prims_subsets_and_shapes(tmp_path, kind):
    from pxr import UsdGeom, UsdShade

    scene = Scene(tmp_path / f"a.{kind}")
    below = UsdGeom.Xform.Define(scene.stage, "/group")
    square, plain = scene.square("/group/square"), scene.square("/plain")
    UsdGeom.Cube.Define(scene.stage, "/group/cube")
    plain.CreateDisplayColorAttr([(0.25, 0.5, 0.75)])
    scene.material("red", [below], diffuseColor=(1, 0, 0))
    subset = UsdGeom.Subset.CreateGeomSubset(square, "right", "face", [1, 7], "materialBind")
    UsdGeom.Subset.CreateGeomSubset(square, "other", "face", [0], "regions")
    green, _ = scene.material("green", [subset], diffuseColor=(0, 0.5, 0), opacity=0.25)
    UsdShade.MaterialBindingAPI(subset.GetPrim()).Bind(green)
    mesh, said = scene.load()
    assert not said
    red, green = mesh.materials if mesh.materials[0].name == "red" else mesh.materials[::-1]
    assert (red.color, green.color) == ((1, 0, 0, 1), (0, 0.5, 0, 0.25))
    assert red.alpha_cutoff is green.alpha_cutoff is None
    names = [each.name for each in mesh.materials]
    found = {
        part.name: [names[row] if row >= 0 else "" for row in rows]
        for part in mesh.parts
        for rows in [mesh.face_data["material"][part.first_face : part.first_face + part.face_count]]
    }
    assert found == {
        "/group/square": ["red"] * 2 + ["green"] * 2,
        "/group/cube": ["red"] * 12,
        "/plain": [""] * 4,
    }
    colors = mesh.face_data["color"]
    assert np.isnan(colors[:-4]).all()
    assert (colors[-4:] == [0.25, 0.5, 0.75]).all()


def test_colors_of_shapes(tmp_path):
    from pxr import UsdGeom

    scene = Scene(tmp_path / "a.usda")
    UsdGeom.Cube.Define(scene.stage, "/cube").CreateDisplayColorAttr([(1, 1, 0)])
    mesh, _ = scene.load()
    assert mesh.face_data["color"].tolist() == [[1, 1, 0]] * 12


@pytest.mark.parametrize("kind", ["usda", "usdz"])
def test_textures_and_their_coordinates(tmp_path, kind):
    from pxr import Sdf, UsdGeom

    scene = Scene(tmp_path / f"a.{kind}")
    if kind == "usda":
        (tmp_path / "images").mkdir()
        (tmp_path / "images" / "wood.png").write_bytes(PNG)
    square = scene.square("/square")
    primvars = UsdGeom.PrimvarsAPI(square)
    for name, kind_of in (("st", Sdf.ValueTypeNames.TexCoord2fArray), ("second", Sdf.ValueTypeNames.Float2Array)):
        primvars.CreatePrimvar(name, kind_of, "vertex").Set([(len(name), at) for at in range(6)])
    square.CreateDisplayColorAttr([(1, 0, 0)])
    material, surface = scene.material("wood", [square], diffuseColor=None, roughness=0.5)
    given = surface.GetInput("diffuseColor")
    scene.texture(material, given, "./images/wood.png", varname="second", scale=(0.5, 0.5, 0.5, 1))
    mesh, said = scene.load()
    assert not said
    assert mesh.materials[0].texture == ("wood.png", PNG)
    assert mesh.materials[0].color == (0.5, 0.5, 0.5, 1)
    assert mesh.face_data["material"].tolist() == [0] * 4
    assert mesh.vertex_data["uv"].tolist() == [[6, at] for at in range(6)]
    # The material replaces it; "color" would be multiplied with the texture.
    assert "color" not in mesh.face_data
    assert mesh.face_data["displayColor"].tolist() == [[1, 0, 0]] * 4


@pytest.mark.parametrize(
    ("opacity", "threshold", "cutoff"), [(False, 0.0, 0.0), (True, 0.0, None), (True, 0.3, pytest.approx(0.3))]
)
def test_alpha_of_textures(tmp_path, opacity, threshold, cutoff):
    (tmp_path / "leaf.png").write_bytes(PNG[:25] + b"\x06" + PNG[26:])
    scene = Scene(tmp_path / "a.usda")
    material, surface = scene.material("leaf", [scene.square("/s")], diffuseColor=None, opacityThreshold=threshold)
    texture = scene.texture(material, surface.GetInput("diffuseColor"), "leaf.png")
    if opacity:
        from pxr import Sdf

        texture.CreateOutput("a", Sdf.ValueTypeNames.Float)
        surface.CreateInput("opacity", Sdf.ValueTypeNames.Float).ConnectToSource(texture.ConnectableAPI(), "a")
    mesh, said = scene.load()
    assert not said
    assert mesh.materials[0].alpha_cutoff == cutoff


def test_holes_and_instances_keep_materials(tmp_path):
    from pxr import UsdGeom

    scene = Scene(tmp_path / "a.usda")
    source = UsdGeom.Xform.Define(scene.stage, "/source")
    square = scene.square("/source/square")
    subset = UsdGeom.Subset.CreateGeomSubset(square, "right", "face", [1], "materialBind")
    square.CreateHoleIndicesAttr([0])
    scene.material("red", [subset], diffuseColor=(1, 0, 0))
    source.MakeInvisible()
    for number in range(2):
        copy = UsdGeom.Xform.Define(scene.stage, f"/copy{number}")
        copy.GetPrim().GetReferences().AddInternalReference("/source")
        copy.GetPrim().SetInstanceable(True)
        copy.CreateVisibilityAttr(UsdGeom.Tokens.inherited)
    mesh, _ = scene.load()
    assert [each.name for each in mesh.materials] == ["red"]
    assert mesh.face_data["material"].tolist() == [0] * 4


def test_purposes_collections_and_first_samples(tmp_path):
    from pxr import Usd, UsdGeom, UsdShade

    scene = Scene(tmp_path / "a.usda")
    group = UsdGeom.Xform.Define(scene.stage, "/group")
    squares = [scene.square(f"/group/s{number}") for number in range(4)]
    red, blue, green = (
        scene.material(name, diffuseColor=color)[0]
        for name, color in (("red", (1, 0, 0)), ("blue", (0, 0, 1)), ("green", (0, 1, 0)))
    )
    collected = Usd.CollectionAPI.Apply(group.GetPrim(), "some")
    collected.IncludePath("/group/s1")
    UsdShade.MaterialBindingAPI.Apply(group.GetPrim()).Bind(collected, red)
    full = UsdShade.MaterialBindingAPI.Apply(squares[2].GetPrim())
    full.Bind(blue, materialPurpose="full")
    both = UsdShade.MaterialBindingAPI.Apply(squares[3].GetPrim())
    both.Bind(blue, materialPurpose="full")
    both.Bind(green, materialPurpose="preview")
    moving = scene.stage.GetPrimAtPath("/looks/green/surface").GetAttribute("inputs:diffuseColor")
    moving.Clear()
    moving.Set((0, 0.5, 0), 3.0)
    mesh, said = scene.load()
    assert not said
    names = [mesh.materials[row].name if row >= 0 else "" for row in mesh.face_data["material"][::4]]
    assert names == ["", "red", "blue", "green"]
    assert mesh.materials[-1].color == (0, 0.5, 0, 1)


def test_what_is_left_out_is_said(tmp_path):
    scene = Scene(tmp_path / "a.usda")
    square = scene.square("/square")
    scene.material("other", [square], shader="ND_standard_surface_surfaceshader")
    mesh, said = scene.load()
    assert said.endswith("a.usda: of materials other than UsdPreviewSurface only the names are read")
    assert mesh.materials == (("other", None, None, None),)

    scene = Scene(tmp_path / "b.usda")
    (tmp_path / "n.png").write_bytes(PNG)
    square = scene.square("/square")
    square.CreateDisplayColorAttr([(1, 0, 0)])
    material, surface = scene.material("m", [square], diffuseColor=None, normal=None)
    scene.texture(material, surface.GetInput("normal"), "n.png")
    scene.texture(material, surface.GetInput("diffuseColor"), "none.png")
    mesh, said = scene.load()
    assert "only those of the base color are read" in said
    assert "'none.png' is missing: its texture is left out" in said
    assert mesh.materials == (("m", None, None, None),)
    # Nothing replaces it.
    assert mesh.face_data["color"].tolist() == [[1, 0, 0]] * 4

    scene = Scene(tmp_path / "c.usda")
    scene.material("odd", [scene.square("/square")], diffuseColor=0.5)
    mesh, said = scene.load()
    assert "the look of material 'odd' is left out" in said
    assert mesh.materials == (("odd", None, None, None),)


def test_images_are_not_opened_outside(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "a.png").write_bytes(PNG)
    os.mkfifo(home / "pipe.png")
    for name, reason in (("../a.png", "outside its own folder"), ("./pipe.png", "not a regular file")):
        scene = Scene(home / "a.usda")
        material, surface = scene.material("m", [scene.square("/square")], diffuseColor=None)
        scene.texture(material, surface.GetInput("diffuseColor"), name)
        mesh, said = scene.load()
        assert reason in said
        assert mesh.materials[0].texture is None
        (home / "a.usda").unlink()
    scene = Scene(home / "b.usda")
    material, surface = scene.material("m", [scene.square("/square")], diffuseColor=None)
    scene.texture(material, surface.GetInput("diffuseColor"), "../a.png")
    mesh, said = scene.load(reference_folders=[tmp_path])
    assert not said
    assert mesh.materials[0].texture.data == PNG


def written(path: Path, mesh, **options):
    """The mesh as it comes back from a file."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gk.mesh.save(path, mesh)
        return gk.mesh.load(path, **options)


@pytest.mark.parametrize("kind", ["usda", "usdc", "usdz"])
def test_materials_come_back(tmp_path, kind):
    random = np.random.default_rng(8)
    torus = gk.mesh.torus(1.0, 0.4, segments=12, tube_segments=8)
    clear = PNG[:25] + b"\x06" + PNG[26:]
    material, texture = gk.mesh.Material, gk.mesh.Texture
    materials = (
        material("my red!", (1.0, 0.25, 0.0, 1.0)),
        material("glass", (0.5, 0.5, 1.0, 0.5)),
        material("wood", (0.5, 1.0, 0.75, 1.0), texture("wood.png", PNG)),
        material("leaf", None, texture("leaf.png", clear), 0.5),
        material("leaf", None, texture("leaf.png", clear + b"0"), 0.0),
        material("veil", None, texture("leaf.png", clear)),
        material("plain"),
    )
    mesh = gk.mesh.TriangleMesh(
        torus.vertices,
        torus.faces,
        vertex_data={"st": random.random((torus.vertex_count, 2)), "color": random.random((torus.vertex_count, 4))},
        face_data={"material": random.integers(-1, len(materials), torus.face_count).astype(np.int32)},
        corner_data={"uv": random.random((torus.face_count, 3, 2)).astype(np.float32)},
        materials=materials,
    )
    again = written(tmp_path / f"my file.{kind}", mesh)
    np.testing.assert_array_equal(again.face_data["material"], mesh.face_data["material"])
    np.testing.assert_array_equal(again.corner_data["uv"], mesh.corner_data["uv"])
    np.testing.assert_array_equal(again.vertex_data["color"], mesh.vertex_data["color"].astype(np.float32))
    np.testing.assert_array_equal(again.vertex_data["st"], mesh.vertex_data["st"])
    for found, expected in zip(again.materials, materials, strict=True):
        assert (found.name, found.color, found.alpha_cutoff) == (expected.name, expected.color, expected.alpha_cutoff)
        assert (found.texture and found.texture.data) == (expected.texture and expected.texture.data)
    images = ["image_leaf.png", "image_leaf_2.png", "image_wood.png"]
    if kind == "usdz":
        assert sorted(zipfile.ZipFile(tmp_path / "my file.usdz").namelist())[:3] == images
    else:
        beside = sorted(path.name for path in tmp_path.glob("*.png"))
        assert beside == [name.replace("image", "my_file") for name in images]


def test_one_material_for_all_is_bound_to_the_mesh(tmp_path):
    from pxr import Usd, UsdShade

    box = gk.mesh.box()
    mesh = gk.mesh.TriangleMesh(
        box.vertices,
        box.faces,
        name="materials",
        face_data={"material": np.ones(box.face_count, np.int32)},
        materials=[gk.mesh.Material("unused"), gk.mesh.Material("red", (1.0, 0.0, 0.0, 1.0))],
    )
    again = written(tmp_path / "a.usda", mesh)
    assert [each.name for each in again.materials] == ["red"]
    assert (again.face_data["material"] == 0).all()
    # Whoever refers to the file gets its default prim.
    stage = Usd.Stage.CreateInMemory()
    stage.DefinePrim("/there").GetReferences().AddReference(str(tmp_path / "a.usda"))
    prim = stage.GetPrimAtPath("/there/materials")
    assert len(prim.GetAttribute("points").Get()) == box.vertex_count
    assert UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0].GetPrim().GetDisplayName() == "red"


def test_images_that_not_every_reader_knows_are_left_out_with_a_word(tmp_path):
    box = gk.mesh.box()
    mesh = gk.mesh.TriangleMesh(
        box.vertices,
        box.faces,
        face_data={"material": np.zeros(box.face_count, np.int32)},
        materials=[gk.mesh.Material("m", None, gk.mesh.Texture("a.tga", b"tga"))],
    )
    with pytest.warns(UserWarning, match=r"a\.usda: \.usda does not hold the texture 'a\.tga'; left out"):
        gk.mesh.save(tmp_path / "a.usda", mesh)
    assert gk.mesh.load(tmp_path / "a.usda").materials == (("m", None, None, None),)
