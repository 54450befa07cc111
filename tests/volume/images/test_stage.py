"""Volumes of USD stages: written and read again, placed by their prims, and refused where they are something else."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit import native
from geokit.cli import main
from geokit.errors import FileAccessError, FileFormatError, InputError, UnsupportedGridError
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches

pytest.importorskip("pxr")
pytestmark = [
    pytest.mark.slow,  # processes that import usd-core
    pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB"),
]

RNG = np.random.default_rng(3)
PLACE = np.array([[0.5, 0, 0, 1.0], [0, 0.5, 0, 2.0], [0, 0, 0.5, 3.0], [0, 0, 0, 1.0]])
DENSITY = gk.volume.from_dense(RNG.random((9, 8, 7), np.float32), transform=PLACE, name="density")
VELOCITY = gk.volume.from_dense(RNG.random((4, 4, 4, 3), np.float32), voxel_size=0.25, name="vel.x")
STAGE = """#usda 1.0
(
    defaultPrim = "world"
    metersPerUnit = {meters}
    upAxis = "{up}"
)
def Xform "world" ({head})
{{
    double3 xformOp:translate = (10, 20, 30)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Volume "smoke" {{
        rel field:density = <density>
        double3 xformOp:scale = (2, 2, 2)
        float xformOp:rotateZ = 90
        uniform token[] xformOpOrder = ["xformOp:scale", "xformOp:rotateZ"]
        def OpenVDBAsset "density" {{
            {field}
        }}
    }}
    {more}
}}
"""


def stage(path: Path, file: str, field: str = 'token fieldName = "density"', **more: str) -> Path:
    given = {"meters": "0.01", "up": "Z", "head": "", "more": "", **more}
    path.write_text(STAGE.format(field=f"asset filePath = @{file}@\n{field}" if file else field, **given))
    return path


@pytest.fixture
def home(tmp_path: Path) -> Path:
    (tmp_path / "home" / "sub").mkdir(parents=True)
    gk.volume.save(tmp_path / "home" / "sub" / "a.vdb", DENSITY, VELOCITY)
    return tmp_path / "home"


@pytest.mark.parametrize("kind", ["usd", "usda", "usdc", "usdz"])
def test_volumes_come_back(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a.{kind}"
    gk.volume.save(path, DENSITY, VELOCITY, codec="zip")
    assert sorted(one.name for one in tmp_path.iterdir()) == [path.name] + ["a_grids.vdb"] * (kind != "usdz")
    found = gk.volume.load_all(path)
    # What USD does not take in names is an underscore.
    assert list(found) == ["density", "vel_x"]
    for volume, given in zip(found.values(), (DENSITY, VELOCITY), strict=True):
        np.testing.assert_array_equal(volume.info.transform, given.info.transform)
        np.testing.assert_array_equal(volume.to_dense().values, given.to_dense().values)
    assert gk.volume.load(path, trusted=True).info.name == "density"
    assert [info.grid_type for info in gk.volume.inspect(path)] == ["float", "vec3f"]


def test_usd_itself_finds_what_is_written(tmp_path: Path) -> None:
    from pxr import Usd, UsdVol

    gk.volume.save(tmp_path / "a.usdz", DENSITY, VELOCITY)
    found = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    volume = UsdVol.Volume(found.GetPrimAtPath("/root/volume"))
    paths = volume.GetFieldPaths()
    assert sorted(paths) == ["density", "vel_x"]
    assets = [UsdVol.OpenVDBAsset(found.GetPrimAtPath(paths[name])) for name in ("density", "vel_x")]
    assert [one.GetFieldNameAttr().Get() for one in assets] == ["density", "vel.x"]
    assert [one.GetFieldDataTypeAttr().Get() for one in assets] == ["float", "float3"]
    assert assets[0].GetFilePathAttr().Get().resolvedPath.endswith("a.usdz[a_grids.vdb]")
    np.testing.assert_allclose(volume.GetExtentAttr().Get(), [[0, 0, 0], [5, 5.5, 6]], rtol=1e-6)


@pytest.mark.parametrize("is_trusted", [False, True])
def test_prims_place_their_fields(home: Path, is_trusted: bool) -> None:
    path = stage(home / "a.usda", "./sub/a.vdb")
    volume = gk.volume.load(path, trusted=is_trusted)
    # Scaled last, turned first: (x, y, z) goes to (-2 y, 2 x, 2 z) and is moved.
    matrix = np.array([[0, -2, 0, 10], [2, 0, 0, 20], [0, 0, 2, 30], [0, 0, 0, 1.0]])
    np.testing.assert_allclose(volume.info.transform, matrix @ PLACE, rtol=1e-15, atol=1e-15)
    check_grid(volume.nanovdb, "a")
    assert checksum_matches(volume.nanovdb)
    inside = np.array([[2.0, 3.0, 4.0], [3.7, 4.1, 5.2]])
    world = inside @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(volume.sample(world), DENSITY.sample(inside), rtol=1e-6)
    assert (volume.info.metadata["geokit:unit"], volume.info.metadata["geokit:up_axis"]) == ("cm", "z")
    (info,) = gk.volume.inspect(path)
    np.testing.assert_array_equal(info.transform, volume.info.transform)
    gk.volume.save(home / "b.usdc", volume)
    again = gk.volume.load(home / "b.usdc")
    np.testing.assert_array_equal(again.info.transform, volume.info.transform)
    assert (again.info.metadata["geokit:unit"], again.info.metadata["geokit:up_axis"]) == ("cm", "z")


def test_units_without_a_name_are_kept(home: Path) -> None:
    volume = gk.volume.load(stage(home / "a.usda", "./sub/a.vdb", meters="0.0254", up="Y"))
    assert volume.info.metadata["geokit:meters_per_unit"] == 0.0254
    gk.volume.save(home / "b.usda", volume)
    text = (home / "b.usda").read_text()
    assert "metersPerUnit = 0.0254" in text
    assert 'upAxis = "Y"' in text


def test_hidden_prims_are_left_out_and_other_assets_are_said(home: Path) -> None:
    more = """
    def Volume "hidden" { rel field:density = </world/smoke/density>
        token visibility = "invisible"
    }
    def Volume "second" { rel field:density = </world/smoke/density>
        rel field:heat = <heat>
        def Field3DAsset "heat" { asset filePath = @./heat.f3d@
        }
    }"""
    path = stage(home / "a.usda", "./sub/a.vdb", more=more)
    with pytest.warns(UserWarning, match=r"a\.usda: field heat is no OpenVDBAsset, left out"):
        assert list(gk.volume.load_all(path)) == ["density", "density[1]"]


def test_files_outside_are_refused(home: Path) -> None:
    (home / "sub" / "a.vdb").rename(home.parent / "a.vdb")
    for file in ("../a.vdb", str(home.parent / "a.vdb")):
        for is_trusted in (False, True):
            with pytest.raises(FileAccessError, match=r"a\.usda: refers to .*outside its own folder"):
                gk.volume.load(stage(home / "a.usda", file), trusted=is_trusted)
    (home / "link.vdb").symlink_to(home.parent / "a.vdb")
    with pytest.raises(FileAccessError, match="outside its own folder"):
        gk.volume.load(stage(home / "a.usda", "link.vdb"))


@pytest.mark.parametrize(
    ("file", "field", "error", "message"),
    [
        ("./b.vdb", "", FileAccessError, r"a\.usda: refers to './b\.vdb', and there is no such file"),
        ("", "", FileFormatError, r"a\.usda: /world/smoke/density names no file; set its filePath"),
        ("./sub/a.vdb", 'token fieldName = "heat"', InputError, r"a\.usda: field 'density' \(a\.vdb\): no grid named"),
        ("./sub/a.vdb", "", None, "the grid called density"),
        ("./text.vdb", "", FileFormatError, r"a\.usda: field 'density' \(text\.vdb\): not a sound \.vdb file"),
        ("./empty.vdb", "", FileFormatError, r"a\.usda: field 'density' \(empty\.vdb\)"),
        ("./sub/a.vdb", "double3 xformOp:scale = (0, 1, 1)\nuniform token[] xformOpOrder = [\"xformOp:scale\"]",
         UnsupportedGridError, r"a\.usda: field 'density': .*not a finite, invertible affine map"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_named(home: Path, file: str, field: str, error: type | None, message: str) -> None:
    (home / "text.vdb").write_text("no grids here, only some text of more than a header's size")
    (home / "empty.vdb").touch()
    path = stage(home / "a.usda", file, field)
    if error is None:
        assert gk.volume.load(path).info.name == "density"
        return
    with pytest.raises(error, match=message):
        gk.volume.load(path)


def test_stages_without_volumes_name_what_they_hold(tmp_path: Path) -> None:
    gk.mesh.save(tmp_path / "a.usda", mesh_catalog.l_profile())
    with pytest.raises(FileFormatError, match=r"no visible Volume prim.*it holds Mesh: load it with geokit\.mesh"):
        gk.volume.load(tmp_path / "a.usda")
    gk.volume.save(tmp_path / "b.usda", DENSITY)
    with pytest.raises(FileFormatError, match=r"it holds Volume; load its fields with geokit\.volume"):
        gk.mesh.load(tmp_path / "b.usda")


def test_a_mesh_beside_volumes_is_a_mesh_and_that_is_said(home: Path) -> None:
    path = stage(home / "a.usda", "./sub/a.vdb", more='def Cube "cube" { }')
    with pytest.warns(UserWarning, match=r"a\.usda: its volumes are left out; geokit\.volume\.load reads them"):
        mesh = gk.mesh.load(path)
    np.testing.assert_array_equal(mesh.bounds, [[9, 19, 29], [11, 21, 31]])
    assert gk.volume.load(path).info.name == "density"


def test_names_in_no_encoding_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="only names in UTF-8"):
        gk.volume.save(tmp_path / "mod\udce8le.usda", DENSITY)
    named = gk.volume.from_dense(np.ones((2, 2, 2), np.float32), voxel_size=1.0, name="\udce8")
    with pytest.raises(InputError, match="only names in UTF-8"):
        gk.volume.save(tmp_path / "a.usdz", named)
    assert list(tmp_path.iterdir()) == []


def test_a_compressed_archive_is_refused(tmp_path: Path) -> None:
    gk.volume.save(tmp_path / "a.usdz", DENSITY)
    with zipfile.ZipFile(tmp_path / "a.usdz") as old, zipfile.ZipFile(tmp_path / "b.usdz", "w") as new:
        for entry in old.infolist():
            how = zipfile.ZIP_DEFLATED if entry.filename.endswith(".vdb") else zipfile.ZIP_STORED
            new.writestr(entry.filename, old.read(entry), compress_type=how)
    with pytest.raises(FileFormatError, match=r"b\.usdz: .*"):
        gk.volume.load(tmp_path / "b.usdz")


def test_the_command_line(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = stage(home / "a.usda", "./sub/a.vdb")
    assert main(["info", str(path)]) == 0
    assert "geokit:up_axis" in capsys.readouterr().out
    assert main(["convert", str(path), str(home / "b.nvdb")]) == 0
    assert main(["convert", str(home / "b.nvdb"), str(home / "c.usdz"), "--kind", "volume"]) == 0
    assert gk.volume.load(home / "c.usdz").info.name == "density"
    assert main(["info", str(home / "c.usdz")]) == 0
    assert "density" in capsys.readouterr().out
    assert main(["convert", str(home / "b.nvdb"), str(home / "c.ply"), "--kind", "volume"]) == 1
    assert "--kind: .ply files are no volume" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("field", "grid_type"),
    [('token fieldName = "vel.x"', "vec3f"), ('token fieldName = "density"', "float"), ("", "float")],
)
def test_inspect_tells_of_the_grid_that_a_field_names(home: Path, field: str, grid_type: str) -> None:
    path = stage(home / "a.usda", "./sub/a.vdb", field)
    assert [info.grid_type for info in gk.volume.inspect(path)] == [grid_type]
