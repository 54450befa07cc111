"""Models of MagicaVoxel: colors and places."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.formats.images.vox import _default_palette
from tests.formats.images.vox_files import SHAPE, VOXELS, chunk, dictionary, palette, vox_of


def test_colors_and_the_place_of_a_bare_model(tmp_path: Path) -> None:
    (tmp_path / "a.vox").write_bytes(vox_of(1))
    volume = gk.volume.load(tmp_path / "a.vox")
    assert (volume.info.grid_type, volume.info.active_voxel_count) == ("rgba8", 3)
    dense = gk.volume.to_dense(volume, bounds=[[0, 0, 0], np.subtract(SHAPE, 1)], device="cpu").values
    expected = np.zeros((*SHAPE, 4), np.uint8)
    for x, y, z, index in VOXELS:
        expected[x, y, z] = palette()[index - 1]
    np.testing.assert_array_equal(dense, expected)
    np.testing.assert_array_equal(volume.info.transform[:3, 3], [0.5, 0.5, 0.5])


def test_models_lie_where_the_scene_has_them(tmp_path: Path) -> None:
    (tmp_path / "a.vox").write_bytes(vox_of(2, {0: "10 20 30", 1: "-4 0 7"}))
    volumes = gk.volume.load_all(tmp_path / "a.vox")
    assert sorted(volumes) == ["part 0", "part 1"]
    for name, place in (("part 0", [10, 20, 30]), ("part 1", [-4, 0, 7])):
        middle = np.array(place) - np.array(SHAPE) // 2 + 0.5
        np.testing.assert_array_equal(volumes[name].info.transform[:3, 3], middle)


def test_hidden_models_and_those_outside_of_the_scene_are_left_out(tmp_path: Path) -> None:
    """By their nodes, or by their layers, which stand behind the scene."""
    path, places = tmp_path / "a.vox", {0: "10 20 30", 1: "-4 0 7", 2: "0 0 0"}
    layers = b"".join(
        chunk(b"LAYR", struct.pack("<i", layer) + dictionary(_hidden=shown) + struct.pack("<i", -1))
        for layer, shown in ((0, "0"), (2, "1"))
    )
    path.write_bytes(vox_of(4, places, hidden=(0,), more=layers + chunk(b"RGBA", palette().tobytes())))
    with pytest.warns(UserWarning, match="3 of its 4 models are hidden, or not in its scene, and left out"):
        (name, volume), *others = gk.volume.load_all(path).items()
    assert (name, others) == ("part 1", [])
    np.testing.assert_array_equal(volume.info.transform[:3, 3], np.array([-4, 0, 7]) - np.array(SHAPE) // 2 + 0.5)
    path.write_bytes(vox_of(1, {0: "0 0 0"}, hidden=(0,)))
    with pytest.raises(gk.FileFormatError, match="its models are hidden, or not in its scene"):
        gk.volume.load(path)


def test_colors_of_a_file_without_a_palette_are_those_of_the_format(tmp_path: Path) -> None:
    (tmp_path / "a.vox").write_bytes(vox_of(1, more=chunk(b"IMAP", bytes(range(255, -1, -1)))))
    dense = gk.volume.to_dense(gk.volume.load(tmp_path / "a.vox"), device="cpu").values
    # 1, 7 and 255 of the list there.
    assert dense[0, 0, 0].tolist() == [0xFF, 0xFF, 0xFF, 0xFF]
    assert dense[1, 2, 3].tolist() == [0xFF, 0xCC, 0xFF, 0xFF]
    assert dense[4, 5, 6].tolist() == [0x11, 0x11, 0x11, 0xFF]
    colors = _default_palette()
    assert colors.shape == (256, 4)
    named = {2: 0xFFCCFFFF, 37: 0xFFFFFFCC, 215: 0xFF330000, 216: 0xFF0000EE, 226: 0xFF00EE00, 236: 0xFFEE0000}
    for index, color in named.items():
        assert int.from_bytes(colors[index - 1].tobytes(), "little") == color


def test_what_is_not_read_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.vox"
    for content, text in (
        (vox_of(1, {0: "0 0 0"}, turn="17"), "turns a model"),
        (vox_of(1, {1: "0 0 0"}), "repeats or lacks model 1"),
        (vox_of(1)[:-30], "ends within a chunk"),
        (vox_of(1).replace(b"\x05\0\0\0\x06\0\0\0", b"\x04\0\0\0\x06\0\0\0"), "voxels outside its size"),
    ):
        path.write_bytes(content)
        with pytest.raises(gk.FileFormatError, match=rf"a\.vox: .*{text}"):
            gk.volume.load(path)
