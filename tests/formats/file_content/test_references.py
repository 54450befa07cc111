"""Files that a file refers to are opened only in its own folder and in folders that the caller names."""

from __future__ import annotations

import base64
import functools
import json
import os
from pathlib import Path

import h5py
import numpy as np
import pytest

from geokit import FileAccessError, FileFormatError, InputError, mesh, volume
from geokit.formats.file_content.references import require_inside, set_default_folders

# Most of them start the processes of the readers; the image of each .gltf lies outside.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:.*a texture is left out")]

POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
FACES = np.array([[0, 1, 2]], np.int64)


def _gltf(path: Path, uri: str) -> None:
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
    ]
    content = {
        "asset": {"version": "2.0"}, "buffers": [{"uri": uri, "byteLength": 48}], "bufferViews": views,
        "accessors": accessors, "images": [{"uri": "/etc/passwd"}], "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0,
    }  # fmt: skip
    path.write_text(json.dumps(content))


def _buffer(path: Path) -> None:
    path.write_bytes(POINTS.astype("<f4").tobytes() + FACES.astype("<u4").tobytes())


def _xdmf(path: Path, kind: str, points: str, extra: str = "") -> None:
    path.write_text(
        '<Xdmf Version="3.0"><Domain><Grid Name="g"><Geometry GeometryType="XYZ">'
        f'<DataItem DataType="Float" Dimensions="3 3" Format="{kind}" Precision="8">{points}</DataItem></Geometry>'
        '<Topology TopologyType="Triangle" NumberOfElements="1"><DataItem DataType="Int" Dimensions="1 3" Format="XML" '
        f'Precision="8">0 1 2</DataItem></Topology></Grid>{extra}</Domain></Xdmf>'
    )


def _binary(path: Path) -> None:
    POINTS.astype("<f8").tofile(path)


def _hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["a/points"] = POINTS


def _usda(path: Path, reference: str) -> None:
    path.write_text(f"#usda 1.0\n(\n    subLayers = [@{reference}@]\n)\n")


def _layer(path: Path, metadata: str = "") -> None:
    path.write_text(
        f'#usda 1.0\n(\n    defaultPrim = "m"\n)\ndef Mesh "m" {metadata}\n{{\n    int[] faceVertexCounts = [3]\n'
        "    int[] faceVertexIndices = [0, 1, 2]\n    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]\n}\n"
    )


# Extension, how a file that refers to another is written, and the other file's name and writer.
KINDS = [
    (".gltf", _gltf, "b.bin", _buffer),
    (".xdmf", lambda path, name: _xdmf(path, "Binary", name), "b.bin", _binary),
    (".xdmf", lambda path, name: _xdmf(path, "HDF", f"{name}:/a/points"), "b.h5", _hdf5),
    (".usda", _usda, "b.usda", _layer),
]
IDS = ["gltf", "xdmf-binary", "xdmf-hdf5", "usda"]


@pytest.fixture(params=KINDS, ids=IDS)
def kind(request):
    return request.param


@pytest.fixture(params=[False, True], ids=["in a process of its own", "trusted"])
def load(request):
    return functools.partial(mesh.load, trusted=request.param)


@pytest.fixture
def home(tmp_path):
    folder = tmp_path / "home"
    (folder / "sub").mkdir(parents=True)
    return folder


def test_inside_is_read_from_any_working_folder(load, kind, home, tmp_path, monkeypatch):
    extension, write, name, write_other = kind
    monkeypatch.chdir(tmp_path)
    for place in (name, f"sub/{name}", f"sub/../{name}", str(home / name)):
        write_other(home / place)
        write(home / f"a{extension}", place)
        np.testing.assert_array_equal(load(f"home/a{extension}").vertices, POINTS)
        (home / place).unlink()


@pytest.mark.parametrize("absolute", [False, True])
def test_outside_is_refused_unless_its_folder_is_allowed(load, kind, home, tmp_path, absolute):
    extension, write, name, write_other = kind
    other = tmp_path / "elsewhere"
    other.mkdir()
    write_other(other / name)
    reference = str(other / name) if absolute else f"../elsewhere/{name}"
    path = home / f"a{extension}"
    write(path, reference)
    with pytest.raises(FileAccessError) as caught:
        load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: refers to {reference!r}")
    assert f"reference_folders=[{str(other)!r}]" in message
    np.testing.assert_array_equal(load(path, reference_folders=[other]).vertices, POINTS)
    with pytest.raises(FileAccessError, match="outside its own folder"):
        load(path, reference_folders=[home / "sub"])


def test_symbolic_links_are_resolved(load, kind, home, tmp_path):
    extension, write, name, write_other = kind
    write_other(tmp_path / name)
    (home / name).symlink_to(tmp_path / name)
    (home / "up").symlink_to(tmp_path)
    for reference in (name, f"up/{name}"):
        write(home / f"a{extension}", reference)
        with pytest.raises(FileAccessError, match="outside its own folder"):
            load(home / f"a{extension}")
        assert len(load(home / f"a{extension}", reference_folders=[tmp_path]).faces) == 1


def test_fifos_and_devices_are_not_opened(load, kind, home):
    extension, write, name, _ = kind
    os.mkfifo(home / name)
    write(home / f"a{extension}", name)
    with pytest.raises(FileAccessError, match="not a regular file"):
        load(home / f"a{extension}")
    (home / name).unlink()
    write(home / f"a{extension}", "/dev/zero")
    with pytest.raises(FileAccessError, match="not a regular file"):
        load(home / f"a{extension}", reference_folders=["/dev"])


@pytest.mark.parametrize("place", ["missing.bin", "http://localhost:1/b.bin", "x" * 5000])
def test_missing_files_are_named(home, place):
    for extension, write, *_ in KINDS[:2]:
        write(home / f"a{extension}", place)
        with pytest.raises(FileFormatError, match="which is missing; get it too"):
            mesh.load(home / f"a{extension}")


@pytest.mark.parametrize("uri", ["%2e%2e%2fb.bin", "..%2fb.bin", "file:///etc/passwd", "%2fetc%2fpasswd", "a%00b"])
def test_escaped_uris(home, uri):
    _buffer(home.parent / "b.bin")
    _gltf(home / "a.gltf", uri)
    with pytest.raises((FileAccessError, FileFormatError), match="refers to"):
        mesh.load(home / "a.gltf")


def test_uris_with_spaces_and_with_data(home):
    _buffer(home / "b c.bin")
    for uri in ("b%20c.bin", "b c.bin"):
        _gltf(home / "a.gltf", uri)
        assert len(mesh.load(home / "a.gltf").faces) == 1
    _gltf(home / "a.gltf", "data:;base64," + base64.b64encode((home / "b c.bin").read_bytes()).decode())
    assert len(mesh.load(home / "a.gltf").faces) == 1


def test_items_that_xdmf_finds_by_reference(home, tmp_path):
    _binary(tmp_path / "b.bin")
    item = '<Other DataType="Float" Dimensions="3 3" Format="Binary" Precision="8">../b.bin</Other>'
    _xdmf(home / "a.xdmf", 'XML" Reference="XML', "/Xdmf/Domain/Other", item)
    with pytest.raises(FileAccessError, match="outside its own folder"):
        mesh.load(home / "a.xdmf")


@pytest.mark.parametrize("how", ["external link", "soft link to one", "external storage", "virtual"])
def test_hdf5_files_that_lead_elsewhere(home, tmp_path, how):
    _hdf5(tmp_path / "b.h5")
    _binary(tmp_path / "raw.bin")
    with h5py.File(home / "b.h5", "w") as file:
        group = file.create_group("a")
        if how == "external storage":
            group.create_dataset("points", (3, 3), "<f8", external=[(str(tmp_path / "raw.bin"), 0, 72)])
        elif how == "virtual":
            layout = h5py.VirtualLayout((3, 3), "<f8")
            layout[:] = h5py.VirtualSource(tmp_path / "b.h5", "a/points", (3, 3))
            group.create_virtual_dataset("points", layout)
        elif how == "external link":
            group["points"] = h5py.ExternalLink(tmp_path / "b.h5", "a/points")
        else:
            group["points"] = h5py.SoftLink("/there/points")
            file["there"] = h5py.ExternalLink(tmp_path / "b.h5", "a")
    _xdmf(home / "a.xdmf", "HDF", "b.h5:/a/points")
    with pytest.raises(FileAccessError, match="another file; copy its arrays into one file"):
        mesh.load(home / "a.xdmf")


def test_hdf5_soft_links_within_the_file_are_followed(home):
    with h5py.File(home / "b.h5", "w") as file:
        file["points"] = POINTS
        file.create_group("a")["points"] = h5py.SoftLink("/points")
        file["round"] = h5py.SoftLink("/round")
    _xdmf(home / "a.xdmf", "HDF", "b.h5:/a/points")
    assert len(mesh.load(home / "a.xdmf").faces) == 1
    _xdmf(home / "a.xdmf", "HDF", "b.h5:/round")
    with pytest.raises(FileFormatError, match="circle of links"):
        mesh.load(home / "a.xdmf")


_CLIPS = "(\n    clips = {{\n        dictionary default = {{\n            {}\n        }}\n    }}\n)"
_VARIANT = """(
    variants = {
        string v = "a"
    }
    prepend variantSets = "v"
)
{
    variantSet "v" = {
        "a" (
            references = @../b.usda@
        ) {
        }
    }
}
def "n\""""
_ARCS = {
    "references": "(\n    references = @../b.usda@\n)",
    "payload": "(\n    payload = @../b.usda@\n)",
    "with arguments": "(\n    references = @../b.usda:SDF_FORMAT_ARGS:x=y@\n)",
    "in a variant": _VARIANT,
    "clips": _CLIPS.format("asset[] assetPaths = [@../b.usda@]"),
    "manifest": _CLIPS.format("asset manifestAssetPath = @../b.usda@"),
    "template": _CLIPS.format('string templateAssetPath = "../b.#.usda"'),
}


@pytest.mark.parametrize("arc", _ARCS)
def test_every_way_in_which_usd_opens_layers(home, tmp_path, arc):
    _layer(tmp_path / "b.usda")
    _layer(home / "a.usda", _ARCS[arc])
    with pytest.raises(FileAccessError, match="outside its own folder"):
        mesh.load(home / "a.usda")


def test_usd_layers_of_layers(home, tmp_path):
    _layer(tmp_path / "c.usda")
    _usda(home / "sub" / "b.usda", "../../c.usda")
    _usda(home / "a.usda", "sub/b.usda")
    with pytest.raises(FileAccessError, match="outside its own folder"):
        mesh.load(home / "a.usda")
    _layer(home / "c.usda")
    _usda(home / "sub" / "b.usda", "../c.usda")
    assert len(mesh.load(home / "a.usda").faces) == 1


def test_usd_expressions_are_refused(home, tmp_path):
    _layer(tmp_path / "b.usda")
    _usda(home / "a.usda", '`"../b.usda"`')
    with pytest.raises(FileAccessError, match="usdcat --flatten"):
        mesh.load(home / "a.usda")


def test_usd_textures_are_nobody_s_business(home):
    _layer(home / "a.usda", '{\n    asset texture = @/etc/passwd@\n}\ndef Mesh "n"')
    assert len(mesh.load(home / "a.usda").faces) == 1


def test_material_libraries_of_obj_are_not_opened(home):
    os.mkfifo(home / "a.mtl")
    (home / "a.obj").write_text("mtllib a.mtl /etc/passwd\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    with pytest.warns(
        UserWarning, match=r"'a\.mtl', which is not a regular file.*'/etc/passwd'.*outside its own folder"
    ):
        assert len(mesh.load(home / "a.obj").faces) == 1


def test_images_of_gltf_are_not_opened_outside(home):
    _buffer(home / "b.bin")
    _gltf(home / "a.gltf", "b.bin")
    with pytest.warns(UserWarning, match=r"a\.gltf: a texture is left out: refers to '/etc/passwd'"):
        assert mesh.load(home / "a.gltf").materials[0].texture is None


def test_folders_that_are_none(home):
    _gltf(home / "a.gltf", "b.bin")
    with pytest.raises(InputError, match="reference_folders"):
        mesh.load(home / "a.gltf", reference_folders=str(home))
    with pytest.raises(FileAccessError, match="is not a folder"):
        mesh.load(home / "a.gltf", reference_folders=[home / "none"])


def test_a_folder_whose_name_begins_alike_is_outside(tmp_path):
    path = tmp_path / "home" / "a.xdmf"
    with pytest.raises(FileAccessError):
        require_inside("../home2/b", tmp_path / "home2" / "b", path, [])
    assert require_inside("b", tmp_path / "home" / "b", path, []) == Path(os.path.realpath(tmp_path / "home" / "b"))


def _ome(path: Path, reference: str) -> None:
    """A stack whose second page lies in another file, as its OME says."""
    tifffile = pytest.importorskip("tifffile")
    pages = [("a.ome.tif", 1), (reference, 2)]
    places = "".join(
        f'<TiffData IFD="0" FirstZ="{z}" PlaneCount="1"><UUID FileName="{name}">urn:uuid:{number}</UUID></TiffData>'
        for z, (name, number) in enumerate(pages)
    )
    ome = (
        '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="urn:uuid:1"><Image ID="Image:0"><Pixels '
        'ID="Pixels:0" DimensionOrder="XYZCT" Type="uint8" SizeX="9" SizeY="8" SizeZ="2" SizeC="1" SizeT="1">'
        f'<Channel ID="Channel:0:0" SamplesPerPixel="1"/>{places}</Pixels></Image></OME>'
    )
    tifffile.imwrite(path, np.full((8, 9), 200, np.uint8), metadata=None, description=ome)


@pytest.mark.filterwarnings("ignore:.*reading array from closed file")
def test_pages_of_ome_in_other_files(home, tmp_path):
    """tifffile follows any name, and takes a file that it cannot open for zeros."""
    tifffile = pytest.importorskip("tifffile")
    path, outside = home / "a.ome.tif", tmp_path / "b.ome.tif"
    tifffile.imwrite(outside, np.full((8, 9), 7, np.uint8), metadata=None)
    (home / "link.ome.tif").symlink_to(outside)
    os.mkfifo(home / "fifo.ome.tif")
    for reference in (str(outside), "../b.ome.tif", "..&#47;b.ome.tif", "link.ome.tif"):
        _ome(path, reference)
        for call in (volume.load, volume.inspect):
            with pytest.raises(FileAccessError, match=r"a\.ome\.tif: refers to .*\), outside its own folder"):
                call(path)
    _ome(path, "fifo.ome.tif")
    with pytest.raises(FileAccessError, match=r"refers to 'fifo\.ome\.tif', which is not a regular file"):
        volume.load(path)
    _ome(path, "../b.ome.tif")
    set_default_folders([tmp_path])
    try:
        assert volume.load(path).info.active_voxel_count == 144
    finally:
        set_default_folders([])
    outside.rename(home / "b.ome.tif")
    _ome(path, "b.ome.tif")
    values = volume.to_dense(volume.load(path), device="cpu").values
    assert values[..., 0].min() == 200
    assert values[..., 1].max() == 7
