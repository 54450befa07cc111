"""What readers leave out is named in one warning, and images of .ply are kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import geokit as gk

PLY = (
    "ply\nformat ascii 1.0\ncomment TextureFile {}\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 2\nproperty list uchar int vertex_indices\nproperty int texnumber\n{}end_header\n"
    "0 0 0\n1 0 0\n0 1 0\n3 0 1 2 0\n3 0 2 1 7\n{}"
)
NRRD = (
    "NRRD0004\ntype: uchar\ndimension: 3\nspace: left-posterior-superior\nsizes: 2 2 2\n"
    "space directions: (1,0,0) (0,1,0) (0,0,1)\nkinds: domain domain domain\nencoding: raw\nspace origin: (0,0,0)\n"
    "Segment0_Name:=liver\nb-value:=a: b\n# note:=no key\n\n"
)
MHA = "ObjectType = Image\nNDims = 3\nPatient = x\nDimSize = 2 2 2\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n"
USD = (
    '#usda 1.0\ndef Mesh "m" {\n point3f[] points = [(0,0,0),(1,0,0),(0,1,0)]\n int[] faceVertexCounts = [3]\n'
    ' int[] faceVertexIndices = [0,1,2]\n string[] primvars:label = ["a","b","c"] (interpolation = "vertex")\n}\n'
)


def vtk_file(path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    surface = pyvista.PolyData.from_regular_faces(np.eye(3), [[0, 1, 2]])
    if path.suffix == ".vti":
        surface = pyvista.ImageData(dimensions=(3, 1, 1))
        surface["number"] = np.arange(3.0)
    if path.suffix == ".vtu":
        surface = surface.cast_to_unstructured_grid()
    surface["label"] = ["a", "b", "c"]
    if path.suffix in (".vtp", ".vtk"):
        surface.field_data["owner"] = ["me"]
        surface.field_data["up_axis"] = ["z"]
    surface.save(path)


def nifti_file(path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(np.ones((2, 2, 2), np.uint8), np.eye(4))
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", b"who"))
    nibabel.save(image, path)


def text_file(text: str):
    return lambda path: path.write_bytes(text.encode() + bytes(8) * (text in (NRRD, MHA)))


CASES = {
    "arrays.vtp": (vtk_file, gk.mesh.load, r"hold no numbers are left out: 'label'.*'owner'"),
    "arrays.vtk": (vtk_file, gk.mesh.load, r"hold no numbers are left out: 'label'.*'owner'"),
    "arrays.vtu": (vtk_file, gk.mesh.load, "hold no numbers are left out: 'label'"),
    "cloud.vtp": (vtk_file, gk.points.load, "hold no numbers are left out: 'label'"),
    "image.vti": (vtk_file, gk.volume.load, "hold no numbers are left out: 'label'"),
    "keys.nrrd": (text_file(NRRD), gk.volume.load, "the keys 'Segment0_Name', 'b-value' of its header are left out"),
    "keys.mha": (text_file(MHA), gk.volume.load, "the keys 'Patient' of its header are left out"),
    "keys.nii": (nifti_file, gk.volume.load, "1 extensions of its header are left out"),
    "words.usda": (text_file(USD), gk.mesh.load, "the array 'label' of /m is left out: it holds no numbers"),
    "edges.ply": (
        text_file(PLY.format("a.png", "element edge 2\nproperty int a\n", "1\n2\n")),
        gk.mesh.load,
        "'a.png' is missing: its texture is left out.*its 2 entries of 'edge' are left out|"
        "its 2 entries of 'edge' are left out.*'a.png' is missing: its texture is left out",
    ),
    "words.npz": (
        lambda path: np.savez(path, points=np.eye(3), label=np.array(["a", "b", "c"])),
        gk.points.load,
        "without a row of numbers for each point are left out: 'label'",
    ),
    "words.npy": (
        lambda path: np.save(path, np.zeros(2, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("label", "U4")])),
        gk.points.load,
        "without a row of numbers for each point are left out: 'label'",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_left_out_is_named(tmp_path: Path, name: str) -> None:
    write, load, message = CASES[name]
    if name.endswith(".usda"):
        pytest.importorskip("pxr")
    write(tmp_path / name)
    with pytest.warns(UserWarning, match=message) as said:
        load(tmp_path / name)
    assert len(said) == 1, [str(one.message) for one in said]
    assert str(said[0].message).count(f"{name}: ") == 1


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_images_of_a_ply_are_its_materials(tmp_path: Path, ending: str) -> None:
    (tmp_path / "a b.png").write_bytes(b"\x89PNG one")
    (tmp_path / "c.png").write_bytes(b"\x89PNG two")
    text = PLY.format("a b.png\ncomment TextureFile c.png", "", "").replace("3 0 2 1 7", "3 0 2 1 1")
    (tmp_path / "t.ply").write_bytes(text.replace("\n", ending).encode())
    mesh = gk.mesh.load(tmp_path / "t.ply")
    assert [(one.name, one.texture.data) for one in mesh.materials] == [
        ("a b.png", b"\x89PNG one"),
        ("c.png", b"\x89PNG two"),
    ]
    assert mesh.face_data["material"].tolist() == [0, 1]
