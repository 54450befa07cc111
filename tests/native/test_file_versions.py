"""Versions of OpenVDB's file format: those of other OpenVDBs are read, and what it logs stays out of the answer."""

from __future__ import annotations

import contextlib
import struct
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit import native
from geokit.cli import main
from geokit.native import _openvdb
from geokit.native._worker import LAST_VERSION

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

# OpenVDB's versions since 2013 differ in grids of points, in Blosc, and in grids of half floats, of which none is here.
EQUAL = [(222, "zip"), (223, "none"), (224, "blosc"), (LAST_VERSION, "blosc"), (LAST_VERSION, "zip")]
LATER = [LAST_VERSION + 1, 0xFFFFFFFF]


@pytest.fixture(scope="module")
def field() -> gk.volume.SparseVolume:
    values = np.random.default_rng(5).normal(size=(6, 7, 8)).astype(np.float32)
    return gk.volume.from_dense(values, voxel_size=0.5, name="field")


def of_version(path: Path, version: int) -> None:
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, 8, version)
    path.write_bytes(content)


@contextlib.contextmanager
def nothing_said(capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    capfd.readouterr()
    yield
    assert capfd.readouterr() == ("", "")


@pytest.fixture(params=["worker", "kept process", "trusted"])
def load(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> dict[str, bool]:
    """How a file is read, as options."""
    monkeypatch.setattr(_openvdb, "FIRST_FILES", 0 if request.param == "kept process" else sys.maxsize)
    return {"trusted": request.param == "trusted"}


@pytest.mark.parametrize(("version", "codec"), EQUAL)
def test_known_versions_are_the_same_file(version, codec, field, load, tmp_path, capfd):
    path = tmp_path / "a.vdb"
    gk.volume.save(path, field, codec=codec)
    expected = gk.volume.load(path).nanovdb
    of_version(path, version)
    with nothing_said(capfd):
        assert np.array_equal(gk.volume.load(path, **load).nanovdb, expected)
        assert np.array_equal(gk.volume.load_all(path, **load)["field"].nanovdb, expected)
        (info,) = gk.volume.inspect(path)
    assert (info.name, info.active_voxel_count) == ("field", field.info.active_voxel_count)


@pytest.mark.parametrize("version", LATER)
def test_later_versions_are_read_with_one_warning(version, field, load, tmp_path, capfd):
    path = tmp_path / "a.vdb"
    gk.volume.save(path, field)
    expected = gk.volume.load(path).nanovdb
    of_version(path, version)
    said = rf"a\.vdb: its format has version {version}, {LAST_VERSION} is the last that geokit knows"
    with nothing_said(capfd), pytest.warns(UserWarning, match=said) as given:
        assert np.array_equal(gk.volume.load(path, **load).nanovdb, expected)
    assert len(given) == 1
    assert given[0].filename == __file__
    with nothing_said(capfd), pytest.warns(UserWarning, match=said) as given:
        gk.volume.inspect(path)
    assert len(given) == 1


@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize("version", [LAST_VERSION, LAST_VERSION + 1])
def test_points_of_later_versions(version, trusted, tmp_path, capfd):
    path, points = tmp_path / "a.vdb", np.random.default_rng(1).random((50, 3))
    gk.points.save(path, points)
    expected = gk.points.load(path).points
    of_version(path, version)
    with nothing_said(capfd), warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        found = gk.points.load(path, trusted=trusted).points
    assert np.array_equal(found, expected)
    assert len(given) == (version > LAST_VERSION)


def test_the_command_line_reads_them(field, tmp_path, capfd):
    path, outs = tmp_path / "a.vdb", [tmp_path / "before.nvdb", tmp_path / "after.nvdb"]
    gk.volume.save(path, field)
    said = []
    for version, out in zip((224, LAST_VERSION), outs, strict=True):
        of_version(path, version)
        assert main(["info", "--json", str(path)]) == 0
        said.append(capfd.readouterr())
        assert main(["convert", str(path), str(out)]) == 0
        assert capfd.readouterr().err == ""
    assert said[0] == said[1]
    assert outs[0].read_bytes() == outs[1].read_bytes()


def test_what_libraries_print_is_no_part_of_the_answer(field, tmp_path, monkeypatch):
    """Debian's Blosc prints what the processor can do where this variable is set."""
    monkeypatch.setenv("BLOSC_PRINT_SHUFFLE_ACCEL", "1")
    path = tmp_path / "a.vdb"
    gk.volume.save(path, field, codec="blosc")
    command = [_openvdb._worker_path(), "read", str(1 << 30), "60", path, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.stdout.startswith('{"grids"')
    assert done.stdout.count("\n") == 1
    expected = gk.volume.load(path).nanovdb
    monkeypatch.delenv("BLOSC_PRINT_SHUFFLE_ACCEL")
    assert np.array_equal(gk.volume.load(path).nanovdb, expected)


def test_short_and_damaged_headers_keep_their_messages(tmp_path):
    for content in (b"x", b"x" * 100, struct.pack("<QI", 0x56444220, LAST_VERSION)):
        path = tmp_path / "a.vdb"
        path.write_bytes(content)
        for trusted in (False, True):
            with pytest.raises(gk.FileFormatError, match=r"a\.vdb: not a sound \.vdb file: its headers (end|cannot)"):
                native.read_vdb(path, trusted=trusted)
