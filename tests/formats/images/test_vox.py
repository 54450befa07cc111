"""Models of MagicaVoxel: colors and places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from tests.formats.images.vox_files import SHAPE, VOXELS, palette, vox_of


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
