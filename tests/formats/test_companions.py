"""Files beside a mesh file: a save replaces those of the file that it replaces, and none of another file."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.mesh import Material, Texture, TriangleMesh
from tests.support.attributed import PNG

FOREIGN = b"of another program"


def wooden(image: bytes = PNG) -> TriangleMesh:
    return TriangleMesh(
        np.eye(3),
        [[0, 1, 2]],
        vertex_data={"uv": np.zeros((3, 2))},
        face_data={"material": np.zeros(1, int)},
        materials=[Material("wood", (1.0, 0.5, 0.0, 1.0), Texture("wood.png", image))],
    )


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("taken", ["a.mtl", "a_wood.png"])
@pytest.mark.parametrize("old", [None, b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", b"mtllib b.mtl\n"])
def test_files_that_the_old_obj_does_not_name_stay(tmp_path, taken, old):
    (tmp_path / taken).write_bytes(FOREIGN)
    if old is not None:
        (tmp_path / "a.obj").write_bytes(old)
    with pytest.warns(UserWarning, match=r"a\.obj: files that it does not refer to .*'a_2_wood\.png', 'a_2\.mtl'"):
        gk.mesh.save(tmp_path / "a.obj", wooden())
    assert (tmp_path / taken).read_bytes() == FOREIGN
    assert contents(tmp_path).keys() == {taken, "a.obj", "a_2.mtl", "a_2_wood.png"}
    assert gk.mesh.load(tmp_path / "a.obj").materials[0].texture.data == PNG
    # The next save finds its own files.
    other = PNG + b"\0"
    with pytest.warns(UserWarning, match="does not refer to"):
        gk.mesh.save(tmp_path / "a.obj", wooden(other))
    assert contents(tmp_path).keys() == {taken, "a.obj", "a_2.mtl", "a_2_wood.png"}
    assert gk.mesh.load(tmp_path / "a.obj").materials[0].texture.data == other


def test_a_library_that_two_stems_share_is_not_replaced(tmp_path):
    gk.mesh.save(tmp_path / "my part.obj", wooden())
    before = contents(tmp_path)
    with pytest.warns(UserWarning, match="does not refer to"):
        gk.mesh.save(tmp_path / "my_part.obj", wooden(PNG + b"\0"))
    assert before.items() <= contents(tmp_path).items()
    assert gk.mesh.load(tmp_path / "my part.obj").materials[0].texture.data == PNG


@pytest.mark.parametrize("kind", [".obj", pytest.param(".usda", marks=pytest.mark.slow)])
def test_a_file_s_own_companions_are_replaced(tmp_path, kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for image in (PNG, PNG + b"\0"):
            gk.mesh.save(tmp_path / f"a{kind}", wooden(image))
            assert gk.mesh.load(tmp_path / f"a{kind}").materials[0].texture.data == image
    names = {"a.obj", "a.mtl", "a_wood.png"} if kind == ".obj" else {"a.usda", "a_wood.png"}
    assert contents(tmp_path).keys() == names


@pytest.mark.slow
def test_images_that_the_old_usd_does_not_name_stay(tmp_path):
    (tmp_path / "a_wood.png").write_bytes(FOREIGN)
    (tmp_path / "a.usda").write_bytes(b"damaged")
    with pytest.warns(UserWarning, match=r"a\.usda: files that it does not refer to .*'a_2_wood\.png'"):
        gk.mesh.save(tmp_path / "a.usda", wooden())
    assert (tmp_path / "a_wood.png").read_bytes() == FOREIGN
    assert gk.mesh.load(tmp_path / "a.usda").materials[0].texture.data == PNG
