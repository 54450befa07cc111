"""Neighbors that are found tile by tile are those of the whole cloud; what cannot be read is named."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

import geokit as gk
from geokit import DeviceMemoryError, FileAccessError, FileFormatError, InputError
from geokit.points.streamed import load_tiles


@pytest.mark.slow
@pytest.mark.parametrize("most", [300, 4000, 100_000])
def test_neighbors_are_those_of_the_whole_cloud(most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load_tiles, "BYTES_PER_POINT", ((1 << 28) - (64 << 20)) // most)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((6000, 3)), 0.05 * rng.random((200, 3)) + 3.0])
    gk.points.save(tmp_path / "a.ply", points)
    tree, seen = cKDTree(points), np.zeros(len(points), int)
    tiles = gk.points.load_tiles(tmp_path / "a.ply", halo=0.06, memory_limit=1 << 28)
    count = 0
    for tile in tiles:
        count += 1
        assert len(tile.points) <= most
        np.testing.assert_array_equal(tile.points, points[tile.indices])
        assert (np.diff(tile.indices) > 0).all()
        rows = tile.indices[tile.own]
        seen[rows] += 1
        found = gk.points.NeighborGrid(tile.points, 0.06, device="cpu").radius_search(tile.points[tile.own])
        expected = tree.query_ball_point(points[rows], 0.06, return_sorted=True)
        for at, wanted in enumerate(expected):
            got = np.sort(tile.indices[found.indices[found.offsets[at] : found.offsets[at + 1]]])
            np.testing.assert_array_equal(got, wanted)
    assert (seen == 1).all()
    assert (count == 1) == (most > 12400)
    assert [file.name for file in tmp_path.iterdir()] == ["a.ply"]


def test_files_are_removed_where_reading_ends_early(tmp_path: Path) -> None:
    gk.points.save(tmp_path / "a.ply", np.random.default_rng(0).random((100, 3)))
    folder = tmp_path / "other"
    folder.mkdir()
    tiles = gk.points.load_tiles(tmp_path / "a.ply", halo=0.1, folder=folder)
    next(tiles)
    assert len(list(folder.iterdir())) == 1
    tiles.close()
    assert not list(folder.iterdir())


def test_no_points_are_no_tiles(tmp_path: Path) -> None:
    gk.points.save(tmp_path / "a.ply", np.zeros((0, 3)))
    assert list(gk.points.load_tiles(tmp_path / "a.ply", halo=0.1)) == []


def test_bad_arguments_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    gk.points.save(path, np.zeros((500, 3)))

    def refused(kind: type[Exception], text: str, source: Any = path, halo: Any = 0.1, **how: Any) -> None:
        with pytest.raises(kind, match=text):
            list(gk.points.load_tiles(source, halo=halo, **how))

    refused(FileAccessError, "no such file", tmp_path / "b.ply")
    refused(InputError, r"\.xyz' is not a streamed point format", tmp_path / "b.xyz")
    refused(InputError, "halo", halo=-1.0)
    refused(InputError, "halo", halo=np.nan)
    refused(InputError, "finite_only", finite_only=0)
    refused(InputError, "memory_limit", memory_limit=1)
    refused(FileAccessError, "none: cannot write there .*name another folder", folder=tmp_path / "none")
    (tmp_path / "c.ply").write_bytes(path.read_bytes()[:-5])
    refused(FileFormatError, r"c\.ply: ends in vertex 499 of the 500", tmp_path / "c.ply")
    monkeypatch.setattr(load_tiles, "BYTES_PER_POINT", ((1 << 28) - (64 << 20)) // 100)
    refused(DeviceMemoryError, "halo: more than 100 points lie within", memory_limit=1 << 28)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=10))
    refused(FileAccessError, "GiB that are free there; name another folder")
